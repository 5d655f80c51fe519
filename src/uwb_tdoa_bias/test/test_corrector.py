# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import fields

from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common import compiled
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.corrector import (
    EFFECTS,
    FADED,
    NETWORK,
    PASSED,
    START,
    Correction,
    Corrector as LateCorrector,
    Poses,
    parts_of,
    rotated_in_yaw,
    warm_up,
)
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EFFECTS as CATALOGUE, AnchorDelay, EffectSet, TagLeverArm

ANCHORS = Anchors.from_positions([[0, 0, 0], [8, 0, 0], [0, 8, 0], [0, 0, 3]], ids=[4, 5, 6, 7])
DELAYS = EffectSet((AnchorDelay({4: 0.1, 6: -0.2}),))
ARM = EffectSet((TagLeverArm({"z": 0.3}),))


def Corrector(*model, history=100, **options):
    """Return a Corrector that uses the first pose at once."""
    return LateCorrector(*model, **options, poses=Poses(history, start=0.0))


class Height(Network):
    """Stand in for a network. The bias is the height of the tag, in m.

    It is unknown without a pose and above z = 2 m.
    """

    name = "height"

    def __init__(self, std=0.05, known=1.0):
        self.std, self.known = std, known

    def predict(self, samples):
        z = samples.p[:, 2]
        return (
            np.where(z > 2.0, np.nan, z),
            np.full(len(samples), self.std),
            np.full(len(samples), self.known),
        )


def correct(corrector, t, dense=False):
    """Correct TDOAs of 1 m at stamps t. `dense` puts one with the same stamp before each."""
    t = np.atleast_1d(np.asarray(t, dtype=float))
    each = 2 if dense else 1
    rows = np.repeat(np.arange(len(t)), each)
    found = corrector.correct(np.repeat(t, each), rows % 4, (rows + 1) % 4, np.ones(len(rows)))
    return Correction(
        *(getattr(found, field.name)[each - 1 :: each] for field in fields(Correction))
    )


def climbing(corrector, stamps):
    """Add poses to the corrector. The height of each pose equals its stamp."""
    for t in stamps:
        corrector.add_pose(t, np.array([1.0, 1.0, t]), np.array([0.0, 0.0, 0.0, 1.0]))
    return corrector


def test_with_nothing_to_correct_with_measurements_pass():
    corrector = climbing(Corrector(ANCHORS), [0.0, 1.0])
    assert corrector.idle and corrector.model_name == "none" and corrector.ready(1e9)
    found = correct(corrector, [0.5, 2.0])
    assert (
        found.bias.tolist() == [0, 0]
        and found.std.tolist() == [0, 0]
        and found.corrected.tolist() == [1, 1]
    )
    assert found.status.tolist() == [PASSED, PASSED]


def test_effects_that_the_filter_judges_are_not_corrected():
    floor = CATALOGUE["floor_multipath"]({"4.delay": 3.3, "4.height": 5.0})
    corrector = Corrector(ANCHORS, EffectSet((*DELAYS, floor)))
    assert (
        floor.is_hypothesis
        and corrector.left_to_filter.effects == (floor,)
        and corrector.effects == DELAYS
    )
    both = climbing(Corrector(ANCHORS, EffectSet((floor, *DELAYS))), [0.0, 1.0])
    alone = climbing(Corrector(ANCHORS, DELAYS), [0.0, 1.0])
    assert both.model_name == "anchor_delay"
    found, expected = correct(both, [1.5, 1.6]), correct(alone, [1.5, 1.6])
    assert np.array_equal(found.bias, expected.bias) and np.array_equal(found.std, expected.std)


@given(
    st.lists(st.integers(0, 100), max_size=30),
    st.lists(st.integers(0, 120), min_size=1, max_size=10),
    st.integers(0, 20),
)
def test_uses_the_newest_pose_a_lag_before_the_preceding_measurement(poses, asked, lag):
    # Eighths of a second are exact, so the test of "no later than" includes equality.
    corrector = climbing(Corrector(ANCHORS, None, Height(), lag=lag / 8), np.array(poses) / 8)
    # A pose that is not newer than all earlier ones is ignored.
    told = [t for k, t in enumerate(poses) if t > max(poses[:k], default=-1)]
    found = correct(corrector, np.array(asked) / 8)
    for k, (t, bias, status) in enumerate(zip(asked, found.bias, found.status)):
        preceding = min(t, max(asked[:k], default=t))
        known = [pose for pose in told if pose <= preceding - lag]
        height = max(known) / 8 if known else 3.0
        assert bias == (height if height <= 2.0 else 0.0)
        assert status == (NETWORK if height <= 2.0 else PASSED)


