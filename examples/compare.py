# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How much better is the smoother than the filter? Compare both with the ground truth.

python examples/compare.py
"""

import uwb_tdoa as uwb

flight = uwb.simulate(trajectory="sines", duration=20.0, seed=2, imu_rate=100.0)
for name, run in (("filter", uwb.filter(flight)), ("smoother", uwb.smooth(flight))):
    row = uwb.errors(flight, run).row()
    print(f"{name:9s}3D RMSE {row['rmse_3d']:.3f} m, largest error {row['max_3d']:.3f} m")
uwb.plot_errors(flight, run).savefig("errors.png")
