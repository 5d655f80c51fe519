import numpy as np
import pytest

from uwb_tdoa_tools.planning import precision
from uwb_tdoa_tools.planning.installation import FixedNoise, Installation
from uwb_tdoa_tools.planning.maps import Grid
from uwb_tdoa_tools.planning.precision import (
    FEWEST,
    ErrorSamples,
    accuracy_map,
    bound,
    comparison,
    error_samples,
    information,
    pooled,
    position_error,
)
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.constellations import corners

INSTALLATION = Installation(corners(), FixedNoise(0.06 / np.sqrt(2)))
BIAS = np.array([0.1, -0.2, 0.3])


def samples(n=4000, scale=1.0, seed=0):
    """As good as the bound of one round times `scale`, beside a bias; the filter claims twice the
    standard deviation.
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform([-2, -2, 0.5], [2, 2, 1.5], (n, 3))
    limit = bound(information(place, INSTALLATION))
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(limit), rng.standard_normal((n, 3)))
    return ErrorSamples(0.01 * np.arange(n), place, scale * noise + BIAS, 4.0 * limit)


def test_a_map_shows_bias_and_scatter_where_they_are():
    grid = Grid.box((-2, -2, 0.5), (2, 2, 1.5), 1.0)
    found = accuracy_map(samples(), INSTALLATION, grid)
    assert found.count.sum() == 4000 and found.count.min() > 200
    np.testing.assert_allclose(found.bias, np.tile(BIAS, (16, 1)), atol=0.015)
    np.testing.assert_allclose(
        np.sqrt(found.rmse**2 - found.bias**2), found.bound, rtol=0.15
    )  # eq. 22 of Grasso et al.
    np.testing.assert_allclose(found.claimed, 2.0 * found.bound, rtol=1e-9)


def test_few_estimates_tell_nothing_and_those_outside_are_left_out():
    grid = Grid.box((-9, -9, 0), (-7, -7, 1), 1.0)
    assert np.isnan(accuracy_map(samples(), INSTALLATION, grid).rmse).all()
    far = samples(FEWEST - 1)
    one = Grid.box((-2, -2, 0.5), (2, 2, 4.5), 4.0)
    assert np.isnan(accuracy_map(far, INSTALLATION, one).bias).all()
    assert np.isfinite(accuracy_map(samples(FEWEST), INSTALLATION, one).bias).all()


def test_ratios_to_the_bound():
    found = comparison(samples(20_000, scale=0.5), INSTALLATION)
    noise, bias = 0.5 * found["bound"], np.linalg.norm(BIAS)
    assert found["rmse"] == pytest.approx(np.hypot(noise, bias), rel=0.01)
    assert found["scatter_over_bound"] == pytest.approx(0.5, rel=0.02)
    assert found["achieved_over_bound"] == pytest.approx(found["rmse"] / found["bound"])
    assert found["efficiency_claimed"] == pytest.approx(0.25)
    assert found["efficiency_achieved"] == pytest.approx(found["achieved_over_bound"] ** -2)


def test_flights_pool_without_mixing_their_seconds():
    one, other = samples(seed=1), samples(seed=2)
    shifted = ErrorSamples(other.t, other.place, other.error + 1.0, other.covariance)
    both = comparison(pooled([one, shifted]), INSTALLATION)
    assert both["samples"] == 8000 and both["scatter_over_bound"] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("trajectory", ["hover", "circle"])
def test_a_simulated_flight(trajectory):
    """Without bias, what the filter reaches is better than one round, and far from a thousand."""
    flight = simulate(
        SimulationConfig(
            trajectory=trajectory,
            duration=20,
            bias=False,
            multipath=False,
            outlier_probability=0.0,
            shared_noise=True,
        )
    )
    flown = error_samples(flight)
    assert len(flown.t) > 1000 and flown.place[:, 2].min() > 0.29
    found = comparison(flown, INSTALLATION)
    limit = position_error(bound(information(flown.place, INSTALLATION)))
    assert found["bound"] == pytest.approx(np.sqrt(np.mean(limit**2)))
    assert 1.0 < found["efficiency_achieved"] < 1000.0


def test_a_static_grid_is_mapped_place_by_place():
    """Several hovers, as on the markers of the paper's Figure 1: one cell each."""
    places = [(-1.0, -1.0), (1.0, 1.0)]
    flights = [
        error_samples(
            simulate(
                SimulationConfig(
                    trajectory="hover",
                    place=place,
                    height=1.2,
                    duration=20,
                    start_in_air=True,
                    floor_time=0.0,
                )
            )
        )
        for place in places
    ]
    grid = Grid.slice((-2, 2), (-2, 2), 1.2, 0.5)
    found = precision.accuracy_map(precision.pooled(flights), INSTALLATION, grid)
    known = np.isfinite(found.rmse[:, 0])
    centres = grid.points[known]
    for place in places:
        assert np.linalg.norm(centres[:, :2] - place, axis=1).min() < 0.4
    assert (np.linalg.norm(found.bias[known], axis=1) > 0.02).all()


def test_a_measured_flight(shared_data):
    path, survey = (
        shared_data / "flights/0425/TDOA2/0425-traj2",
        shared_data / "surveys/anchor_0425.txt",
    )
    flight = read_flight(path, survey)
    found = comparison(error_samples(flight), Installation(flight.anchors))
    assert 0.10 < found["bound"] < 0.13
    assert 1.0 < found["achieved_over_bound"] < 4.0 and 0.05 < found["efficiency_achieved"] < 1.0
