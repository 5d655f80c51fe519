# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The position bias map: markers, map, file and fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.debias import (
    FADE,
    BiasMap,
    Markers,
    Part,
    collect,
    corrected_bias,
    fit,
)

STEP = 0.5


def grid(n):
    cell = np.stack(np.meshgrid(range(n), range(n), indexing="ij"), axis=-1).reshape(-1, 2)
    return cell, STEP * cell


# --- markers ---


def test_each_surveyed_point_is_a_marker_with_its_statistics():
    rng = np.random.default_rng(1)
    places = grid(3)[1] + 0.3
    true = np.repeat(places, 20, axis=0)
    measured = true + 0.1 * rng.standard_normal(true.shape)
    found = collect([Part(measured, true)], STEP)
    np.testing.assert_allclose(found.true, places)
    np.testing.assert_allclose(found.bias, (measured - true).reshape(-1, 20, 2).mean(axis=1))
    np.testing.assert_allclose(found.std, measured.reshape(-1, 20, 2).std(axis=1))


def test_a_path_is_cut_into_cells_and_thin_ones_are_left_out():
    true = np.column_stack([np.linspace(0.0, 1.9, 191), np.zeros(191)])
    found = collect([Part(true + [0.1, -0.2], true)], STEP, least=30)
    np.testing.assert_allclose(found.bias, np.tile([0.1, -0.2], (3, 1)))
    # the cells at the ends hold 25 and 15
    assert found.cell.tolist() == [[1, 0], [2, 0], [3, 0]]


def test_corrected_bias_is_the_mean_of_the_integrals_along_the_axes():
    cell, true = grid(5)
    bias = 0.2 * np.random.default_rng(3).standard_normal(true.shape)
    std = np.broadcast_to([0.05, 0.15], true.shape)
    row = 12  # In the middle, 3 standard deviations stay on the line.
    expected = np.zeros(2)
    for axis in range(2):
        line = cell[:, 1 - axis] == 2
        spline = CubicSpline(true[line, axis], bias[line], bc_type="natural")
        at, sigma = true[row, axis], std[row, axis]
        limits = at - 3 * sigma, at + 3 * sigma
        for k in range(2):
            value, _ = quad(lambda x, k=k: norm.pdf(x, at, sigma) * spline(x)[k], *limits)
            expected[k] += 0.5 * value / (norm.cdf(3.0) - norm.cdf(-3.0))
    found = corrected_bias(Markers(cell, true, bias, std))
    np.testing.assert_allclose(found[row], expected, atol=2e-4)
    alike = np.full_like(bias, 0.3)
    np.testing.assert_allclose(corrected_bias(Markers(cell, true, alike, std)), alike, atol=1e-12)


# --- map ---


def make_map(bias=(0.0, -0.2), **fields):
    _, at = grid(4)
    return BiasMap(at, np.tile(bias, (16, 1)), 0.01 * np.eye(2), STEP, **fields)


def test_it_is_the_bias_at_the_markers_and_smooth_between_them():
    _, at = grid(5)
    bias = 0.1 * np.column_stack([np.sin(2.0 * at[:, 0]), np.cos(2.0 * at[:, 1])])
    one = BiasMap(at, bias, 0.01 * np.eye(2), STEP)
    np.testing.assert_allclose(one.bias_at(at), bias, atol=0.02)
    between = np.random.default_rng(5).uniform(0.0, 2.0, (60, 2))
    expected = 0.1 * np.column_stack([np.sin(2.0 * between[:, 0]), np.cos(2.0 * between[:, 1])])
    np.testing.assert_allclose(one.bias_at(between), expected, atol=0.03)


