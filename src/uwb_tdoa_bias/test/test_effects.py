# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Properties that every effect has, whatever its family."""

from dataclasses import replace
from functools import cache
from pathlib import Path
import re

from finite_differences import numerical_jacobian
from hypothesis import assume, given, settings, strategies as st
import numpy as np
import pytest
from random_samples import random_samples, ranges_of
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import (
    BY_POSE,
    STREAM_OF,
    Height,
    Pressure,
    Ranges,
    Velocity,
    measured_on,
)
from uwb_tdoa_bias.common.sensors.pressure import pressure_at
from uwb_tdoa_bias.effects import (
    EFFECTS,
    RADIO,
    AnchorDelay,
    EffectSet,
    ImuCorrector,
    ImuSamples,
    LabelEffect,
    Samples,
    SmoothTerm,
    StreamCorrector,
    TagLeverArm,
    Track,
    samples_at,
    sensor_samples,
    tag,
    true_samples,
)
from uwb_tdoa_bias.effects.base import counted, listed, measured, relabelled
from uwb_tdoa_bias.effects.sensor import StampEffect

# --- effects ---

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "effects.md"
PAIRS = np.array([[0, 1], [3, 2]])
_PLACED = random_samples(3).anchors
ANCHORS = Anchors(np.arange(5), _PLACED.positions + 8.0, _PLACED.orientations)
seeds = st.integers(0, 2**32 - 1)
ALL = list(EFFECTS.values())
ESTIMATED = [effect for effect in ALL if not issubclass(effect, LabelEffect)]
NOISE = [EFFECTS[name] for name in ("noise_level", "noise_correlation", "outlier_rate")]
ON_SENSORS = [effect for effect in ALL if set(effect.channels) <= {"gyro", "accel", *BY_POSE}]
FITTED_ON_RADIO = [
    (effect, channel)
    for effect in ALL
    if effect.fitted and not issubclass(effect, StampEffect)
    for channel in effect.channels
    if channel in RADIO
]
ON_BOTH = [effect for effect, _ in FITTED_ON_RADIO if set(RADIO) <= set(effect.channels)]


@cache
def flight_with_all(seed, n=400):
    """Return a Flight on a smooth path with every stream, without noise and errors."""
    rng, t = np.random.default_rng(seed), np.arange(n) / 25.0
    phase = rng.uniform(0.0, 6.0, 6)
    p = np.stack([np.sin(0.7 * t + phase[0]), np.cos(0.5 * t + phase[1]), np.zeros(n)], axis=1)
    p[:, 2] = 1.1 + np.sin(0.9 * t + phase[2])
    angles = np.stack([0.1 * np.sin(t + phase[3]), 0.1 * np.cos(t + phase[4]), 0.3 * t], axis=1)
    truth = Truth(t, p, Rotation.from_euler("xyz", angles).as_quat())
    a, b = np.arange(n) % 5, (np.arange(n) + 1) % 5
    tdoas = Tdoas(t, a, b, samples_at(t, a, b, truth, ANCHORS).predicted())
    track, late = Track(truth), t[10:-10:5] + 0.01
    row = np.arange(len(late)) % 5
    d = np.linalg.norm(track.positions(late) - ANCHORS.positions[row], axis=1)
    reading = {name: sensor_samples(name, t, track, t[0]).reading for name in BY_POSE}
    return Flight(
        "f",
        ANCHORS,
        tdoas,
        truth=truth,
        imu=Imu(t, rng.standard_normal((n, 3)), rng.standard_normal((n, 3)) + [0.0, 0.0, 9.8]),
        height=Height(t, reading["height"][:, 0]),
        pressure=Pressure(t, pressure_at(reading["pressure"][:, 0])),
        velocity=Velocity(
            t,
            reading["velocity"],
            np.full((n, 3), 0.1),
            reading["yaw_rate"][:, 0],
            np.full(n, 0.1),
        ),
        range=Ranges(late, row, d, np.zeros(len(late))),
    )


