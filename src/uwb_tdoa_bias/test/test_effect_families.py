# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Single effects and their correctors: delays, geometry, floor, labels, sensors, advice."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import Velocity
from uwb_tdoa_bias.effects import (
    EFFECTS,
    AnchorDelay,
    EffectSet,
    ImuCorrector,
    Samples,
    SmoothTerm,
    StreamCorrector,
    TagLeverArm,
    tag,
)
from uwb_tdoa_bias.effects.base import counted, listed, measured, relabelled

ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 3], [0, 7, 0], [8, 7, 3]], ids=[0, 1, 3, 7])
A, B, D = np.array([1, 2, 4, 7]), np.array([2, 4, 7, 1]), np.array([0.5, -1.0, 2.0, -0.25])
IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"4-2": -1})
BLOCKED = {"1.x": -0.9, "1.y": -1.2, "1.z": 2.0, "1.radius": 1.0, "1.delay": 0.53}
seeds = st.integers(0, 2**32 - 1)


def test_the_power_of_anchors_of_unknown_orientation_needs_no_pattern(monkeypatch):
    samples = random_samples(1)
    effect = EFFECTS["received_power_bias"]({"scale": 2.0})
    turned = replace(samples.anchors, orientations=np.full((5, 4), np.nan))
    unknown = replace(samples, anchors=turned)
    expected = effect.bias(replace(unknown, q=np.full((20, 4), np.nan)))
    monkeypatch.setattr(tag, "received_power_dbm", None)
    np.testing.assert_array_equal(effect.bias(unknown), expected)
    assert np.abs(expected).max() > 0.01


@given(seeds)
def test_lever_arm_is_where_the_antenna_is_and_a_delay_of_all_anchors_is_not_seen(seed):
    samples = random_samples(seed)
    delays = AnchorDelay({str(i): 0.7 for i in samples.anchors.ids})
    np.testing.assert_array_equal(delays.bias(samples), 0.0)
    effect = TagLeverArm({"x": -0.012, "z": 0.091})
    antenna = samples.p + Rotation.from_quat(samples.q).apply([-0.012, 0.0, 0.091])
    a, b = samples.anchors.positions[samples.a], samples.anchors.positions[samples.b]
    np.testing.assert_allclose(
        effect.bias(samples), tdoa(antenna, a, b) - tdoa(samples.p, a, b), atol=1e-12
    )


def test_lever_arm_without_attitude_cannot_tell_and_adds_nothing_to_the_set():
    samples = random_samples(2, n=3)
    samples.q[1] = np.nan
    arm, delay = TagLeverArm({"z": 0.1}), AnchorDelay({str(samples.anchors.ids[0]): 0.2})
    assert np.isnan(arm.bias(samples)).tolist() == [False, True, False]
    together = EffectSet((arm, delay)).bias(samples)
    expected = delay.bias(samples) + np.where([True, False, True], arm.bias(samples), 0.0)
    np.testing.assert_array_equal(together, expected)


def standing(heights, x=0.0):
    """Return samples at heights (n,), in m, above (x, 0).

    The TDOAs are between anchor 0, which has no delay, and anchor 1.
    """
    anchors, n = Anchors.from_positions([[4, 4, 3], [5, 0, 0.2]], ids=[0, 1]), len(heights)
    p = np.column_stack([np.full(n, x), np.zeros(n), heights])
    return Samples(
        np.arange(n) / 100.0, np.zeros(n, int), np.ones(n, int), p, np.full((n, 4), np.nan), anchors
    )


def test_on_the_floor_an_anchor_is_late_below_its_height_and_may_be_about_it():
    floor = EFFECTS["floor_multipath"]({"1.delay": 3.0, "1.height": 0.12})
    samples = standing(np.array([0.0, 0.03, 0.08, 0.12, 0.18, 1.0]))
    bias, noise = floor.bias(samples), floor.noise_std(samples)
    np.testing.assert_allclose(bias, [3.0, 3.0, 3.0, 1.5, 0.0, 0.0], atol=1e-6)
    # Each TDOA is late with probability p, so the deviation is 3 m times sqrt(p (1 - p)).
    np.testing.assert_allclose(noise, [0.0, 0.0, 0.0, 1.5, 0.0, 0.0], atol=2e-3)
    hopping = EFFECTS["floor_multipath"]({"1.delay": 3.0, "1.height": 0.12, "1.noise": 0.4})
    np.testing.assert_allclose(
        hopping.noise_std(samples)[[0, 3, 5]], [0.4, np.sqrt(1.5**2 + 0.5 * 0.4**2), 0.0], atol=2e-3
    )


