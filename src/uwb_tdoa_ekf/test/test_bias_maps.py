# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The position bias map: markers, fit, interpolation and file."""

from dataclasses import replace
from math import atan2, exp, log, pi

from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.debias import INTERPOLATORS, BiasMap, Part, fit
from uwb_tdoa_ekf.debias.bias_map import FADE, AngularNetwork
from uwb_tdoa_ekf.debias.fit import Markers, collect, corrected_bias

# --- debias markers ---


def grid(n, d, step=0.5):
    cell = np.stack(np.meshgrid(*[np.arange(n)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    return cell, step * cell


def markers(n=5, d=2, std=0.1, seed=3):
    rng = np.random.default_rng(seed)
    cell, true = grid(n, d)
    bias = 0.2 * rng.standard_normal(true.shape)
    return Markers(cell, true, bias, np.broadcast_to(std, true.shape), np.full(len(cell), 9))


@pytest.mark.parametrize("d", [2, 3])
def test_each_surveyed_point_is_a_marker_with_its_statistics(d):
    rng = np.random.default_rng(1)
    _, places = grid(3, d)
    places = places + 0.3
    true = np.repeat(places, 20, axis=0)
    measured = true + 0.1 * rng.standard_normal(true.shape)
    found = collect(measured, true, 0.5)
    np.testing.assert_allclose(found.true, places)
    np.testing.assert_allclose(found.bias, (measured - true).reshape(-1, 20, d).mean(axis=1))
    np.testing.assert_allclose(found.std, measured.reshape(-1, 20, d).std(axis=1))
    assert (found.count == 20).all()


def test_a_path_is_cut_into_cells_and_thin_ones_are_left_out():
    true = np.column_stack([np.linspace(0.0, 1.9, 191), np.zeros(191)])
    found = collect(true + [0.1, -0.2], true, 0.5, least=30)
    np.testing.assert_allclose(found.bias, np.tile([0.1, -0.2], (len(found), 1)))
    # the cells at the ends hold 25 and 15
    assert [tuple(cell) for cell in found.cell] == [
        (1, 0),
        (2, 0),
        (3, 0),
    ]
    assert found.count.tolist() == [50, 50, 50]


@pytest.mark.parametrize("d", [2, 3])
def test_corrected_bias_is_the_mean_of_the_integrals_along_the_axes(d):
    one = markers(d=d, std=np.linspace(0.05, 0.15, d))
    found = corrected_bias(one)
    # In the middle, 3 standard deviations stay on the line.
    row = int(np.flatnonzero((one.cell == 2).all(axis=1))[0])
    expected = np.zeros(d)
    for axis in range(d):
        on_line = (np.delete(one.cell, axis, axis=1) == 2).all(axis=1)
        for k in range(d):
            spline = CubicSpline(one.true[on_line, axis], one.bias[on_line, k], bc_type="natural")
            at, sigma = one.true[row, axis], one.std[row, axis]
            value, _ = quad(
                lambda x: norm.pdf(x, at, sigma) * spline(x), at - 3 * sigma, at + 3 * sigma
            )
            expected[k] += value / (norm.cdf(3.0) - norm.cdf(-3.0)) / d
    np.testing.assert_allclose(found[row], expected, atol=2e-4)


@given(st.floats(-0.3, 0.3), st.floats(0.0, 0.4), st.sampled_from([2, 3]))
def test_a_bias_that_is_alike_everywhere_stays(bias, std, d):
    cell, true = grid(3, d)
    one = Markers(
        cell, true, np.full(true.shape, bias), np.full(true.shape, std), np.ones(len(cell))
    )
    np.testing.assert_allclose(corrected_bias(one), bias, atol=1e-12)


# --- debias network ---
STEP = 0.5


def nodes(n, d, values, wobble=0.0):
    """Return cells, positions and one column of values; values(at) -> (n,)."""
    cell, at = grid(n, d)
    at = at + wobble * np.random.default_rng(2).standard_normal(cell.shape)
    return cell, at, values(at)[:, None]


def gentle(at):
    """Return positive values. No value is 8 times a neighbour, so eq. A5 has positive widths."""
    return 1.0 + 0.3 * np.sin(at[:, 0]) + 0.2 * np.cos(2.0 * at[:, 1])


def slow(cell, at, values, x):
    """Evaluate eqs. A1 - A8 one by one, in the plane, for one position."""
    b_min = min(values) if min(values) < 0 else 0.0
    b = values - b_min
    total, c1 = b_min, 0.5
    c3 = (1 - c1) / (8 * c1)
    for i in range(len(at)):
        d2 = float(np.sum((x - at[i]) ** 2))
        if d2 >= 1.0:
            continue
        widths = []
        for j in range(len(at)):
            if j != i and np.abs(cell[i] - cell[j]).max() == 1:
                away = at[j] - at[i]
                widths.append(
                    (atan2(away[1], away[0]), -log(c3 * b[j] / b[i]) / float(away @ away))
                )
        widths.sort()
        theta = atan2(x[1] - at[i][1], x[0] - at[i][0])
        widths = [
            (widths[-1][0] - 2 * pi, widths[-1][1]),
            *widths,
            (widths[0][0] + 2 * pi, widths[0][1]),
        ]
        c2 = np.interp(theta, *zip(*widths))
        total += c1 * b[i] * exp(-c2 * d2)
    return total


def test_equations_of_the_appendix():
    cell, at, values = nodes(4, 2, gentle, wobble=0.04)
    network = AngularNetwork(cell, at, values, STEP)
    places = np.random.default_rng(5).uniform(-0.5, 2.0, (60, 2))
    expected = [slow(cell, at, values[:, 0], x) for x in places]
    np.testing.assert_allclose(network(places)[:, 0], expected, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_an_inner_node_keeps_its_value(d):
    cell, at, values = nodes(5, d, gentle)
    network = AngularNetwork(cell, at, values, STEP)
    inner = ((cell > 0) & (cell < 4)).all(axis=1)
    shift = np.abs(network(at[inner]) - values[inner])
    # Nodes two steps away still contribute a little.
    assert shift.max() < 0.02


@pytest.mark.parametrize("d", [2, 3])
def test_negative_values_are_shifted_and_far_away_the_smallest_one_is_left(d):
    cell, at, values = nodes(4, d, lambda at: np.sin(3.0 * at[:, 0]) - 0.1)
    found = AngularNetwork(cell, at, values, STEP)(np.vstack([at, np.full((1, d), 50.0)]))
    assert np.isfinite(found).all()
    assert found[-1, 0] == pytest.approx(values.min())
    assert (found >= values.min() - 1e-12).all()


def test_a_node_without_neighbours_and_columns_apart():
    cell, at = np.array([[0, 0], [5, 5]]), np.array([[0.0, 0.0], [2.5, 2.5]])
    values = np.array([[0.2, -0.3], [0.1, 0.4]])
    found = AngularNetwork(cell, at, values, STEP)(at)
    np.testing.assert_allclose(found, [[0.1, -0.3], [0.05, -0.3 + 0.5 * 0.7]])


# --- debias bias map ---


def make_map(d=3, n=4, step=0.5, bias=None, **fields):
    cell, at = grid(n, d, step)
    bias = np.tile([0.1, -0.2, 0.3][:d], (len(at), 1)) if bias is None else bias(at)
    added = 0.01 * np.eye(d)
    return BiasMap(
        cell, at, bias, np.full(at.shape, 0.05), np.full(len(at), 50), added, step, **fields
    )


def outside(x, d=3):
    """Return a position `x` m beyond the middle of the face x = 1.5 m of the hull."""
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
    x = np.array([-0.1, 0.25 * FADE, 0.5 * FADE, 0.75 * FADE, FADE, 10.0])
    p = np.concatenate([outside(far) for far in x])
    found, covariance, validity = one.correct(p, np.repeat(before, len(x), axis=0))
    np.testing.assert_allclose(validity, np.clip(1.0 - x / FADE, 0.0, 1.0), atol=1e-12)
    assert (np.linalg.eigvalsh(covariance - before) > -1e-12).all()
    corrections = np.linalg.norm(found - p, axis=1)
    assert (np.diff(corrections) <= 1e-12).all() and corrections[-2] == corrections[-1] == 0.0
    traces = np.trace(covariance, axis1=1, axis2=2)
    # The covariance includes the bias that remains uncorrected.
    assert traces[-1] == pytest.approx(0.12 + 0.1**2 + 0.2**2 + 0.3**2) and traces[-1] > traces[0]


def test_a_hole_in_the_markers_is_not_known():
    cell = np.array([[0, 0], [0, 1], [1, 0], [10, 0], [10, 1], [9, 0], [5, 9]])
    one = BiasMap(
        cell, 0.5 * cell, np.full((7, 2), 0.1), np.full((7, 2), 0.1), np.full(7, 9), np.eye(2), 0.5
    )
    assert (
        one.validity(np.array([[0.2, 0.2, 0.0]])) == 1.0
        and one.validity(np.array([[2.5, 1.0, 0.0]])) == 0.0
    )


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


# --- debias fit ---


def field(true):
    """Return a bias of up to 0.2 m, (n, 3)."""
    return 0.15 * np.stack(
        [np.sin(true[:, 0]), np.cos(true[:, 1]), np.sin(0.7 * true[:, 0] + true[:, 2])], axis=1
    )


def fly(seed, n=4000, noise=0.03, claimed=None, bias=field):
    """Return a Part with positions all over 3 x 3 x 2 m.

    claimed : standard deviation of its covariance, in m; None for no covariance.
    """
    rng = np.random.default_rng(seed)
    true = rng.uniform([0.0, 0.0, 0.0], [3.0, 3.0, 2.0], (n, 3))
    measured = true + bias(true) + noise * rng.standard_normal((n, 3))
    return Part(
        measured, true, None if claimed is None else np.tile(claimed**2 * np.eye(3), (n, 1, 1))
    )


def left_over(bias_map, part):
    known = bias_map.validity(part.measured) == 1.0
    return (part.measured - bias_map.bias_at(part.measured) - part.true)[known]


@pytest.mark.parametrize("planar", [False, True])
def test_a_known_bias_is_found_and_taken_out_elsewhere(planar):
    found = fit([fly(1), fly(2)], 0.5, least=10, planar=planar)
    fresh = fly(3, noise=0.0)
    before, after = field(fresh.true), left_over(found, fresh)
    d = 2 if planar else 3
    assert np.std(before[:, :d]) > 0.08
    assert np.sqrt(np.mean(after[:, :d] ** 2)) < 0.02
    assert found.planar == planar


def test_the_network_needs_a_full_grid_and_is_worse_than_the_thin_plate():
    """In the plane, with markers everywhere, both reduce the error."""
    parts, fresh = [fly(1, 8000), fly(2, 8000)], fly(3, noise=0.0)
    left = {
        kind: left_over(fit(parts, 0.5, 10, True, kind), fresh)[:, :2] for kind in INTERPOLATORS
    }
    rms = {kind: np.sqrt(np.mean(error**2)) for kind, error in left.items()}
    assert (
        rms["thin_plate"] < rms["network"] < 0.6 * np.sqrt(np.mean(field(fresh.true)[:, :2] ** 2))
    )


@pytest.mark.parametrize(("claimed", "honest"), [(0.03, True), (0.2, False)])
def test_covariances_become_honest_but_never_smaller(claimed, honest):
    # The bias differs from flight to flight, so no map can correct it.
    def drifting(seed):
        own = 0.08 * np.random.default_rng(seed).standard_normal(3)
        return fly(seed, 1500, claimed=claimed, bias=lambda true: field(true) + own)

    found = fit([drifting(seed) for seed in range(10)], 0.5, least=10)
    fresh = [drifting(seed) for seed in range(20, 40)]
    nees = []
    for part in fresh:
        p, covariance, validity = found.correct(part.measured, part.covariance)
        error = (p - part.true)[validity == 1.0]
        nees.append(
            np.mean(
                np.einsum(
                    "ni,ni->n",
                    error,
                    np.linalg.solve(covariance[validity == 1.0], error[:, :, None])[:, :, 0],
                )
            )
        )
    if honest:
        # 20 flights: the mean NEES of 3 is uncertain by a third, and by more above it.
        assert 2.0 < np.mean(nees) < 5.0
        assert np.trace(found.added) > 0.01
    else:
        assert np.mean(nees) < 3.0 and not found.added.any()


def test_points_without_covariance_add_the_map_s_whole_error():
    _, places = grid(7, 2)
    true = np.column_stack([places, np.zeros(len(places))])
    parts = [Part(row + field(row[None]), row[None]) for row in true]
    found = fit(parts, 0.5, planar=True)
    assert len(found.at) == len(places)
    assert 0.0 < np.sqrt(found.added[0, 0]) < 0.05


LOST_FLIGHT = Part(np.full((50, 3), 9.0), np.zeros((50, 3)))
SHORT_FLIGHT = fly(4, n=20)


@pytest.mark.parametrize("unusable", [LOST_FLIGHT, SHORT_FLIGHT], ids=["lost", "short"])
@pytest.mark.parametrize("first", [False, True])
def test_a_held_out_flight_without_a_marker_is_left_out_of_the_figures(unusable, first):
    """No position of a flight is within 1 m of the truth, or no cell holds enough of them."""
    others = [fly(1, claimed=0.03), fly(2, claimed=0.03)]
    parts = [unusable, *others] if first else [*others, unusable]
    found, expected = fit(parts, 0.5, least=10), fit(others, 0.5, least=10)
    assert len(found.at) == len(expected.at)
    np.testing.assert_allclose(found.bias, expected.bias, atol=0.01)
    np.testing.assert_allclose(found.added, expected.added, atol=2e-5)
    if unusable is LOST_FLIGHT:
        np.testing.assert_array_equal(found.added, expected.added)


def test_without_any_held_out_marker_the_whole_bias_counts_as_uncertain():
    found = fit([fly(1), LOST_FLIGHT], 0.5, least=10)
    np.testing.assert_allclose(found.added, found.bias.T @ found.bias / len(found.bias))


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ([], "none is within 1 m of the truth"),
        ([Part(np.full((5, 3), 9.0), np.zeros((5, 3)))], "none is within 1 m"),
        ([Part(np.full((5, 3), np.nan), np.zeros((5, 3)))], "none is within 1 m"),
        ([fly(1, n=20)], "no cell of 0.5 m holds 10 positions"),
    ],
)
def test_too_little_is_refused(parts, named):
    with pytest.raises(InputError, match=named):
        fit(parts, 0.5, least=10)
