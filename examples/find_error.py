# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with the measurements? Diagnose a flight, and correct the next one.

python examples/find_error.py
"""

from pathlib import Path

import uwb_tdoa as uwb

settings = {"duration": 25.0, "imu_rate": 100.0, "bias": False, "multipath": False}
flights = [uwb.simulate(seed=seed, **settings) for seed in (1, 2)]
late = uwb.EFFECTS["anchor_delay"]({"3": 0.3})  # m
first, second = (late.inject(flight) for flight in flights)

diagnosis = uwb.diagnose([first])
for effect in diagnosis.effects:
    print(effect.name, effect.values)
Path("report.html").write_text(uwb.report(diagnosis), encoding="utf-8")
diagnosis.effects.to_yaml("effects.yaml")
for name, effects in (("without", None), ("with", diagnosis.effects)):
    score = uwb.errors(second, uwb.filter(second, effects), effects)
    print(f"next flight: 3D RMSE {score.rmse_3d:.3f} m {name} these effects")
