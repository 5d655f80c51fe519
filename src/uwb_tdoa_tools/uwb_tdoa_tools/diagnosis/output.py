# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a Diagnosis as JSON and as text for the screen. Both follow the order of the report."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm

from .. import cli
from .findings import EffectFinding, prefixes_of
from .over_flights import course
from .report.entries import entries
from .report.unclear import undetermined
from .report.verdict import faults_in_words, truth_in_words, verdict
from .result import Diagnosis

WIDTH, LABEL = 120, 10  # characters of a line on the screen, and of its label


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the content of diagnosis.json as plain values.

    docs/diagnosis_report.md describes its keys.
    """
    found = verdict(diagnosis)
    return cli.as_json(
        {
            "verdict": found.sentences,
            "apply": found.applies,
            "details": found.details,
            "flights": [flight.name for flight in diagnosis.flights],
            "rests_on": diagnosis.reference.words,
            "findings": [_finding(finding) for finding in diagnosis.findings if finding.declared],
            "numbers": {
                name: [vars(item) for item in found] for name, found in diagnosis.numbers.items()
            },
            "ground_truth": {name: list(said) for name, said in diagnosis.judge_truth.items()},
            "truth_transform": diagnosis.truth_transform and diagnosis.truth_transform.as_dict(),
            "unattributed": [
                _function(item, item.function) for item in diagnosis.findings if item.function
            ],
            "ambiguous": _ambiguous(diagnosis),
            "unobservable": [
                {
                    "effect": item.effect,
                    "direction": item.direction
                    or "the flights lack the channel, or the reference, that shows it",
                    "told_by": words.remedy,
                }
                for item, words in zip(diagnosis.unobservable, undetermined(diagnosis))
            ],
            "changes": list(diagnosis.changes),
            "refused": [{"what": item.what, "why": item.why} for item in diagnosis.refused],
            "before": {key: diagnosis.before[key] for key in ("runs", "pooled")},
            "after": {key: diagnosis.after[key] for key in ("runs", "pooled")},
            "judged_on": diagnosis.judged_on,
            "share": diagnosis.share,
            "tdoa_std": diagnosis.tdoa_std,
            "written": diagnosis.written
            and {key: diagnosis.written[key] for key in ("runs", "pooled")},
            "health": diagnosis.health,
            "next_flight": diagnosis.next_flight and diagnosis.next_flight.as_json(),
        }
    )


def as_text(diagnosis: Diagnosis) -> str:
    """Return the lines for the screen: the verdict, and faults of the numbers."""
    found = verdict(diagnosis)
    lines = [("verdict", found.headline), ("cause", found.cause)]
    lines += [("truth", sentence) for sentence in truth_in_words(diagnosis)]
    lines += [("numbers", sentence) for sentence in faults_in_words(diagnosis)]
    lines += [
        ("changed", f"since the last calibration, {sentence}") for sentence in diagnosis.changes
    ]
    lines += [("" if k else "do", sentence) for k, sentence in enumerate(found.actions)]
    lines += [("fly", found.fly), ("apply", found.apply)]
    return "\n".join(_wrapped(*line) for line in lines)


def _wrapped(label: str, text: str) -> str:
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=label.ljust(LABEL),
        subsequent_indent=" " * LABEL,
        break_on_hyphens=False,
        break_long_words=False,
    )


def _finding(finding: EffectFinding) -> dict[str, Any]:
    effect = finding.effect
    return {
        "effect": effect.name,
        "parameters": dict(effect.values),
        "std": dict(effect.std),
        "unit": effect.unit,
        "channel": finding.channel,
        "advice": effect.advice(),
        "worth": finding.worth,
        "alternatives": _alternatives(finding),
        "evidence": finding.evidence,
        "variance_explained": finding.explained,
        "confounded_with": [
            {"effect": other.effect, "share": other.share, "tell_apart": other.tell_apart}
            for other in finding.alternatives
            if other.share is not None
        ],
        "could_be_mistaken_for": list(effect.row.confounded_with),
        **_over_flights(finding),
        "added": finding.added,
        "on_floor": finding.on_floor,
    }


def _function(finding: EffectFinding, effect: SmoothTerm) -> dict[str, Any]:
    at = np.linspace(effect.knots[0], effect.knots[-1], 25)
    return {
        "channel": effect.channel,
        "covariate": effect.covariate,
        "form": effect.form,
        "factor": _factor(effect),
        "course": effect.shape,
        "strength": finding.explained,
        "advice": effect.advice(),
        "worth": finding.worth,
        "alternatives": _alternatives(finding),
        "evidence": finding.evidence,
        "together_with": list(finding.together_with),
        "levels": {anchor: vars(level) for anchor, level in finding.levels.items()},
        "shape": {
            "at": at,
            "values": {
                prefix.rstrip("."): effect.curve(at, prefix) for prefix in prefixes_of(effect)
            },
        },
        "usable": effect.usable,
        **_over_flights(finding),
        "added": finding.added,
        "on_floor": finding.on_floor,
    }


def _factor(effect: SmoothTerm) -> dict[str, Any] | None:
    """Return the factor of a function of two covariates; None without one."""
    if not effect.factor:
        return None
    return {
        "covariate": effect.factor,
        "course": effect.factor_shape,
        "knots": effect.factor_knots,
    }


def _over_flights(finding: EffectFinding) -> dict[str, Any]:
    return {
        "shares": [vars(share) for share in finding.shares],
        "over_flights": course(finding.shares),
        "flight": finding.flight,
    }


def _alternatives(finding: EffectFinding) -> list[dict[str, Any]]:
    return [
        {
            "effect": other.effect,
            "share": other.share,
            "criterion_gap": other.gap,
            "tell_apart": other.tell_apart,
        }
        for other in finding.alternatives
    ]


def _ambiguous(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return findings that another effect explains nearly equally well."""
    return [
        {
            "found": entry.title,
            "alternatives": [
                {"effect": other.effect, "criterion_gap": other.gap, "tell_apart": other.tell_apart}
                for other in entry.undecided
            ],
        }
        for entry in entries(diagnosis)
        if entry.findings[0].declared and entry.undecided
    ]
