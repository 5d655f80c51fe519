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
    EffectSet,
    ImuSamples,
    LabelEffect,
    Track,
    samples_at,
    sensor_samples,
    true_samples,
)
from uwb_tdoa_bias.effects.stamps import StampEffect

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
    keys = effect.groups(ANCHORS, PAIRS)[0] or (effect.example,)
    limits = {"1.start": 3.0, "1.end": 9.0} if effect.example.startswith("1.") else {}
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
    assert effect.bound > effect.negligible > 0.0 and effect.prior_std > 0.0
    assert effect.unit and effect.reference and effect.physics
    assert set(effect.distinguished_by) <= set(effect.confounded_with) <= set(EFFECTS)
    assert set(effect.channels) <= {"tdoa", "gyro", "accel", *STREAM_OF}
    # An effect without parameters changes nothing.
    np.testing.assert_array_equal(effect().bias(random_samples(1)), 0.0)
    np.testing.assert_array_equal(effect().noise_std(random_samples(1)), 0.0)
    bound = effect.bound_of(effect.example)
    for wrong in (np.nan, np.inf, 1.01 * bound, -1.01 * bound, "much", None, [0.1]):
        with pytest.raises(InputError, match="values"):
            effect({effect.example: wrong})
    for wrong in ("sideways", "0.sideways", "1-2-3", "123456", "²"):
        with pytest.raises(InputError, match=f"effects: {effect.name}: parameter '{wrong}' is not"):
            effect({wrong: 0.1})


@pytest.mark.parametrize("effect", ALL)
def test_is_in_the_document(effect):
    text = DOCUMENT.read_text()
    section = text.partition(f"### {effect.name}\n")[2].partition("\n### ")[0]
    assert effect.physics in section and effect.reference in section
    assert all(other in section for other in effect.confounded_with)
    assert (
        f"| {effect.bound:g} | {effect.prior_std:g} | {effect.negligible:g} |"
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
    keys = effect.groups(samples.anchors, PAIRS)[0] or (effect.example,)
    one = effect({key: 0.1 * effect.bound_of(key) for key in keys})
    turned = replace(samples, q=Rotation.random(len(samples), random_state=1).as_quat())
    changed = np.abs(one.bias(samples) - one.bias(turned)).max() > 1e-9
    assert changed == effect.uses_attitude


def filled(effect, value, std):
    """Return the effect with the same value for all parameters that a fit may set."""
    keys = effect.groups(ANCHORS, PAIRS)[0] or (effect.example,)
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
