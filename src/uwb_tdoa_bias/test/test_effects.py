from dataclasses import replace
from pathlib import Path

from finite_differences import numerical_jacobian
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_samples import random_samples, ranges_of
from scipy.spatial.transform import Rotation
import yaml

from uwb_tdoa_bias.effects import (
    EFFECTS,
    RADIO,
    AidCorrector,
    AnchorDelay,
    EffectSet,
    ImuCorrector,
    LabelEffect,
    Samples,
    SmoothTerm,
    TagLeverArm,
    Track,
    aid_samples,
    true_samples,
)
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight, Tdoas, Truth
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_bias.foundation.sensors import (
    BY_POSE,
    STREAM_OF,
    Height,
    Pressure,
    Ranges,
    Velocity,
    measured_on,
)
from uwb_tdoa_bias.foundation.sensors.pressure import pressure_at

seeds = st.integers(0, 2**32 - 1)


FITTED = [effect for effect in EFFECTS.values() if effect.fitted and "tdoa" in effect.channels]
SCALABLE = [
    effect for effect in EFFECTS.values() if not issubclass(effect, LabelEffect)
]  # not whole numbers
STAMPS = (
    "tdoa_time_offset",
    "truth_time_offset",
    "range_delay",
)  # act on stamps: their bias is zero, their regressors are not
OF_RADIO = [
    (effect, channel)
    for effect in EFFECTS.values()
    if effect.fitted
    for channel in effect.channels
    if channel in RADIO
]
OF_BOTH = [effect for effect, channel in OF_RADIO if channel == "range" and effect in FITTED]


def parameters(effect, samples, rng):
    """Some parameters of an effect for these samples: {name: value}."""
    ids = samples.anchors.ids
    keys = effect.groups(samples.anchors, np.column_stack([ids[samples.a], ids[samples.b]]))[0]
    return {key: 0.1 * min(1.0, effect.bound_of(key)) * rng.uniform(-1.0, 1.0) for key in keys}


@pytest.mark.parametrize(
    "effect, channel",
    [(effect, channel) for effect, channel in OF_RADIO if effect.name not in STAMPS],
)
@given(seeds)
def test_regressors_against_finite_differences(effect, channel, seed):
    samples = random_samples(seed)
    samples = samples if channel == "tdoa" else ranges_of(samples, samples.b)
    values = parameters(effect, samples, np.random.default_rng(seed))
    keys = list(values)[::-1]

    def bias(at):
        return effect({**values, **dict(zip(keys, at))}).bias(samples)

    found = effect(values).regressors(samples, keys)
    assert found.shape == (len(samples), len(keys))
    np.testing.assert_allclose(
        found, numerical_jacobian(bias, [values[k] for k in keys]), atol=1e-5
    )


@pytest.mark.parametrize("effect", OF_BOTH)
@given(seeds)
def test_a_tdoa_errs_as_the_ranges_whose_difference_it_is(effect, seed):
    samples = random_samples(seed)
    made = effect(parameters(effect, samples, np.random.default_rng(seed)))
    first, second = ranges_of(samples, samples.a), ranges_of(samples, samples.b)
    np.testing.assert_allclose(samples.true(), second.true() - first.true(), atol=1e-12)
    np.testing.assert_allclose(
        samples.direction(), second.direction() - first.direction(), atol=1e-12
    )
    np.testing.assert_allclose(made.bias(samples), made.bias(second) - made.bias(first), atol=1e-9)
    keys = list(made.values)
    of_each = (made.regressors(part, keys) for part in (samples, second, first))
    together, at_b, at_a = of_each
    np.testing.assert_allclose(together, at_b - at_a, atol=1e-6)


