# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects that are not in the catalogue: test whether the scan names channel and covariate, and
whether its term improves other flights.
"""

from known_effects import clean_flight, names_found
import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.findings import usable
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.scoring.evaluation import evaluate


def run(name, case, seed):
    """dict of one case: (function, channel, covariates) put into one flight, judged on another."""
    put_in, channel, covariates = case
    attribution = attribute([put_in(clean_flight(seed))], GroundTruth())
    terms = [finding for finding in attribution.findings() if not finding.declared]
    terms = sorted(terms, key=lambda f: -f.evidence["held_out_gain"])
    first = terms[0].effect if terms else None
    other, plain = put_in(clean_flight(seed + 5000)), clean_flight(seed + 5000)
    model = usable(attribution.effects)
    return {
        "name": name,
        "seed": seed,
        "found": names_found(attribution),
        "right": first is not None and first.channel == channel and first.covariate in covariates,
        "residual_removed": _removed(channel, plain, other, model),
        "rmse": [
            evaluate(f, effects=e)[0].row()["rmse_3d"]
            for f, e in ((plain, None), (other, None), (other, model))
        ],
    }


def _removed(channel, plain, other, effects):
    """Share of the root mean square of the channel's excess residual that the effects remove."""
    values = []
    for flight, model in ((plain, EffectSet()), (other, EffectSet()), (other, effects)):
        sensor, _, axis = channel.partition(".")
        part = residuals(flight, GroundTruth(), model)[sensor]
        r = part.residual[:, "xyz".index(axis)] if axis else part.residual[part.airborne]
        limit = 5.0 * 1.4826 * np.median(np.abs(r))
        values.append(np.mean(np.clip(r, -limit, limit) ** 2))
    none, before, after = values
    return float(1.0 - np.sqrt(max(after - none, 0.0) / max(before - none, 1e-12)))


def figures(results):
    """Figures of the cases."""
    return {
        "cases": len(results),
        "right first": round(float(np.mean([r["right"] for r in results])), 3),
        "half of the excess removed": round(
            float(np.mean([r["residual_removed"] >= 0.5 for r in results])), 3
        ),
        "median removed": round(float(np.median([r["residual_removed"] for r in results])), 3),
        "by effect": {
            name: round(float(np.mean([r["right"] for r in results if r["name"] == name])), 2)
            for name in dict.fromkeys(r["name"] for r in results)
        },
    }
