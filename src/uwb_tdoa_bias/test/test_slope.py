from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_samples import random_samples

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.covariates import OF_ARRIVAL, OF_TDOA, STATES
from uwb_tdoa_bias.effects.motion import Motion
from uwb_tdoa_bias.effects.slope import REACH, slope_of, state_of

STEEP = 0.17  # m per unit


def line(covariate, form="common", steep=STEEP):
    """A straight function of a covariate, far beyond what samples have."""
    return SmoothTerm(
        covariate=covariate,
        form=form,
        knots=(-100.0, 100.0),
        shape="line",
        values={"c0": 0.0, "c1": 200.0 * steep},
    )


def moving(seed, n=20):
    samples = random_samples(seed, n)
    rng = np.random.default_rng(seed)
    return replace(samples, motion=Motion(*rng.standard_normal((3, n, 3))))


@given(seed=st.integers(0, 10**6))
def test_a_straight_function_has_its_slope_and_nothing_is_left(seed):
    samples = moving(seed)
    for covariate, state in (("x", 0), ("y", 1), ("height", 2), ("climb_rate", 5)):
        _, slope, curved = slope_of([line(covariate)], samples)
        np.testing.assert_allclose(
            slope, STEEP * (np.arange(6) == state) * np.ones((len(samples), 1)), atol=1e-9
        )
        np.testing.assert_allclose(curved, 0.0, atol=1e-9)


@given(seed=st.integers(0, 10**6))
def test_of_ranges_it_is_the_difference_of_directions(seed):
    samples = moving(seed)
    far = replace(samples, p=samples.p + 500.0)  # so that a range is straight within the reach
    wide = SmoothTerm(
        covariate="range",
        form="arrival",
        knots=(0.0, 2000.0),
        shape="line",
        values={"c0": 0.0, "c1": 100.0},
    )
    _, slope, curved = slope_of([wide], far)
    to_a, to_b = (far.p - side for side in (far.position_a, far.position_b))
    expected = (
        to_b / np.linalg.norm(to_b, axis=1)[:, None] - to_a / np.linalg.norm(to_a, axis=1)[:, None]
    )
    np.testing.assert_allclose(slope[:, :3], 0.05 * expected, atol=1e-5)
    assert not slope[:, 3:].any() and (curved < 1e-3).all()


def test_what_is_left_of_a_step_is_a_standard_deviation():
    """A step of s right between the ends of the reach: half of it is no line, to either side."""
    samples = moving(3)
    samples = replace(samples, p=np.zeros_like(samples.p))
    step = SmoothTerm(
        covariate="x", knots=(-9.0, 0.1, 9.0), shape="step", values={"c0": 0.0, "c1": 0.8}
    )
    _, slope, curved = slope_of([step], samples)
    np.testing.assert_allclose(slope[:, 0], 0.8 / (2.0 * REACH))
    np.testing.assert_allclose(curved, np.sqrt(2.0) * 0.4)


def test_parts_add_up():
    samples = moving(4)
    both = [line("x"), line("range", "arrival", 0.1), AnchorDelay({0: 1.0})]
    bias, slope, _ = slope_of(both, samples)
    np.testing.assert_allclose(
        slope, slope_of(both[:1], samples)[1] + slope_of(both[1:2], samples)[1], atol=1e-12
    )
    np.testing.assert_allclose(bias, both[0].bias(samples) + both[1].bias(samples))
    assert not slope_of(both[2:], samples)[1].any()


def test_where_nobody_knows_the_velocity_nothing_follows_it():
    for part in slope_of([line("climb_rate")], random_samples(5)):
        assert not part.any()


@pytest.mark.parametrize(
    "covariate", [name for name in (*OF_TDOA, *OF_ARRIVAL) if name not in STATES]
)
def test_nothing_else_is_followed(covariate):
    assert line(covariate, "arrival" if covariate in OF_ARRIVAL else "common").states == ()


def test_of_an_inertial_sensor_there_is_none():
    assert (
        SmoothTerm(
            channel="accel.x",
            covariate="height",
            knots=(0.0, 1.0),
            shape="line",
            values={"c1": 1.0},
        ).states
        == ()
    )


def test_where_nothing_is_known_there_is_none():
    samples = moving(5)
    samples.p[3], samples.motion.velocity[4] = np.nan, np.nan
    _, slope, curved = slope_of([line("x"), line("climb_rate")], samples)
    assert (
        not slope[3, :3].any()
        and not slope[4, 3:].any()
        and (curved < 1e-9).all()
        and slope[0, [0, 5]].all()
    )
    assert np.isfinite(state_of(samples)).all() and not state_of(samples)[3, :3].any()


def test_a_correction_holds_it_about_the_pose_that_it_was_made_at():
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


def test_without_a_yaw_there_is_none():
    samples = random_samples(7)
    corrector = Corrector(samples.anchors, EffectSet((line("bearing_in_tag", "arrival"),)))
    for k, yaw_std in enumerate([0.1] * 60 + [2.0] * 60):
        corrector.add_pose(
            0.01 * k, np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), yaw_std
        )
    times = 0.5, 1.1, 1.15  # the pose is as old as the TDOA before
    sure, _, unsure = (
        corrector.correct(np.array([t]), np.array([0]), np.array([1]), np.array([2.0]))
        for t in times
    )
    assert sure.slope.any() and not unsure.slope.any()


def test_effects_without_any_say_nothing():
    samples = random_samples(8)
    corrector = Corrector(
        samples.anchors, EffectSet((AnchorDelay({int(samples.anchors.ids[0]): 0.2}),))
    )
    found = corrector.correct(np.array([0.5]), np.array([0]), np.array([1]), np.array([2.0]))
    assert (
        found.bias[0] == -0.2
        and found.std[0] == 0.0
        and not found.slope.any()
        and not found.state.any()
    )
