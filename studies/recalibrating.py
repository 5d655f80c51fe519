# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""recalibrating: survey with one flight, change the installation, and survey again with another
flight, starting from the first result.

The change is an anchor that is moved, or late. It is put into the survey that came with the
flights, so only the change is simulated. A third flight judges last week's calibration and the new
one.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.prior import with_calibration
from uwb_tdoa_tools.surveying.report import with_blocked

from .surveying import at, measured_flights, rmse

_CONST1, _CONST4 = "util/const1-trial{}-tdoa2.csv.gz", "util/const4-trial1-tdoa2-traj{}.csv.gz"
SETS = {
    "const1": [_CONST1.format(k) for k in (1, 2, 3)],
    "const4": [_CONST4.format(k) for k in (1, 2, 3)],
}
TRUSTED = "0", "6"
CHANGES = {  # {description: effect of the change}
    "nothing": EFFECTS["anchor_delay"]({}),
    "anchor 3 moved by 15 cm in x": EFFECTS["anchor_position"]({"3.x": 0.15}),
    "anchor 1 moved by 14 cm in y and z": EFFECTS["anchor_position"]({"1.y": -0.1, "1.z": 0.1}),
    "anchor 5 later by 15 cm": EFFECTS["anchor_delay"]({"5": 0.15}),
    "anchor 4 late by 60 cm within 1 m of (-1, -1, 1.2)": EFFECTS["nlos"](
        {"4.x": -1.0, "4.y": -1.0, "4.z": 1.2, "4.radius": 1.0, "4.delay": 0.6}
    ),
    "anchor 2 moved by 36 cm in x and y": EFFECTS["anchor_position"]({"2.x": -0.3, "2.y": -0.2}),
}


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    add("--only", choices=tuple(SETS), help="one set")


def run(args):
    """Print a table, a row for each set and change."""
    print(
        "| set | what changed | last week's | surveyed anew | what it says "
        "|\n|---|---|---:|---:|---|"
    )
    for name in [args.only] if args.only else SETS:
        first, second, judged = (measured_flights(args.data, [path])[0] for path in SETS[name])
        week = self_calibrate([first], Tape(trusted=TRUSTED))
        known, anchors = taken(week, week.base), week.surveyed
        for words, change in CHANGES.items():
            flown = [at(change.inject(flight), anchors.positions) for flight in (second, judged)]
            today = with_blocked(
                self_calibrate([replace(flown[0], truth=None)], Tape(), known), flown[:1]
            )
            errors = (
                rmse(flown[1:], known),
                rmse([at(flown[1], today.surveyed.positions)], taken(today, known)),
            )
            said = "; ".join(one.as_text() for one in today.changes) or "no anchor has changed"
            said = " ".join([said + ".", *today.blocked])
            print(f"| {name} | {words} | {errors[0]:.3f} | {errors[1]:.3f} | {said} |", flush=True)


def taken(result, base):
    """The EffectSet of a SelfCalibration, whether it would be applied or not."""
    return with_calibration(base, result.found(np.zeros_like(result.shifts)), result.covariance)
