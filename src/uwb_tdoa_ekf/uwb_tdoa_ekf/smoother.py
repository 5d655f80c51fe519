"""Fixed-interval smoother over the filter's own run: every estimate from all measurements, before and after it.

Modified Bryson-Frazier recursion (Bierman, Fixed interval smoothing with discrete measurements, Int. J. Control 1973):
backwards through the scalar updates on the filter's tape, with its robust weights, inverting no covariance.
"""

from dataclasses import replace
import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled

from .core.config import FilterConfig
from .core.engine import REST_PERIOD
from .estimator import Odometry
from .core.hypotheses import YAW_STD
from .offline import run_offline
from .core.state import inject
from .core.tape import REPLACED, new_tape


def smooth(flight, config=None, corrector=None):
    """Run a Flight through bias correction, filter and smoother.

    Takes what run_offline takes and returns its Run with the odometry smoothed: at the stamps of updates, thinned to
    odometry_rate. If the yaw is unknown, the direction that the filter believes in the end counts from the beginning.
    Memory: 5 kB per TDOA.
    """
    config = config or FilterConfig()
    if config.use_imu and config.initial_yaw_std > YAW_STD:
        turned = run_offline(flight, config, corrector).turned
        config = replace(config, initial_yaw=config.initial_yaw + turned, initial_yaw_std=YAW_STD)
    duration = np.ptp(flight.tdoa.t) if len(flight.tdoa) else 0.0
    tape = new_tape(len(flight.tdoa) + 3 * int(duration / REST_PERIOD) + 100)
    result = run_offline(flight, config, corrector, tape)
    n = result.taped
    rows, covariance = np.empty((n, 17)), np.empty((n, 9, 9))
    count = _backward(tape, n, config.odometry_rate, rows, covariance)
    rows, covariance = rows[n - count :], covariance[n - count :]
    return replace(result, odometry=Odometry.from_rows(rows, covariance))


@compiled
def _backward(tape, n, rate, rows, covariance):
    """Fill rows (n, 17) and covariance (n, 9, 9) from the end on; returns how many."""
    adjoint = np.zeros(15)
    information = np.zeros((15, 15))
    shift = np.zeros(15)
    moved = np.empty((15, 15))
    count = 0
    for i in range(n - 1, -1, -1):
        P = tape.P[i]
        if i == 0 or math.floor(tape.t[i] * rate) != math.floor(tape.t[i - 1] * rate):
            count += 1
            out = rows[n - count]
            out[0] = tape.t[i]
            out[1:] = tape.x[i]
            for j in range(15):
                shift[j] = -np.dot(P[j], adjoint)
            inject(out[1:], shift, 1.0)
            reduced = P[:9, :9] - P[:9] @ information @ np.ascontiguousarray(P[:, :9])
            covariance[n - count] = 0.5 * (reduced + reduced.T)
        if tape.kind[i] == REPLACED:
            adjoint[:] = 0.0
            information[:, :] = 0.0
            continue
        # through the update: C = I - gain h
        h, gain = tape.h[i], tape.gain[i]
        lean = information @ gain
        both = np.dot(gain, lean) + 1.0 / tape.total[i]
        pull = np.dot(gain, adjoint) + tape.innovation[i] / tape.total[i]
        for j in range(15):
            adjoint[j] -= h[j] * pull
            for k in range(15):
                information[j, k] += h[j] * h[k] * both - h[j] * lean[k] - lean[j] * h[k]
        # through the prediction: the lower rows of the transition are those of the identity
        phi = tape.phi[i]
        shift[:] = phi.T @ adjoint[:9]
        shift[9:] += adjoint[9:]
        adjoint[:] = shift
        moved[:, :] = np.ascontiguousarray(information[:, :9]) @ phi
        moved[:, 9:] += information[:, 9:]
        information[:, :] = phi.T @ moved[:9]
        information[9:] += moved[9:]
    return count
