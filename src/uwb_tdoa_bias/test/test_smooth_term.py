# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Smooth terms: splines and shapes, their bias, refused values, and descriptions."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples, ranges_of
import yaml

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import RADIO, EffectSet, Samples, SmoothTerm
from uwb_tdoa_bias.effects.samples import fade_weight
from uwb_tdoa_bias.effects.smooth_term import FACTORS, SHAPES, described, shape_basis

KNOTS = {2: (1.0, 3.0), 3: (1.0, 2.0, 3.0), 4: (1.0, 1.5, 2.5, 3.0)}
KNOTS[None] = 1.0, 1.5, 2.0, 2.5, 3.0  # of any number
seeds = st.integers(0, 2**32 - 1)


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
    with pytest.raises(InputError, match="form: 'pair' is not one of common, arrival or anchor"):
        term(channel="range", form="pair", covariate="height")
    with pytest.raises(InputError, match="covariate: 'previous_anchor' is not one of"):
        term(channel="range", form="common", covariate="previous_anchor")


@pytest.mark.parametrize("shape, knots", [("wave", (0.0, 4.0)), ("pulse", (1.0, 2.0, 5.0))])
def test_what_recurs_goes_on_beyond_its_domain_and_fades(shape, knots):
    samples = random_samples(3)
    one = SmoothTerm({"c1": 0.3}, covariate="time", knots=knots, shape=shape, form="common")
    seen = replace(one, domain={"time": (0.0, 0.5 * np.ptp(samples.t))})
    weight = fade_weight(samples.t - samples.start, seen.domain["time"])
    assert weight.min() < 0.9
    np.testing.assert_allclose(seen.corrected_bias(samples), weight * one.bias(samples), atol=1e-12)


@pytest.mark.parametrize("knots", [[[0.0, 1.0], [2.0, 3.0]], "12", 1.0, [0.0, "b"], None])
def test_knots_are_a_list_of_numbers(knots):
    with pytest.raises(InputError, match="two or more"):
        SmoothTerm({"c1": 0.3}, covariate="time", knots=knots, shape="spline", form="common")


def test_a_spline_is_constant_beyond_its_knots():
    at = np.array([-5.0, 1.0, 9.0, 50.0])
    np.testing.assert_allclose(term().curve(at), [0.1, 0.1, 0.3, 0.3], atol=1e-12)


@pytest.mark.parametrize("shape", ["spline", *SHAPES])
@pytest.mark.parametrize("form", ["common", "arrival", "anchor"])
def test_one_measurement_has_the_bias_that_it_has_among_others(shape, form):
    """Nodes correct one by one, replays all at once: both are equal to the bit."""
    samples = random_samples(5)
    covariate = "height" if form == "common" else "range"
    knots = (0.0, 1.0, 2.5, 3.0, 7.0) if shape == "spline" else KNOTS[SHAPES[shape][0]]
    empty = SmoothTerm({}, {}, "", "tdoa", covariate, form, knots, shape)
    keys = empty.keys(samples.anchors)
    values = dict(zip(keys, np.random.default_rng(1).standard_normal(len(keys)).tolist()))
    one = replace(empty, values=values)
    columns = samples.t, samples.a, samples.b, samples.p, samples.q
    single = [
        one.bias(Samples(*(part[k : k + 1] for part in columns), samples.anchors, samples.start))
        for k in range(len(samples))
    ]
    np.testing.assert_array_equal(np.concatenate(single), one.bias(samples))
    assert np.ptp(single) > 0.1


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


