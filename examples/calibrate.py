# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where do the anchors really stand? Improve a survey by a flight without ground truth.

python examples/calibrate.py
"""

from dataclasses import replace

import numpy as np
import uwb_tdoa as uwb

settings = {"trajectory": "sines", "imu_rate": 100.0, "bias": False, "multipath": False}
flight = uwb.simulate(duration=60.0, seed=4, **settings)
right = flight.anchors
shift = np.random.default_rng(1).normal(0.0, 0.1, right.positions.shape)
measured = replace(right, positions=right.positions + shift)
taped = replace(flight, anchors=measured, truth=None)

found = uwb.calibrate([taped], tape=uwb.Tape(std=0.1))
for name, anchors, effects in (
    ("tape measure", measured, None),
    ("calibrated", found.anchors, found.effects),
):
    run = uwb.filter(replace(flight, anchors=anchors), effects)
    print(f"{name:13s}3D RMSE {uwb.errors(flight, run).rmse_3d:.3f} m")
if found.why_not:
    print(f"not to be used: {found.why_not}")
