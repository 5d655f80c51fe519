"""Everything one filter remembers between two events. A copy of its arrays is a copy of the filter."""

from typing import NamedTuple

import numpy as np

from .state import GRAVITY

HYPOTHESES = 4  # starts in as many directions while the yaw is unknown
WINDOW = 512  # TDOAs kept for a start

# places in Memory.clock
(NOW, LAST_IMU, FIRST_TDOA, LAST_TDOA, NEXT_TRY, NEXT_ODOMETRY, NEXT_REST, NEXT_MERGE,
 AGREEMENT, RUNNING, QUIET, RECOVERIES, KEPT, BEST, TAPED) = range(15)  # fmt: skip

# rows of Memory.imu
GYRO, FORCE, SLOW_FORCE, FORCE_POWER, MEAN_FORCE, SLOW_GYRO, GYRO_POWER = range(7)


class Memory(NamedTuple):
    """State of one filter: one nominal state and covariance per yaw hypothesis, the rest shared."""

    x: np.ndarray  # (HYPOTHESES, 16) nominal states, see state.py
    P: np.ndarray  # (HYPOTHESES, 15, 15) error covariances
    belief: np.ndarray  # (HYPOTHESES,) log probability relative to the best; -inf: given up
    clock: np.ndarray  # stamps, s, counters and flags
    imu: np.ndarray  # (7, 3): last sample and running statistics
    window: np.ndarray  # (4, 2 * WINDOW): t, a, b, d of recent TDOAs, oldest first
    noise: np.ndarray  # (2, N): variance of what is received of each anchor, m^2, and stamp of its last change, s
    box: np.ndarray  # (2, 3): lower and upper end of where the tag is believed to be, m
    F: np.ndarray  # the rest is scratch
    R: np.ndarray
    E: np.ndarray
    K: np.ndarray
    g: np.ndarray
    S: np.ndarray
    step: np.ndarray


def new_memory(anchors):
    """Memory of a filter that has seen nothing; anchors : how many there are."""
    clock = np.full(15, -np.inf)
    clock[[AGREEMENT, RUNNING, QUIET, RECOVERIES, KEPT, BEST, TAPED]] = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    imu = np.zeros((7, 3))
    imu[[FORCE, SLOW_FORCE, MEAN_FORCE], 2] = GRAVITY
    x = np.zeros((HYPOTHESES, 16))
    x[:, 9] = 1.0
    P = np.tile(np.eye(15), (HYPOTHESES, 1, 1))
    belief = np.full(HYPOTHESES, -np.inf)
    belief[0] = 0.0
    shapes = ((15, 15), (3, 3), (3, 3), (15,), (3,), (15, 3), (16,))
    scratch = (np.zeros(shape) for shape in shapes)
    return Memory(x, P, belief, clock, imu, np.zeros((4, 2 * WINDOW)), np.zeros((2, anchors)), np.zeros((2, 3)), *scratch)
