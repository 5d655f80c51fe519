# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""EffectSet: effects.yaml, domains, covariances and the bias Jacobian."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_samples import random_samples

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import (
    EFFECTS,
    AnchorDelay,
    Covariance,
    EffectSet,
    ImuCorrector,
    SmoothTerm,
    TagLeverArm,
)
from uwb_tdoa_bias.effects.anchor import AnchorClockDrift
from uwb_tdoa_bias.effects.effect_set import REACH
from uwb_tdoa_bias.effects.samples import Motion
from uwb_tdoa_bias.effects.tag import RangeBias

DELAYS = (EFFECTS["anchor_delay"]({"0": 0.1, "3": -0.2}), EFFECTS["anchor_position"]({"3.x": 0.0}))
KEYS = ("anchor_delay", "0"), ("anchor_delay", "3"), ("anchor_position", "3.x")
MATRIX = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, -2e-4], [0.0, -2e-4, 1e-4]])
ANCHORS = Anchors.from_positions(
    [[0.0, 0.0, 0.0], [6.0, 0.0, 1.0], [0.0, 6.0, 2.0], [6.0, 6.0, 3.0]]
)
STEEP = 0.17  # m per unit


def test_a_file_gives_back_what_was_written(tmp_path):
    effects = (
        TagLeverArm({"x": -0.012, "y": 0.001, "z": 0.091}),
        *DELAYS,
        AnchorDelay({12: -0.02}, {12: 0.004}, "bench"),
        AnchorClockDrift({"1": 0.01}, domain={"time": (0.0, 60.0)}),
        EFFECTS["anchor_ids"]({"1": 4, "4": 1}),
        *(SmoothTerm({"c0": value}, knots=(0.0, 1.0)) for value in (0.1, 0.2)),
        SmoothTerm({"0-1.c1": 0.4}, {}, "", "tdoa", "time", "pair", (0.0, 3.0, 9.0), "step"),
        EFFECTS["pair_sign"](),
    )
    EffectSet(effects, Covariance(KEYS, MATRIX)).to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert read == EffectSet(effects) and read.covariance.keys == KEYS
    assert read.name == "+".join(effect.name for effect in effects)
    np.testing.assert_allclose(read.covariance.matrix, MATRIX)
    samples = random_samples(3)
    np.testing.assert_array_equal(read.bias(samples), EffectSet(effects).bias(samples))


TWO = "effects: {anchor_delay: {values: {0: 0.1, 3: 0.1}}}\ncovariance: "
DRIFT = "effects: {anchor_clock_drift: {values: {1: 0.01}, domain: "


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
        (DRIFT + "{time: [60.0, 0.0]}}}", "domain"),
        (DRIFT + "{time: 60.0}}}", "domain"),
        (DRIFT + "{weather: [0.0, 1.0]}}}", "domain"),
        (DRIFT + "{time: [a, 2]}}}", "domain"),
        (DRIFT + "{time: [0.0, .inf]}}}", "not finite"),
        (TWO + "[]", "must hold parameters and matrix"),
        (TWO + "{parameters: [anchor_delay 0], matrix: []}", "a row of the matrix for each"),
        (TWO + "{parameters: [anchor_delay 5], matrix: [[1]]}", "'anchor_delay 5' is no parameter"),
        (
            TWO + "{parameters: [anchor_delay 0, anchor_delay 0], matrix: [[1], [0, 1]]}",
            "there twice",
        ),
        (
            TWO + "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], [0, 0, 1]]}",
            "row 2 must be 2 numbers",
        ),
        (
            TWO + "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], []]}",
            "row 2 must be 2 numbers",
        ),
        (
            TWO + "{parameters: [anchor_delay 0, anchor_delay 3], matrix: [[1], [2, 1]]}",
            "positive semidefinite",
        ),
        (TWO + "{parameters: [anchor_delay 0], matrix: [[-1]]}", "positive semidefinite"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, text, said):
    (tmp_path / "effects.yaml").write_text(text)
    with pytest.raises(InputError, match=said):
        EffectSet.from_yaml(tmp_path / "effects.yaml")


def test_empty_sets_and_effects_without_values_are_zero(tmp_path):
    (tmp_path / "effects.yaml").write_text("effects: {anchor_delay: }")
    effects = EffectSet.from_yaml(tmp_path / "effects.yaml")
    assert effects.name == "anchor_delay" and effects.effects[0].values == {}
    assert len(EffectSet()) == 0 and EffectSet().name == "none"
    for zero in (effects, EffectSet()):
        np.testing.assert_array_equal(zero.bias(random_samples(0)), 0.0)


def test_parts_of_a_covariance():
    whole = Covariance(KEYS, MATRIX)
    places, some = whole.of((("anchor_delay", "7"), KEYS[2], KEYS[0]))
    np.testing.assert_array_equal(places, [1, 2])
    np.testing.assert_array_equal(some, MATRIX[np.ix_([2, 0], [2, 0])])
    assert whole.without(("3",)).keys == KEYS[:1] and whole.without(("3",)).matrix == MATRIX[0, 0]
    each = whole.block_diagonal_by_anchor()
    assert each.of(KEYS[:2])[1].tolist() == [[4e-4, 0.0], [0.0, 9e-4]]
    np.testing.assert_array_equal(each.of(KEYS[1:])[1], MATRIX[1:, 1:])


