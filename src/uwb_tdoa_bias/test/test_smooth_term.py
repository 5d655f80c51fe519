"""Functions of a covariate: shapes, words, slopes and motion."""

from dataclasses import replace
from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_samples import random_samples
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, SmoothTerm, samples_at
from uwb_tdoa_bias.effects.covariates import OF_AIDS, OF_ARRIVAL, OF_IMU, OF_TDOA, STATES
from uwb_tdoa_bias.effects.motion import Motion, motion_at, preceding
from uwb_tdoa_bias.effects.shapes import SHAPES, functions
from uwb_tdoa_bias.effects.slope import REACH, slope_of, state_of
from uwb_tdoa_bias.effects.smooth_words import causes, described
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

# --- shapes ---
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


# --- smooth words ---


def term(values, covariate, form, knots, shape, channel="tdoa"):
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
            term({"2.c0": 0.0, "2.c1": 0.64}, "range", "anchor", (1.0, 5.0, 8.0), "step"),
            "2",
            "anchor 2 seems 0.64 ± 0.02 m farther where range is above 5 m (seen from 1 m to 8 m)",
        ),
        (
            term(
                {"0-1.c0": 0.0, "0-1.c1": -0.3}, "time", "pair", (0.0, 10.0, 20.0, 30.0), "interval"
            ),
            "0-1",
            "the TDOA of 0-1 is 0.30 ± 0.02 m smaller from 10 s to 20 s (seen from 0 s to 30 s)",
        ),
        (
            term({"c0": 0.0, "c1": 0.4}, "height", "common", (1.0, 3.0), "line"),
            "",
            "every TDOA is 0.20 ± 0.01 m larger for each m more of height (seen from 1 m to 3 m)",
        ),
        (
            term({"c0": 0.0, "c1": 0.4}, "accel_z", "common", (8.0, 10.0, 12.0), "below", "gyro.y"),
            "",
            "the gyroscope reads 0.20 ± 0.01 rad/s too little about y for each m/s^2 more of "
            "accel z, below 10 m/s^2 "
            "(seen from 8 m/s^2 to 12 m/s^2)",
        ),
    ],
)
def test_a_function_in_words(found, part, words):
    assert described(found, part) == words


@pytest.mark.parametrize("form", ["common", "arrival", "anchor", "pair", "direction"])
def test_every_function_has_causes_and_a_trial_that_tells(form):
    for covariate in OF_ARRIVAL if form == "arrival" else OF_TDOA:
        assert all(causes(SmoothTerm(covariate=covariate, form=form, knots=(0.0, 1.0))))


@pytest.mark.parametrize("channel", ["gyro.x", "accel.z"])
def test_every_function_of_a_sensor_has_causes(channel):
    for covariate in (*OF_IMU, *OF_AIDS):
        assert all(causes(SmoothTerm(channel=channel, covariate=covariate, knots=(0.0, 1.0))))


def test_what_all_anchors_share_over_the_room_is_no_advice():
    values = {f"{anchor}.c0": 0.1 for anchor in range(8)}
    assert SmoothTerm(values, {}, "", "tdoa", "x", "anchor", (0.0, 1.0)).advice() == ()


# --- slope ---
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


# --- motion ---
ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 0], [0, 8, 0], [0, 0, 3]], ids=[4, 5, 6, 7])
RATE = np.array([0.3, -0.5, 0.8])  # rad/s, body


def path(n=400, step=0.01):
    """A parabola that is flown while turning evenly: namespace of t, p, q, v."""
    t = 5.0 + step * np.arange(n)
    s = (t - t[0])[:, None]
    p = np.array([1.0, 2.0, 1.0]) + s * [0.5, -0.2, 0.1] + 0.5 * s**2 * [0.2, 0.4, -0.1]
    v = np.array([0.5, -0.2, 0.1]) + s * [0.2, 0.4, -0.1]
    return SimpleNamespace(t=t, p=p, q=Rotation.from_rotvec(s * RATE).as_quat(), v=v)


