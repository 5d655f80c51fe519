from finite_differences import numerical_jacobian
from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, EffectSet, Samples, TagLeverArm
from uwb_tdoa_bias.errors import InputError
from uwb_tdoa_bias.geometry import tdoa

seeds = st.integers(0, 2**32 - 1)


def parameters(effect, samples, rng):
    """Some parameters of an effect for these samples: {name: value}."""
    keys = samples.anchors.ids if effect is AnchorDelay else "xyz"
    return {str(key): rng.uniform(-0.5, 0.5) for key in keys}


@pytest.mark.parametrize("effect", EFFECTS.values())
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
def test_regressors_of_some_parameters_are_those_columns(effect):
    samples = random_samples(5)
    values = parameters(effect, samples, np.random.default_rng(5))
    keys = list(values)
    whole = effect(values).regressors(samples, keys)
    np.testing.assert_array_equal(effect(values).regressors(samples, keys[1:2]), whole[:, 1:2])


@pytest.mark.parametrize("effect", EFFECTS.values())
def test_is_declared_in_full(effect):
    assert EFFECTS[effect.name] is effect
    assert effect.bound > 0.0 and effect.unit and effect.reference
    np.testing.assert_array_equal(effect().bias(random_samples(1)), 0.0)  # no parameter, no effect
    for wrong in (np.nan, np.inf, 1.01 * effect.bound, -1.01 * effect.bound, "much", None, [0.1]):
        with pytest.raises(InputError, match="values"):
            effect({"x" if effect is TagLeverArm else "0": wrong})
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
