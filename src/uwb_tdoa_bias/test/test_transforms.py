import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.transforms import HELD, Frames

QUARTER = Rotation.from_euler("z", 90.0, degrees=True)  # to the left
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def robot():
    """A mast on the base, an IMU on the mast turned to the left, and a radio on the base."""
    frames = Frames()
    frames.set("base_link", "mast", IDENTITY, (0.1, 0.0, 0.5))
    frames.set("mast", "imu_link", QUARTER.as_quat(), (0.0, 0.2, 0.0))
    frames.set("base_link", "radio", IDENTITY, (0.0, 0.0, 0.3))
    return frames


def test_a_chain_of_constant_transforms():
    turn, p = robot().between("base_link", "imu_link")
    np.testing.assert_allclose(turn.apply([1.0, 0.0, 0.0]) + p, [0.1, 1.2, 0.5], atol=1e-12)
    back, q = robot().between("imu_link", "base_link")
    np.testing.assert_allclose(back.apply([0.1, 1.2, 0.5]) + q, [1.0, 0.0, 0.0], atol=1e-12)


def test_two_branches_meet_where_they_part():
    turn, p = robot().between("radio", "imu_link")
    np.testing.assert_allclose(turn.apply([0.0, 0.0, 0.0]) + p, [0.1, 0.2, 0.2], atol=1e-12)
    turn, p = robot().between("radio", "radio")
    assert turn.magnitude() == 0.0 and not p.any()


def test_what_nobody_says_is_not_known():
    frames = robot()
    assert frames.between("base_link", "camera") is None
    frames.set("camera", "lens", IDENTITY, (0.0, 0.0, 0.1))
    assert frames.between("base_link", "lens") is None


def test_a_loop_ends():
    frames = Frames()
    frames.set("a", "b", IDENTITY, (1.0, 0.0, 0.0))
    frames.set("b", "a", IDENTITY, (1.0, 0.0, 0.0))
    assert frames.between("c", "a") is None


def test_a_frame_that_moves_is_interpolated_and_held_for_a_while():
    frames = robot()
    frames.move("odom", "base_link", IDENTITY, (0.0, 0.0, 0.0), 1.0)
    frames.move("odom", "base_link", QUARTER.as_quat(), (2.0, 0.0, 0.0), 2.0)
    frames.move("odom", "base_link", IDENTITY, (9.0, 0.0, 0.0), 1.9)  # not later
    turn, p = frames.between("odom", "base_link", 1.5)
    assert turn.magnitude() == pytest.approx(np.pi / 4) and p.tolist() == [1.0, 0.0, 0.0]
    turn, p = frames.between("odom", "radio", 2.0 + HELD)
    assert turn.magnitude() == pytest.approx(np.pi / 2) and p.tolist() == [2.0, 0.0, 0.3]
    for t in (0.9, 2.01 + HELD, None):
        assert frames.between("odom", "base_link", t) is None


def test_a_frame_that_goes_back_in_time_starts_anew():
    frames = Frames()
    frames.move("odom", "base_link", IDENTITY, (5.0, 0.0, 0.0), 100.0)
    frames.move("odom", "base_link", IDENTITY, (1.0, 0.0, 0.0), 3.0)
    assert frames.between("odom", "base_link", 3.0)[1].tolist() == [1.0, 0.0, 0.0]
    assert frames.between("odom", "base_link", 100.0) is None


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_refused(q):
    frames = Frames()
    for take in (frames.set, lambda *transform: frames.move(*transform, 1.0)):
        with pytest.raises(InputError, match="a -> b"):
            take("a", "b", q, (0.0, 0.0, 0.0))
        with pytest.raises(InputError, match="must be finite"):
            take("a", "b", (0.0, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0))
    assert frames.between("a", "b", 1.0) is None


def test_frames_are_bounded(monkeypatch):
    monkeypatch.setattr("uwb_tdoa_bias.common.transforms.MOST", 3)
    frames = Frames()
    for k in range(3):
        frames.set("a", f"b{k}", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="3 frames already"):
        frames.set("a", "c", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    frames.set("a", "b1", (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0))  # one that is known may move


def test_a_transform_that_is_sent_again_with_jitter_is_no_other():
    frames = Frames()
    assert frames.set("base_link", "imu", (0.0, 0.0, 0.0, 1.0), (0.1, 0.0, 0.0))
    for k in range(1, 50):  # it does not creep
        assert not frames.set(
            "base_link", "imu", (0.0, 0.0, 1e-6, 1.0), (0.1 + 1e-4 * min(k, 9), 0.0, 0.0)
        )
    assert frames.between("base_link", "imu")[1].tolist() == [0.1, 0.0, 0.0]
    assert frames.set("base_link", "imu", (0.0, 0.0, 1e-3, 1.0), (0.1, 0.0, 0.0))
    assert frames.set("base_link", "imu", (0.0, 0.0, 1e-3, 1.0), (0.102, 0.0, 0.0))