def ranged(moving):
    """The same Flight with distances to anchors, one after the other."""
    anchors = replace(
        random_samples(3).anchors, positions=random_samples(3).anchors.positions + 8.0
    )
    t = np.linspace(moving.truth.t[0] + 0.5, moving.truth.t[-1] - 0.5, 60)
    row = np.arange(len(t)) % len(anchors)
    d = np.linalg.norm(Track(moving.truth).positions(t) - anchors.positions[row], axis=1)
    return replace(moving, anchors=anchors, range=Ranges(t, anchors.ids[row], d, np.zeros(len(t))))


@pytest.mark.parametrize(
    "effect",
    [effect for effect, channel in OF_RADIO if channel == "range" and effect.name not in STAMPS],
)
def test_is_injected_into_ranges_and_taken_out_of_them(effect):
    before = ranged(felt(1)[0])
    keys = effect.groups(before.anchors, np.array([[0, 1]]))[0]
    made = effect(dict.fromkeys(keys, 0.2 * min(1.0, effect.bound)))
    after = made.inject(before)
    samples, rows = true_samples(after, RADIO["range"])
    assert len(rows) == len(before.range) and np.abs(after.range.d - before.range.d).max() > 0.01
    np.testing.assert_allclose(
        after.range.d - EffectSet((made,)).bias(samples), before.range.d, atol=1e-12
    )


def test_late_stamps_of_ranges_are_moved_back():
    flight = felt(1)[0]
    before, late = ranged(flight), EFFECTS["range_delay"]({"offset": 0.05})
    after = late.inject(before)
    np.testing.assert_array_equal(after.range.t, before.range.t + 0.05)
    np.testing.assert_allclose(
        EffectSet((late,)).correct_streams(after).range.t, before.range.t, atol=1e-12
    )
    with pytest.raises(InputError, match="holds no range, which range_delay needs"):
        late.inject(flight)


@pytest.mark.parametrize("effect", SCALABLE)
def test_says_whether_it_uses_the_attitude(effect):
    samples = random_samples(7)
    groups = effect.groups(samples.anchors, np.array([[0, 1]]))[0] or (effect.example,)
    values = {key: 0.1 * effect.bound_of(key) for key in groups}
    turned = replace(samples, q=Rotation.random(len(samples), random_state=1).as_quat())
    changed = np.abs(effect(values).bias(samples) - effect(values).bias(turned)).max() > 1e-9
    assert changed == effect.uses_attitude


@pytest.mark.parametrize("effect", FITTED)
def test_regressors_of_some_parameters_are_those_columns(effect):
    samples = random_samples(5)
    values = parameters(effect, samples, np.random.default_rng(5))
    keys = list(values)
    whole = effect(values).regressors(samples, keys)
    np.testing.assert_array_equal(effect(values).regressors(samples, keys[1:2]), whole[:, 1:2])


@pytest.mark.parametrize("effect", EFFECTS.values())
def test_is_declared_in_full(effect):
    assert EFFECTS[effect.name] is effect
    assert (
        effect.bound > effect.negligible > 0.0
        and effect.unit
        and effect.reference
        and effect.physics
    )
    assert set(effect.confounded_with) <= set(EFFECTS) and set(effect.channels) <= {
        "tdoa",
        "gyro",
        "accel",
        *STREAM_OF,
    }
    np.testing.assert_array_equal(effect().bias(random_samples(1)), 0.0)  # no parameter, no effect
    np.testing.assert_array_equal(effect().noise_std(random_samples(1)), 0.0)
    bound = effect.bound_of(effect.example)
    for wrong in (np.nan, np.inf, 1.01 * bound, -1.01 * bound, "much", None, [0.1]):
        with pytest.raises(InputError, match="values"):
            effect({effect.example: wrong})
    with pytest.raises(InputError, match=f"effects: {effect.name}: parameter 'sideways'"):
        effect({"sideways": 0.1})