def test_away_from_where_the_floor_was_seen_it_is_not_taken_out_but_feared():
    floor = EFFECTS["floor_multipath"]({"1.delay": 3.0, "1.height": 0.12, "x": 0.0, "y": 0.0})
    near, far = (standing(np.array([0.03]), x) for x in (0.1, 4.0))
    assert floor.bias(near)[0] == pytest.approx(3.0, abs=0.02) and floor.noise_std(near)[0] < 0.4
    assert abs(floor.bias(far)[0]) < 0.01 and floor.noise_std(far)[0] == pytest.approx(
        3.0, abs=0.01
    )


@pytest.mark.parametrize(
    "name, limits",
    [
        ("floor_multipath", {"x": 0.5, "y": -0.5}),
        ("nlos", {"1.start": 0.05, "1.end": 0.15, "2.radius": 6.0}),
    ],
)
def test_regressors_of_delays_under_conditions_are_what_these_do(name, limits):
    samples, rng = random_samples(3), np.random.default_rng(3)
    samples.p[:, 2] = rng.uniform(0.0, 0.3, len(samples))
    anchors = replace(samples.anchors, ids=np.arange(5))
    samples = replace(samples, anchors=anchors)
    delays = {f"{i}.delay": 1.0 + i for i in range(5)}
    effect = EFFECTS[name]({**delays, **limits})
    expected = effect.regressors(samples, list(delays)) @ list(delays.values())
    np.testing.assert_allclose(effect.bias(samples), expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-3


def test_advice_on_the_floor_names_the_anchors_that_are_late_by_much():
    values = {"0.delay": 3.3, "1.delay": 0.4, "2.delay": 2.8, "0.height": 0.1, "2.height": 0.13}
    mount, hang = EFFECTS["floor_multipath"](
        values, {key: 0.05 for key in values if key.endswith("delay")}
    ).advice()
    assert (
        "0.13 m" in mount
        and "anchors 0 and 2 are up to 3.30 ± 0.05 m late" in mount
        and "anchors 0 and 2" in hang
    )
    assert EFFECTS["floor_multipath"]().advice() == ()


def test_the_spread_of_a_pair_counts_both_ways():
    samples = random_samples(4)
    ids = samples.anchors.ids
    noisy = EFFECTS["noise_level"]({f"{ids[0]}-{ids[1]}": 0.3})
    hit = np.isin(samples.a, (0, 1)) & np.isin(samples.b, (0, 1))
    np.testing.assert_allclose(EffectSet((noisy,)).noise_std(samples), 0.3 * hit)


def test_inertial_samples_are_corrected_the_same_at_once_and_one_by_one():
    rng = np.random.default_rng(0)
    effects = [
        EFFECTS["gyro_bias"]({"z": 0.02}),
        EFFECTS["imu_misalignment"]({"x": 0.1}),
        EFFECTS["accel_scale"]({"y": 0.03}),
        SmoothTerm({"c3": 0.4}, {}, "", "accel.z", "vibration", "common", [0.0, 1.0, 2.0]),
    ]
    samples = np.arange(200) / 1000.0, *rng.standard_normal((2, 200, 3))
    together, corrector = ImuCorrector(effects).correct(*samples), ImuCorrector(effects)
    single = [corrector.correct(*(part[k : k + 1] for part in samples)) for k in range(200)]
    for one_by_one, at_once in zip(zip(*single), together):
        np.testing.assert_allclose(np.concatenate(one_by_one), at_once, atol=1e-12)


def test_sensors_are_corrected_the_same_at_once_and_one_by_one_whatever_was_not_measured():
    rng, n = np.random.default_rng(0), 50
    values = {
        "velocity_scale": {"scale": 0.1},
        "velocity_misalignment": {"yaw": 1.5},
        "velocity_delay": {"offset": 0.02},
        "yaw_rate_scale": {"scale": 0.25},
    }
    corrector = StreamCorrector([EFFECTS[name](each) for name, each in values.items()])
    t, v, std = np.arange(n) / 25.0, rng.standard_normal((n, 3)), rng.uniform(0.1, 0.2, (n, 3))
    v[:, 2], std[:, 2] = np.nan, np.inf
    rates = rng.standard_normal(n), np.where(rng.random(n) < 0.5, 0.0, 0.1)
    velocity = Velocity(t, v, std, *rates)
    late, turned, wider, *slower = corrector.correct("velocity", velocity).columns
    for column, rate in zip(slower, rates):
        np.testing.assert_allclose(column, rate / 1.25, atol=1e-12)
    expected = Rotation.from_euler("z", 1.5).apply(np.where(np.isfinite(v), v, 0.0)) / 1.1
    np.testing.assert_allclose(turned[:, :2], expected[:, :2], atol=1e-12)
    np.testing.assert_allclose(late, t - 0.02)
    assert np.isinf(wider[:, 2]).all() and (wider[:, :2] < 0.2).all()
    unstated = corrector.correct(
        "velocity", Velocity(t, v, np.where(np.isinf(std), std, 0.0))
    ).columns[2]
    # A deviation that the driver does not state stays unstated.
    np.testing.assert_array_equal(unstated, np.where(np.isinf(std), std, 0.0))
    single = [
        corrector.correct(
            "velocity", Velocity(*(column[k : k + 1] for column in (t, v, std, *rates)))
        ).columns
        for k in range(n)
    ]
    for column, whole in enumerate((late, turned, wider, *slower)):
        np.testing.assert_allclose(
            np.concatenate([each[column] for each in single]), whole, atol=1e-12
        )


def test_a_yaw_rate_that_was_not_measured_has_no_scale():
    n, scale = 30, EFFECTS["yaw_rate_scale"]({"scale": 0.25})
    t, v = np.arange(n) / 25.0, np.ones((n, 3))
    silent = Velocity(t, v, np.full((n, 3), 0.1))
    flight = Flight("f", ANCHORS, Tdoas(t, t, t, t), velocity=silent)
    with pytest.raises(InputError, match="f: holds no yaw rate, which yaw_rate_scale needs"):
        scale.inject(flight)
    some = np.arange(n) % 3 == 0
    std, rate = np.where(some, np.inf, 0.0), np.where(some, np.nan, 0.5)
    mixed = Velocity(t, v, np.full((n, 3), 0.1), rate, std)
    corrected = StreamCorrector([scale]).correct("velocity", mixed)
    np.testing.assert_array_equal(corrected.yaw_rate_std, std)
    np.testing.assert_allclose(corrected.yaw_rate[~some], 0.4)
    np.testing.assert_array_equal(corrected.v, v)


def test_ids_are_exchanged_at_once_and_signs_after_them():
    a, b, d = relabelled([IDS, SIGN], A, B, D)
    assert (
        a.tolist() == [4, 2, 1, 7]
        and b.tolist() == [2, 1, 7, 4]
        and d.tolist() == [-0.5, -1.0, 2.0, -0.25]
    )
    # The inputs are unchanged.
    assert A.tolist() == [1, 2, 4, 7] and D[0] == 0.5


@pytest.mark.parametrize(
    "name, values",
    [("anchor_ids", {"1": 2.5}), ("anchor_ids", {"1": -2}), ("pair_sign", {"0-1": 0.5})],
)
def test_only_whole_numbers(name, values):
    with pytest.raises(InputError, match=f"{name}: values"):
        EFFECTS[name](values)


@pytest.mark.parametrize(
    "value, std, text",
    [
        (0.3123, 0.0104, "0.31 ± 0.01 m"),
        (0.0507, 0.12, "0.05 ± 0.12 m"),
        (1.26, 1.4, "1.3 ± 1.4 m"),
        (0.3123, 0.0008, "0.3123 ± 0.0008 m"),
        (-0.05, 0.096, "-0.05 ± 0.10 m"),
        (16.74, 1.1, "17 ± 1 m"),
        (1234.0, 40.0, "1234 ± 40 m"),
        (0.28333, None, "0.283 m"),
        (0.28333, 0.0, "0.283 m"),
    ],
)
def test_values_are_rounded_to_their_standard_deviation(value, std, text):
    assert measured(value, std, "m") == text
    assert listed(["3"]) == "3" and listed("357") == "3, 5 and 7"
    assert counted(["3"], "anchor") == "anchor 3" and counted("35", "anchor") == "anchors 3 and 5"


@pytest.mark.parametrize(
    "values, std, order",
    [
        ({0: 0.1, 1: -0.3, 3: 0.02}, {0: 0.05, 1: 0.02, 3: 0.011}, ["1", "0"]),
        ({0: 0.3, 1: 0.2, 3: 0.4}, {0: 0.0, 1: 0.01}, ["1", "0", "3"]),  # unknown deviations last
    ],
)
def test_significant_values_come_in_the_order_of_their_significance(values, std, order):
    assert list(EFFECTS["anchor_delay"](values, std).significant()) == order


@given(st.floats(-100, 100), st.floats(1e-6, 10))
def test_what_is_printed_is_the_value_within_half_a_digit_of_its_standard_deviation(value, std):
    shown, error = (float(number) for number in measured(value, std).split(" ± "))
    assert abs(shown - value) <= 0.5 * std * (1 + 1e-6) and error == pytest.approx(
        std, rel=0.51 if std > 1.0 else 0.12
    )


@pytest.mark.parametrize(
    "name, values, std, said",
    [
        ("anchor_delay", {3: 0.31}, {3: 0.01}, ["anchor 3", "0.31 ± 0.01 m late"]),
        ("anchor_delay", {3: -0.31, 1: 0.01}, {3: 0.01, 1: 0.02}, ["0.31 ± 0.01 m early"]),
        (
            "anchor_position",
            {"5.x": 0.2, "5.z": -0.1},
            {"5.x": 0.01, "5.z": 0.01},
            ["+x", "-z", "Measure anchor 5 again before you move it"],
        ),
        (
            "nlos",
            {"1.delay": 0.5, "1.start": 20, "1.end": 32},
            {"1.delay": 0.02},
            ["from 20 to 32 s", "anchor 1"],
        ),
        (
            "nlos",
            BLOCKED,
            {"1.delay": 0.04},
            ["anchor 1 and (-0.9, -1.2, 2.0) m", "within 1.0 m", "0.53 ± 0.04 m"],
        ),
        (
            "floor_step",
            {"1.height": 0.5, "1.start": 20},
            {"1.height": 0.02},
            ["from 20 s on after the first TDOA: the ground was 0.50 ± 0.02 m higher"],
        ),
        (
            "imu_misalignment",
            {"z": -0.0698},
            {"z": 0.005},
            ["Turn the IMU by 4.0 ± 0.3 degrees about z"],
        ),
        ("tdoa_time_offset", {"offset": 0.012}, {"offset": 0.001}, ["12 ± 1 ms late"]),
        (
            "accel_bias",
            {"x": -2.181, "z": -0.04},
            {"x": 0.092, "z": 0.055},
            ["2.18 ± 0.09 m/s^2 too little along x"],
        ),
        ("anchor_ids", {"1": 4}, {}, ["Give the anchors", "called 1 is anchor 4 of the survey"]),
        ("pair_sign", {"1-4": -1}, {}, ["Look in the driver", "the sign of the TDOA of 1-4"]),
        ("gyro_scale", {"z": 0.03}, {"z": 0.001}, ["3.0 ± 0.1 % too much about z"]),
    ],
)
def test_advice_names_place_size_and_sign(name, values, std, said):
    (sentence,) = EFFECTS[name](values, std).advice()
    for part in said:
        assert part in sentence
    # Advice leaves insignificant values out.
    for key in values:
        if key in std and abs(values[key]) < 2 * std[key]:
            assert f"anchor {key}" not in sentence and f"along {key}" not in sentence


def test_regions_and_shifts_on_the_map_are_those_of_the_values():
    (region,) = EFFECTS["nlos"](BLOCKED, {"1.delay": 0.04}).marks(ANCHORS)
    assert (region.anchor, region.radius) == (1, 1.0)
    assert region.centre.tolist() == [-0.9, -1.2, 2.0]
    (shift,) = EFFECTS["anchor_position"]({"3.x": 0.2, "3.z": -0.1}, {"3.x": 0.03}).marks(ANCHORS)
    assert shift.anchor == 3 and shift.by.tolist() == [0.2, 0.0, -0.1]
    np.testing.assert_array_equal(shift.std, [0.03, np.nan, np.nan])
    frame = EFFECTS["truth_frame"]({"x": 0.1, "yaw": 0.05}).marks(ANCHORS)
    assert [mark.anchor for mark in frame] == [0, 1, 3, 7]
    np.testing.assert_allclose(frame[0].by, [0.1, 0.0, 0.0], atol=1e-12)
    assert np.linalg.norm(frame[3].by) > 0.4


def test_an_effect_without_a_sentence_of_its_own_is_advised_on_by_its_physics():
    class Rust(EFFECTS["anchor_delay"]):
        """An effect that a user adds."""

        name, physics, remedy = "rust", "rusty connectors", ""

    (sentence,) = Rust({3: 0.31, 1: 0.001}, {3: 0.01, 1: 0.002}).advice()
    assert (
        sentence == "Look for the cause of rust: rusty connectors (found: 3 = 0.31 ± 0.01, in m)."
    )
