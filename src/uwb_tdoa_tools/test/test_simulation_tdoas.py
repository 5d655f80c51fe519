# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated TDOAs: schedules, radio links, errors."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.radio import (
    Antenna,
    RadioLink,
    arrival_bias,
    power_bias,
    received_power_dbm,
)
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import PROTOCOLS, constellation, heard_at
from uwb_tdoa_tools.simulation.sensors import (
    floor_multipath,
    make_schedule,
    outliers,
    restrict_to_heard,
    tdoa_noise,
)


def schedule(protocol, n_anchors=8, duration=60.0, seed=0):
    return make_schedule(protocol, n_anchors, duration, np.random.default_rng(seed))


@given(st.sampled_from(PROTOCOLS), st.integers(2, 64), st.floats(1.0, 10.0), st.integers(0, 1000))
def test_every_schedule_is_sound(protocol, n_anchors, duration, seed):
    s = schedule(protocol, n_anchors, duration, seed)
    assert (np.diff(s.t) > 0.0).all() and s.t[0] > 0.0 and s.t[-1] <= duration
    for anchor in (s.a, s.b):
        assert anchor.min() >= 0 and anchor.max() < n_anchors
    assert (s.a != s.b).all()
    np.testing.assert_array_equal(s.sender[s.heard_a], s.a)
    np.testing.assert_array_equal(s.sender[s.heard_b], s.b)
    assert (s.heard_a < s.heard_b).all() and (np.diff(s.heard_b) > 0).all()


def test_tdoa2_is_a_ring_of_some_475_per_second():
    s = schedule("tdoa2")
    np.testing.assert_array_equal(s.b, (s.a + 1) % 8)
    np.testing.assert_array_equal(s.heard_a, s.heard_b - 1)
    assert 450.0 < len(s.t) / 60.0 < 490.0
    assert np.median(np.diff(s.t)) == pytest.approx(2e-3, rel=0.02)
    assert np.diff(s.t).std() > 5e-5
    assert 0.9 < np.mean(s.b[:-1] == s.a[1:]) < 1.0


def test_tdoa3_takes_any_pair_some_240_times_per_second():
    s = schedule("tdoa3")
    assert 200.0 < len(s.t) / 60.0 < 270.0
    pairs, count = np.unique(s.a * 8 + s.b, return_counts=True)
    assert len(pairs) == 56 and count.min() > 0.6 * count.mean()


def across_a_hall(protocol, reach, seed, cells=None):
    """Return the schedule of a tag that crosses 60 m of a hall.

    Returns (Schedule, position (n, 3) at each measurement, anchor positions (40, 3)), m.
    """
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.uniform(0.0, 60.0, (40, 2)), rng.uniform(0.0, 5.0, 40)])
    schedule = make_schedule(protocol, len(positions), 2.0, rng)
    p = np.column_stack(
        [np.linspace(5.0, 55.0, len(schedule.t)), np.full((len(schedule.t), 2), (30.0, 1.0))]
    )
    near = restrict_to_heard(schedule, heard_at(p, positions, reach), protocol, rng, cells)
    assert np.isin(near.t, schedule.t).all()
    return near, p[np.searchsorted(schedule.t, near.t)], positions


@given(st.sampled_from(PROTOCOLS), st.floats(4.0, 30.0), st.integers(0, 100))
def test_within_reach_only_anchors_that_are_near_are_heard(protocol, reach, seed):
    near, there, positions = across_a_hall(protocol, reach, seed)
    for rows, heard in ((near.a, near.heard_a), (near.b, near.heard_b)):
        np.testing.assert_array_equal(near.sender[heard], rows)
    assert (near.a != near.b).all()
    assert (np.linalg.norm(there - positions[near.b], axis=1) <= reach).all()
    assert (np.linalg.norm(there - positions[near.a], axis=1) <= reach).all()


CLEAN = {"noise_std": 0.0, "bias": False, "multipath": False, "outlier_probability": 0.0}
LEVER = np.array([-0.012, 0.001, 0.091])


