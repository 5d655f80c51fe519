"""The loop closed: the filter with and without the effects, on data that they were not fitted to."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.core.engine import USED
from uwb_tdoa_ekf.offline import run_offline

from ..scoring.evaluation import evaluate
from ..scoring.metrics import Score, airborne, as_json, pooled
from .attribute import effects_of, label_of
from .fit import refit
from .select import columns_of

BOOTSTRAPS = 400
BLOCK = 5.0  # s
JUDGES = 3
WORSE = 0.005  # share of the error by which leaving an effect out must make it smaller, for the effect to be left out


def cross_fitted(attribution, flights, base, kept, noise):
    """[(flight, effects, span)]: each flight, or each half of a single one, with effects fitted to the others alone.

    kept : Candidates to use; noise : findings of noise effects to use. span : (first, last) s to judge, None for all.
    """
    table, selection = attribution.table, attribution.selection
    if len(flights) > 1:
        parts = [(k, table.flight != k, None) for k in range(len(flights))]
    else:
        first, last = airborne(flights[0].truth)
        middle, start = 0.5 * (first + last), float(flights[0].tdoa.t[0])
        early = table.t + start < middle
        parts = [(0, ~early, (first, middle)), (0, early, (middle, last))]
    out = []
    for k, rows, span in parts:
        changed = replace(selection, chosen=kept, fit=refit(table, columns_of(kept), selection.fit, rows))
        mine = [e for e in effects_of(changed) if getattr(e, "usable", True)]
        out.append((flights[k], EffectSet((*base.effects, *mine, *(f.effect for f in noise))), span))
    return out


def judge(attribution, flights, holdout, base, effects, config, judgeable, progress):
    """(before, after, on what): the errors on the hold-out flights if there are any, or cross-fitted, or, without
    any ground truth, what the filter's own innovations say."""
    progress()
    if holdout:
        cases, on = [(flight, effects, None) for flight in holdout], "flights that took no part in the fit"
    elif judgeable:
        noise = [f for f in attribution.findings if f.candidate is None]
        cases = cross_fitted(attribution, flights, base, attribution.selection.chosen, noise)
        on = (
            "each flight with effects fitted to the others"
            if len(flights) > 1
            else "each half of the flight with effects fitted to the other"
        )
    else:
        cases, on = (
            [(flight, effects, None) for flight in flights],
            "the flights that were fitted, by their innovations alone",
        )
    before, after = compare(cases, base, config) if judgeable else _innovations(cases, base, config)
    return before, after, on


def compare(cases, base, config=None):
    """(before, after) of cases (flight, effects, span): {"runs": [...], "pooled": {...}}, keys as in evaluate, besides
    residual_spread (m, 1.48 MAD of the innovations) and rmse_3d_ci (95 %, bootstrap over blocks of 5 s)."""
    sides = []
    for name in ("before", "after"):
        scores, rows, blocks = [], [], []
        for flight, effects, span in cases:
            score, run = _score(flight, effects if name == "after" else base, span, config)
            used = run.residuals.verdict == USED
            spread = float(1.4826 * np.median(np.abs(run.residuals.innovation[used]))) if used.any() else None
            mine = _blocks(score)
            blocks.append(mine)
            scores.append(score)
            rows.append({**as_json(score.row()), "residual_spread": spread, "rmse_3d_ci": _interval([mine])})
        spreads = [row["residual_spread"] for row in rows if row["residual_spread"] is not None]
        together = {**as_json(pooled(scores)), "residual_spread": float(np.mean(spreads)) if spreads else None}
        sides.append({"runs": rows, "pooled": {**together, "rmse_3d_ci": _interval(blocks)}})
        sides[-1]["blocks"] = blocks
    gain = _gain_interval(sides[0].pop("blocks"), sides[1].pop("blocks"))
    sides[1]["pooled"]["rmse_3d_gain_ci"] = gain
    return sides


def mean_error(cases, config=None):
    """Mean 3D RMSE of the cases, m."""
    return float(np.mean([_score(*case, config)[0].row()["rmse_3d"] for case in cases]))


