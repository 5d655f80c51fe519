"""The whole loop in one call."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError

from ..checking.numbers import numbers
from ..parallel import in_one_thread
from ..scoring.metrics import Score
from . import output, repairing, validation
from .attribution import Attribution, attribute, residuals_of
from .calibration import merged
from .findings import Refused, usable
from .health import health
from .references import GroundTruth, Reference
from .regression.confounding import unobservable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.streams.finding import Finding as NumbersFinding
    from ..parallel import MapFunction
    from .channels import ChannelResiduals
    from .channels.base import Figures
    from .findings import EffectFinding
    from .validation import ValidatedSelection
    from .regression.confounding import Unobservable

SAME_PLACE = 0.05  # m by which an anchor may differ between flights of one installation


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found in some flights, and what it is worth.

    flights : (Flight, ...), as the reference leaves them; reference : Reference; findings : [EffectFinding]; effects :
    EffectSet, the base and what is added; refused : [Refused]; unobservable : [Unobservable]; before, after : dicts of
    `validation.compare`; judged_on : sentence; health : dict; attribution : Attribution; remaining : [{channel:
    ChannelResidual}] under `effects`; numbers : {name of a flight: [Finding of checking]}, what is wrong with its numbers; changes :
    sentences, what is not as in the last calibration;
    applying : ((command line, what it does), ...), how the effects are put to use;
    of_truth : {name of a flight: sentences}, what was wrong with the clock or the frame of its ground truth.
    """

    flights: tuple[Flight, ...]
    reference: Reference
    findings: list[EffectFinding]
    effects: EffectSet
    refused: list[Refused]
    unobservable: list[Unobservable]
    before: dict[str, Any]
    after: dict[str, Any]
    judged_on: str
    health: Figures
    attribution: Attribution
    remaining: list[ChannelResiduals]
    numbers: dict[str, list[NumbersFinding]]
    changes: tuple[str, ...] = ()
    applying: tuple[tuple[str, str], ...] = ()
    of_truth: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """What diagnosis.json holds."""
        return output.as_json(self)

    def as_text(self) -> str:
        """A few lines for the screen."""
        return output.as_text(self)

    def as_html(self) -> str:
        """One self-contained page."""
        from .report.page import html  # here, because drawing takes a second to import

        return html(self)


