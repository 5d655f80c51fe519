from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import BiasMap
from uwb_tdoa_ekf.debias.bias_map import FADE, INTERPOLATORS


def make_map(d=3, n=4, step=0.5, bias=None, **fields):
    cell = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    at = step * cell
    bias = np.tile([0.1, -0.2, 0.3][:d], (len(at), 1)) if bias is None else bias(at)
    added = 0.01 * np.eye(d)
    return BiasMap(
        cell, at, bias, np.full(at.shape, 0.05), np.full(len(at), 50), added, step, **fields
    )


def outside(x, d=3):
    """A place `x` m beyond the middle of the face x = 1.5 m of the hull."""
    return np.array([[1.5 + x, 0.75, 0.75 if d == 3 else 9.0]])


@pytest.mark.parametrize("d", [2, 3])
def test_inside_the_bias_is_taken_out_and_the_map_s_own_error_added(d):
    one = make_map(d)
    p = np.random.default_rng(1).uniform(0.2, 1.3, (50, 3))
    found, covariance, validity = one.correct(p, np.tile(0.04 * np.eye(3), (50, 1, 1)))
    assert (validity == 1.0).all()
    expected = np.array([0.1, -0.2, 0.3]) * (np.arange(3) < d)
    np.testing.assert_allclose(p - found, np.tile(expected, (50, 1)), atol=1e-9)
    np.testing.assert_allclose(
        covariance, np.tile(np.diag(0.04 + 0.01 * (np.arange(3) < d)), (50, 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize("interpolator", INTERPOLATORS)
def test_outside_of_the_hull_the_correction_fades_and_the_covariance_grows(interpolator):
    one = make_map(interpolator=interpolator)
    before = 0.04 * np.eye(3)[None]
    corrections, traces = [], []
    for x in (-0.1, 0.25 * FADE, 0.5 * FADE, 0.75 * FADE, FADE, 10.0):
        p = outside(x)
        found, covariance, validity = one.correct(p, before)
        corrections.append(np.linalg.norm(found - p))
        traces.append(np.trace(covariance[0]))
        assert validity == pytest.approx(np.clip(1.0 - x / FADE, 0.0, 1.0))
        assert (np.linalg.eigvalsh(covariance[0] - before[0]) > -1e-12).all()
    assert (np.diff(corrections) <= 1e-12).all() and corrections[-2] == corrections[-1] == 0.0
    assert traces[-1] == pytest.approx(
        0.12 + 0.1**2 + 0.2**2 + 0.3**2
    )  # the bias that was not taken out
    assert traces[-1] > traces[0]


def test_a_hole_in_the_markers_is_not_known():
    cell = np.array([[0, 0], [0, 1], [1, 0], [10, 0], [10, 1], [9, 0], [5, 9]])
    one = BiasMap(
        cell, 0.5 * cell, np.full((7, 2), 0.1), np.full((7, 2), 0.1), np.full(7, 9), np.eye(2), 0.5
    )
    assert (
        one.validity(np.array([[0.2, 0.2, 0.0]])) == 1.0
        and one.validity(np.array([[2.5, 1.0, 0.0]])) == 0.0
    )


def test_a_smooth_field_is_found_between_the_markers():
    def field(at):
        return 0.2 * np.stack(
            [np.sin(at[:, 0]), np.cos(at[:, 1]), np.sin(at[:, 0] + at[:, 2])], axis=1
        )

    p = np.random.default_rng(3).uniform(0.2, 1.3, (100, 3))
    assert np.abs(make_map(bias=field).bias_at(p) - field(p)).max() < 0.01


def test_a_planar_map_leaves_z(tmp_path):
    one = make_map(2)
    p = np.array([[0.7, 0.7, 5.0]])
    assert one.planar and one.correct(p, np.zeros((1, 3, 3)))[0][0, 2] == 5.0


@pytest.mark.parametrize("interpolator", INTERPOLATORS)
def test_file(tmp_path, interpolator):
    anchors = Anchors.from_positions(np.arange(12.0).reshape(4, 3), [7, 3, 5, 9], "hall")
    one = make_map(
        interpolator=interpolator,
        frame="hall",
        source="traj1",
        ids=anchors.ids,
        positions=anchors.positions,
    )
    one.save(tmp_path / "map.npz")
    again = BiasMap.load(tmp_path / "map.npz")
    p = np.random.default_rng(3).uniform(-1.0, 3.0, (100, 3))
    np.testing.assert_array_equal(again.bias_at(p), one.bias_at(p))
    assert (again.frame, again.source, again.interpolator, again.step) == (
        "hall",
        "traj1",
        interpolator,
        0.5,
    )
    moved, order = anchors.positions + [0.0, 0.0, 0.2], [2, 0, 3, 1]
    assert again.belongs_to(anchors.only(order)) and again.belongs_to(
        anchors.at(anchors.positions + 0.05)
    )
    for other in (
        anchors.at(moved),
        anchors.only([0, 1, 2]),
        Anchors.from_positions(anchors.positions, [7, 3, 5, 8], "hall"),
    ):
        assert not again.belongs_to(other)
    assert not again.belongs_to(
        Anchors.from_positions(anchors.positions, anchors.ids)
    ) and not make_map().belongs_to(anchors)
    with np.load(tmp_path / "map.npz") as content:
        assert int(content["version"]) == 2 and "metres" in str(content["units"])


def test_what_is_no_map_is_refused(tmp_path):
    file = tmp_path / "map.npz"
    for content in (b"", b"something else", b"PK\x03\x04 cut"):
        file.write_bytes(content)
        with pytest.raises(InputError, match="is no position bias map .* make one with"):
            BiasMap.load(file)
    with pytest.raises(InputError, match="nowhere.npz"):
        BiasMap.load(tmp_path / "nowhere.npz")
    make_map().save(file)
    with np.load(file) as content:
        fields = dict(content)
    np.savez(file, **{**fields, "version": 1})
    with pytest.raises(InputError, match="version 1"):
        BiasMap.load(file)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"bias": np.zeros((3, 3))}, "do not fit together"),
        ({"ids": np.arange(3)}, "ids and positions"),
        ({"step": 0.0}, "step"),
        ({"added": np.full((3, 3), np.nan)}, "not finite"),
        ({"added": -np.eye(3)}, "variance below 0"),
        ({"added": np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "not symmetric"),
        ({"std": -make_map().std}, "deviation or a variance below 0"),
        ({"count": 0 * make_map().count}, "no measurements"),
        ({"bias": 1e9 * make_map().bias}, "more than 100000 m"),
        ({"interpolator": "spline"}, "interpolator: 'spline'"),
        ({"at": make_map().at * [1.0, 1.0, 0.0]}, "lie in one plane: make a planar map"),
    ],
)
def test_fields_that_make_no_map_are_refused(change, named):
    with pytest.raises(InputError, match=named):
        replace(make_map(), **change)
