"""A recorded flight as it would have arrived."""

from dataclasses import replace

import numpy as np

LATENCY, JITTER = 2e-3, 1e-3  # s, of a message on its way, the least and the mean of what comes on top


def arriving(recording, seed):
    """The Recording with arrival times: every message a few milliseconds after its stamp, none before the one before
    it."""
    rng = np.random.default_rng([seed, 1])
    out = {"tdoa_arrival": _arrival(recording.tdoa.t, rng)}
    if recording.imu is not None:
        out["imu_arrival"] = _arrival(recording.imu.t, rng)
    return replace(recording, **out)


def _arrival(t, rng):
    return np.maximum.accumulate(t + LATENCY + rng.exponential(JITTER, len(t)))
