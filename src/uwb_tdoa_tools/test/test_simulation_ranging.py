import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_bias.foundation.radio import arrival_bias
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.tdoas import floor_multipath, make_schedule, outliers, tdoa_noise

CLEAN = {"noise_std": 0.0, "bias": False, "multipath": False, "outlier_probability": 0.0}
LEVER = np.array([-0.012, 0.001, 0.091])


def geometry(flight, lever=(0.0, 0.0, 0.0)):
    """TDOAs from the true pose that is next in time."""
    at = np.minimum(np.searchsorted(flight.truth.t, flight.tdoa.t), len(flight.truth) - 1)
    p = flight.truth.p[at] + Rotation.from_quat(flight.truth.q[at]).apply(lever)
    a, b = (
        flight.anchors.positions[flight.anchors.index(ids)]
        for ids in (flight.tdoa.a, flight.tdoa.b)
    )
    return tdoa(p, a, b)


@pytest.mark.parametrize("protocol", ["tdoa2", "tdoa3"])
@pytest.mark.parametrize("lever", [(0.0, 0.0, 0.0), tuple(LEVER)])
def test_without_errors_a_tdoa_is_geometry(protocol, lever):
    """A hovering tag: the poses at any stamp are those of the truth."""
    config = SimulationConfig(
        trajectory="hover",
        place=(0.7, -1.1),
        yaw_angle=0.8,
        protocol=protocol,
        tag_lever_arm=lever,
        start_in_air=True,
        duration=5.0,
        **CLEAN,
    )
    flight = simulate(config)
    np.testing.assert_allclose(flight.tdoa.d, geometry(flight, lever), atol=1e-9)


def test_without_errors_a_moving_tag_too():
    flight = simulate(
        SimulationConfig(trajectory="sines", truth_rate=10000.0, duration=20.0, **CLEAN)
    )
    truth, parts = flight.truth, flight.extra["tdoa_truth"]
    p = np.column_stack([np.interp(flight.tdoa.t, truth.t, truth.p[:, k]) for k in range(3)])
    a, b = (
        flight.anchors.positions[flight.anchors.index(ids)]
        for ids in (flight.tdoa.a, flight.tdoa.b)
    )
    inside = flight.tdoa.t >= truth.t[0]
    np.testing.assert_allclose(
        flight.tdoa.d[inside], tdoa(p, a, b)[inside], atol=1e-8
    )  # linear within 0.1 ms
    for name in ("bias", "multipath", "noise", "outlier"):
        np.testing.assert_array_equal(parts[name], 0.0)


def test_the_parts_add_up_and_are_independent_of_each_other():
    full = {"trajectory": "circle", "duration": 20.0, "seed": 3}
    everything = simulate(SimulationConfig(**full))
    parts = everything.extra["tdoa_truth"]
    exact = simulate(SimulationConfig(**full, **CLEAN)).tdoa
    parts_in_order = ("bias", "multipath", "noise", "outlier")
    total = sum(parts[name] for name in parts_in_order)
    np.testing.assert_allclose(everything.tdoa.d, exact.d + total, atol=1e-9)
    for switch, part in zip(
        ("bias", "multipath", "noise_std", "outlier_probability"), parts_in_order
    ):
        assert np.abs(parts[part]).max() > 0.1
        other = simulate(SimulationConfig(**full, **{switch: CLEAN[switch]})).extra["tdoa_truth"]
        for name in ("bias", "multipath", "noise", "outlier"):
            np.testing.assert_array_equal(other[name], 0.0 if name == part else parts[name])


def test_bias_is_that_of_both_arrivals_and_the_anchor_delays():
    flight = simulate(
        SimulationConfig(trajectory="hover", start_in_air=True, duration=3.0, yaw_angle=1.1)
    )
    delays = flight.meta["parameters"]["anchor_delays"]
    late = arrival_bias(
        flight.truth.p[0], flight.truth.q[0], flight.anchors.positions, flight.anchors.orientations
    )
    late = late + [delays[i] for i in flight.anchors.ids.tolist()]
    a, b = flight.anchors.index(flight.tdoa.a), flight.anchors.index(flight.tdoa.b)
    np.testing.assert_allclose(flight.extra["tdoa_truth"]["bias"], late[b] - late[a], atol=1e-6)
    assert 0.01 < np.std(list(delays.values())) < 0.15


def noise(shared, std, protocol="tdoa2", duration=600.0):
    schedule = make_schedule(protocol, len(std), duration, np.random.default_rng(1))
    return schedule, tdoa_noise(schedule, np.asarray(std), shared, np.random.default_rng(2))