@given(
    st.sampled_from(list(SHAPES)),
    st.sampled_from(FACTORS),
    st.sampled_from(["common", "arrival", "anchor", "pair", "direction"]),
    seeds,
)
def test_a_factor_multiplies_the_function_but_not_its_level(shape, factor_shape, form, seed):
    samples, rng = random_samples(seed % 100), np.random.default_rng(seed)
    ids, knots = samples.anchors.ids, KNOTS[SHAPES[shape][0]]
    several = form in ("arrival", "anchor")
    factor = "range" if several and seed % 2 else "x"
    factor_knots = {2: (-2.0, 4.0), 3: (-2.0, 1.0, 4.0), 4: (-2.0, 0.5, 2.0, 4.0)}
    settings = {
        "covariate": "height",
        "form": form,
        "knots": knots,
        "shape": shape,
        "factor": factor,
        "factor_shape": factor_shape,
        "factor_knots": factor_knots[SHAPES[factor_shape][0]],
    }
    empty = SmoothTerm(**settings)
    part = {"pair": f"{ids[0]}-{ids[1]}", "direction": f"{ids[1]}-{ids[0]}"}.get(form)
    keys = empty.keys_of((part,)) if part else empty.keys(samples.anchors)
    values = dict(zip(keys, rng.standard_normal(len(keys)).tolist()))
    full = SmoothTerm(values, **settings)
    bias = full.bias(samples)
    np.testing.assert_allclose(bias, full.regressors(samples, keys) @ list(values.values()))
    # By hand: the factor has no effect on the levels and multiplies all other values.
    alone = {key: value for key, value in settings.items() if not key.startswith("factor")}
    levels = {key: value for key, value in values.items() if key.endswith("c0")}
    rest = {key: value for key, value in values.items() if not key.endswith("c0")}
    if not several:
        by = shape_basis(factor_shape, settings["factor_knots"], samples.p[:, 0])[:, 1]
        expected = SmoothTerm(levels, **alone).bias(samples)
        expected = expected + by * SmoothTerm(rest, **alone).bias(samples)
        np.testing.assert_allclose(bias, expected, atol=1e-12)
    assert set(full.covariates) == {"height", factor}
    assert full.jacobian_states == (0, 1, 2)


def test_a_product_is_read_as_it_is_written(tmp_path):
    one = term(
        covariate="speed",
        form="anchor",
        shape="step",
        knots=[0.0, 1.0, 2.0],
        factor="height",
        factor_shape="interval",
        factor_knots=[0.0, 1.0, 2.0, 3.0],
        values={"3.c0": 0.1, "3.c1": 0.8},
    )
    EffectSet((one,)).to_yaml(tmp_path / "effects.yaml")
    (read,) = EffectSet.from_yaml(tmp_path / "effects.yaml").effects
    assert read == one
    assert one.label == "tdoa of anchor 3 over speed and height"
    assert one.needs_motion and one.usable


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"factor": "range"}, "'range' is not one of time, x"),
        ({"factor": "speed"}, "'speed' is not one of time, x"),
        ({"factor": "colour"}, "'colour' is not one of"),
        ({"factor": "previous_anchor"}, "'previous_anchor' is not one of"),
        ({"shape": "spline"}, "'height' is not possible here"),
        (
            {"factor_shape": "wave", "factor_knots": [0.0, 1.0]},
            "factor_shape: 'wave' is not one of line",
        ),
        ({"factor_knots": [0.0, 1.0]}, "are not 3 rising numbers, as the shape step needs"),
        ({"factor_knots": [1.0, 0.0, 2.0]}, "factor_knots: .* are not 3 rising"),
        ({"channel": "gyro.x"}, "factor: 'height' is not possible here"),
    ],
)
def test_a_factor_that_cannot_be_is_refused(changes, message):
    settings = {
        "covariate": "speed",
        "form": "common",
        "shape": "line",
        "knots": [0.0, 1.0],
        "factor": "height",
        "factor_shape": "step",
        "factor_knots": [0.0, 1.0, 2.0],
        "values": {"c1": 0.1},
    }
    settings |= {"covariate": "turning_rate"} if "channel" in changes else {}
    with pytest.raises(InputError, match=message):
        term(**(settings | changes))


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
        match=f"covariate: '{covariate}' is not one of time, ",
    ):
        EffectSet.from_yaml(tmp_path / "effects.yaml")


