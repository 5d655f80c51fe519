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
from . import judging, output, repairing
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
    from .findings import Finding
    from .judging import Kept
    from .regression.confounding import Unobservable

SAME_PLACE = 0.05  # m by which an anchor may differ between flights of one installation


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found in some flights, and what it is worth.

    flights : (Flight, ...), as the reference leaves them; reference : Reference; findings : [Finding]; effects :
    EffectSet, the base and what is added; refused : [Refused]; unobservable : [Unobservable]; before, after : dicts of
    `judging.compare`; judged_on : sentence; health : dict; attribution : Attribution; remaining : [{channel:
    ChannelResidual}] under `effects`; numbers : {name of a flight: [Finding of checking]}, what is wrong with its numbers; changes : sentences, what is not as in the last calibration;
    applying : ((command line, what it does), ...), how the effects are put to use;
    of_truth : {name of a flight: sentences}, what was wrong with the clock or the frame of its ground truth.
    """

    flights: tuple[Flight, ...]
    reference: Reference
    findings: list[Finding]
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
    progress: Callable[[str], object] = lambda what: None, over: MapFunction = map,
) -> Diagnosis:  # fmt: skip
    """Diagnosis of Flights.

    holdout : Flights to judge on; base : EffectSet that is in the model already; config : FilterConfig; reference :
    Reference, by default the recorded ground truth; progress(what) is called every few seconds at least;
    over : as of `attribute`, of work on single flights.
    Raises InputError where a flight cannot be used: flights of different anchors, or without the reference.
    """
    reference = reference or GroundTruth()
    same_anchors([*flights, *holdout])
    flights, holdout = (tuple(map(reference.prepare, some)) for some in (flights, holdout))

    def saying(what: str) -> Callable[[], object]:
        return lambda: progress(what)

    looking, count = saying(f"looking at {reference.words}"), len(flights)
    settled = []
    for one in over(partial(_settled, reference, base, config), [*flights, *holdout]):
        settled.append(one)
        looking()
    of_truth = {flight.name: said for flight, said in settled if said}
    flights, holdout = (tuple(flight for flight, _ in some) for some in (settled[:count], settled[count:]))

    repairs = repairing.repaired(flights, base, config, saying("looking at ids and signs")) if reference.judges else {}
    sound, rest = repairing.sound(flights, base, repairs)
    attribution = attribute(sound, reference, rest, progress=saying("tracing residuals to effects"), over=over)
    # A finding stays one even if the filter does without it; it is only not added.
    trying = saying("running the filter without each")
    baseline = judging.Baseline(base, config)
    if reference.judges:
        kept = judging.useful(attribution, sound, judging.Baseline(rest, config), trying, over)
    else:
        kept = judging.borne_out(attribution, sound, rest, config, reference.constraints, trying, over)
    attribution, kept = repairing.before_others(attribution, kept, repairs)
    model = attribution.of(kept)
    effects = merged(base, usable(model.effects).effects, model.selection)
    judged = judging.judge(model, flights, holdout, baseline, effects, reference, saying("judging"), over)
    before, after, judged_on = judged
    refused = [*attribution.refused, *kept.refused]
    why_not = judging.why_not(before, after, max(reference.shift_std(flight.name).max() for flight in flights)) if reference.judges else None
    if why_not and len(effects) > len(base) + len(attribution.of_floor):  # of those it tells nothing
        refused.append(Refused("all", why_not))
        after, kept = before, replace(judging.nothing(attribution), worth=kept.worth)
        model = attribution.of(kept)
        effects = merged(base, attribution.of_floor, model.selection)
    remaining = residuals_of(flights, reference, effects, saying("judging"), over)
    baseline.prepare(flights, saying("judging"), over)
    runs = [baseline.run(flight) for flight in flights]
    scores = [
        Score(flight.name, run.odometry, flight.truth, run.residuals)
        for flight, run in zip(flights, runs)
        if reference.judges
    ]
    return Diagnosis(
        flights,
        reference,
        _findings(attribution, model, kept),
        effects,
        refused,
        unobservable(attribution.selection, attribution.candidates),
        before,
        after,
        judged_on,
        health(attribution.residuals, runs, scores),
        attribution,
        remaining,
        {flight.name: found for found, flight in zip(over(numbers, flights), flights) if found},
        kept.changes,
        of_truth=of_truth,
    )


def _settled(
    reference: Reference, base: EffectSet, config: FilterConfig | None, flight: Flight
) -> tuple[Flight, tuple[str, ...]]:
    return reference.settled(flight, base, config)


def _findings(attribution: Attribution, model: Attribution, kept: Kept) -> list[Finding]:
    """[Finding]: those that are added, with the values that are written, then the others."""
    detected = {detection.effect.name: detection for detection in attribution.detections}

    def judged(finding: Finding, added: bool) -> Finding:
        tried = finding.candidates or (detected[finding.effect.name],)
        worth = [kept.worth[each] for each in tried if each in kept.worth]
        return replace(finding, added=added, worth=float(np.sum(worth)) if worth else None)

    def usable_there(finding: Finding) -> bool:
        return finding.effect.weighed if finding.on_floor else finding.effect.usable

    out = [judged(finding, usable_there(finding)) for finding in model.findings()]
    added = {finding.key for finding in out}
    return out + [judged(finding, False) for finding in attribution.findings() if finding.key not in added]


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