def test_a_constant_correction_waits_for_no_pose():
    constant = EffectSet((AnchorDelay({"5": 0.25}),))
    corrector = Corrector(ANCHORS, constant)
    corrector.add_pose(0.0, np.ones(3), np.array([0.0, 0.0, 0.0, 1.0]))
    assert corrector.ready(1e9) and not Corrector(ANCHORS, ARM).ready(1e9)
    first = correct(corrector, 5.0).bias[0]
    climbing(corrector, [4.0, 5.0])
    assert first == correct(corrector, 5.0).bias[0] != 0.0


@given(
    st.lists(st.integers(0, 60), max_size=20),
    st.integers(0, 60),
    st.lists(st.integers(0, 90), max_size=20),
)
def test_once_ready_no_later_pose_changes_a_correction(before, asked, after):
    corrector = climbing(Corrector(ANCHORS, None, Height(), lag=0.5), np.array(before) / 40)
    if not corrector.ready(asked / 40):
        return
    first = correct(corrector, asked / 40).bias[0]
    climbing(corrector, np.array(after) / 40)
    assert correct(corrector, asked / 40).bias[0] == first


def test_where_the_network_cannot_tell_effects_remain():
    corrector = climbing(Corrector(ANCHORS, DELAYS, Height(), lag=0.0), [1.0, 2.5])
    # no pose yet; within the domain of the network; outside of it
    found = correct(corrector, [0.0, 1.0, 2.5], dense=True)
    np.testing.assert_allclose(found.bias, [-0.1, -0.2 + 1.0, 0.2])
    assert found.status.tolist() == [EFFECTS, NETWORK, EFFECTS]
    assert found.std.tolist() == [0.0, 0.05, 0.0]


@pytest.mark.parametrize(
    ("known", "status"), [(1.0, NETWORK), (0.5, NETWORK), (0.49, FADED), (0.0, FADED)]
)
def test_says_when_the_network_has_faded(known, status):
    corrector = climbing(Corrector(ANCHORS, None, Height(known=known), lag=0.0), [1.0])
    # Before the first pose the network gives no bias.
    found = correct(corrector, [0.0, 1.0], dense=True)
    assert found.status.tolist() == [PASSED, status] and found.std.tolist() == [0.0, 0.05]


@given(
    st.lists(st.lists(st.integers(0, 60), max_size=12), max_size=6),
    st.lists(st.integers(0, 60), min_size=1),
)
def test_poses_told_together_are_poses_told_one_by_one(batches, asked):
    correctors = [Corrector(ANCHORS, None, Height(), lag=0.0, history=5) for _ in range(2)]
    for batch in batches:
        t = np.array(batch) / 8.0
        climbing(correctors[0], t)
        correctors[1].add_pose(
            t, np.stack([t, t, t], axis=1), np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
        )
    one, other = (corrector._poses.kept for corrector in correctors)
    np.testing.assert_array_equal(one.t[-5:], other.t[-5:])
    np.testing.assert_array_equal(one.p[-5:, 2], other.p[-5:, 2])
    newest = [t for t in np.array(asked) / 8.0 if len(one.t) == 0 or t >= one.t[-5:][0]]
    found = [correct(corrector, newest) for corrector in correctors]
    np.testing.assert_array_equal(found[0].bias, found[1].bias)


