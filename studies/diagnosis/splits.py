# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Random splits by whole flights: compare the error that a diagnosis of some flights of a day
promises with the error on other flights of the day.
"""

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis import diagnose

from . import blind, measured

_T2, _T3 = "flights/0425/TDOA2/0425-traj{}", "flights/0425/TDOA3/0425-traj{}"
_UTIL = "util/const{}-trial{}.csv.gz"
# {installation: paths of its flights}
DAYS = {
    "0425": [
        *(_T2.format(k) for k in (1, 2, 3, 6, 7, 10)),
        *(_T3.format(k) for k in (13, 14, 17, 21)),
    ],
    "0426": [f"flights/0426/0426-traj{k}" for k in (1, 2, 3, 5, 7, 9, 11, 13, 15)],
    "0422": [f"flights/0422/0422-log0{k}" for k in (0, 2)],
    "const1": [_UTIL.format(1, name) for name in ("1-tdoa2", "1-tdoa3", "2-tdoa2", "3-tdoa2")],
    "const3": [_UTIL.format(3, f"{trial}-tdoa2") for trial in (1, 2, 3, 4)],
    "const4 trial 1": [_UTIL.format(4, f"1-tdoa2-traj{k}") for k in (1, 2, 3)],
    "const4 trial 3": [_UTIL.format(4, f"3-tdoa2-traj{k}") for k in (1, 2, 3)],
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
    """dict of a split: the promised errors, and the errors of each judged flight, m."""
    day, fit, judge = drawn(seed)
    result = diagnose(measured.load(data, fit))
    promised = [
        float(np.mean([score.rmse_3d for score in side["scores"]]))
        for side in (result.before, result.after)
    ]
    rows = [
        [flight.name, blind.rmse(flight, EffectSet()), blind.rmse(flight, result.effects)]
        for flight in measured.load(data, judge)
    ]
    names = [effect.label for effect in result.effects]
    return {
        "seed": seed,
        "day": day,
        "fitted": fit,
        "promised": promised,
        "judged": rows,
        "applied": names,
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
