import numpy as np

from uwb_tdoa_tools.localizing.localize import write_tum


def test_one_line_per_pose(tmp_path):
    path = tmp_path / "made" / "for" / "it.tum"
    t = np.array([1700000000.123456, 1700000000.128456])
    p, q = (
        np.array([[1.0, -2.0, 3.25], [0.0, 0.5, 1e-7]]),
        np.array([[0.0, 0.0, 0.6, 0.8], [np.nan] * 4]),
    )
    write_tum(path, t, p, q)
    lines = path.read_text().splitlines()
    assert (
        lines[0]
        == "1700000000.123456001 1.000000 -2.000000 3.250000 0.000000 0.000000 0.600000 0.800000"
    )
    assert [len(line.split()) for line in lines] == [8, 8]
    read = np.loadtxt(path)
    np.testing.assert_allclose(read[:, 0], t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read[:, 1:4], p, atol=1e-6)
    np.testing.assert_array_equal(read[1, 4:], [0, 0, 0, 1])  # unknown becomes the identity


def test_no_poses(tmp_path):
    write_tum(tmp_path / "none.tum", np.empty(0), np.empty((0, 3)), np.empty((0, 4)))
    assert (tmp_path / "none.tum").read_text() == ""