def test_effects_are_those_of_the_mean_heading_while_the_yaw_is_unknown():
    arm = EffectSet((TagLeverArm({"x": 0.3, "z": 0.2}),))
    told = {}
    for yaw_std in (0.1, 2.0):
        corrector = Corrector(ANCHORS, arm, lag=0.0)
        corrector.add_pose(
            0.0, np.array([1.0, 2.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]), yaw_std=yaw_std
        )
        told[yaw_std] = correct(corrector, [0.0])
    upright = Corrector(ANCHORS, EffectSet((TagLeverArm({"z": 0.2}),)), lag=0.0)
    upright.add_pose(0.0, np.array([1.0, 2.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    # The horizontal part of the lever arm averages out.
    np.testing.assert_allclose(told[2.0].bias, correct(upright, [0.0]).bias, atol=0.01)
    assert abs(told[0.1].bias[0] - told[2.0].bias[0]) > 0.03
    assert told[0.1].std[0] == 0.0 and told[2.0].std[0] > 0.03


@given(st.integers(-4, 4), st.integers(0, 1000))
def test_rotated_in_yaw_turns_about_the_vertical(quarters, seed):
    q = Rotation.random(3, random_state=seed)
    expected = Rotation.from_euler("z", quarters * np.pi / 2) * q
    assert (
        np.abs(
            (Rotation.from_quat(rotated_in_yaw(q.as_quat(), quarters)) * expected.inv()).magnitude()
        ).max()
        < 1e-9
    )


@given(seed=st.integers(0, 1000))
def test_parts_of_odometry_hold_the_velocity_in_the_world(seed):
    rng = np.random.default_rng(seed)
    poses, twists = rng.normal(size=(3, 43)), rng.normal(size=(3, 42))
    poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1)[:, None]
    poses[2, 3:7] = 0.0  # unknown
    poses[:, [28, 35, 42]] = [[0.01, 0.01, 4.0], [1.44, 1.44, 6.25], [0.01, 0.01, 0.09]]
    p, q, v, yaw_std = parts_of(poses, twists)
    # Without an estimated attitude, the assumed yaw counts as exact.
    np.testing.assert_allclose(yaw_std, [2.0, 0.0, 0.3])
    np.testing.assert_array_equal(p, poses[:, :3])
    np.testing.assert_allclose(v[:2], Rotation.from_quat(q[:2]).apply(twists[:2, :3]), atol=1e-12)
    assert np.isnan(v[2]).all() and np.isnan(q[2]).all()


@pytest.mark.slow
@given(st.floats(0.0, 0.999 * START))
def test_the_first_pose_may_be_late_and_changes_nothing(late):
    """TDOAs arrive at 100 Hz. The poses up to `late` s arrive together, all later ones on time.

    A TDOA waits for the pose that it needs.
    """
    stamps, told = np.arange(0.0, 1.5, 0.01), []
    for arrival in (0.0, late):
        corrector, before, told_now = LateCorrector(ANCHORS, ARM), 0.0, []
        for t in stamps:
            if t >= arrival:
                climbing(
                    corrector,
                    [p for p in np.arange(0.0, t + 0.005, 0.01) if p > corrector._poses.newest],
                )
            # Before the first pose, TDOAs are corrected without waiting.
            assert t < arrival or corrector.ready(before)
            told_now.append(correct(corrector, t).bias[0])
            before = t
        told.append(told_now)
    assert (
        told[0] == told[1]
        and not any(told[0][: int(START / 0.01)])
        and all(told[0][int(START / 0.01) + 2 :])
    )


def test_forgets_old_poses_and_keeps_the_last_ones():
    corrector = climbing(
        Corrector(ANCHORS, None, Height(), lag=0.0, history=10), np.arange(1000) / 1000
    )
    found = correct(corrector, [0.001, 0.990, 0.995, 0.999], dense=True)
    np.testing.assert_allclose(found.bias, [0.0, 0.990, 0.995, 0.999], atol=1e-12)
    assert all(len(column) <= 20 for column in corrector._poses.kept)


def signatures():
    return {function: len(function.signatures) for function in compiled._FUNCTIONS}


def test_nothing_is_compiled_after_the_warm_up():
    """bias_node is ready then; it gives poses and TDOAs in batches of any size, with a new yaw."""
    effects = EffectSet((TagLeverArm({"z": 0.1}), AnchorDelay({"1": 0.1})))
    warm_up(effects, None)
    before = signatures()
    corrector, k = Corrector(ANCHORS, effects), np.arange(400)
    for some in np.array_split(k, [1, 5, 40, 200]):
        pose, twist = np.eye(len(some), 43, 6), np.zeros((len(some), 42))
        pose[:, 6], pose[:, 42] = 1.0, 9.0 * (some > 100)  # the yaw is unknown after 1 s
        corrector._poses.add(0.01 * some, *parts_of(pose, twist))
        corrector.correct(0.01 * some, some % 2, (some + 1) % 2, np.zeros(len(some)))
    assert signatures() == before
