# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Paths of any kind: where they lead, and how fast."""

import numpy as np
from scipy.spatial.transform import Rotation

from studies.any_path import Path, between


def test_the_motion_of_a_path_is_its_derivative_and_what_a_sensor_feels():
    path = Path(10.0, between((0.0, 0, 0, 1), (1.0, 0, 0, 1), (4.0, 3, 1, 2), (9.0, 0, 0, 1)))
    t = np.linspace(0.5, 9.5, 400)
    motion, h = path.motion(t), 1e-3
    ahead, behind = path.motion(t + h), path.motion(t - h)
    np.testing.assert_allclose((ahead.p - behind.p) / (2 * h), motion.v, atol=1e-4)
    np.testing.assert_allclose((ahead.v - behind.v) / (2 * h), motion.a, atol=1e-3)
    turn = Rotation.from_quat(motion.q)
    np.testing.assert_allclose(
        turn.apply(motion.specific_force), motion.a + [0, 0, 9.81], atol=1e-9
    )
    turned = (Rotation.from_quat(behind.q).inv() * Rotation.from_quat(ahead.q)).as_rotvec() / (
        2 * h
    )
    np.testing.assert_allclose(turned, motion.body_rates, atol=1e-3)
    still = path.motion(np.array([0.3]))
    np.testing.assert_allclose(still.specific_force, [[0, 0, 9.81]], atol=1e-6)
    np.testing.assert_allclose(still.p, [[0, 0, 1]], atol=1e-9)
    assert (
        not path.motors(t).any()
        and Path(10.0, between((0.0, 0, 0, 1), (1.0, 0, 0, 1)), running=(2.0, 3.0)).motors(t).sum()
        > 30
    )
