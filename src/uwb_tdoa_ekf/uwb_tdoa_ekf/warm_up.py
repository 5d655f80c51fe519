"""What the first messages of ekf_node would compile, compiled before: without ROS, so that it can
be done before the messages are built.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.sensors import SENSORS

from .estimator import Estimator
from .frames import pose_and_twist, rotation_std
from .monitoring.change import YOUNGEST, ChangeDetector
from .monitoring.slices import LENGTH, Slice
from .monitoring.stream_watch import StreamWatch
from .streams.scale import SurveyScale


@cache
def warm_up() -> None:
    """Compile, or load from numba's cache, what the first messages would."""
    estimator = Estimator(Anchors.from_positions([[0, 0, 0], [5, 0, 1], [0, 5, 2], [5, 5, 0]]))
    watch, steps = StreamWatch(estimator.anchors, 0.25), np.arange(400)
    watch.add_imu(
        0.01 * steps, 0.01 * steps, np.zeros((400, 3)), np.tile((0.0, 0.0, 9.81), (400, 1))
    )
    watch.add_tdoa(0.01 * steps, 0.01 * steps, steps % 4, (steps + 1) % 4, np.zeros(400))
    for some in np.split(steps, 20):
        t, none = 0.01 * some, np.zeros((len(some), 3))
        estimator.add_imu(t, none, none + (0.0, 0.0, 9.81))
        estimator.add_tdoa(t, some % 4, (some + 1) % 4, np.zeros(len(some)))
        for name, sensor in SENSORS.items():
            estimator.add(
                name,
                sensor.read(
                    t,
                    {
                        field: np.ones((len(some), k) if k > 1 else len(some))
                        for field, k in sensor.fields.items()
                    },
                ),
            )
        odometry, _ = estimator.advance()
    pose_and_twist(odometry, *estimator.rates_at(odometry))
    rotation_std(odometry.q[-1:], odometry.covariance[-1:])
    watch.findings()
    SurveyScale(Anchors.from_positions(np.eye(5, 3))).add(
        np.array([(k, (k + 1) % 5, 1.0) for k in range(5)])
    )
    detector = ChangeDetector()
    for k in range(YOUNGEST + 2):
        detector.add(
            Slice(
                LENGTH * k,
                np.zeros(3),
                np.zeros(1, int),
                np.zeros(1),
                np.eye(1),
                np.eye(1),
                np.zeros(1),
            )
        )
    detector.find(0.0)
    estimator.set_pose(4.0, (1.0, 1.0, 1.0), np.eye(3), 0.0, 0.1)
    estimator.finish()
