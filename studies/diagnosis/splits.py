# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random splits by whole flights: compare the error that a diagnosis of some flights of a day
promises with the error on other flights of the day.
"""

import time

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis import diagnose

from . import blind, measured

_T2, _T3 = "flights/0425/TDOA2/0425-traj{}", "flights/0425/TDOA3/0425-traj{}"
_UTIL = "util/const{}-trial{}.csv.gz"
TDOA2_OF_0425, TDOA3_OF_0425 = ((1, 2, 3, 6, 7, 10), (13, 14, 17, 21))
# {installation: paths of its flights}
DAYS = {
    "0425": [
        *(_T2.format(k) for k in TDOA2_OF_0425),
        *(_T3.format(k) for k in TDOA3_OF_0425),
    ],
    "0426": [f"flights/0426/0426-traj{k}" for k in (1, 2, 3, 5, 7, 9, 11, 13, 15)],
    "0422": [f"flights/0422/0422-log0{k}" for k in (0, 2)],
    "const1": [_UTIL.format(1, name) for name in ("1-tdoa2", "1-tdoa3", "2-tdoa2", "3-tdoa2")],
    "const3": [_UTIL.format(3, f"{trial}-tdoa2") for trial in (1, 2, 3, 4)],
    "const4 trial 1": [_UTIL.format(4, f"1-tdoa2-traj{k}") for k in (1, 2, 3)],
    "const4 trial 3": [_UTIL.format(4, f"3-tdoa2-traj{k}") for k in (1, 2, 3)],
}


def _of_0425(*numbers):
    return [(_T3 if k in TDOA3_OF_0425 else _T2).format(k) for k in numbers]


def _of_0426(*numbers):
    return [f"flights/0426/0426-traj{k}" for k in numbers]


def _util(constellation, *names):
    return [_UTIL.format(constellation, name) for name in names]


# {name: (to fit, to judge)}, the table of docs/diagnosis.md
ROWS = {
    "const1 trial 1": (
        _util(1, "1-tdoa2"),
        _util(1, "1-tdoa3", "2-tdoa2", "3-tdoa2"),
    ),
    "const3 trials 1, 2": (_util(3, "1-tdoa2", "2-tdoa2"), _util(3, "3-tdoa2", "4-tdoa2")),
    "const3 trial 3": (_util(3, "3-tdoa2"), _util(3, "1-tdoa2", "2-tdoa2", "4-tdoa2")),
    "const4 trial 1, traj 1": (
        _util(4, "1-tdoa2-traj1"),
        _util(4, "1-tdoa2-traj2", "1-tdoa2-traj3"),
    ),
    "const4 trial 1, traj 1, 2": (
        _util(4, "1-tdoa2-traj1", "1-tdoa2-traj2"),
        _util(4, "1-tdoa2-traj3"),
    ),
    "const4 trial 3, traj 1": (
        _util(4, "3-tdoa2-traj1"),
        _util(4, "3-tdoa2-traj2", "3-tdoa2-traj3"),
    ),
    "const4 trial 3, traj 3": (
        _util(4, "3-tdoa2-traj3"),
        _util(4, "3-tdoa2-traj1", "3-tdoa2-traj2"),
    ),
    "0425: 1, 2, 3": (_of_0425(1, 2, 3), _of_0425(6, 7, 17)),
    "0425: 6, 13, 21": (_of_0425(6, 13, 21), _of_0425(1, 10, 14)),
    "0425: 10": (_of_0425(10), _of_0425(2, 6, 17)),
    "0426: 1, 7, 9": (_of_0426(1, 7, 9), _of_0426(2, 11, 15)),
    "0426: 3, 13": (_of_0426(3, 13), _of_0426(1, 2, 5)),
}
# the same of flights whose pairs of anchors differ: TDOA2 and TDOA3
OTHER_PAIRS = {
    "const1 trials 1, 2": (_util(1, "1-tdoa2", "2-tdoa2"), _util(1, "1-tdoa3")),
    "const1 trials 1, 3": (_util(1, "1-tdoa2", "3-tdoa2"), _util(1, "1-tdoa3")),
    "const1 trials 2, 3": (_util(1, "2-tdoa2", "3-tdoa2"), _util(1, "1-tdoa3")),
    "const1 trial 1, TDOA3": (_util(1, "1-tdoa3"), _util(1, "1-tdoa2", "2-tdoa2", "3-tdoa2")),
    "0425: 1, 2": (_of_0425(1, 2), _of_0425(*TDOA3_OF_0425)),
    "0425: 3, 6": (_of_0425(3, 6), _of_0425(*TDOA3_OF_0425)),
    "0425: 7, 10": (_of_0425(7, 10), _of_0425(*TDOA3_OF_0425)),
    "0425: 13, 14": (_of_0425(13, 14), _of_0425(*TDOA2_OF_0425)),
    "0425: 17, 21": (_of_0425(17, 21), _of_0425(*TDOA2_OF_0425)),
}
# the same of single flights, and of flights with the next one of their day
FEW = {
    f"{number} of {day}: {k}": (
        [paths[(k + step) % len(paths)] for step in range(number)],
        [path for step, path in enumerate(paths) if (step - k) % len(paths) >= number],
    )
    for number, days in (
        (1, ("0425", "0426", "const1", "const4 trial 1", "const4 trial 3")),
        (2, ("0425", "0426")),
    )
    for day in days
    for paths in (DAYS[day],)
    for k in range(len(paths))
}
SHARES = (0.3, 0.3, 0.02, 0.1, 0.12, 0.08, 0.08)  # of the draws, by day
FITTED, JUDGED = (5, 4)  # flights of a split at most
WORSE = 1.05  # error after over before, above which a flight counts as worse


def drawn(seed):
    """(day, paths to fit, paths to judge) of a seed."""
    rng = np.random.default_rng([seed, 99])
    day = str(rng.choice(list(DAYS), p=SHARES))
    flights = DAYS[day]
    number = int(rng.integers(1, min(FITTED, len(flights) - 1) + 1))
    order = [flights[k] for k in rng.permutation(len(flights))]
    return day, order[:number], order[number : number + JUDGED]


def run(data, seed):
    """dict of the split of a seed, as of `judged`, with the seed and its day."""
    day, fit, judge = drawn(seed)
    return {"seed": seed, "day": day, **judged(data, (fit, judge))}


def judged(data, split):
    """dict of a split: processor time, s, the promised errors, and those of each judged flight, m.

    split : (paths to fit, paths to judge)
    """
    fit, judge = split
    flights = measured.load(data, fit)
    started = time.process_time()
    result = diagnose(flights)
    seconds = time.process_time() - started
    promised = [
        float(np.mean([score.rmse_3d for score in side["scores"]]))
        for side in (result.before, result.after)
    ]
    rows = [
        [flight.name, blind.rmse(flight, EffectSet()), blind.rmse(flight, result.effects)]
        for flight in measured.load(data, judge)
    ]
    return {
        "fitted": fit,
        "seconds": round(seconds, 1),
        "promised": promised,
        "judged": rows,
        "applied": [effect.label for effect in result.effects],
    }


def row(result):
    """Figures of a result of `judged`: mean errors, m, and the ratio of each flight."""
    before, after = np.array([errors for _, *errors in result["judged"]]).T
    return {
        "before": round(before.mean(), 3),
        "after": round(after.mean(), 3),
        "ratios": (after / before).round(2).tolist(),
        "seconds": result["seconds"],
    }


def figures(results):
    """Figures of all splits."""
    promised, obtained, ratios = [], [], []
    for result in results:
        before, after = result["promised"]
        promised.append(1.0 - after / before)
        errors = np.array([row[1:] for row in result["judged"]])
        obtained.append(1.0 - errors[:, 1].mean() / errors[:, 0].mean())
        ratios += (errors[:, 1] / errors[:, 0]).tolist()
    promised, obtained, ratios = map(np.array, (promised, obtained, ratios))
    return {
        "splits": len(results),
        "judged flights": len(ratios),
        "mean promised gain": promised.mean(),
        "mean obtained gain": obtained.mean(),
        "obtained for each promised": promised @ obtained / max(promised @ promised, 1e-12),
        "flights worse by 5 %": int(np.sum(ratios > WORSE)),
        "worst, error after over before": ratios.max(),
    }
