# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Functions without a name: splines and shapes, their bias, their refusals and their words."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_samples import random_samples, ranges_of
import yaml

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import RADIO, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.smooth_term import SHAPES, described, shape_basis

KNOTS = {2: (1.0, 3.0), 3: (1.0, 2.0, 3.0), 4: (1.0, 1.5, 2.5, 3.0)}
seeds = st.integers(0, 2**32 - 1)


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
        "values": {"c0": 0.1, "c1": -0.2, "c2": 0.05, "c3": 0.3},
    }
    return SmoothTerm(**{**settings, **changes})


def test_a_function_of_ranges_adds_nothing_to_tdoas_nor_the_other_way_round():
    samples = random_samples(2)
    np.testing.assert_array_equal(term(channel="range").bias(samples), 0.0)
    np.testing.assert_array_equal(term().bias(ranges_of(samples, samples.b)), 0.0)
    with pytest.raises(InputError, match="form: pair acts on two anchors"):
        term(channel="range", form="pair", covariate="height")
    with pytest.raises(InputError, match="'previous_anchor' acts on 'range'"):
        term(channel="range", form="common", covariate="previous_anchor")


def test_a_spline_is_constant_beyond_its_knots():
    at = np.array([-5.0, 1.0, 9.0, 50.0])
    np.testing.assert_allclose(term().curve(at), [0.1, 0.1, 0.3, 0.3], atol=1e-12)


@pytest.mark.parametrize("channel", RADIO)
@given(
    st.sampled_from(["spline", *SHAPES]),
    st.sampled_from(["common", "arrival", "anchor", "pair", "direction"]),
    seeds,
)
def test_the_bias_is_what_its_regressors_are_times_its_coefficients(channel, shape, form, seed):
    form = form if channel == "tdoa" or form not in ("pair", "direction") else "common"
    covariate = "range" if form in ("arrival", "anchor") and seed % 2 else "height"
    samples, rng = random_samples(seed % 100), np.random.default_rng(seed)
    samples = samples if channel == "tdoa" else ranges_of(samples, samples.b)
    ids, knots = samples.anchors.ids, KNOTS[SHAPES.get(shape, (3, 0))[0]]
    empty = SmoothTerm({}, {}, "", channel, covariate, form, knots, shape)
    part = {"pair": f"{ids[0]}-{ids[1]}", "direction": f"{ids[1]}-{ids[0]}"}.get(form)
    keys = empty.keys_of((part,)) if part else empty.keys(samples.anchors)
    values = dict(zip(keys, rng.standard_normal(len(keys)).tolist()))
    full = SmoothTerm(values, {}, "", channel, covariate, form, knots, shape)
    expected = full.regressors(samples, keys) @ list(values.values())
    np.testing.assert_allclose(full.bias(samples), expected, atol=1e-12)
    assert channel == "tdoa" or np.abs(full.bias(samples)).max() > 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"knots": [1.0]},
        {"knots": [2.0, 1.0]},
        {"covariate": "colour"},
        {"channel": "gyro.w"},
        {"form": "odd"},
        {"shape": "odd"},
        {"shape": "step", "knots": [0.0, 1.0]},
        {"shape": "line", "knots": [0.0, 1.0], "form": "pair"},
        {"form": "common", "covariate": "range"},
        {"values": {"0": 0.1}},
    ],
)
def test_smooth_term_refuses_nonsense(changes):
    with pytest.raises(InputError, match="smooth_term"):
        term(**changes)


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
        shape_basis(shape, KNOTS[SHAPES[shape][0]], at)[:, 1], second, atol=1e-12
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


def found_term(values, covariate, form, knots, shape, channel="tdoa"):
    return SmoothTerm(
        values,
        {key: 0.02 for key in values if key.endswith("c1")},
        "",
        channel,
        covariate,
        form,
        knots,
        shape,
    )


@pytest.mark.parametrize(
    "found, part, words",
    [
        (
            found_term({"2.c0": 0.0, "2.c1": 0.64}, "range", "anchor", (1.0, 5.0, 8.0), "step"),
            "2",
            "anchor 2 seems 0.64 ± 0.02 m farther where range is above 5 m (seen from 1 m to 8 m)",
        ),
        (
            found_term(
                {"0-1.c0": 0.0, "0-1.c1": -0.3}, "time", "pair", (0.0, 10.0, 20.0, 30.0), "interval"
            ),
            "0-1",
            "the TDOA of 0-1 is 0.30 ± 0.02 m smaller from 10 s to 20 s (seen from 0 s to 30 s)",
        ),
        (
            found_term({"c0": 0.0, "c1": 0.4}, "height", "common", (1.0, 3.0), "line"),
            "",
            "every TDOA is 0.20 ± 0.01 m larger for each m more of height (seen from 1 m to 3 m)",
        ),
        (
            found_term(
                {"c0": 0.0, "c1": 0.4}, "accel_z", "common", (8.0, 10.0, 12.0), "below", "gyro.y"
            ),
            "",
            "the gyroscope reads 0.20 ± 0.01 rad/s too little about y for each m/s^2 more of "
            "accel z, below 10 m/s^2 "
            "(seen from 8 m/s^2 to 12 m/s^2)",
        ),
        (
            found_term({"c0": 0.0, "c1": 0.4}, "time", "common", (0.0, 4.0), "line", "yaw_rate"),
            "",
            "each value of yaw_rate is 0.100 ± 0.005 rad/s larger for each s more of time "
            "(seen from 0 s to 4 s)",
        ),
    ],
)
def test_a_function_in_words(found, part, words):
    assert described(found, part) == words


def test_what_all_anchors_share_over_the_room_is_no_advice():
    values = {f"{anchor}.c0": 0.1 for anchor in range(8)}
    assert SmoothTerm(values, {}, "", "tdoa", "x", "anchor", (0.0, 1.0)).advice() == ()