def made(effect, size=0.1, rng=None):
    """Return the effect with a random value for every possible parameter.

    The magnitude is about `size`, or smaller if the bound of a parameter is below 1.
    """
    if effect.name in ("anchor_ids", "pair_sign"):
        return effect(
            {"anchor_ids": {"1": 2, "2": 4, "4": 1}, "pair_sign": {"0-1": -1}}[effect.name]
        )
    rng = rng or np.random.default_rng(0)
    keys = effect.groups(ANCHORS, PAIRS)[0] or (effect.row.example,)
    limits = {"1.start": 3.0, "1.end": 9.0} if effect.row.example.startswith("1.") else {}
    sizes = {key: size * min(1.0, effect.bound_of(key)) * rng.uniform(0.5, 1.0) for key in keys}
    return effect({**limits, **sizes})


def part_of(flight, channel):
    """Return the stream of a channel of a Flight, "truth" included."""
    if channel in ("gyro", "accel"):
        return flight.imu
    return measured_on(flight, channel) if channel in STREAM_OF else getattr(flight, channel)


def values_of(flight, channel):
    """Return the values of a channel of a Flight, "truth" included."""
    part = part_of(flight, channel)
    if channel in ("gyro", "accel"):
        return getattr(part, channel)
    return getattr(part, {"truth": "p", "tdoa": "d", "range": "d"}.get(channel, "values"))


def labels_of(flight, channel):
    """Return the stamps and ids of a channel of a Flight."""
    part = part_of(flight, channel)
    ids = {"tdoa": ("a", "b"), "range": ("anchor",)}.get(channel, ())
    return np.stack([part.t, *(getattr(part, name) for name in ids)])


def samples_of(flight, channel):
    """Return samples of a sensor of a Flight, for effects on it."""
    track = Track(flight.truth)
    if channel in BY_POSE:
        return sensor_samples(channel, measured_on(flight, channel).t, track, flight.tdoa.t[0])
    t, reading = flight.imu.t, getattr(flight.imu, channel)
    up = Rotation.from_quat(track.attitudes(t)).inv().apply([0.0, 0.0, 1.0])
    unused = None
    return ImuSamples(channel, t, track.positions(t), t[0], reading, unused, up, unused, unused)


@pytest.mark.parametrize("effect", ALL)
def test_is_declared_in_full(effect):
    assert EFFECTS[effect.name] is effect
    assert effect.row.bound > effect.row.negligible > 0.0 and effect.row.prior_std > 0.0
    assert effect.unit and effect.row.reference and effect.row.physics
    assert set(effect.row.distinguished_by) <= set(effect.row.confounded_with) <= set(EFFECTS)
    assert set(effect.channels) <= {"tdoa", "gyro", "accel", *STREAM_OF}
    # An effect without parameters changes nothing.
    np.testing.assert_array_equal(effect().bias(random_samples(1)), 0.0)
    np.testing.assert_array_equal(effect().noise_std(random_samples(1)), 0.0)
    bound = effect.bound_of(effect.row.example)
    for wrong in (np.nan, np.inf, 1.01 * bound, -1.01 * bound, "much", None, [0.1]):
        with pytest.raises(InputError, match="values"):
            effect({effect.row.example: wrong})
    for wrong in ("sideways", "0.sideways", "1-2-3", "123456", "²"):
        with pytest.raises(InputError, match=f"effects: {effect.name}: parameter '{wrong}' is not"):
            effect({wrong: 0.1})


@pytest.mark.parametrize("effect", ALL)
def test_is_in_the_document(effect):
    text = DOCUMENT.read_text()
    section = text.partition(f"### {effect.name}\n")[2].partition("\n### ")[0]
    assert effect.row.physics in section and effect.row.reference in section
    assert all(other in section for other in effect.row.confounded_with)
    assert (
        f"| {effect.row.bound:g} | {effect.row.prior_std:g} | {effect.row.negligible:g} |"
        in text.partition(f"[`{effect.name}`]")[2].split("\n")[0]
    )


@pytest.mark.parametrize("effect, channel", FITTED_ON_RADIO)
@settings(max_examples=25)
@given(seeds)
def test_regressors_are_derivatives_of_the_bias(effect, channel, seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed)
    ids = samples.anchors.ids
    keys = effect.groups(samples.anchors, np.column_stack([ids[samples.a], ids[samples.b]]))[0]
    values = {key: 0.1 * min(1.0, effect.bound_of(key)) * rng.uniform(-1.0, 1.0) for key in keys}
    samples = samples if channel == "tdoa" else ranges_of(samples, samples.b)
    keys = list(values)[::-1]

    def bias(at):
        return effect({**values, **dict(zip(keys, at))}).bias(samples)

    found = effect(values).regressors(samples, keys)
    assert found.shape == (len(samples), len(keys))
    expected = numerical_jacobian(bias, [values[k] for k in keys])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(effect(values).regressors(samples, keys[:1]), found[:, :1])