def test_the_covariance_of_a_hall_takes_little_room(tmp_path):
    n = 300
    keys = (
        *(("anchor_position", f"{i}.{axis}") for i in range(n) for axis in "xyz"),
        *(("anchor_delay", str(i)) for i in range(n)),
    )
    root = np.random.default_rng(0).standard_normal((4 * n, 40))
    each = Covariance(keys, root @ root.T + np.eye(4 * n)).block_diagonal_by_anchor()
    effects = tuple(
        EFFECTS[name]({key: 0.1 for of, key in keys if of == name})
        for name in ("anchor_position", "anchor_delay")
    )
    EffectSet(effects, each).to_yaml(tmp_path / "effects.yaml")
    read = EffectSet.from_yaml(tmp_path / "effects.yaml").covariance
    np.testing.assert_allclose(read.of(keys)[1], each.of(keys)[1], rtol=1e-5)
    assert (tmp_path / "effects.yaml").stat().st_size < 200_000


def corrected(effect, t, p=(3.0, 3.0, 1.5), first=0.0):
    """Return (Correction, Corrector) of TDOAs of anchors 0 and 1.

    Parameters
    ----------
    t : float or (n,) array
        Stamps, in s.
    p : (3,)
        Position of the tag, in m.
    first : float
        Stamp of a TDOA before them, in s. It is the zero of the time of the effects.
    """
    corrector, t = (
        Corrector(ANCHORS, EffectSet((effect,))),
        np.concatenate([[first], np.atleast_1d(t)]),
    )
    corrector.add_pose(first - 1.0, np.array(p), np.array([0.0, 0.0, 0.0, 1.0]))
    zeros = np.zeros(len(t), dtype=int)
    out = corrector.correct(t, zeros, zeros + 1, np.zeros(len(t)))
    return type(out)(*(column[1:] for column in vars(out).values())), corrector


def test_a_drift_is_corrected_within_its_domain_only():
    drift = AnchorClockDrift({"1": 0.01}, domain={"time": (0.0, 60.0)})
    out, corrector = corrected(drift, [30.0, 60.0, 90.0, 600.0, 3600.0])
    assert out.bias[:2] == pytest.approx([0.3, 0.6]) and 0.2 < out.bias[2] < 0.5
    assert abs(out.bias[3:]).max() < 1e-6
    # The deviation covers the drift at the end of the domain.
    assert (out.std[:2] == 0.0).all() and out.std[3:] == pytest.approx([0.6, 0.6], abs=1e-6)
    assert corrector.outside == ["anchor_clock_drift (time 0 to 60 s)"]
    assert corrected(drift, 30.0)[1].outside == []


def test_a_function_and_its_jacobian_fade_beyond_its_domain():
    height = SmoothTerm(
        {"1.c0": 0.4, "1.c1": 0.4, "1.c2": 0.4},
        covariate="height",
        form="anchor",
        knots=(1.0, 2.0),
        domain={"height": (1.0, 2.0)},
    )
    at = {z: corrected(height, 1.0, (3.0, 3.0, z))[0] for z in (0.0, 1.5, 2.0, 2.5, 5.0)}
    assert at[1.5].bias == pytest.approx(0.4) and at[1.5].std == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < at[2.5].bias[0] < 0.4 and at[2.5].slope[0, 2] < 0.0
    assert at[5.0].bias == pytest.approx(0.0, abs=1e-6) and at[5.0].std == pytest.approx(
        0.4, abs=1e-3
    )
    assert at[0.0].bias[0] < 0.1


def test_an_arrival_fades_with_the_longer_of_both_ranges():
    near = RangeBias({"quadratic": 0.01}, domain={"range": (2.0, 5.0)})
    assert corrected(near, 1.0, (3.0, 0.0, 1.0))[0].std == pytest.approx(0.0, abs=1e-9)
    far, corrector = corrected(near, 1.0, (3.0, 30.0, 1.0))
    assert far.bias == pytest.approx(0.0, abs=1e-6) and len(corrector.outside) == 1


def turning(covariate, knots):
    """Return a constant error of 0.1 rad/s on gyro.z within the domain of a covariate."""
    values = dict.fromkeys(("c0", "c1", "c2"), 0.1)
    return SmoothTerm(
        values, {}, "", "gyro.z", covariate, "common", knots, domain={covariate: knots}
    )


def test_inertial_corrections_fade_beyond_their_domain():
    corrector = ImuCorrector((turning("time", (0.0, 10.0)),))
    t = np.arange(0.0, 100.0, 0.1)
    gyro, _ = corrector.correct(t, np.zeros((1000, 3)), np.zeros((1000, 3)))
    assert gyro[t <= 10.0, 2] == pytest.approx(-0.1) and abs(gyro[t > 40.0]).max() < 1e-6
    assert corrector.outside == ["gyro.z over time (time 0 to 10 s)"]


