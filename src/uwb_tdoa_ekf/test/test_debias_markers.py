from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.stats import norm

from uwb_tdoa_ekf.debias.markers import Markers, collect, corrected_bias, measured_places


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
    assert [tuple(cell) for cell in found.cell] == [
        (1, 0),
        (2, 0),
        (3, 0),
    ]  # the ends hold 25 and 15
    assert found.count.tolist() == [50, 50, 50]


@pytest.mark.parametrize("d", [2, 3])
def test_corrected_bias_is_the_mean_of_the_integrals_along_the_axes(d):
    one = markers(d=d, std=np.linspace(0.05, 0.15, d))
    found = corrected_bias(one)
    row = int(
        np.flatnonzero((one.cell == 2).all(axis=1))[0]
    )  # in the middle: 3 standard deviations stay on the line
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


def test_without_scatter_the_corrected_bias_is_the_bias():
    one = markers(std=0.0)
    np.testing.assert_allclose(corrected_bias(one), one.bias, atol=1e-12)
    np.testing.assert_allclose(measured_places(one, one.bias), one.true + one.bias)