def test_a_function_of_no_channel_is_refused_with_those_that_there_are():
    with pytest.raises(
        InputError, match="channel: 'gyro' is not one of tdoa, range, gyro.x, .* or yaw_rate"
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
        ("switching", [1.4, 1.5, 2.1, 2.5, 3.1], [0.0, 1.0, 0.0, 1.0, 1.0]),
        ("pulse", [0.9, 1.0, 1.9, 2.0, 3.1, 4.1, -0.5], [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0]),
        ("wave", [1.0, 1.5, 2.5], [0.0, 1.0, -1.0]),
    ],
)
def test_the_course_of_a_shape(shape, at, second):
    np.testing.assert_allclose(
        shape_basis(shape, KNOTS[SHAPES[shape][0]], at)[:, 1], second, atol=1e-12
    )


@pytest.mark.parametrize("shape", ["line", "beyond", "below", "step", "interval", "switching"])
def test_several_shapes_at_once_are_those_of_each(shape):
    one = np.array(KNOTS[SHAPES[shape][0]])
    several = np.stack([one, one + 0.3, 1.7 * one])
    at = np.array([0.5, 1.0, 1.6, 2.2, 3.7, 9.0, np.nan])
    together = shape_basis(shape, several.T, at[:, None])
    for k, knots in enumerate(several):
        np.testing.assert_array_equal(together[:, k], shape_basis(shape, knots, at))


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
            "anchor 2 seems 0.64 ± 0.02 m farther where range is above 5 m (seen: range from 1 m to 8 m)",
        ),
        (
            found_term(
                {"0-1.c0": 0.0, "0-1.c1": -0.3}, "time", "pair", (0.0, 10.0, 20.0, 30.0), "interval"
            ),
            "0-1",
            "the TDOA of 0-1 is 0.30 ± 0.02 m smaller from 10 s to 20 s (seen: time from 0 s to 30 s)",
        ),
        (
            found_term({"c0": 0.0, "c1": 0.4}, "height", "common", (1.0, 3.0), "line"),
            "",
            "every TDOA is 0.20 ± 0.01 m larger for each m more of height (seen: height from 1 m to 3 m)",
        ),
        (
            found_term(
                {"c0": 0.0, "c1": 0.4}, "accel_z", "common", (8.0, 10.0, 12.0), "below", "gyro.y"
            ),
            "",
            "the gyroscope reads 0.20 ± 0.01 rad/s too little about y for each m/s^2 more of "
            "accel z, below 10 m/s^2 "
            "(seen: accel z from 8 m/s^2 to 12 m/s^2)",
        ),
        (
            found_term({"c0": 0.0, "c1": 0.4}, "time", "common", (0.0, 4.0), "line", "yaw_rate"),
            "",
            "each value of yaw_rate is 0.100 ± 0.005 rad/s larger for each s more of time "
            "(seen: time from 0 s to 4 s)",
        ),
        (
            found_term(
                {"2.c0": 0.0, "2.c1": 0.4},
                "time",
                "anchor",
                (0.0, 3.0, 5.0, 9.0, 10.0),
                "switching",
            ),
            "2",
            "anchor 2 seems 0.40 ± 0.02 m farther for 30 % of the time, in 2 pieces of 1 s to 2 s",
        ),
        (
            found_term({"2.c0": 0.0, "2.c1": 0.4}, "time", "anchor", (3.0, 5.0, 11.0), "pulse"),
            "2",
            "anchor 2 seems 0.40 ± 0.02 m farther for 2 s in each 8 s of time, first at 3 s",
        ),
        (
            SmoothTerm(
                {"2.c0": 0.0, "2.c1": 0.8},
                {},
                covariate="speed",
                form="anchor",
                knots=(0.0, 1.5, 3.0),
                shape="step",
                factor="height",
                factor_shape="step",
                factor_knots=(0.5, 2.0, 3.0),
            ),
            "2",
            "anchor 2 seems 0.8 m farther where speed is above 1.5 m/s, while height is above 2 m "
            "(seen: speed from 0 m/s to 3 m/s)",
        ),
    ],
)
def test_a_function_in_words(found, part, words):
    assert described(found, part) == words