def test_outside_of_the_hull_the_correction_fades_and_the_covariance_grows():
    one, before = make_map(), 0.04 * np.eye(3)[None]
    x = np.array([-0.1, 0.25 * FADE, 0.5 * FADE, 0.75 * FADE, FADE, 10.0])
    p = np.column_stack([1.5 + x, np.full(6, 0.75), np.full(6, 9.0)])
    found, covariance, validity = one.correct(p, np.repeat(before, 6, axis=0))
    np.testing.assert_allclose(validity, np.clip(1.0 - x / FADE, 0.0, 1.0), atol=1e-12)
    # All biases are alike, and so the map gives the same everywhere.
    np.testing.assert_allclose(p - found, np.outer(validity, [0.0, -0.2, 0.0]), atol=1e-12)
    # The covariance has the error of the map, and the bias that remains uncorrected.
    uncorrected = np.outer((1.0 - validity) ** 2, [0.0, 0.2**2, 0.0])
    expected = 0.04 + uncorrected + np.outer(validity**2, [0.01, 0.01, 0.0])
    np.testing.assert_allclose(np.diagonal(covariance, 0, 1, 2), expected, atol=1e-12)


def test_a_hole_in_the_markers_is_not_known():
    cell = np.array([[0, 0], [0, 1], [1, 0], [10, 0], [10, 1], [9, 0], [5, 9]])
    one = BiasMap(STEP * cell, np.full((7, 2), 0.1), np.eye(2), STEP)
    assert one.validity(np.array([[0.2, 0.2], [2.5, 1.0]])).tolist() == [1.0, 0.0]


def test_a_share_of_a_map_leaves_the_rest_as_uncertainty():
    half = make_map(bias=(0.1, 0.0)).scaled(0.5)
    np.testing.assert_allclose(half.bias[:, 0], 0.05)
    np.testing.assert_allclose(half.added, [[0.25 * 0.01 + 0.25 * 0.01, 0.0], [0.0, 0.0025]])


def test_file(tmp_path):
    anchors = Anchors.from_positions(np.arange(12.0).reshape(4, 3), [7, 3, 5, 9], "hall")
    own = {"frame": "hall", "ids": anchors.ids, "positions": anchors.positions}
    one = make_map(source="traj1", **own)
    one.save(tmp_path / "map.npz")
    again = BiasMap.load(tmp_path / "map.npz")
    p = np.random.default_rng(3).uniform(-1.0, 3.0, (100, 2))
    np.testing.assert_array_equal(again.bias_at(p), one.bias_at(p))
    assert (again.frame, again.source, again.step) == ("hall", "traj1", 0.5)
    assert again.belongs_to(anchors.only([2, 0, 3, 1]))
    assert again.belongs_to(anchors.at(anchors.positions + 0.05))
    for other in (
        anchors.at(anchors.positions + [0.0, 0.0, 0.2]),
        anchors.only([0, 1, 2]),
        Anchors.from_positions(anchors.positions, [7, 3, 5, 8], "hall"),
        Anchors.from_positions(anchors.positions, anchors.ids),
    ):
        assert not again.belongs_to(other)
    assert not make_map().belongs_to(anchors)
    with np.load(tmp_path / "map.npz") as content:
        assert int(content["version"]) == 4 and "metres" in str(content["units"])
        fields = dict(content)
    np.savez(tmp_path / "old.npz", **{**fields, "version": 3})
    (tmp_path / "text.npz").write_bytes(b"something else")
    for name in ("old", "text"):
        with pytest.raises(InputError, match="is no position bias map .* make one with"):
            BiasMap.load(tmp_path / f"{name}.npz")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"bias": np.zeros((3, 2))}, "do not fit together"),
        ({"ids": np.arange(3)}, "do not fit together"),
        ({"step": 0.0}, "step is 0 m"),
        ({"added": np.full((2, 2), np.nan)}, "not finite"),
        ({"bias": 1e9 * make_map().bias}, "above 100000"),
        ({"added": -np.eye(2)}, "no covariance"),
        ({"added": np.array([[1.0, 0.5], [0.0, 1.0]])}, "no covariance"),
        ({"at": make_map().at * [1.0, 0.0]}, "lie on one line"),
    ],
)
def test_fields_that_make_no_map_are_refused(change, named):
    with pytest.raises(InputError, match=named):
        replace(make_map(), **change)