@pytest.mark.parametrize("effect", ON_SENSORS)
@given(st.integers(0, 20))
def test_regressors_on_sensors_are_what_inject_adds(effect, seed):
    """Compare to first order. Both are undefined at the ends of intervals and of the recording."""
    flight = flight_with_all(seed)
    one = made(effect, 1e-3, np.random.default_rng(seed))
    keys = [key for key in one.values if not key.endswith(("start", "end"))]
    fixed = effect({key: value for key, value in one.values.items() if key not in keys})
    changed = one.inject(flight)
    for channel in effect.channels:
        before, after = values_of(flight, channel), values_of(changed, channel)
        t, moved = flight.truth.t, labels_of(changed, channel)[0]
        # Stamps are late: interpolate the readings to the old stamps.
        if not np.array_equal(moved, t):
            after = np.stack([np.interp(t, moved, column) for column in after.T], axis=1)
        sizes = [one.values[key] for key in keys]
        predicted = fixed.regressors(samples_of(flight, channel), keys) @ sizes
        rough = 5e-5 if effect.name == "velocity_delay" else 2e-5  # accelerations come from poses
        np.testing.assert_allclose((after - before)[5:-5], predicted[5:-5], atol=rough)


@pytest.mark.parametrize("effect", [effect for effect in ALL if effect not in NOISE])
def test_what_is_injected_is_corrected(effect):
    before, effects = flight_with_all(3), EffectSet((made(effect),))
    changed = effects.effects[0].inject(before)
    after = effects.correct_streams(changed)
    touched = False
    held = [channel for channel in BY_POSE if measured_on(before, channel) is not None]
    for channel in ("gyro", "accel", "truth", *RADIO, *held):
        left = 0.0
        if channel in RADIO:
            left = effects.bias(true_samples(after, RADIO[channel])[0])
        elif channel in effect.channels:
            left = effects.uncorrected(samples_of(before, channel))
        was, labels = values_of(before, channel), labels_of(before, channel)
        np.testing.assert_allclose(labels_of(after, channel), labels, atol=1e-9)
        np.testing.assert_allclose(values_of(after, channel) - left, was, atol=1e-6)
        touched |= not np.array_equal(values_of(changed, channel), was)
        touched |= not np.array_equal(labels_of(changed, channel), labels)
    assert touched


@pytest.mark.parametrize("effect", [effect for effect in ALL if effect not in NOISE])
def test_a_flight_without_its_stream_is_refused(effect):
    flight, channel = flight_with_all(1), effect.channels[0]
    stream = "imu" if channel in ("gyro", "accel") else STREAM_OF.get(channel, channel)
    if stream == "imu" or channel in BY_POSE or effect.name == "range_delay":
        words = "inertial samples" if stream == "imu" else channel.replace("_", " ")
        lacking = replace(flight, **{stream: None})
    elif issubclass(effect, (LabelEffect, StampEffect)):
        return
    else:
        words, lacking = "ground truth", replace(flight, truth=None)
    with pytest.raises(InputError, match=f"holds no {words}, which {effect.name} needs"):
        made(effect).inject(lacking)
    unknown = replace(flight.truth, q=np.full((len(flight.truth), 4), np.nan))
    if effect.name in ("tag_lever_arm", "antenna_pattern"):
        with pytest.raises(InputError, match="has no attitude in its ground truth"):
            made(effect).inject(replace(flight, truth=unknown))


@pytest.mark.parametrize("effect", ON_BOTH)
@settings(max_examples=25)
@given(seeds)
def test_a_tdoa_errs_as_the_ranges_whose_difference_it_is(effect, seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed)
    keys = list(effect.groups(samples.anchors, None)[0])
    one = effect({key: 0.1 * min(1.0, effect.bound_of(key)) * rng.uniform(-1, 1) for key in keys})
    first, second = ranges_of(samples, samples.a), ranges_of(samples, samples.b)
    for function, atol in (
        (lambda part: part.predicted(), 1e-12),
        (lambda part: part.position_jacobian(), 1e-12),
        (one.bias, 1e-9),
        (lambda part: one.regressors(part, keys), 1e-6),
    ):
        np.testing.assert_allclose(function(samples), function(second) - function(first), atol=atol)