def useful(attribution, flights, base, config, progress):
    """(kept Candidates, kept noise findings, [(name, reason)]): what makes the filter no worse where it was not fitted.

    Candidates go, one by one, if the error is smaller without; noise findings stay only if it is smaller with them. At
    most JUDGES flights are judged.
    """
    kept, noise, dropped = list(attribution.selection.chosen), [], []

    def error(candidates, findings):
        progress()
        cases = cross_fitted(attribution, flights, base, candidates, findings)
        return mean_error(cases[:: -(-len(cases) // JUDGES)], config)

    now = error(kept, noise)
    while kept:
        trials = [error([other for other in kept if other is not one], noise) for one in kept]
        best = int(np.argmin(trials))
        if trials[best] > now * (1.0 - WORSE):
            break
        dropped.append(
            (label_of(kept[best]), f"the filter does better without it: {now:.3f} m with, {trials[best]:.3f} m without")
        )
        now = trials[best]
        del kept[best]
    for finding in attribution.findings:
        if finding.candidate is not None or finding.effect.name == "outlier_rate":
            continue  # outliers are the business of the filter's weights
        trial = error(kept, [*noise, finding])
        if trial < now * (1.0 - WORSE):
            noise.append(finding)
            now = trial
        else:
            dropped.append(
                (finding.effect.name, f"does not make the filter better: {now:.3f} m without, {trial:.3f} m with")
            )
    return kept, noise, dropped


def _innovations(cases, base, config):
    sides = []
    for chosen in (lambda effects: base, lambda effects: effects):
        rows = []
        for flight, effects, _ in cases:
            run = run_offline(flight, config, Corrector(flight.anchors, chosen(effects)))
            used = run.residuals.verdict == USED
            innovation, variance = run.residuals.innovation[used], run.residuals.variance[used]
            rows.append(
                {
                    "flight": flight.name,
                    "rmse_3d": None,
                    "nis_mean": float(np.mean(innovation**2 / variance)),
                    "residual_spread": float(1.4826 * np.median(np.abs(innovation))),
                }
            )
        pooled_row = {key: float(np.mean([row[key] for row in rows])) for key in ("nis_mean", "residual_spread")}
        sides.append({"runs": rows, "pooled": {"rmse_3d": None, **pooled_row}})
    return sides


def _score(flight, effects, span, config=None):
    score, run = evaluate(flight, config, effects)
    if span is not None:
        truth = effects.correct_streams(replace(flight, imu=None)).truth
        inside = (truth.t >= span[0]) & (truth.t <= span[1])
        score = Score(
            flight.name, run.odometry, Truth(truth.t[inside], truth.p[inside], truth.q[inside]), run.residuals
        )
    return score, run


def _blocks(score):
    """(sums of squared 3D errors, counts) per block of 5 s."""
    if not len(score.t):
        return np.zeros((1, 2))
    block = ((score.t - score.t[0]) / BLOCK).astype(int)
    power = np.sum(score.error**2, axis=1)
    return np.stack([np.bincount(block, power), np.bincount(block)], axis=1)


def _interval(blocks):
    """95 % interval of the 3D RMSE: [low, high], m."""
    draws = _draws(np.concatenate(blocks))
    return [float(x) for x in np.quantile(draws, [0.025, 0.975])] if np.isfinite(draws).all() else None


def _draws(blocks):
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(blocks), (BOOTSTRAPS, len(blocks)))
    total = blocks[chosen].sum(axis=1)
    return np.sqrt(total[:, 0] / np.maximum(total[:, 1], 1))


def _gain_interval(before, after):
    """95 % interval of the share of the 3D RMSE that is gone, the same blocks drawn for both."""
    one, two = np.concatenate(before), np.concatenate(after)
    if len(one) != len(two):
        return None
    gain = 1.0 - _draws(two) / np.maximum(_draws(one), 1e-12)
    return [float(x) for x in np.quantile(gain, [0.025, 0.975])] if np.isfinite(gain).all() else None
