"""The whole loop in one call."""

from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.offline import run_offline

from ..scoring.metrics import Score
from . import closing, confounding, report
from .attribute import attribute, restricted
from .findings import Attribution
from .health import health


@dataclass
class Diagnosis:
    """attribution : Attribution; effects : EffectSet, the base and what is added; findings, unattributed,
    ambiguous, unobservable, refused : lists of dicts as in diagnosis.json; before, after : {"runs", "pooled"};
    judged_on : sentence; health : dict; flights : names."""

    attribution: Attribution
    effects: EffectSet
    findings: list
    unattributed: list
    ambiguous: list
    unobservable: list
    refused: list
    before: dict
    after: dict
    judged_on: str
    health: dict
    flights: list

    def as_json(self):
        """What diagnosis.json holds."""
        names = (
            "findings",
            "unattributed",
            "ambiguous",
            "unobservable",
            "refused",
            "before",
            "after",
            "judged_on",
            "health",
        )
        return {"flights": self.flights, **{name: plain(getattr(self, name)) for name in names}}

    def as_text(self):
        """A few lines for the screen."""
        return report.text(self)

    def as_html(self):
        """One self-contained page."""
        return report.html(self)


def diagnose(flights, holdout=(), base=EffectSet(), config=None, truth=True, progress=None):
    """Diagnosis of Flights. holdout : Flights to judge on; base : EffectSet that is in the model already; config :
    FilterConfig; truth : use the ground truth (False: do without it); progress() is called now and then.

    Raises InputError where a flight cannot be used: flights of different anchors, or without ground truth.
    """
    tick = progress or (lambda: None)
    _same_anchors([*flights, *holdout])
    runs = [run_offline(flight, config, Corrector(flight.anchors, base)) for flight in flights]
    tick()

    def estimator(flight, effects):
        return run_offline(flight, config, Corrector(flight.anchors, effects)).odometry

    attribution = attribute(flights, base, None if truth else estimator, tick)
    judgeable = all(f.truth is not None for f in [*flights, *holdout])
    # A finding stays one even if the filter does without it; it is only not added.
    kept, noise, not_added = list(attribution.selection.chosen), [], []
    if all(f.truth is not None for f in flights):
        kept, noise, not_added = closing.useful(attribution, flights, base, config, tick)
    lean = restricted(attribution, kept, noise)
    effects = EffectSet((*base.effects, *(e for e in lean.effects if getattr(e, "usable", True))))
    before, after, judged_on = closing.judge(lean, flights, holdout, base, effects, config, judgeable, tick)
    if judgeable and after["pooled"]["rmse_3d"] >= before["pooled"]["rmse_3d"] and len(effects) > len(base):
        kept, noise = [], []
        not_added = not_added + [("all", "together they do not make the error smaller on held-out data")]
        effects, after = base, before
    scores = [
        Score(f.name, run.odometry, f.truth, run.residuals) for f, run in zip(flights, runs) if f.truth is not None
    ]
    return Diagnosis(
        attribution,
        effects,
        [_finding(f, attribution, kept, noise) for f in attribution.findings],
        _unattributed(attribution, kept),
        _ambiguous(attribution),
        confounding.unobservable(attribution),
        [{"what": what, "why": why} for what, why in [*attribution.refused, *not_added]],
        before,
        after,
        judged_on,
        health(attribution.found, runs, scores),
        [f.name for f in flights],
    )


def _same_anchors(flights):
    if not flights:
        raise InputError("diagnose: give at least one flight.")
    first = flights[0]
    for flight in flights[1:]:
        same = np.array_equal(flight.anchors.ids, first.anchors.ids)
        if not (same and np.allclose(flight.anchors.positions, first.anchors.positions, atol=0.05)):
            raise InputError(
                f"{flight.name}: its anchors are not those of {first.name}; diagnose each installation and day alone."
            )


def _finding(finding, attribution, kept, noise):
    one, effect = finding.candidate, finding.effect
    return {
        "effect": effect.name,
        "parameters": dict(effect.values),
        "std": dict(effect.std),
        "unit": effect.unit,
        "channel": finding.channel,
        "evidence": finding.evidence,
        "variance_explained": finding.variance_explained,
        "confounded_with": confounding.confounded(attribution, one) if one is not None else [],
        "could_be_mistaken_for": list(effect.confounded_with),
        "added": any(finding is f for f in noise) if one is None else any(one is other for other in kept),
    }


def _unattributed(attribution, kept):
    out = []
    for finding in sorted(attribution.terms, key=lambda f: -f.evidence["held_out_gain"]):
        term, spread = finding.effect, np.linspace(finding.effect.knots[0], finding.effect.knots[-1], 25)
        prefixes = sorted({key.rpartition("c")[0] for key in term.values})
        out.append(
            {
                "channel": term.channel,
                "covariate": term.covariate,
                "form": term.form,
                "strength": finding.variance_explained,
                "evidence": finding.evidence,
                "together_with": [t.covariate for t in finding.candidate.terms if t.covariate != term.covariate],
                "shape": {
                    "at": spread,
                    "values": {prefix.rstrip("."): term.curve(spread, prefix) for prefix in prefixes},
                },
                "usable": term.usable,
                "added": term.usable and any(finding.candidate is one for one in kept),
            }
        )
    return out


def _ambiguous(attribution):
    out = []
    for finding in attribution.findings:
        rivals = {candidate.effect: gap for gap, candidate in finding.rivals if candidate.effect != finding.effect.name}
        if rivals:
            out.append(
                {
                    "found": finding.effect.name,
                    "alternatives": [
                        {
                            "effect": name,
                            "criterion_gap": gap,
                            "tell_apart": confounding.flight_to_tell(finding.effect.name, name),
                        }
                        for name, gap in sorted(rivals.items(), key=lambda item: item[1])
                    ],
                }
            )
    return out


def plain(value):
    """numpy and non-finite numbers as JSON has them."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