@pytest.mark.parametrize("effect", ESTIMATED)
def test_says_whether_it_uses_the_attitude(effect):
    samples = random_samples(7)
    keys = effect.groups(samples.anchors, PAIRS)[0] or (effect.row.example,)
    one = effect({key: 0.1 * effect.bound_of(key) for key in keys})
    turned = replace(samples, q=Rotation.random(len(samples), random_state=1).as_quat())
    changed = np.abs(one.bias(samples) - one.bias(turned)).max() > 1e-9
    assert changed == effect.uses_attitude


def filled(effect, value, std):
    """Return the effect with the same value for all parameters that a fit may set."""
    keys = effect.groups(ANCHORS, PAIRS)[0] or (effect.row.example,)
    limits = {"0.x": 1.0, "0.y": -2.0, "0.z": 1.5, "0.radius": 0.6} if effect.name == "nlos" else {}
    return effect({**dict.fromkeys(keys, value), **limits}, dict.fromkeys(keys, std))


@pytest.mark.parametrize("effect", [e for e in ESTIMATED if e.name != "noise_correlation"])
def test_advice_is_imperative_sentences_with_the_size(effect):
    sentences = filled(effect, 0.2, 0.01).advice()
    assert any("±" in sentence for sentence in sentences)
    for sentence in sentences:
        assert re.match(r"[A-Z][a-z]+ [a-zA-Z]", sentence) and sentence.endswith(".")
        assert not re.search(r"nan|\n|[{}]", sentence) and len(sentence) < 900


@pytest.mark.parametrize("effect", ESTIMATED)
@settings(max_examples=25)
@given(st.floats(0.0, 0.2), st.floats(1.001, 5.0))
def test_nothing_is_advised_on_what_the_data_do_not_determine(effect, value, doubt):
    assume(value > 1e-6)
    assert filled(effect, value, 0.5 * value * doubt).advice() == ()


# --- effect families ---

FOUR = Anchors.from_positions([[0, 0, 0], [8, 0, 3], [0, 7, 0], [8, 7, 3]], ids=[0, 1, 3, 7])
A, B, D = np.array([1, 2, 4, 7]), np.array([2, 4, 7, 1]), np.array([0.5, -1.0, 2.0, -0.25])
IDS, SIGN = EFFECTS["anchor_ids"]({"1": 4, "4": 1}), EFFECTS["pair_sign"]({"4-2": -1})
BLOCKED = {"1.x": -0.9, "1.y": -1.2, "1.z": 2.0, "1.radius": 1.0, "1.delay": 0.53}


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
    flight = Flight("f", FOUR, Tdoas(t, t, t, t), velocity=silent)
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
    (region,) = EFFECTS["nlos"](BLOCKED, {"1.delay": 0.04}).marks(FOUR)
    assert (region.anchor, region.radius) == (1, 1.0)
    assert region.centre.tolist() == [-0.9, -1.2, 2.0]
    (shift,) = EFFECTS["anchor_position"]({"3.x": 0.2, "3.z": -0.1}, {"3.x": 0.03}).marks(FOUR)
    assert shift.anchor == 3 and shift.by.tolist() == [0.2, 0.0, -0.1]
    np.testing.assert_array_equal(shift.std, [0.03, np.nan, np.nan])
    frame = EFFECTS["truth_frame"]({"x": 0.1, "yaw": 0.05}).marks(FOUR)
    assert [mark.anchor for mark in frame] == [0, 1, 3, 7]
    np.testing.assert_allclose(frame[0].by, [0.1, 0.0, 0.0], atol=1e-12)
    assert np.linalg.norm(frame[3].by) > 0.4


def test_an_effect_without_a_sentence_of_its_own_is_advised_on_by_its_physics():
    class Rust(EFFECTS["anchor_delay"]):
        """An effect that a user adds."""

        row = replace(
            EFFECTS["anchor_delay"].row, name="rust", physics="rusty connectors", remedy=""
        )

    (sentence,) = Rust({3: 0.31, 1: 0.001}, {3: 0.01, 1: 0.002}).advice()
    assert (
        sentence == "Look for the cause of rust: rusty connectors (found: 3 = 0.31 ± 0.01, in m)."
    )
