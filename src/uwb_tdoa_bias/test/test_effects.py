from dataclasses import replace
from pathlib import Path

from finite_differences import numerical_jacobian
from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, EffectSet, ImuCorrector, Samples, SmoothTerm, TagLeverArm
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.geometry import tdoa

seeds = st.integers(0, 2**32 - 1)


FITTED = [effect for effect in EFFECTS.values() if effect.fitted and "tdoa" in effect.channels]
STAMPS = ("tdoa_time_offset", "truth_time_offset")  # act on stamps: their bias is zero, their regressors are not


def parameters(effect, samples, rng):
    """Some parameters of an effect for these samples: {name: value}."""
    ids = samples.anchors.ids
    keys = effect.groups(samples.anchors, np.column_stack([ids[samples.a], ids[samples.b]]))[0]
    return {key: 0.1 * min(1.0, effect.bound_of(key)) * rng.uniform(-1.0, 1.0) for key in keys}


@pytest.mark.parametrize("effect", [effect for effect in FITTED if effect.name not in STAMPS])
@given(seeds)
def test_regressors_against_finite_differences(effect, seed):
    samples = random_samples(seed)
    values = parameters(effect, samples, np.random.default_rng(seed))
    keys = list(values)[::-1]

    def bias(at):
        return effect({**values, **dict(zip(keys, at))}).bias(samples)

    found = effect(values).regressors(samples, keys)
    assert found.shape == (len(samples), len(keys))
    np.testing.assert_allclose(found, numerical_jacobian(bias, [values[k] for k in keys]), atol=1e-5)


@pytest.mark.parametrize("effect", EFFECTS.values())
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
    assert effect.bound > effect.negligible > 0.0 and effect.unit and effect.reference and effect.physics
    assert set(effect.confounded_with) <= set(EFFECTS) and set(effect.channels) <= {"tdoa", "gyro", "accel"}
    np.testing.assert_array_equal(effect().bias(random_samples(1)), 0.0)  # no parameter, no effect
    np.testing.assert_array_equal(effect().noise_std(random_samples(1)), 0.0)
    bound = effect.bound_of(effect.example)
    for wrong in (np.nan, np.inf, 1.01 * bound, -1.01 * bound, "much", None, [0.1]):
        with pytest.raises(InputError, match="values"):
            effect({effect.example: wrong})
    with pytest.raises(InputError, match="parameter 'sideways'"):
        effect({"sideways": 0.1})


def test_delay_of_an_anchor_makes_it_seem_farther_away():
    anchors = Anchors.from_positions([[0, 0, 0], [10, 0, 0], [0, 10, 0]], ids=[5, 6, 7])
    samples = Samples(
        np.zeros(3), np.array([0, 1, 1]), np.array([1, 0, 2]), np.ones((3, 3)), np.full((3, 4), np.nan), anchors
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
    np.testing.assert_allclose(effect.bias(samples), tdoa(antenna, a, b) - tdoa(samples.p, a, b), atol=1e-12)


def test_lever_arm_without_attitude_cannot_tell_and_adds_nothing_to_the_set():
    samples = random_samples(2, n=3)
    samples.q[1] = np.nan
    arm, delay = TagLeverArm({"z": 0.1}), AnchorDelay({str(samples.anchors.ids[0]): 0.2})
    assert np.isnan(arm.bias(samples)).tolist() == [False, True, False]
    together = EffectSet((arm, delay)).bias(samples)
    expected = delay.bias(samples) + np.where([True, False, True], arm.bias(samples), 0.0)
    np.testing.assert_array_equal(together, expected)


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
        effect.physics in section and effect.reference in section and all(o in section for o in effect.confounded_with)
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
    settings = {"channel": "tdoa", "covariate": "range", "form": "arrival", "knots": [1.0, 4.0, 9.0]}
    return SmoothTerm({"c0": 0.1, "c1": -0.2, "c2": 0.05, "c3": 0.3}, **{**settings, **changes})


@pytest.mark.parametrize(
    "form, covariate", [("common", "height"), ("arrival", "elevation_in_anchor"), ("anchor", "range")]
)
@given(seed=seeds)
def test_smooth_term_is_linear_in_its_coefficients(form, covariate, seed):
    samples, rng = random_samples(seed), np.random.default_rng(seed)
    empty = term(form=form, covariate=covariate)
    keys = empty.keys(samples.anchors)
    values = dict(zip(keys, rng.standard_normal(len(keys))))
    full = SmoothTerm(values, {}, "", "tdoa", covariate, form, empty.knots)
    np.testing.assert_allclose(full.bias(samples), full.regressors(samples, keys) @ list(values.values()), atol=1e-12)


def test_smooth_term_is_constant_beyond_its_knots_and_survives_a_file(tmp_path):
    one = term()
    np.testing.assert_allclose(one.curve(np.array([-5.0, 1.0, 9.0, 50.0])), [0.1, 0.1, 0.3, 0.3], atol=1e-12)
    EffectSet((one, term(covariate="height", form="common"))).to_yaml(tmp_path / "effects.yaml")
    again = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert [e.covariate for e in again.effects] == ["range", "height"]
    np.testing.assert_array_equal(
        again.bias(random_samples(3)), EffectSet((one, term(covariate="height", form="common"))).bias(random_samples(3))
    )


@pytest.mark.parametrize(
    "changes",
    [{"knots": [1.0]}, {"knots": [2.0, 1.0]}, {"covariate": "colour"}, {"channel": "gyro.w"}, {"form": "odd"}],
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
    effects += [SmoothTerm({"c0": 0.1, "c3": 0.4}, {}, "", "accel.z", "vibration", "common", [0.0, 1.0, 2.0])]
    t, gyro, accel = np.arange(200) / 1000.0, rng.standard_normal((200, 3)), rng.standard_normal((200, 3))
    together = ImuCorrector(effects).correct(t, gyro, accel)
    corrector = ImuCorrector(effects)
    single = [corrector.correct(t[k : k + 1], gyro[k : k + 1], accel[k : k + 1]) for k in range(200)]
    for sensor in range(2):
        np.testing.assert_allclose(np.concatenate([s[sensor] for s in single]), together[sensor], atol=1e-12)


def test_stamps_and_spread():
    from uwb_tdoa_bias.foundation.flight import Flight, Tdoas

    samples = random_samples(4)
    ids = samples.anchors.ids
    noisy = EFFECTS["noise_level"]({f"{ids[0]}-{ids[1]}": 0.3})
    hit = np.isin(samples.a, (0, 1)) & np.isin(samples.b, (0, 1))
    np.testing.assert_allclose(EffectSet((noisy,)).noise_std(samples), 0.3 * hit)
    late = EffectSet((EFFECTS["tdoa_time_offset"]({"offset": 0.03}),))
    flight = Flight("f", samples.anchors, Tdoas(samples.t, ids[samples.a], ids[samples.b], samples.t))
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