def geometry(flight, lever=(0.0, 0.0, 0.0)):
    """Return TDOAs from the next true pose."""
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
    """The tag hovers, so its pose at any stamp equals the ground truth."""
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


ISOTROPIC = Antenna((0.0,) * 4, (0.0,) * 4, (0.0,) * 4)
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_power_bias_is_the_table_of_aps011():
    assert power_bias(-61.0) == pytest.approx(-0.110)
    assert power_bias(-77.0) == pytest.approx(0.0)
    assert power_bias(-75.0) == pytest.approx(-0.027)
    assert power_bias(-95.0) == pytest.approx(0.086)
    assert power_bias(-76.0) == pytest.approx(-0.0135)
    np.testing.assert_allclose(power_bias([-20.0, -130.0]), [-0.110, 0.086])


def test_friis_by_hand():
    """Two isotropic antennas have the free-space loss of the handbooks.

    It is 32.45 + 20 log10(km) + 20 log10(MHz) dB.
    """
    link = RadioLink(ISOTROPIC, ISOTROPIC, tx_power_dbm=0.0, frequency=4.0e9)
    p = received_power_dbm(np.zeros(3), LEVEL, np.array([4.0, 0, 0]), LEVEL, link)
    assert p == pytest.approx(-(32.45 + 20 * np.log10(0.004) + 20 * np.log10(4000.0)), abs=0.01)
    farther = received_power_dbm(np.zeros(3), LEVEL, np.array([40.0, 0, 0]), LEVEL, link)
    assert p - farther == pytest.approx(20.0)


def test_gains_of_both_antennas_count():
    """The tag is above the anchor: in the upper null of the anchor's antenna.

    The anchor is behind the tag's flat antenna (-x).
    """
    link = RadioLink(tx_power_dbm=0.0)
    isotropic = RadioLink(ISOTROPIC, ISOTROPIC, tx_power_dbm=0.0)
    where = np.array([0.0, 0.0, 2.0]), LEVEL, np.zeros(3), LEVEL
    gains = Antenna().gain(np.array([-1.0, 0, 0])) + Antenna().gain(np.array([0, 0, 1.0]))
    assert received_power_dbm(*where, link) - received_power_dbm(
        *where, isotropic
    ) == pytest.approx(gains)


def test_only_relative_poses_matter():
    rng = np.random.default_rng(3)
    p_tag, p_anchor = rng.standard_normal((2, 50, 3)) * 3
    q_tag, q_anchor = (Rotation.random(50, random_state=k) for k in (1, 2))
    turn, shift = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]), np.array([1.0, -2.0, 0.5])
    one = arrival_bias(p_tag, q_tag.as_quat(), p_anchor, q_anchor.as_quat())
    other = arrival_bias(
        turn.apply(p_tag) + shift,
        (turn * q_tag).as_quat(),
        turn.apply(p_anchor) + shift,
        (turn * q_anchor).as_quat(),
    )
    np.testing.assert_allclose(one, other, atol=1e-9)
    assert np.ptp(one) > 0.1


def spin(anchors, link=RadioLink()):
    """Return the TDOA bias of the pair (0, 1) over a full turn of the tag.

    The tag is half-way between the anchors.
    """
    yaw = np.linspace(-np.pi, np.pi, 181)
    q_tag = Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0])).as_quat()
    late = arrival_bias(
        anchors.positions.mean(axis=0),
        q_tag[:, None],
        anchors.positions,
        anchors.orientations,
        link,
    )
    return late[:, 1] - late[:, 0]


def test_figure_4_left_bias_over_a_spin_depends_on_anchor_orientation():
    anchors = constellation("pair")
    curves = []
    for azimuth, elevation in ((0, 0), (90, 30), (200, 70)):
        turn = Rotation.from_euler("zy", [azimuth, elevation], degrees=True)
        orientations = anchors.orientations.copy()
        orientations[0] = (turn * Rotation.from_quat(orientations[0])).as_quat()
        curves.append(spin(Anchors(anchors.ids, anchors.positions, orientations)))
    for curve in curves:
        assert 0.1 < np.ptp(curve) < 0.8
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(curves[one] - curves[other]).max() > 0.03
