# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A random prior, for the tests of updates."""

from covariances import random_covariance
import numpy as np

from uwb_tdoa_ekf.core.memory import new_state
from uwb_tdoa_ekf.core.state import inject
from uwb_tdoa_ekf.core.update import project


class Prior:
    """A random HYPOTHESIS and a projected INNOVATION.

    `h` (15,) is the same measurement as a dense row of the Jacobian.
    """

    def __init__(self, seed, states=(0, 1, 2), surprise=1.0):
        """Draw a prior.

        states : measured error states.
        surprise : size of the innovation, in its standard deviations.
        """
        self.rng = rng = np.random.default_rng(seed)
        self._ekf = new_state(np.zeros((1, 3))).record
        self.hypothesis, self.innovation = self._ekf.hypotheses[0], self._ekf.innovation
        self.hypothesis.x[:3] = rng.uniform(-5, 5, 3)
        self.hypothesis.P[:] = random_covariance(rng)
        self.h = np.zeros(15)
        self.h[list(states)] = rng.uniform(-1, 1, len(states))
        entries = self.innovation.entries = len(states)
        self.innovation.states[:entries], self.innovation.row[:entries] = (
            states,
            self.h[list(states)],
        )
        self.innovation.noise_variance = 10.0 ** rng.uniform(-3, 1)
        self.project()
        variance = self.innovation.prior_variance + self.innovation.noise_variance
        self.innovation.value = surprise * rng.standard_normal() * np.sqrt(variance)

    def project(self):
        project(self.hypothesis.P, self.innovation)

    def textbook(self, noise):
        """Return state and covariance of a Kalman update with this noise variance."""
        return self.after(*kalman(self.hypothesis.P, self.h, self.innovation.value, noise))

    def after(self, error, covariance):
        """Return the state after an error estimate (15,), and the given covariance."""
        x = self.hypothesis.x.copy()
        inject(x, error, 1.0)
        return x, covariance

    def assert_is(self, x, P, rtol=1e-9):
        std = np.sqrt(np.diag(P))
        np.testing.assert_allclose(
            self.hypothesis.P / np.outer(std, std), P / np.outer(std, std), atol=rtol
        )
        np.testing.assert_allclose(self.hypothesis.x, x, rtol=rtol, atol=rtol)


def kalman(P, h, innovation, noise):
    """Return error (n,) and covariance of the textbook update, by matrices."""
    gain = P @ h / (h @ P @ h + noise)
    return gain * innovation, (np.eye(len(h)) - np.outer(gain, h)) @ P


def with_offset(prior):
    """Set random offset states of a prior and return the joint covariance (18, 18)."""
    joint = np.zeros((18, 18))
    joint[:15, :15] = prior.hypothesis.P
    link = 0.1 * prior.rng.standard_normal((3, 15)) @ np.linalg.cholesky(prior.hypothesis.P).T
    joint[15:, :15], joint[:15, 15:] = link, link.T
    joint[15:, 15:] = [[2.0, 0.1, 0.2], [0.1, 1.0, -0.1], [0.2, -0.1, 1.5]]
    prior.hypothesis.offset_cross[:], prior.hypothesis.offset_P[:] = link, joint[15:, 15:]
    prior.hypothesis.offset[:] = [3.0, -0.2, 0.4]
    return joint