def test_of_an_even_acceleration_and_turn():
    poses = path()
    found = motion_at(poses.t, poses.v, poses.q, np.array([-1, 10, 30, 100, 399]))
    assert (
        np.isnan(found.velocity[0]).all()
        and np.isnan(found.acceleration[:2]).all()
        and np.isnan(found.rate[:2]).all()
    )
    np.testing.assert_array_equal(found.velocity[1:], poses.v[[10, 30, 100, 399]])
    np.testing.assert_allclose(found.acceleration[2:], [[0.2, 0.4, -0.1]] * 3, atol=1e-9)
    np.testing.assert_allclose(found.rate[2:], [RATE] * 3, atol=1e-9)


def test_an_attitude_that_is_not_known_has_no_rate():
    poses = path()
    poses.q[:] = np.nan
    found = motion_at(poses.t, poses.v, poses.q, np.array([100]))
    assert np.isnan(found.rate).all() and np.isfinite(found.velocity).all()


@given(st.lists(st.floats(0, 100), min_size=1, max_size=20), st.none() | st.floats(0, 100))
def test_the_preceding_stamp_is_that_of_the_newest_before(t, newest):
    t = np.array(t)
    found = preceding(t, newest)
    for k in range(len(t)):
        earlier = [*t[:k], *([] if newest is None else [newest])]
        assert found[k] == min(t[k], max(earlier, default=t[k]))


@pytest.mark.parametrize(
    "covariate",
    ["speed", "climb_rate", "acceleration", "turning_rate", "interval", "previous_anchor"],
)
def test_what_is_learned_is_what_is_applied(covariate):
    """The regressors at true poses, and those of a Corrector that is told the same poses, are the
    same function.
    """
    poses = path()
    t = np.sort(np.random.default_rng(1).uniform(5.8, 8.9, 60))
    a, b = np.arange(60) % 4, (np.arange(60) + 1) % 4
    knots = (4.0, 5.0, 6.0, 7.0) if covariate == "previous_anchor" else (0.0, 0.3, 1.0, 2.0)
    values = {
        f"c{k}": 0.1 * (k + 1) ** 2 for k in range(6 if covariate != "previous_anchor" else 4)
    }
    term = SmoothTerm(values=values, covariate=covariate, form="common", knots=knots)
    learned = samples_at(t, a, b, poses, ANCHORS, t[0])
    corrector = Corrector(ANCHORS, EffectSet((term,)))
    corrector.add_pose(poses.t, poses.p, poses.q, poses.v)
    applied = corrector.samples(t, a, b)
    if covariate in ("interval", "previous_anchor"):
        np.testing.assert_array_equal(applied.interval, np.diff(t, prepend=t[0]))
        np.testing.assert_array_equal(applied.previous, np.concatenate([[-1], ANCHORS.ids[b[:-1]]]))
        return
    np.testing.assert_allclose(applied.motion.velocity, learned.motion.velocity, atol=1e-9)
    np.testing.assert_allclose(term.bias(applied), term.bias(learned), atol=1e-9)
    assert np.abs(term.bias(applied)).min() > 0.01


def test_batches_know_what_was_heard_before():
    poses = path()
    term = SmoothTerm(covariate="interval", knots=(0.0, 1.0))
    whole, parts = (Corrector(ANCHORS, EffectSet((term,))) for _ in range(2))
    t, a, b = np.arange(6.0, 7.0, 0.1), np.arange(10) % 4, (np.arange(10) + 1) % 4
    for corrector in (whole, parts):
        corrector.add_pose(poses.t, poses.p, poses.q, poses.v)
    expected = whole.samples(t, a, b)
    found = [parts.samples(t[k : k + 3], a[k : k + 3], b[k : k + 3]) for k in range(0, 10, 3)]
    for name in ("interval", "previous"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in found]), getattr(expected, name)
        )
