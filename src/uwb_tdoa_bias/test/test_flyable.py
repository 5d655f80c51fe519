from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flyable import FlyableVolume

ANCHORS = Anchors.from_positions([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3]], ids=[3, 1, 7, 5])
CELLS = np.random.default_rng(0).random((5, 4, 3)) < 0.5
BOUND = np.where(CELLS, np.arange(60.0).reshape(5, 4, 3), np.inf)


def volume(**changes):
    fields = {"lower": [-1.0, 0.0, 0.5], "step": [0.5, 0.5, 0.25], "flyable": CELLS, "bound": BOUND}
    if "flyable" in changes:
        fields["bound"] = np.ones(changes["flyable"].shape)
    return FlyableVolume(
        **{**fields, "ids": ANCHORS.ids, "positions": ANCHORS.positions, **changes}
    )


@given(st.tuples(*[st.floats(-3, 4)] * 3))
def test_contains_looks_into_the_right_cell(p):
    inside = -1.0 <= p[0] < 1.5 and 0.0 <= p[1] < 2.0 and 0.5 <= p[2] < 1.25
    wanted = inside and CELLS[int((p[0] + 1.0) // 0.5), int(p[1] // 0.5), int((p[2] - 0.5) // 0.25)]
    assert volume().contains(p) == wanted
    assert np.isfinite(volume().bound_at(p)) == wanted and np.isnan(volume().bound_at(p)) == (
        not inside
    )


def test_a_planar_one_asks_for_no_height():
    flat = volume(flyable=np.ones((5, 4, 1), bool), planar=True)
    assert flat.contains([[0.0, 1.0, 99.0], [0.0, 9.0, 0.6]]).tolist() == [True, False]
    assert not volume(flyable=np.ones((5, 4, 1), bool)).contains([0.0, 1.0, 99.0])


def test_a_saved_one_comes_back(tmp_path):
    file = tmp_path / "flyable.npz"
    volume(frame="hall", planar=False).save(file)
    back = FlyableVolume.load(file)
    assert (back.frame, back.planar) == ("hall", False)
    for name in ("lower", "step", "flyable", "bound", "ids", "positions"):
        np.testing.assert_array_equal(getattr(back, name), getattr(volume(), name))


def test_it_knows_its_anchors():
    assert volume().belongs_to(ANCHORS)
    order = [2, 0, 3, 1]
    assert volume().belongs_to(
        Anchors.from_positions(ANCHORS.positions[order] + 0.05, ANCHORS.ids[order])
    )
    assert not volume().belongs_to(Anchors.from_positions(ANCHORS.positions + 0.2, ANCHORS.ids))
    assert not volume().belongs_to(Anchors.from_positions(ANCHORS.positions, [3, 1, 7, 6]))
    assert not volume().belongs_to(Anchors.from_positions(ANCHORS.positions[:3], ANCHORS.ids[:3]))
    assert not volume().belongs_to(
        Anchors.from_positions(ANCHORS.positions, ANCHORS.ids, frame="hall")
    )


def test_other_files_are_refused(tmp_path):
    for name, content in (
        ("none", None),
        ("empty", b""),
        ("text", b"flyable: all"),
        ("zip", b"PK\x03\x04 cut"),
    ):
        file = tmp_path / name
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(InputError, match="is no flyable volume"):
            FlyableVolume.load(file)
    np.savez(tmp_path / "other.npz", lower=np.zeros(3))
    with pytest.raises(InputError, match="is no flyable volume"):
        FlyableVolume.load(tmp_path / "other.npz")
    for wrong in ({"step": [0.1, 0.1]}, {"bound": np.ones((5, 4, 2))}):
        with pytest.raises(InputError, match="do not fit together"):
            volume(**wrong)
    negative, unknown = np.full((5, 4, 3), -1.0), np.full((5, 4, 3), np.nan)
    for wrong in (
        {"step": [0.1, 0.1, 0.0]},
        {"lower": [0.0, np.nan, 0.0]},
        {"bound": negative},
        {"bound": unknown},
    ):
        with pytest.raises(
            InputError, match="not finite, a step that is not above 0 or a bound below 0"
        ):
            volume(**wrong)
