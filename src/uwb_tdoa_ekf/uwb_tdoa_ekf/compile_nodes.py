# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""compile_nodes: compile what the nodes need, so that their first start takes no longer than any
other.

Compiled code is kept in the folder that NUMBA_CACHE_DIR names, by default ~/.cache/uwb_tdoa, and
used until the sources, numba or the processor change. `./dev build` and `./dev demo` call this;
after a `colcon build` call it as the user who starts the nodes. What a learned network needs is
compiled at the first start of `bias_node` with one, before it is ready.
"""

from __future__ import annotations

import argparse
from argparse import ArgumentParser
from collections.abc import Sequence
from functools import cache
import sys
import time

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.correction import corrector
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.samples import ImuFeatures
from uwb_tdoa_bias.effects.tag import TagLeverArm

from .estimator import Estimator
from .monitoring.anchor_watch import LENGTH, Slice
from .monitoring.change_detector import YOUNGEST, ChangeDetector
from .monitoring.judge import Judge
from .monitoring.stream_rules import StreamWatch
from .results import pose_and_twist, rotation_std


@cache
def warm_up() -> None:
    """Compile, or load from numba's cache, the functions that the first messages need."""
    estimator = Estimator(Anchors.from_positions([[0, 0, 0], [5, 0, 1], [0, 5, 2], [5, 5, 0]]))
    # 4 s, so that the filter starts; 20 calls, as messages of a node come in parts
    watch, steps = StreamWatch(estimator.anchors, lag=0.25), np.arange(400)
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
    ImuFeatures()(t, none, none)
    pose_and_twist(odometry, odometry.rate, odometry.rate_variance)
    rotation_std(odometry.q[-1:], odometry.covariance[-1:])
    watch.findings()
    Judge(Anchors.from_positions(np.eye(5, 3))).add(
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


def parser() -> ArgumentParser:
    """Return the command line parser; the program has no options."""
    layout = argparse.RawDescriptionHelpFormatter
    examples = "examples:\n  compile_nodes"
    return argparse.ArgumentParser(
        prog="compile_nodes", description=__doc__, epilog=examples, formatter_class=layout
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Compile all functions that are not in the cache and return the exit code."""
    try:
        parser().parse_args(argv)
    except SystemExit as ended:  # argparse has printed the error
        return int(ended.code or 0)
    began = time.monotonic()
    warm_up()
    # one effect for each input of a correction: the attitude, and the motion
    of_motion = SmoothTerm(
        form="common", covariate="speed", shape="line", knots=(0.0, 1.0), values={"c1": 0.1}
    )
    corrector.warm_up(EffectSet((TagLeverArm(values={"z": 0.1}), of_motion)), model=None)
    print(f"ekf_node and bias_node are compiled; {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
