# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnose measured flights with weaker references than ground truth.

Ground truth judges the result on other flights.
"""

import numpy as np

from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.references import REFERENCES
from uwb_tdoa_tools.scoring.evaluation import evaluate

from .measured import AIDED, SPLITS, load

USED = {"nothing": (), "heights": ("height",)}  # {reference: streams that it may see}
MOST = 3  # flights to judge a single one on


def cases():
    """[(reference, paths to fit, paths to judge)]: the splits, and every flight alone against the
    next of its split.
    """
    splits = {name: split for name, split in SPLITS.items() if split[1]}
    out = [("nothing", *split) for split in splits.values()] + [
        ("heights", *splits[name]) for name in AIDED
    ]
    flights = {
        name.removesuffix(" a"): fit + judge
        for name, (fit, judge) in splits.items()
        if not name.endswith(" b")
    }
    for several in flights.values():
        for k, path in enumerate(several):
            others = [*several[k + 1 :], *several[:k]]
            out.append(("nothing", [path], others[:MOST]))
    return out


def run(data, reference, fit, judge):
    """One case: dict with the mean 3D RMSE, m, of the judged flights before and after, from TDOAs
    and IMU alone.
    """
    flights = load(data, fit, USED[reference])
    result = diagnose(flights, reference=REFERENCES[reference]())
    before, after = [], []
    for flight in load(data, judge):
        before.append(_error(flight, EffectSet()))
        after.append(_error(flight, result.effects) if len(result.effects) else before[-1])
    return {
        "reference": reference,
        "fit": [flight.name for flight in flights],
        "before": float(np.mean(before)),
        "after": float(np.mean(after)),
        "worst": float(np.max(np.divide(after, before))),
        "applied": result.effects.name if len(result.effects) else "nothing",
        "why not": [item.why for item in result.refused][-1:] if not len(result.effects) else [],
    }


def figures(results):
    """The summary of several `run`s."""
    applied = [r for r in results if r["applied"] != "nothing"]
    rows = [
        (
            f"{r['reference']}: {', '.join(r['fit'])}: {r['before']:.3f} -> {r['after']:.3f}, "
            f"{r['applied']}"
        )
        for r in results
    ]
    return {
        "cases": len(results),
        "applied": len(applied),
        "largest ratio of a judged flight, after over before": max(r["worst"] for r in results),
        "rows": rows,
    }


def _error(flight, effects):
    return evaluate(flight.without(*SENSOR_NAMES), effects=effects)[0].row()["rmse_3d"]
