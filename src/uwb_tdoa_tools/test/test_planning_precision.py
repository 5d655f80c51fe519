# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The precision that an installation and its radio noise allow, and the errors of flights."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.radio import DWM1000_AZIMUTH, Antenna
from uwb_tdoa_tools.planning.maps import (
    FEWEST,
    ErrorSamples,
    Grid,
    accuracy_map,
    comparison,
    error_samples,
    pooled,
)
from uwb_tdoa_tools.planning.precision import (
    NORMAL_99,
    FixedNoise,
    Installation,
    RadioNoise,
    antenna_from_yaml,
    bound,
    dilution,
    ellipses,
    information,
    position_error,
    variance_gradient,
)
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import constellation, corners, facing

# --- planning installation ---


@pytest.mark.parametrize(
    ("positions", "dimensions", "says"),
    [
        (
            [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
            3,
            "3 were given; a position in space needs at least 4",
        ),
        ([[0, 0, 0], [1, 0, 0]], 2, "2 were given; a position at known height needs at least 3"),
        (
            [[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3], [4, 0, 0.005]],
            3,
            "1 and 4 are at the same place",
        ),
        ([[0, 0, 1], [4, 0, 1], [4, 4, 1.01], [0, 4, 1], [2, 3, 1]], 3, "all are in one plane"),
        ([[0, 0, 0], [1, 1, 1], [2, 2, 2], [5, 5, 5.01]], 3, "all are on one line to"),
        ([[0, 0, 0], [2, 2, 3], [5, 5, 0]], 2, "all are on one line seen from above"),
        ([[1, 1, 0], [1, 1, 1], [1, 1, 2], [1, 1, 3]], 2, "all are on one line seen from above"),
    ],
)
def test_anchors_that_locate_nothing_are_told_so(positions, dimensions, says):
    with pytest.raises(InputError, match="^anchors: ") as refusal:
        Installation(Anchors.from_positions(np.array(positions, float)), dimensions=dimensions)
    assert says in str(refusal.value) and str(refusal.value).endswith(".")


def test_hull():
    installation = Installation(corners(4.0, 4.0, 3.0))
    points = np.array([[0, 0, 1.5], [1.9, 1.9, 1.0], [0, 0, 3.1], [2.1, 0, 1.0]])
    assert installation.inside_hull(points).tolist() == [True, True, False, False]
    above = Installation(corners(4.0, 4.0, 3.0), dimensions=2)
    assert above.inside_hull(points).tolist() == [True, True, True, False]


def test_with_a_height_sensor_anchors_in_a_plane_are_enough_and_the_hull_is_that_from_above():
    flat = Installation(constellation("planar"), height_std=0.02)
    high, low = flat.anchors.positions[:, :2].max(axis=0), flat.anchors.positions[:, :2].min(axis=0)
    points = np.array([[*(0.5 * (high + low)), 7.0], [*(high + 0.1), 1.0]])
    assert (
        flat.inside_hull(points).tolist() == [True, False]
        and flat.unknowns == 2
        and flat.dimensions == 3
    )
    for options in (
        {"height_std": 0.0},
        {"height_std": np.nan},
        {"height_std": 0.1, "dimensions": 2},
    ):
        with pytest.raises(InputError, match="height std"):
            Installation(constellation("planar"), **options)


ONE = Anchors.from_positions([[0.0, 0.0, 0.0]])  # no orientation: omnidirectional


def test_link_budget_by_hand():
    """Eqs. 9 - 12 by hand: 10 m at 3.9936 GHz and 499.2 MHz, 25 degrees C, -10 dBm, mean gain."""
    got = RadioNoise(tx_power_dbm=-10.0).variance(np.array([[10.0, 0.0, 0.0]]), ONE)[0, 0]
    path_loss = 20 * np.log10(4 * np.pi * 10.0 * 3.9936e9 / 299792458.0)  # 64.48 dB
    thermal = 10 * np.log10(1.380649e-23 * 298.15 * 499.2e6 / 1e-3)  # -86.88 dBm
    snr = 10 ** ((-10.0 + np.mean(DWM1000_AZIMUTH) - path_loss - thermal) / 10)
    assert path_loss == pytest.approx(64.48, abs=0.01) and thermal == pytest.approx(
        -86.87, abs=0.01
    )
    assert got == pytest.approx((299792458.0 / 499.2e6) ** 2 / snr, rel=1e-9)


def test_twice_as_far_is_twice_as_noisy_and_near_is_no_better_than_at_full_strength():
    at = np.array([[0.01, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    std = np.sqrt(RadioNoise().variance(at, ONE)[:, 0])
    np.testing.assert_allclose(std / std[2], [1, 1, 1, 2, 4], rtol=1e-9)


def test_the_pattern_counts_and_the_receiver_does_not():
    anchor = facing([[0.0, 0.0, 1.0]], (5.0, 0.0, 1.0))
    front, above = RadioNoise().variance(np.array([[3.0, 0, 1], [0, 0, 4.0]]), anchor)[:, 0]
    difference = Antenna().gain(np.array([1.0, 0, 0])) - Antenna().gain(np.array([0, 0, 1.0]))
    assert 10 * np.log10(above / front) == pytest.approx(difference)
    louder = RadioNoise(Antenna(gain_offset=3.0)).variance(np.array([[3.0, 0, 1]]), anchor)[0, 0]
    assert 10 * np.log10(front / louder) == pytest.approx(3.0)


def test_an_anchor_without_orientation_among_others():
    anchors = corners()
    q = anchors.orientations.copy()
    q[3] = np.nan
    mixed = RadioNoise().variance(
        np.array([[0.3, 0.2, 1.0]]), Anchors(anchors.ids, anchors.positions, q)
    )
    whole = RadioNoise().variance(np.array([[0.3, 0.2, 1.0]]), anchors)
    assert np.isfinite(mixed).all()
    np.testing.assert_array_equal(np.delete(mixed, 3), np.delete(whole, 3))


def test_fixed_noise():
    fixed = FixedNoise(0.1)
    variance = fixed.variance(np.zeros((4, 3)), corners())
    assert variance.shape == (4, 8) and (variance == 0.1**2).all()
    assert not variance_gradient(fixed, np.zeros((4, 3)), corners(), variance, 2).any()
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="standard deviation"):
            FixedNoise(bad)


def test_antenna_file(tmp_path):
    file = tmp_path / "antenna.yaml"
    file.write_text(
        "azimuth: [0, 1, 2, 1]\nelevation_1: [0, -5, 2, -9]\nelevation_2: [1, -5, 1, "
        "-9]\ngain_offset: 2\n"
    )
    assert antenna_from_yaml(file).gain(np.array([-1.0, 0, 0])) == pytest.approx(4.0)
    for text in (
        "azimuth: [0, 1, 2, 1]",
        "- 3",
        "azimuth: 5\nelevation_1: 5\nelevation_2: 5",
        ": :",
        "a: [1",
    ):
        file.write_text(text)
        with pytest.raises(InputError, match="antenna"):
            antenna_from_yaml(file)


# --- planning precision ---


SQUARE = facing([[0, 0, 0.2], [4, 0, 0.2], [4, 4, 0.2], [0, 4, 0.2]], (2, 2, 0.2))
# metres of noise: the second term of eq. 1 matters
NOISY = RadioNoise(tx_power_dbm=-38.0, full_strength=0.1)
PLACES = np.array([[0.4, -0.7, 1.3], [2.9, 3.1, 0.8], [-3.0, 1.0, 2.2], [3.2, 3.6, 0.5]])


def ranges(points, anchors):
    return np.linalg.norm(points[..., None, :] - anchors.positions, axis=-1)


def incidence(part):
    """Return the (M, 8) matrix with -1 at a and +1 at b; the identity for ranges."""
    each = np.eye(8)
    a, b = np.triu_indices(8, 1)
    if part == "ring":  # without the last pair: the measurements of the closed ring have no density
        a, b = np.arange(7), np.arange(1, 8)
    return each if part == "every_range" else each[b] - each[a]


def covariance_of(part, variance):
    """Return the covariance of the measurements of a part of a round, (n, M, M) m^2.

    variance : (n, N) m^2.
    """
    d = incidence(part)
    if part != "all_pairs":
        return (d * variance[:, None, :]) @ d.T
    return (variance @ np.abs(d).T)[:, :, None] * np.eye(len(d))


def numerical_information(point, installation, part, step=1e-3):
    """Return the information of the TDOAs by finite differences.

    It is minus the second derivative of the expected log-likelihood.
    """
    k, anchors, d = installation.dimensions, installation.anchors, incidence(part)

    def moments(x):
        variance = installation.noise.variance(x[None], anchors)
        return d @ ranges(x, anchors), covariance_of(part, variance)[0]

    true_mean, true_covariance = moments(point)

    def likelihood(offset):
        mean, covariance = moments(point + np.append(offset, np.zeros(3 - k)))
        factor = cho_factor(covariance)
        off = true_mean - mean
        quadratic = np.trace(cho_solve(factor, true_covariance)) + off @ cho_solve(factor, off)
        return -0.5 * quadratic - np.log(np.diag(factor[0])).sum()

    hessian = np.empty((k, k))
    for i, u in enumerate(step * np.eye(k)):
        for j, v in enumerate(step * np.eye(k)):
            corner = likelihood(u + v) - likelihood(u - v) - likelihood(v - u) + likelihood(-u - v)
            hessian[i, j] = corner / (4 * step**2)
    times = 2 / 7 if part == "all_pairs" else 1  # 28 TDOAs count as 8
    return -times * hessian


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("name", ["ring", "all_pairs", "every_range"])
def test_information_is_the_curvature_of_the_likelihood(name, dimensions):
    installation = Installation(corners(), NOISY, name, dimensions)
    for point, matrix in zip(PLACES, information(PLACES, installation)):
        wanted = numerical_information(point, installation, name)
        np.testing.assert_allclose(matrix, wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("noise", [NOISY, FixedNoise(0.1)])
def test_what_tdoas_and_ranges_tell_adds_up(noise):
    """TDOAs and ranges are independent measurements, so their information adds up."""
    alone = [
        information(PLACES, Installation(corners(), noise, name))
        for name in ("ring", "every_range")
    ]
    both = information(PLACES, Installation(corners(), noise, "ring+every_range"))
    np.testing.assert_allclose(both, sum(alone), rtol=1e-12)
    assert (
        position_error(bound(both))
        < 0.95 * np.minimum(*(position_error(bound(one)) for one in alone))
    ).all()


def test_dilution_in_the_middle_of_a_square():
    """Four equal ranges from the corners with an unknown offset: variance 1/2 along each axis."""
    installation = Installation(SQUARE, dimensions=2)
    np.testing.assert_allclose(
        dilution(np.array([[2.0, 2.0, 0.2]]), installation), [[np.sqrt(0.5)] * 2]
    )
    assert (dilution(np.array([[9.0, 2.0, 0.2]]), installation)[0] > [5.0, 1.0]).all()


def test_no_bound_where_there_is_no_information():
    singular = np.array(
        [np.diag([4.0, 1.0, 0.0]), np.diag([4.0, 1.0, 0.5]), np.full((3, 3), np.nan)]
    )
    got = bound(singular)
    assert np.isinf(got[[0, 2]]).all()
    np.testing.assert_allclose(got[1], np.diag([0.25, 1.0, 2.0]))


def test_the_4_x_4_m_square_of_the_paper():
    """Grasso et al., sec. 2.2.3: best inside the hull, about +-5 cm at 99 % there.

    The paper does not state the power. The test uses the maximum in the data sheet, -39 dBm/MHz
    over 499.2 MHz, plus 9 dB for frames shorter than 0.125 ms.
    """
    installation = Installation(
        SQUARE, RadioNoise(tx_power_dbm=-39.0 + 10 * np.log10(499.2) + 9.0), dimensions=2
    )
    points = Grid.slice((-2, 6), (-2, 6), 0.2, 0.1).points
    covariance = bound(information(points, installation))
    per_axis = NORMAL_99 * np.sqrt(0.5) * position_error(covariance)
    inside = installation.inside_hull(points)
    assert 0.04 < np.median(per_axis[inside]) < 0.055
    assert np.quantile(per_axis[inside], 0.95) < 0.07
    assert (
        per_axis[~inside].min() > np.median(per_axis[inside]) and np.median(per_axis[~inside]) > 0.1
    )


def test_ellipses_hold_their_share():
    covariance = np.array([[[0.04, 0.03, 0.0], [0.03, 0.05, 0.0], [0.0, 0.0, 1.0]]])
    (semi,), (angle,) = ellipses(covariance)
    x, y = (np.random.default_rng(0).multivariate_normal([0, 0], covariance[0, :2, :2], 50_000)).T
    u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    assert semi[0] > semi[1]
    assert np.mean((u / semi[0]) ** 2 + (v / semi[1]) ** 2 < 1) == pytest.approx(0.99, abs=0.002)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_one_more_anchor_never_hurts(seed):
    more = constellation(f"random-{seed % 1000}-8")
    few = Anchors(more.ids[:7], more.positions[:7], more.orientations[:7])
    point = np.random.default_rng(seed).uniform([-2, -2, 0.3], [2, 2, 2.3], (1, 3))
    gain = information(point, Installation(more)) - information(point, Installation(few))
    assert np.linalg.eigvalsh(gain)[0, 0] > -1e-6 * np.abs(gain).max()


@given(st.floats(0.01, 0.5))
def test_a_height_sensor_adds_its_information(std):
    plain, aided = Installation(corners(), NOISY), Installation(corners(), NOISY, height_std=std)
    expected = information(PLACES, plain) + np.diag([0.0, 0.0, std**-2])
    np.testing.assert_allclose(information(PLACES, aided), expected)
    before, after = (bound(information(PLACES, each)) for each in (plain, aided))
    assert (after[:, 2, 2] < std**2).all() and (np.linalg.eigvalsh(before - after) > -1e-9).all()


def test_a_perfect_height_sensor_leaves_the_bound_at_known_height():
    anchors = corners()
    known = bound(information(PLACES, Installation(anchors, NOISY, dimensions=2)))
    measured = bound(information(PLACES, Installation(anchors, NOISY, height_std=1e-4)))
    np.testing.assert_allclose(measured[:, :2, :2], known, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        dilution(PLACES, Installation(anchors, height_std=0.1)),
        dilution(PLACES, Installation(anchors, dimensions=2)),
    )


INSTALLATION = Installation(corners(), FixedNoise(0.06 / np.sqrt(2)))
BIAS = np.array([0.1, -0.2, 0.3])


def samples(n=4000, scale=1.0, seed=0):
    """Return ErrorSamples at the bound of one round times `scale`, plus a bias.

    The filter states twice the standard deviation.
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
    # eq. 22 of Grasso et al.
    np.testing.assert_allclose(np.sqrt(found.rmse**2 - found.bias**2), found.bound, rtol=0.15)
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
    """Without bias, the filter is better than the bound of one round.

    It is far from the bound of a thousand rounds.
    """
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


def test_a_measured_flight(shared_data):
    path, survey = (
        shared_data / "flights/0425/TDOA2/0425-traj2",
        shared_data / "surveys/anchor_0425.txt",
    )
    flight = read_flight(path, survey)
    found = comparison(error_samples(flight), Installation(flight.anchors))
    assert 0.10 < found["bound"] < 0.13
    assert 1.0 < found["achieved_over_bound"] < 4.0 and 0.05 < found["efficiency_achieved"] < 1.0