@pytest.mark.parametrize("shared", [False, True])
def test_variance_is_the_sum_of_both_anchors(shared):
    """Grasso et al. 2022, eq. 4."""
    std = np.array([0.02, 0.05, 0.1, 0.03])
    schedule, n = noise(shared, std)
    for a in range(4):
        b = (a + 1) % 4
        assert np.var(n[schedule.a == a]) == pytest.approx(std[a] ** 2 + std[b] ** 2, rel=0.04)


def test_shared_noise_covariance_of_neighbours():
    """Grasso et al. 2022, eq. 5: pairs (i, j) and (j, k) of one round have the covariance -std_j^2."""
    std = np.array([0.02, 0.05, 0.1, 0.03])
    schedule, n = noise(True, std)
    chained = schedule.heard_a[1:] == schedule.heard_b[:-1]
    for j in range(4):
        rows = np.flatnonzero(chained & (schedule.a[1:] == j))
        assert np.mean(n[rows] * n[rows + 1]) == pytest.approx(
            -(std[j] ** 2), abs=0.03 * np.max(std) ** 2
        )
    apart = np.mean(n[2:] * n[:-2])
    assert abs(apart) < 0.03 * np.var(n)


def test_independent_noise_has_no_covariance():
    _, n = noise(False, [0.06] * 8)
    assert abs(np.mean(n[1:] * n[:-1])) < 0.02 * np.var(n)


def test_tdoa3_shares_receptions_as_well():
    schedule, n = noise(True, [0.06] * 4, "tdoa3")
    chained = np.flatnonzero(schedule.heard_a[1:] == schedule.heard_b[:-1])
    assert len(chained) > 1000
    assert np.mean(n[chained] * n[chained + 1]) == pytest.approx(-(0.06**2), rel=0.05)


@pytest.mark.parametrize("shared", [False, True])
def test_noise_std_is_that_of_one_tdoa(shared):
    flight = simulate(SimulationConfig(noise_std=0.08, shared_noise=shared, duration=60.0))
    assert flight.extra["tdoa_truth"]["noise"].std() == pytest.approx(0.08, rel=0.03)


def test_outliers_come_in_three_kinds():
    size = outliers(200_000, 0.1, np.random.default_rng(0))
    hit = np.abs(size[size != 0.0])
    assert len(hit) / len(size) == pytest.approx(0.1, rel=0.02)
    kinds = [(hit > 0.4) & (hit < 0.6), (hit > 3.0) & (hit < 5.0), hit > 20.0]
    np.testing.assert_allclose([k.mean() for k in kinds], [0.6, 0.3, 0.1], atol=0.01)
    assert np.mean(size > 0.0) == pytest.approx(np.mean(size < 0.0), rel=0.05)
    np.testing.assert_array_equal(outliers(1000, 0.0, np.random.default_rng(0)), 0.0)


def test_multipath_is_late_near_the_floor_only_and_correlated_in_time():
    t = np.arange(0.0, 500.0, 0.02)

    def late_at(height):
        each = np.repeat(np.arange(6)[:, None], len(t), axis=1)
        return floor_multipath(
            t, np.full(len(t), height), each, 6, np.random.default_rng(3), 500.0
        ).T

    late = late_at(0.03)
    assert late.min() == 0.0 and 0.2 < late.max() < 2.0
    assert 0.3 < np.mean(late > 0.0) < 0.7
    centred = late - late.mean(axis=0)
    correlation = [
        np.mean(centred[k:] * centred[: len(t) - k]) / np.mean(centred**2) for k in (1, 25, 250)
    ]
    assert correlation[0] > 0.9 and 0.1 < correlation[1] < 0.6 and abs(correlation[2]) < 0.1
    assert np.abs(np.corrcoef(late.T) - np.eye(6)).max() < 0.2
    np.testing.assert_allclose(late_at(0.25), 0.5 * late, atol=1e-12)
    np.testing.assert_array_equal(late_at(0.5), 0.0)


def test_in_flight_there_is_no_multipath():
    flight = simulate(SimulationConfig(trajectory="circle", duration=20.0))
    late = flight.extra["tdoa_truth"]["multipath"]
    airborne = np.interp(flight.tdoa.t, flight.truth.t, flight.truth.p[:, 2]) > 0.41
    np.testing.assert_array_equal(late[airborne], 0.0)
    assert (
        late[~airborne].max() > 0.2 and late[~airborne].min() < -0.2
    )  # of either anchor of a pair
