# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where was the tag? Smooth a recording, and write the path as a table and a picture.

python examples/locate.py [RECORDING [SURVEY]]
"""

from pathlib import Path
import sys

import uwb_tdoa as uwb

recording, survey, *_ = *sys.argv[1:], None, None
if recording is None:
    recording = "circle_bag"
    uwb.write(uwb.simulate(duration=20.0, seed=1, imu_rate=100.0), recording, force=True)

flight = uwb.read(recording, survey)
for finding in uwb.check(flight):
    print(f"{finding.severity}: {finding.cause}")
run = uwb.smooth(flight)
table = uwb.table(run)
name = Path(recording).stem
uwb.plot(flight, run).savefig(f"{name}.png")
print(f"{len(table)} estimates, the first at x = {table['x'][0]:.2f} m; picture: {name}.png")