# --- fit ---


def field(true):
    """Return a bias of up to 0.15 m, (n, 2)."""
    return 0.15 * np.column_stack([np.sin(true[:, 0]), np.cos(true[:, 1])])


def fly(seed, n=4000, noise=0.03, claimed=None, shift=0.0):
    """Return a Part with positions all over 3 x 3 m.

    claimed : standard deviation of its covariance, in m; None for no covariance.
    """
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.0, 3.0, (n, 2))
    measured = true + field(true) + shift + noise * rng.standard_normal((n, 2))
    return Part(
        measured, true, None if claimed is None else np.tile(claimed**2 * np.eye(2), (n, 1, 1))
    )


def test_a_known_bias_is_found_and_reduced_elsewhere():
    found, fresh = fit([fly(1, 8000), fly(2, 8000)], STEP, least=10), fly(3, noise=0.0)
    known = found.validity(fresh.measured) == 1.0
    after = (fresh.measured - found.bias_at(fresh.measured) - fresh.true)[known]
    assert np.sqrt(np.mean(after**2)) < 0.6 * np.sqrt(np.mean(field(fresh.true) ** 2))
    assert 0.0 < np.sqrt(found.added[0, 0]) < 0.06  # no covariances: the map's whole error


@pytest.mark.parametrize(("claimed", "honest"), [(0.03, True), (0.3, False)])
def test_covariances_become_honest_but_never_smaller(claimed, honest):
    # The bias differs from flight to flight, so no map can correct it.
    def drifting(seed):
        shift = 0.08 * np.random.default_rng(seed).standard_normal(2)
        return fly(seed, 1500, claimed=claimed, shift=shift)

    found = fit([drifting(seed) for seed in range(10)], STEP, least=10)
    nees = []
    for part in (drifting(seed) for seed in range(20, 40)):
        known = found.validity(part.measured) == 1.0
        error = (part.measured - found.bias_at(part.measured) - part.true)[known]
        solved = np.linalg.solve(part.covariance[known] + found.added, error[:, :, None])
        nees.append(np.mean(np.sum(error * solved[:, :, 0], axis=1)))
    if honest:
        # 20 flights: the mean NEES of 2 is uncertain by a third, and by more above it.
        assert 1.3 < np.mean(nees) < 3.5 and found.added.any()
    else:
        assert np.mean(nees) < 2.0 and not found.added.any()


LOST_FLIGHT = Part(np.full((50, 2), 9.0), np.zeros((50, 2)))


@pytest.mark.parametrize("unusable", [LOST_FLIGHT, fly(4, n=20)], ids=["lost", "short"])
def test_a_held_out_flight_without_a_marker_is_left_out_of_the_figures(unusable):
    """No position of a flight is within 1 m of the truth, or no cell holds enough of them."""
    others = [fly(1, claimed=0.03), fly(2, claimed=0.03)]
    found, expected = fit([unusable, *others], STEP, least=10), fit(others, STEP, least=10)
    np.testing.assert_allclose(found.bias, expected.bias, atol=0.01)
    np.testing.assert_allclose(found.added, expected.added, atol=5e-4)


def test_without_any_held_out_marker_the_whole_bias_counts_as_uncertain():
    found = fit([fly(1), LOST_FLIGHT], STEP, least=10)
    np.testing.assert_allclose(found.added, found.bias.T @ found.bias / len(found.bias))


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ([], "none is within 1 m of the truth"),
        ([LOST_FLIGHT], "none is within 1 m"),
        ([Part(np.full((5, 2), np.nan), np.zeros((5, 2)))], "none is within 1 m"),
        ([fly(1, n=20)], "no cell of 0.5 m holds 10 positions"),
    ],
)
def test_too_little_is_refused(parts, named):
    with pytest.raises(InputError, match=named):
        fit(parts, STEP, least=10)
