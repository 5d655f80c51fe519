# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnose the measured flights."""

import json
import time

import numpy as np

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_tools.diagnosis import diagnose, output
from uwb_tdoa_tools.diagnosis.report.page import html
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.phases import NEAR_THE_FLOOR

_T2, _T3 = "flights/0425/TDOA2/0425-traj", "flights/0425/TDOA3/0425-traj"
# {name: (to fit, to judge)}; a swap of both judges the others.
SPLITS = {
    "0425 a": (
        [_T2 + "1", _T2 + "2", _T2 + "6", _T3 + "13", _T3 + "17"],
        [_T2 + "3", _T2 + "7", _T2 + "10", _T3 + "14", _T3 + "21"],
    ),
    "0425 b": (
        [_T2 + "3", _T2 + "7", _T2 + "10", _T3 + "14", _T3 + "21"],
        [_T2 + "1", _T2 + "2", _T2 + "6", _T3 + "13", _T3 + "17"],
    ),
    "0426 a": (
        [f"flights/0426/0426-traj{k}" for k in (1, 3, 5, 9)],
        [f"flights/0426/0426-traj{k}" for k in (2, 7, 11, 13, 15)],
    ),
    "0426 b": (
        [f"flights/0426/0426-traj{k}" for k in (2, 7, 11, 13, 15)],
        [f"flights/0426/0426-traj{k}" for k in (1, 3, 5, 9)],
    ),
    "0422 a": (["flights/0422/0422-log00"], ["flights/0422/0422-log02"]),
    "0422 b": (["flights/0422/0422-log02"], ["flights/0422/0422-log00"]),
    "0607": (["flights/0607/tdoa2-obs-log1"], []),
    "const1": (
        ["util/const1-trial1-tdoa2.csv.gz"],
        [f"util/const1-trial{k}.csv.gz" for k in ("1-tdoa3", "2-tdoa2", "3-tdoa2")],
    ),
    "const3": (
        [f"util/const3-trial{k}-tdoa2.csv.gz" for k in (1, 2)],
        [f"util/const3-trial{k}-tdoa2.csv.gz" for k in (3, 4)],
    ),
    "const4 trial 1": (
        ["util/const4-trial1-tdoa2-traj1.csv.gz"],
        [f"util/const4-trial1-tdoa2-traj{k}.csv.gz" for k in (2, 3)],
    ),
    "const4 trial 3": (
        ["util/const4-trial3-tdoa2-traj1.csv.gz"],
        [f"util/const4-trial3-tdoa2-traj{k}.csv.gz" for k in (2, 3)],
    ),
}
AIDED = ("0425 a", "0425 b")  # all of whose flights hold height and pressure


def load(data, paths, sensors=()):
    """Flights of paths below the folder `data`, with only the given sensors of SENSOR_NAMES."""
    flights = inputs.Reading(data / "surveys").flights([data / path for path in paths])
    return [
        flight.without(*(name for name in SENSOR_NAMES if name not in sensors))
        for flight in flights
    ]


def folder_of(name):
    """Name of the folder of a split's results."""
    return name.replace(" ", "-")


def _phases(content):
    """{phase near the floor: [3D RMSE m before, after]} over all judged flights."""
    before, after = (content[side]["pooled"]["phases"] for side in ("before", "after"))
    return {
        name: [_rounded(side[name]["rmse_3d"]) for side in (before, after)]
        for name in NEAR_THE_FLOOR
        if name in before
    }


def _rounded(value):
    return None if value is None else round(value, 3)


def run(data, name, out, sensors=()):
    """Diagnose one split; writes its report and effects.yaml. sensors : streams that are used where
    flights hold them. Returns dict of the summary and all findings.
    """
    fit, judge = SPLITS[name]
    started = time.monotonic()
    result = diagnose(load(data, fit, sensors), load(data, judge, sensors))
    folder = out / folder_of(name)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "report.html", html(result))
    result.effects.to_yaml(folder / "effects.yaml")
    content = output.as_json(result)
    write_text(folder / "diagnosis.json", json.dumps(content, indent=1, allow_nan=False))
    sides = {
        side: [row["rmse_3d"] for row in content[side]["runs"]] for side in ("before", "after")
    }
    summary = {
        "mean 3D before": round(float(np.mean(sides["before"])), 3),
        "after": round(float(np.mean(sides["after"])), 3),
        "gain 95 %": content["after"]["pooled"].get("rmse_3d_gain_ci"),
        "diverged": sum(row["diverged"] for row in content["after"]["runs"]),
        "phases before, after": _phases(content),
        "found": [f["effect"] for f in content["findings"]],
        "without a name": [
            f"{t['channel']}/{t['covariate']}/{t['form']}" for t in content["unattributed"]
        ],
    }
    runs = [
        [row["flight"], row["rmse_3d"], other["rmse_3d"]]
        for row, other in zip(content["before"]["runs"], content["after"]["runs"])
    ]
    return {
        "split": name,
        "summary": summary,
        "runs": runs,
        "judged_on": content["judged_on"],
        "seconds": time.monotonic() - started,
    }
