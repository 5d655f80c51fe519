from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_samples import random_samples

from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.shapes import SHAPES, functions
from uwb_tdoa_bias.foundation.errors import InputError

KNOTS = {2: (1.0, 3.0), 3: (1.0, 2.0, 3.0), 4: (1.0, 1.5, 2.5, 3.0)}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_has_a_level_and_is_held_beyond_its_knots(shape):
    count, coefficients = SHAPES[shape]
    at = np.linspace(-1.0, 5.0, 61)
    out = functions(shape, KNOTS[count], at)
    assert out.shape == (61, coefficients)
    np.testing.assert_array_equal(out[:, 0], 1.0)
    if shape != "wave":
        np.testing.assert_array_equal(
            out[at <= 1.0], out[at <= 1.0][:1].repeat((at <= 1.0).sum(), axis=0)
        )
        np.testing.assert_array_equal(
            out[at >= 3.0], out[at >= 3.0][:1].repeat((at >= 3.0).sum(), axis=0)
        )


@pytest.mark.parametrize(
    "shape, at, second",
    [
        ("line", [1.0, 2.0, 3.0], [-0.5, 0.0, 0.5]),
        ("beyond", [1.5, 2.0, 2.5, 3.0], [0.0, 0.0, 0.5, 1.0]),
        ("below", [1.0, 1.5, 2.0, 2.5], [1.0, 0.5, 0.0, 0.0]),
        ("step", [1.9, 2.0, 4.0], [0.0, 1.0, 1.0]),
        ("interval", [1.4, 1.5, 2.4, 2.5], [0.0, 1.0, 1.0, 0.0]),
        ("wave", [1.0, 1.5, 2.5], [0.0, 1.0, -1.0]),
    ],
)
def test_the_course_of_a_shape(shape, at, second):
    np.testing.assert_allclose(
        functions(shape, KNOTS[SHAPES[shape][0]], at)[:, 1], second, atol=1e-12
    )


@given(
    st.sampled_from(sorted(SHAPES)),
    st.sampled_from(["pair", "direction", "anchor", "common"]),
    st.integers(0, 2**32 - 1),
)
def test_the_bias_of_a_shape_is_what_its_regressors_say(shape, form, seed):
    samples, rng = random_samples(seed % 100), np.random.default_rng(seed)
    ids = samples.anchors.ids
    part = {"anchor": str(ids[1]), "common": ""}.get(form, f"{ids[0]}-{ids[1]}")
    term = SmoothTerm(covariate="height", form=form, knots=KNOTS[SHAPES[shape][0]], shape=shape)
    keys = term.keys_of((part,))
    values = dict(zip(keys, rng.standard_normal(len(keys)).tolist()))
    full = SmoothTerm(values, {}, "", "tdoa", "height", form, term.knots, shape)
    np.testing.assert_allclose(
        full.bias(samples), full.regressors(samples, keys) @ list(values.values()), atol=1e-12
    )


def test_a_pair_counts_both_ways_and_a_direction_one():
    samples = random_samples(1)
    ids = samples.anchors.ids
    values = {f"{ids[0]}-{ids[1]}.c0": 0.4}
    forth = (samples.a == 0) & (samples.b == 1)
    back = (samples.a == 1) & (samples.b == 0)
    for form, expected in (("pair", 0.4 * forth - 0.4 * back), ("direction", 0.4 * forth)):
        term = SmoothTerm(values, {}, "", "tdoa", "height", form, (0.0, 1.0), "line")
        np.testing.assert_allclose(term.bias(samples), expected, atol=1e-12)


def test_a_shape_survives_a_file(tmp_path):
    term = SmoothTerm(
        {"0-1.c1": 0.4}, {"0-1.c1": 0.1}, "", "tdoa", "time", "pair", (0.0, 3.0, 9.0), "step"
    )
    EffectSet((term,)).to_yaml(tmp_path / "effects.yaml")
    assert EffectSet.from_yaml(tmp_path / "effects.yaml") == EffectSet((term,))


@pytest.mark.parametrize(
    "changes",
    [{"shape": "odd"}, {"shape": "step"}, {"shape": "line", "form": "pair", "covariate": "range"}],
)
def test_a_shape_refuses_nonsense(changes):
    with pytest.raises(InputError, match="smooth_term: (shape|form)"):
        SmoothTerm(knots=(0.0, 1.0), **changes)