def of_two(covariate, knots, factor, factor_knots):
    return SmoothTerm(
        {"6.c0": 0.0, "6.c1": 0.824},
        {"6.c1": 0.018},
        covariate=covariate,
        form="anchor",
        knots=knots,
        shape="interval",
        factor=factor,
        factor_shape="interval",
        factor_knots=factor_knots,
    )


RANGES, BEARINGS, ELEVATIONS = (2.0, 4.75, 4.94, 7.0), (-1.0, 0.925, 0.969, 2.0), (0, 0.5, 0.6, 1)
FARTHER = "anchor 6 seems 0.824 ± 0.018 m farther where "


def test_knots_are_rounded_to_centimetres_and_whole_degrees():
    term = of_two("y", (-1.0, -0.000404, 0.0962, 1.0), "tilt", (0.0, 0.0346, 0.0686, 0.1))
    assert "y is between 0 m and 0.1 m, while tilt is between 2 degrees and 4 degrees" in described(
        term, "6"
    )


@pytest.mark.parametrize(
    "found, words",
    [
        (
            of_two("range", RANGES, "bearing", BEARINGS),
            "range is between 4.75 m and 4.94 m, while bearing is between 53 degrees and 56 degrees "
            "(seen: range from 2 m to 7 m): there the tag is -2.8 m in x and -3.9 m in y from the anchor, at "
            "most",
        ),
        (
            of_two("elevation", ELEVATIONS, "range", RANGES),
            "elevation is between 29 degrees and 34 degrees, while range is between 4.75 m and "
            "4.94 m (seen: elevation from 0 degrees to 57 degrees): there the tag is -2.5 m in z and 4.1 m "
            "level from the anchor",
        ),
        (
            of_two("bearing", BEARINGS, "elevation", ELEVATIONS),
            "bearing is between 53 degrees and 56 degrees, while elevation is between 29 degrees "
            "and 34 degrees (seen: bearing from -57 degrees to 115 degrees): there the tag is in the "
            "direction (-0.50, -0.69, -0.52) from the anchor",
        ),
        (
            of_two("range", (1.0, 2.0, 6.0, 7.0), "bearing", BEARINGS),
            "range is between 2 m and 6 m, while bearing is between 53 degrees and 56 degrees "
            "(seen: range from 1 m to 7 m)",
        ),
    ],
)
def test_angles_are_in_degrees_and_narrow_intervals_name_the_place(found, words):
    assert described(found, "6") == FARTHER + words


@pytest.mark.parametrize(
    "covariate, knots, shape, words",
    [
        (
            "y",
            (-1.54, -1.4, 1.0),
            "below",
            "where y is -1.54 m than where it is -1.4 m or more (seen: y from -1.54 m to 1 m)",
        ),
        (
            "y",
            (-1.0, 1.4, 1.54),
            "beyond",
            "where y is 1.54 m than where it is 1.4 m or less (seen: y from -1 m to 1.54 m)",
        ),
        (
            "height",
            (1.0, 1.5),
            "line",
            "where height is 1.5 m than where it is 1 m (seen: height from 1 m to 1.5 m)",
        ),
        (
            "elevation",
            (0.0, 1.5),
            "line",
            "where elevation is 86 degrees than where it is 0 degrees (seen: elevation from 0 degrees to "
            "86 degrees)",
        ),
    ],
)
def test_a_slope_over_less_than_a_metre_is_not_extrapolated(covariate, knots, shape, words):
    found = found_term({"1.c0": 0.0, "1.c1": 0.69}, covariate, "anchor", knots, shape)
    assert described(found, "1") == f"anchor 1 seems 0.69 ± 0.02 m farther {words}"


def test_what_all_anchors_share_over_the_room_is_no_advice():
    values = {f"{anchor}.c0": 0.1 for anchor in range(8)}
    assert SmoothTerm(values, {}, "", "tdoa", "x", "anchor", (0.0, 1.0)).advice() == ()