@in_one_thread
def diagnose(
    flights: Sequence[Flight], holdout: Sequence[Flight] = (), base: EffectSet = EffectSet(),
    config: FilterConfig | None = None, reference: Reference | None = None,
    progress: Callable[[str], object] = lambda what: None, map_function: MapFunction = map,
) -> Diagnosis:  # fmt: skip
    """Diagnosis of Flights.

    holdout : Flights to judge on; base : EffectSet that is in the model already; config : FilterConfig; reference :
    Reference, by default the recorded ground truth; progress(what) is called every few seconds at least;
    map_function : as of `attribute`, of work on single flights.
    Raises InputError where a flight cannot be used: flights of different anchors, or without the reference.
    """
    reference = reference or GroundTruth()
    same_anchors([*flights, *holdout])
    prepared = [reference.prepare(flight) for flight in (*flights, *holdout)]

    def saying(what: str) -> Callable[[], object]:
        return lambda: progress(what)

    looking = saying(f"looking at {reference.words}")
    settled = []
    for one in map_function(partial(_settled, reference, base, config), prepared):
        settled.append(one)
        looking()
    of_truth = {flight.name: said for flight, said in settled if said}
    count = len(flights)
    fitted, held_out = (tuple(flight for flight, _ in some) for some in (settled[:count], settled[count:]))

    tells_errors = reference.tells_errors
    repairs = repairing.repaired(fitted, base, config, saying("looking at ids and signs")) if tells_errors else {}
    sound, rest = repairing.sound(fitted, base, repairs)
    tracing = saying("tracing residuals to effects")
    found = attribute(sound, reference, rest, progress=tracing, map_function=map_function)
    # A finding stays one even if the filter does without it; it is only not added.
    trying = saying("running the filter without each")
    baseline = validation.Baseline(base, config)
    if tells_errors:
        selected = validation.select_by_error(found, sound, validation.Baseline(rest, config), trying, map_function)
    else:
        known = reference.constraints
        selected = validation.select_calibration(found, sound, rest, config, known, trying, map_function)
    attribution, validated = repairing.before_others(found, selected, repairs)
    tried = attribution.of(validated)
    tried_effects = merged(base, usable(tried.effects).effects, tried.selection)
    progress("judging")
    cases, judged_on = validation.validation_cases(tried, fitted, held_out, base, tried_effects, reference)
    before, with_tried = validation.validate(cases, baseline, reference, saying("judging"), map_function)
    refused = [*attribution.refused, *validated.refused]
    shift_std = max(reference.shift_std(flight.name).max() for flight in fitted) if tells_errors else 0.0
    why_not = validation.why_not(before, with_tried, shift_std) if tells_errors else None
    model, effects, after, applied = tried, tried_effects, with_tried, validated
    if why_not and len(tried_effects) > len(base) + len(attribution.of_floor):  # of those it tells nothing
        refused.append(Refused("all", why_not))
        applied = replace(validation.empty_selection(attribution), worth=validated.worth)
        model, after = attribution.of(applied), before
        effects = merged(base, attribution.of_floor, model.selection)
    remaining = residuals_of(fitted, reference, effects, saying("judging"), map_function)
    baseline.prepare(fitted, saying("judging"), map_function)
    runs = [baseline.run(flight) for flight in fitted]
    scores = [
        Score(flight.name, run.odometry, flight.truth, run.residuals)
        for flight, run in zip(fitted, runs)
        if tells_errors and flight.truth is not None
    ]
    return Diagnosis(
        fitted,
        reference,
        _findings(attribution, model, applied),
        effects,
        refused,
        unobservable(attribution.selection, attribution.candidates),
        before,
        after,
        judged_on,
        health(attribution.residuals, runs, scores),
        attribution,
        remaining,
        {flight.name: faults for faults, flight in zip(map_function(numbers, fitted), fitted) if faults},
        applied.changes,
        of_truth=of_truth,
    )


def _settled(
    reference: Reference, base: EffectSet, config: FilterConfig | None, flight: Flight
) -> tuple[Flight, tuple[str, ...]]:
    return reference.settled(flight, base, config)


def _findings(attribution: Attribution, model: Attribution, applied: ValidatedSelection) -> list[EffectFinding]:
    """[EffectFinding]: those that are added, with the values that are written, then the others."""
    detected = {detection.effect.name: detection for detection in attribution.detections}

    def with_worth(finding: EffectFinding, added: bool) -> EffectFinding:
        tried = finding.candidates or (detected[finding.effect.name],)
        worth = [applied.worth[each] for each in tried if each in applied.worth]
        return replace(finding, added=added, worth=float(np.sum(worth)) if worth else None)

    def usable_there(finding: EffectFinding) -> bool:
        return finding.effect.weighed if finding.on_floor else finding.effect.usable

    out = [with_worth(finding, usable_there(finding)) for finding in model.findings()]
    added = {finding.key for finding in out}
    return out + [with_worth(finding, False) for finding in attribution.findings() if finding.key not in added]


def same_anchors(flights: Sequence[Flight]) -> None:
    """Raises InputError unless all of some Flights, at least one, were flown among the same anchors."""
    if not flights:
        raise InputError("give at least one flight.")
    first = flights[0]
    for flight in flights[1:]:
        same = np.array_equal(flight.anchors.ids, first.anchors.ids)
        if not (same and np.allclose(flight.anchors.positions, first.anchors.positions, atol=SAME_PLACE)):
            raise InputError(
                f"{flight.name}: its anchors are not those of {first.name}; take each installation and day alone."
            )