def test_functions_of_the_filter_state_fade_too():
    (function,) = turning("height", (1.0, 2.0)).sensor_functions()
    at = np.linspace(function.low, function.high, len(function.values))
    assert function.values[(at > 1.0) & (at < 2.0)] == pytest.approx(0.1)
    assert abs(function.values[[0, -1]]).max() < 1e-4


def line(covariate, form="common", steep=STEEP):
    """Return a straight function of a covariate. Its knots lie far beyond the samples."""
    return SmoothTerm(
        covariate=covariate,
        form=form,
        knots=(-100.0, 100.0),
        shape="line",
        values={"c0": 0.0, "c1": 200.0 * steep},
    )


def jacobian_of(effects, samples):
    return EffectSet(tuple(effects)).bias_jacobian(samples)


def moving(seed, n=20):
    samples = random_samples(seed, n)
    rng = np.random.default_rng(seed)
    return replace(samples, motion=Motion(*rng.standard_normal((3, n, 3))))


@given(seed=st.integers(0, 10**6))
def test_the_jacobian_of_a_line_is_its_slope(seed):
    samples = moving(seed)
    for covariate, state in (("x", 0), ("y", 1), ("height", 2), ("climb_rate", 5)):
        _, slope, curved = jacobian_of([line(covariate)], samples)
        np.testing.assert_allclose(
            slope, STEEP * (np.arange(6) == state) * np.ones((len(samples), 1)), atol=1e-9
        )
        np.testing.assert_allclose(curved, 0.0, atol=1e-9)


@given(seed=st.integers(0, 10**6))
def test_the_jacobian_of_a_range_is_the_difference_of_directions(seed):
    samples = moving(seed)
    far = replace(samples, p=samples.p + 500.0)  # A range is straight within the reach.
    wide = SmoothTerm(
        covariate="range",
        form="arrival",
        knots=(0.0, 2000.0),
        shape="line",
        values={"c0": 0.0, "c1": 100.0},
    )
    _, slope, curved = jacobian_of([wide], far)
    to_a, to_b = (far.p - side for side in (far.position_a, far.position_b))
    expected = (
        to_b / np.linalg.norm(to_b, axis=1)[:, None] - to_a / np.linalg.norm(to_a, axis=1)[:, None]
    )
    np.testing.assert_allclose(slope[:, :3], 0.05 * expected, atol=1e-5)
    assert not slope[:, 3:].any() and (curved < 1e-3).all()


def test_what_is_left_of_a_step_is_a_standard_deviation():
    """The step lies between the ends of the reach.

    Half of the step remains, with either sign.
    """
    samples = moving(3)
    samples = replace(samples, p=np.zeros_like(samples.p))
    step = SmoothTerm(
        covariate="x", knots=(-9.0, 0.1, 9.0), shape="step", values={"c0": 0.0, "c1": 0.8}
    )
    _, slope, curved = jacobian_of([step], samples)
    np.testing.assert_allclose(slope[:, 0], 0.8 / (2.0 * REACH))
    np.testing.assert_allclose(curved, np.sqrt(2.0) * 0.4)


def test_the_jacobian_at_an_unknown_state_is_zero():
    samples = moving(5)
    samples.p[3], samples.motion.velocity[4] = np.nan, np.nan
    _, slope, curved = jacobian_of([line("x"), line("climb_rate")], samples)
    assert (
        not slope[3, :3].any()
        and not slope[4, 3:].any()
        and (curved < 1e-9).all()
        and slope[0, [0, 5]].all()
    )
    assert (
        np.isfinite(samples.linearization_point).all()
        and not samples.linearization_point[3, :3].any()
    )


def test_a_correction_holds_the_jacobian_and_its_linearization_point():
    samples = random_samples(6)
    corrector = Corrector(samples.anchors, EffectSet((line("height"), line("climb_rate"))))
    p, v = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.2, 0.3])
    for k in range(60):
        corrector.add_pose(0.01 * k, p, np.array([0.0, 0.0, 0.0, 1.0]), v)
    found = corrector.correct(np.array([0.5]), np.array([0]), np.array([1]), np.array([2.0]))
    np.testing.assert_allclose(found.slope, STEEP * np.array([[0, 0, 1, 0, 0, 1]]), atol=1e-9)
    np.testing.assert_allclose(found.state, [[*p, *v]])
    assert (
        found.bias[0] == pytest.approx(STEEP * (0.5 + 0.3))
        and found.corrected[0] == 2.0 - found.bias[0]
    )


def test_the_jacobian_without_a_yaw_is_zero():
    samples = random_samples(7)
    corrector = Corrector(samples.anchors, EffectSet((line("bearing_in_tag", "arrival"),)))
    for k, yaw_std in enumerate([0.1] * 60 + [2.0] * 60):
        corrector.add_pose(
            0.01 * k, np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), yaw_std
        )
    times = 0.5, 1.1, 1.15  # pose no newer than the TDOA before
    sure, _, unsure = (
        corrector.correct(np.array([t]), np.array([0]), np.array([1]), np.array([2.0]))
        for t in times
    )
    assert sure.slope.any() and not unsure.slope.any()