def test_delay_of_an_anchor_makes_it_seem_farther_away():
    anchors = Anchors.from_positions([[0, 0, 0], [10, 0, 0], [0, 10, 0]], ids=[5, 6, 7])
    samples = Samples(
        np.zeros(3),
        np.array([0, 1, 1]),
        np.array([1, 0, 2]),
        np.ones((3, 3)),
        np.full((3, 4), np.nan),
        anchors,
    )
    ranges = np.linalg.norm(samples.p[0] - anchors.positions, axis=1) + [0.3, 0.0, -0.1]
    late = ranges[samples.b] - ranges[samples.a]
    clean = tdoa(samples.p, anchors.positions[samples.a], anchors.positions[samples.b])
    effect = AnchorDelay({5: 0.3, "7": -0.1})
    np.testing.assert_allclose(effect.bias(samples), late - clean, atol=1e-12)


@given(seeds)
def test_a_delay_that_all_anchors_share_is_not_seen(seed):
    samples = random_samples(seed)
    effect = AnchorDelay({str(i): 0.7 for i in samples.anchors.ids})
    np.testing.assert_array_equal(effect.bias(samples), 0.0)


@given(seeds)
def test_lever_arm_is_where_the_antenna_is(seed):
    samples = random_samples(seed)
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
    """Samples at heights (n,), m, above (x, 0), of TDOAs from an anchor 0 that is on time to anchor
    1.
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
    np.testing.assert_allclose(
        noise, [0.0, 0.0, 0.0, 1.5, 0.0, 0.0], atol=2e-3
    )  # late or not: 3 m times sqrt(p (1 - p))
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


def test_regressors_of_the_floor_are_what_its_delays_do():
    samples = random_samples(3)
    ids, rng = samples.anchors.ids.tolist(), np.random.default_rng(3)
    samples.p[:, 2] = rng.uniform(0.0, 0.3, len(samples))
    delays = {f"{i}.delay": rng.uniform(0.0, 4.0) for i in ids}
    floor = EFFECTS["floor_multipath"]({**delays, "x": 0.5, "y": -0.5})
    np.testing.assert_allclose(
        floor.regressors(samples, list(delays)) @ list(delays.values()),
        floor.bias(samples),
        atol=1e-9,
    )


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


def test_empty_set():
    effects = EffectSet()
    assert len(effects) == 0 and effects.name == "none"
    np.testing.assert_array_equal(effects.bias(random_samples(0)), 0.0)


def test_yaml_gives_back_what_was_written(tmp_path):
    delay = AnchorDelay({0: 0.05, 12: -0.02}, {0: 0.004, 12: 0.004}, "bench")
    written = EffectSet((TagLeverArm({"x": -0.012, "y": 0.001, "z": 0.091}), delay))
    written.to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert read == written
    assert read.name == "tag_lever_arm+anchor_delay"
    assert read.effects[1].source == "bench" and read.effects[1].std == {"0": 0.004, "12": 0.004}


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "mapping 'effects'"),
        ("effects: [anchor_delay]", "mapping 'effects'"),
        ("effects: {gravity: {values: {x: 1}}}", "'gravity' is not known"),
        ("effects: {anchor_delay: {value: {0: 0.1}}}", "'value' is not one of"),
        ("effects: {anchor_delay: [0.1]}", "not"),
        ("effects: {anchor_delay: {values: [0.1]}}", "mappings"),
        ("effects: {anchor_delay: {values: 0.1}}", "mappings"),
        ("effects: {anchor_delay: {values: {0: late}}}", "0 is 'late'"),
        ("effects: {anchor_delay: {values: {0: 6.0}}}", "between -5 and 5"),
        ("effects: {anchor_delay: {values: {north: 0.1}}}", "'north'"),
        ("effects: {tag_lever_arm: {values: {w: 0.1}}}", "'w'"),
        ("effects: {anchor_delay: {values: {0: 0.1}", "YAML"),
    ],
)
def test_bad_yaml_is_told_in_one_sentence(tmp_path, text, said):
    path = tmp_path / "effects.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        EffectSet.from_yaml(path)


def test_an_effect_without_values_is_one_that_is_zero(tmp_path):
    (tmp_path / "effects.yaml").write_text("effects: {anchor_delay: }")
    effects = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert effects.name == "anchor_delay" and effects.effects[0].values == {}


@pytest.mark.parametrize("effect", EFFECTS.values())
def test_is_in_the_document(effect):
    text = (Path(__file__).resolve().parents[3] / "docs" / "effects.md").read_text()
    section = text.partition(f"### {effect.name}\n")[2].partition("\n### ")[0]
    assert (
        effect.physics in section
        and effect.reference in section
        and all(o in section for o in effect.confounded_with)
    )
    assert (
        f"| {effect.bound:g} | {effect.typical:g} | {effect.negligible:g} |"
        in text.partition(f"[`{effect.name}`]")[2].split("\n")[0]
    )


@given(st.lists(st.floats(-5, 15), min_size=1, max_size=20), st.integers(0, 50))
def test_splines_are_those_of_scipy(values, seed):
    from scipy.interpolate import BSpline

    rng = np.random.default_rng(seed)
    knots = np.cumsum(rng.uniform(0.1, 3.0, rng.integers(2, 8)))
    smooth = SmoothTerm(knots=tuple(knots))
    clamped = np.array([knots[0]] * 2 + list(knots) + [knots[-1]] * 2)
    expected = BSpline(clamped, np.eye(len(knots) + 1), 2)(np.clip(values, knots[0], knots[-1]))
    np.testing.assert_allclose(smooth.basis(np.array(values)), expected, atol=1e-12)


def term(**changes):
    settings = {
        "channel": "tdoa",
        "covariate": "range",
        "form": "arrival",
        "knots": [1.0, 4.0, 9.0],
    }
    return SmoothTerm({"c0": 0.1, "c1": -0.2, "c2": 0.05, "c3": 0.3}, **{**settings, **changes})


@pytest.mark.parametrize(
    "form, covariate",
    [("common", "height"), ("arrival", "elevation_in_anchor"), ("anchor", "range")],
)
@pytest.mark.parametrize("channel", RADIO)
@given(seed=seeds)
def test_smooth_term_is_linear_in_its_coefficients(channel, form, covariate, seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed)
    samples = samples if channel == "tdoa" else ranges_of(samples, samples.b)
    empty = term(channel=channel, form=form, covariate=covariate)
    keys = empty.keys(samples.anchors)
    values = dict(zip(keys, rng.standard_normal(len(keys))))
    full = SmoothTerm(values, {}, "", channel, covariate, form, empty.knots)
    assert channel == "tdoa" or np.abs(full.bias(samples)).max() > 1e-3
    np.testing.assert_allclose(
        full.bias(samples), full.regressors(samples, keys) @ list(values.values()), atol=1e-12
    )


def test_a_function_of_ranges_adds_nothing_to_tdoas_nor_the_other_way_round():
    samples = random_samples(2)
    np.testing.assert_array_equal(term(channel="range").bias(samples), 0.0)
    np.testing.assert_array_equal(term().bias(ranges_of(samples, samples.b)), 0.0)
    with pytest.raises(InputError, match="form: pair acts on two anchors"):
        term(channel="range", form="pair", covariate="height")
    with pytest.raises(InputError, match="'previous_anchor' acts on 'range'"):
        term(channel="range", form="common", covariate="previous_anchor")


def test_smooth_term_is_constant_beyond_its_knots_and_survives_a_file(tmp_path):
    one = term()
    np.testing.assert_allclose(
        one.curve(np.array([-5.0, 1.0, 9.0, 50.0])), [0.1, 0.1, 0.3, 0.3], atol=1e-12
    )
    EffectSet((one, term(covariate="height", form="common"))).to_yaml(tmp_path / "effects.yaml")
    again = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert [e.covariate for e in again.effects] == ["range", "height"]
    np.testing.assert_array_equal(
        again.bias(random_samples(3)),
        EffectSet((one, term(covariate="height", form="common"))).bias(random_samples(3)),
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"knots": [1.0]},
        {"knots": [2.0, 1.0]},
        {"covariate": "colour"},
        {"channel": "gyro.w"},
        {"form": "odd"},
    ],
)
def test_smooth_term_refuses_nonsense(changes):
    with pytest.raises(InputError, match="smooth_term"):
        term(**changes)


def test_inertial_samples_are_corrected_the_same_at_once_and_one_by_one():
    rng = np.random.default_rng(0)
    effects = [
        EFFECTS["gyro_bias"]({"z": 0.02}),
        EFFECTS["imu_misalignment"]({"x": 0.1}),
        EFFECTS["accel_scale"]({"y": 0.03}),
    ]
    effects += [
        SmoothTerm(
            {"c0": 0.1, "c3": 0.4}, {}, "", "accel.z", "vibration", "common", [0.0, 1.0, 2.0]
        )
    ]
    t, gyro, accel = (
        np.arange(200) / 1000.0,
        rng.standard_normal((200, 3)),
        rng.standard_normal((200, 3)),
    )
    together = ImuCorrector(effects).correct(t, gyro, accel)
    corrector = ImuCorrector(effects)
    single = [
        corrector.correct(t[k : k + 1], gyro[k : k + 1], accel[k : k + 1]) for k in range(200)
    ]
    for sensor in range(2):
        np.testing.assert_allclose(
            np.concatenate([s[sensor] for s in single]), together[sensor], atol=1e-12
        )


def test_stamps_and_spread():
    samples = random_samples(4)
    ids = samples.anchors.ids
    noisy = EFFECTS["noise_level"]({f"{ids[0]}-{ids[1]}": 0.3})
    hit = np.isin(samples.a, (0, 1)) & np.isin(samples.b, (0, 1))
    np.testing.assert_allclose(EffectSet((noisy,)).noise_std(samples), 0.3 * hit)
    late = EffectSet((EFFECTS["tdoa_time_offset"]({"offset": 0.03}),))
    flight = Flight(
        "f", samples.anchors, Tdoas(samples.t, ids[samples.a], ids[samples.b], samples.t)
    )
    assert late.stamp_offset("tdoa") == 0.03 and late.stamp_offset("imu") == 0.0
    np.testing.assert_allclose(late.correct_streams(flight).tdoa.t, samples.t - 0.03)


def test_a_covariate_keeps_working_under_its_old_name():
    with pytest.warns(FutureWarning, match="force_x is now accel_x"):
        old = SmoothTerm(channel="gyro.x", covariate="force_x", knots=(0.0, 1.0))
    assert old == SmoothTerm(channel="gyro.x", covariate="accel_x", knots=(0.0, 1.0))


def test_several_effects_of_one_name_are_all_kept(tmp_path):
    curves = [SmoothTerm({"c0": value}, knots=(0.0, 1.0)) for value in (0.1, 0.2)]
    written = EffectSet((AnchorDelay({"0": 0.2}), *curves, AnchorDelay({"0": 0.1})))
    written.to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert read == written
    samples = random_samples(3)
    np.testing.assert_array_equal(read.bias(samples), written.bias(samples))


ON_AIDS = [effect for effect in EFFECTS.values() if set(effect.channels) <= set(BY_POSE)]


def felt(seed, n=400):
    """A Flight on a smooth path with true heights, pressures, velocities and yaw rates, and its
    AidSamples by channel.
    """
    rng, t = np.random.default_rng(seed), np.arange(n) / 25.0
    phase = rng.uniform(0.0, 6.0, 6)
    p = np.stack(
        [
            np.sin(0.7 * t + phase[0]),
            np.cos(0.5 * t + phase[1]),
            1.5 + 0.5 * np.sin(0.9 * t + phase[2]),
        ],
        axis=1,
    )
    angles = np.stack([0.1 * np.sin(t + phase[3]), 0.1 * np.cos(t + phase[4]), 0.3 * t], axis=1)
    truth = Truth(t, p, Rotation.from_euler("xyz", angles).as_quat())
    track = Track(truth)
    samples = {channel: aid_samples(channel, t, track, t[0]) for channel in BY_POSE}
    streams = {
        "height": Height(t, samples["height"].reading[:, 0]),
        "pressure": Pressure(t, pressure_at(samples["pressure"].reading[:, 0])),
        "velocity": Velocity(
            t,
            samples["velocity"].reading,
            np.full((n, 3), 0.1),
            samples["yaw_rate"].reading[:, 0],
            np.full(n, 0.1),
        ),
    }
    tdoa = Tdoas(t, np.zeros(n, int), np.ones(n, int), np.zeros(n))
    return Flight("f", Anchors.from_positions(np.eye(3)), tdoa, truth=truth, **streams), samples


def some_values(effect, rng, size=1e-3):
    keys = effect.groups(None, None)[0] or (effect.example,)
    limits = {"1.start": 3.0, "1.end": 9.0} if effect.example.startswith("1.") else {}
    return {**limits, **{key: size * rng.uniform(0.5, 1.0) for key in keys}}


OF_EACH_CHANNEL = pytest.mark.parametrize(
    "effect, channel", [(effect, channel) for effect in ON_AIDS for channel in effect.channels]
)


@OF_EACH_CHANNEL
@given(st.integers(0, 1000))
def test_regressors_on_aids_are_what_inject_adds(effect, channel, seed):
    """To first order; at the ends of intervals and of the recording neither is defined."""
    (flight, samples), rng = felt(seed), np.random.default_rng(seed)
    values = some_values(effect, rng)
    made, keys = effect(values), [key for key in values if not key.endswith(("start", "end"))]
    changed = measured_on(made.inject(flight), channel)
    before, after = measured_on(flight, channel).values, changed.values
    if not np.array_equal(changed.t, flight.truth.t):  # stamps moved: what it reads at the old ones
        after = np.stack(
            [np.interp(flight.truth.t, changed.t, column) for column in after.T], axis=1
        )
    predicted = effect({k: v for k, v in values.items() if k not in keys}).regressors(
        samples[channel], keys
    ) @ [values[key] for key in keys]
    inner, rough = (
        slice(5, -5),
        5e-5 if effect.name == "velocity_delay" else 2e-6,
    )  # of accelerations from poses
    np.testing.assert_allclose((after - before)[inner], predicted[inner], atol=rough)


@OF_EACH_CHANNEL
def test_what_is_put_into_an_aid_is_taken_out_of_it_or_out_of_the_residual(effect, channel):
    flight, samples = felt(3)
    made = effect(some_values(effect, np.random.default_rng(0), 0.1))
    back = measured_on(EffectSet((made,)).correct_streams(made.inject(flight)), channel)
    assert not np.array_equal(measured_on(made.inject(flight), channel).t, back.t) == (
        effect.name == "velocity_delay"
    )
    left = back.values - EffectSet((made,)).uncorrected(samples[channel])
    np.testing.assert_allclose(left, measured_on(flight, channel).values, atol=1e-6)
    np.testing.assert_allclose(back.t, flight.truth.t, atol=1e-9)
    with pytest.raises(InputError, match=f"holds no {effect.channels[0].replace('_', ' ')}"):
        made.inject(flight.without(STREAM_OF[channel]))


def test_a_yaw_rate_that_was_not_measured_has_no_scale():
    flight, _ = felt(4)
    silent = replace(flight.velocity, yaw_rate=None, yaw_rate_std=None)
    with pytest.raises(InputError, match="f: holds no yaw rate, which yaw_rate_scale needs"):
        EFFECTS["yaw_rate_scale"]({"scale": 0.03}).inject(flight.replaced(velocity=silent))
    some = np.arange(len(flight.velocity)) % 3 == 0
    std = np.where(some, np.inf, 0.0)
    mixed = replace(
        flight.velocity, yaw_rate=np.where(some, np.nan, flight.velocity.yaw_rate), yaw_rate_std=std
    )
    corrected = AidCorrector([EFFECTS["yaw_rate_scale"]({"scale": 0.25})]).correct(
        "velocity", mixed
    )
    np.testing.assert_array_equal(corrected.yaw_rate_std, std)
    np.testing.assert_allclose(corrected.yaw_rate[~some], flight.velocity.yaw_rate[~some] / 1.25)
    np.testing.assert_array_equal(corrected.v, flight.velocity.v)


def test_aids_are_corrected_the_same_at_once_and_one_by_one_whatever_was_not_measured():
    rng, n = np.random.default_rng(0), 50
    values = {
        "velocity_scale": {"scale": 0.1},
        "velocity_misalignment": {"yaw": 1.5},
        "velocity_delay": {"offset": 0.02},
        "yaw_rate_scale": {"scale": 0.25},
    }
    corrector = AidCorrector([EFFECTS[name](each) for name, each in values.items()])
    t, v, std = np.arange(n) / 25.0, rng.standard_normal((n, 3)), rng.uniform(0.1, 0.2, (n, 3))
    v[:, 2], std[:, 2] = np.nan, np.inf
    rates = rng.standard_normal(n), np.where(rng.random(n) < 0.5, 0.0, 0.1)
    late, turned, wider, *slower = corrector.correct(
        "velocity", Velocity(t, v, std, *rates)
    ).columns
    for column, rate in zip(slower, rates):
        np.testing.assert_allclose(column, rate / 1.25, atol=1e-12)
    expected = Rotation.from_euler("z", 1.5).apply(np.where(np.isfinite(v), v, 0.0)) / 1.1
    np.testing.assert_allclose(turned[:, :2], expected[:, :2], atol=1e-12)
    np.testing.assert_allclose(late, t - 0.02)
    assert np.isinf(wider[:, 2]).all() and (wider[:, :2] < 0.2).all()
    unstated = corrector.correct(
        "velocity", Velocity(t, v, np.where(np.isinf(std), std, 0.0))
    ).columns[2]
    np.testing.assert_array_equal(
        unstated, np.where(np.isinf(std), std, 0.0)
    )  # the driver still states none
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


@pytest.mark.parametrize(
    "channel, covariate",
    [
        ("gyro.x", "tilt"),
        ("gyro.y", "interval"),
        ("accel.z", "previous_anchor"),
        ("height", "tilt"),
        ("height", "extra.battery.voltage"),
        ("velocity.x", "rate_x"),
        ("gyro.x", "range"),
        ("tdoa", "accel"),
    ],
)
def test_a_function_of_what_its_channel_does_not_have_is_refused_when_it_is_read(
    tmp_path, channel, covariate
):
    entry = {
        "channel": channel,
        "covariate": covariate,
        "form": "common",
        "knots": [0.0, 1.0],
        "values": {"c0": 0.1},
    }
    (tmp_path / "effects.yaml").write_text(yaml.safe_dump({"effects": {"smooth_term_1": entry}}))
    with pytest.raises(
        InputError,
        match=(
            f"function of '{covariate}' acts on '{channel}'; forms are .*, covariates of this "
            "channel time, "
        ),
    ):
        EffectSet.from_yaml(tmp_path / "effects.yaml")


def test_a_function_of_no_channel_is_refused_with_those_that_there_are():
    with pytest.raises(
        InputError, match="acts on 'gyro'; channels are tdoa, range, gyro.x, .* and yaw_rate"
    ):
        SmoothTerm(channel="gyro", covariate="time", knots=(0.0, 1.0))
