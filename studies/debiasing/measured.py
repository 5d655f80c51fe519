# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""debias-measured: fit a map to some measured flights, judge it on others, and compare it with
`diagnose`.
"""

from functools import partial
import json
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.debias import fit
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.debiasing import LEAST, estimate_flight, evaluate_map, map_figures, part_of
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.readers import inputs

from ..diagnosis.measured import SPLITS
from .report import measured_tables

STEP = 0.35  # m, chosen by leaving out one flight after the other among those to fit
MAPS = {  # name: (interpolator, step in m, planar)
    "thin plate": ("thin_plate", STEP, False),
    "network": ("network", 0.5, False),
    "thin plate, planar": ("thin_plate", STEP, True),
    "network, planar": ("network", 0.5, True),
}


def add_options(add):
    """The options of the study."""
    add(
        "--data",
        metavar="DIR",
        type=Path,
        required=True,
        help="the measured flights: flights/, util/, surveys/",
    )
    add(
        "--diagnosed",
        metavar="DIR",
        type=Path,
        help="what `study diagnosis measured` wrote: its effects are compared",
    )
    add(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        required=True,
        help="where to write tables, figures and pictures",
    )
    add("--jobs", metavar="N", type=int, help="cases at once (default: as many as there are cores)")


def run(args):
    """Write measured.md and measured.json, and print the tables."""
    args.out.mkdir(parents=True, exist_ok=True)
    figures = judged(args.data, args.diagnosed, args.jobs)
    write_text(args.out / "measured.md", measured_tables(figures))
    write_text(args.out / "measured.json", json.dumps(figures, indent=1, allow_nan=False) + "\n")
    print(measured_tables(figures))


def cases():
    """{name: (split whose effects to compare with or None, flights to fit, flights to judge)};
    flights are paths in the data.
    """
    a25, b25 = SPLITS["0425 a"]
    a26, b26 = SPLITS["0426 a"]
    found = {name: (name, *split) for name, split in SPLITS.items() if split[1]}
    found["0425 a, another day"] = ("0425 a", a25, a26 + b26)
    found["0426 a, another day"] = ("0426 a", a26, a25 + b25)
    found["0425 TDOA2, judged on TDOA3"] = (
        None,
        *([path for path in a25 + b25 if kind in path] for kind in ("TDOA2", "TDOA3")),
    )
    found["const3, another constellation"] = (
        "const3",
        SPLITS["const3"][0],
        SPLITS["const4 trial 1"][1],
    )
    return found


def judged(data, diagnosed=None, jobs=None):
    """[{"case", "fitted", "maps", "runs": [{"flight", name of the estimate: {"rmse": m, "rmse_xy":
    m, "nees": mean}}]}] of all cases.

    data : folder of the flights; diagnosed : folder that `study diagnosis measured` wrote, or None.
    """
    if diagnosed is not None and not any(
        _effects_file(diagnosed, name).is_file() for name in SPLITS
    ):
        raise InputError(
            f"--diagnosed: {diagnosed} holds no */effects.yaml; run `study diagnosis measured "
            f"--out {diagnosed}`."
        )
    tasks = [(name, *case) for name, case in cases().items()]
    return list(
        parallel.over(partial(_case, data=data, diagnosed=diagnosed), tasks, jobs, unit="case")
    )


def _case(task, data, diagnosed):
    case, split, to_fit, to_judge = task
    rows, about = {}, {}
    for words, effects in _corrections(split, diagnosed).items():
        fitted, judging = (
            [flown(data, path, effects) for path in paths] for paths in (to_fit, to_judge)
        )
        parts = [part_of(score, odometry) for _, score, odometry in fitted]
        kinds = MAPS if effects is None else {"thin plate": MAPS["thin plate"]}
        prefix = f"{words} + " if words else ""
        maps = {
            prefix + name: fit(parts, step, LEAST, planar, how)
            for name, (how, step, planar) in kinds.items()
        }
        for run in judging:
            row = rows.setdefault(run[1].name, {})
            row[words or "before"] = _figures(run[1])
            row |= {name: _figures(evaluate_map(run, one, effects)) for name, one in maps.items()}
        about |= {name: map_figures(one) for name, one in maps.items()}
    return {
        "case": case,
        "fitted": to_fit,
        "maps": about,
        "runs": [{"flight": flight, **row} for flight, row in rows.items()],
    }


def _corrections(split, diagnosed):
    """{"": None, "effects": EffectSet}: what the TDOAs are corrected with before the filter."""
    out = {"": None}
    if diagnosed is not None and split is not None:
        out["effects"] = EffectSet.from_yaml(_effects_file(diagnosed, split))
    return out


def _effects_file(diagnosed, split):
    return diagnosed / split.replace(" ", "-") / "effects.yaml"


def flown(data, path, effects=None):
    """What `fly` gives for a flight of the data, without height, pressure and velocity."""
    (flight,) = inputs.Reading(data / "surveys").flights([data / path])
    return estimate_flight(flight.without(*SENSOR_NAMES), effects=effects)


def _figures(score):
    row = score.row()
    horizontal = float(np.hypot(row["rmse_x"], row["rmse_y"]))
    return {
        "rmse": row["rmse_3d"],
        "rmse_xy": horizontal,
        "nees": row["nees_mean"],
        "diverged": row["diverged"],
    }
