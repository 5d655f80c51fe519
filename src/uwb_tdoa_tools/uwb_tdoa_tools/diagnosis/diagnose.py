# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the complete diagnosis in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.correction.corrector import FixedPoses
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.evidence import OF_ANCHORS
from uwb_tdoa_ekf.offline import may_have_offset

from ..checking.check import judge_flight
from ..parallel import MapFunction
from ..scoring.metrics import LOSS, Score, gain, radio_residuals
from . import comparison, repairing, validation
from .attribution import Attribution, EffectSearch, residuals_of
from .channels import CHANNELS, health
from .detectors import Detection
from .findings import EffectFinding, Refused, usable
from .frames import moved_together
from .noise import DECIMALS
from .references import GroundTruth, Reference
from .refinement import written
from .regression.confounding import Unobservable, unobservable
from .regression.terms import Candidate
from .result import Diagnosis
from .self_calibration import SelfCalibration, Tape, self_calibrate
from .self_calibration.equations import measured_noise
from .self_calibration.prior import with_calibration
from .self_calibration.solve import same_anchors

Flights = tuple[Flight, ...]

# smallest share of the power of slow innovations that a self-calibration must explain
EXPLAINED = 0.1
# m, increase of the error that counts as a loss by the measured noise for the filter
LEAST_LOSS = 0.005
HONEST = 3.0  # NEES of positions whose stated deviations are right
CANNOT_JUDGE = "without ground truth nobody can tell whether taking it out helps the position"


def diagnose(
    flights: Sequence[Flight],
    holdout: Sequence[Flight] = (),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    reference: Reference | None = None,
    progress: Callable[[str], object] = lambda what: None,
    map_function: MapFunction = map,
) -> Diagnosis:
    """Diagnose Flights: find effects, validate them, and return a Diagnosis.

    Parameters
    ----------
    flights : sequence of Flight
        Flights to fit, all with the same anchors.
    holdout : sequence of Flight
        Flights for validation only.
    base : EffectSet
        Effects that are already in the model.
    config : FilterConfig, optional
        Configuration of the filter. Streams that it does not use are left out of everything.
    reference : Reference, optional
        The recorded ground truth by default.
    progress : function
        progress(text) is called every few seconds.
    map_function : function
        As of `attribute`, for work on single flights.

    Raises
    ------
    InputError
        If flights have different anchors, or a flight lacks the reference.
    """
    reference = reference or GroundTruth()
    same_anchors([*flights, *holdout])
    prepared = [reference.prepare(flight) for flight in (*flights, *holdout)]

    work = _Work(reference, base, config, progress, map_function)
    looking = work.saying(f"looking at {reference.words}")
    settled = []
    unused = unused_streams(config or FilterConfig())
    for flight, said in map_function(
        partial(reference.settled, base=base, config=config), prepared
    ):
        settled.append((flight.without(*unused), said))
        looking()
    count = len(flights)
    moved, transform = moved_together(prepared, [flight for flight, _ in settled], count, base)
    judge_truth = {  # without the last sentence, on the frame, which the transform replaces
        flight.name: left
        for flight, said in settled
        if (left := said[:-1] if transform and flight.name in transform.flights else said)
    }
    fitted, held_out = tuple(moved[:count]), tuple(moved[count:])

    repairs = (
        repairing.repaired(fitted, base, config, work.saying("looking at ids and signs"))
        if reference.tells_errors
        else {}
    )
    sound, rest = repairing.sound(fitted, base, repairs)
    if reference.tells_errors:
        looking = work.saying("looking for what switches in each flight")
        steady, switching = repairing.without_switching(sound, reference, rest, config, looking)
        found, selected = _searched(work, steady, rest)
        found = replace(found, alone=(*switching, *found.alone))
        outcome = _by_error(work, found, selected, fitted, held_out, repairs)
    else:
        search = work.search(sound, rest)
        found = search.reported(search.found())
        outcome = _by_self_calibration(work, found, (fitted, sound), held_out, rest)
    judging = work.saying("judging")
    remaining = residuals_of(fitted, reference, outcome.effects, judging, map_function)
    outcome.baseline.prepare(fitted, judging, map_function)
    runs = [outcome.baseline.run(flight) for flight in fitted]
    scores = [
        Score(flight.name, run.odometry, flight.truth, radio_residuals(flight, run))
        for flight, run in zip(fitted, runs)
        if reference.tells_errors and flight.truth is not None
    ]
    return Diagnosis(
        fitted,
        reference,
        outcome.findings,
        outcome.effects,
        [*outcome.attribution.refused, *outcome.refused],
        _unobservable(found, unused, outcome.refused),
        *outcome.sides,
        outcome.judged_on,
        health(found.residuals, scores),
        outcome.attribution,
        remaining,
        {
            flight.name: faults
            for faults, flight in zip(map_function(judge_flight, fitted), fitted)
            if faults
        },
        outcome.changes,
        judge_truth=judge_truth,
        truth_transform=transform,
        cases=tuple(outcome.cases),
        share=outcome.share,
        base=base,
    )


def with_noise(
    diagnosis: Diagnosis,
    config: FilterConfig | None = None,
    map_function: MapFunction = map,
    say: Callable[[str], object] = lambda why: None,
) -> Diagnosis:
    """Return the Diagnosis with the noise for the filter, judged as the files will hold it.

    If the noise raises the error by more than LOSS, it is left out.

    config : FilterConfig of the diagnosis; map_function : as of `attribute`
    say : say(sentence) is called if the flights are too short to measure the noise
    """
    if not all(len(flight.tdoa) for flight in diagnosis.flights):
        return diagnosis
    std = measured_noise(diagnosis.flights, diagnosis.effects, config, map_function, say)
    if std is None or not diagnosis.reference.tells_errors:
        return replace(diagnosis, tdoa_std=std)
    written = comparison.with_config(
        diagnosis.cases,
        diagnosis.before,
        replace(config or FilterConfig(), tdoa_std=round(std, DECIMALS)),
        diagnosis.reference.shift_std,
        map_function,
    )
    if why := _why_not_noise(diagnosis.after["pooled"], written["pooled"]):
        refused = Refused(f"tdoa_std {std:.{DECIMALS}f} m", why)
        return replace(diagnosis, refused=[*diagnosis.refused, refused])
    return replace(diagnosis, tdoa_std=std, written=written)


def _why_not_noise(without: dict[str, Any], written: dict[str, Any]) -> str | None:
    """Return why the measured noise is not written, given pooled figures; None if it is.

    A loss up to LOSS is accepted, because the noise makes the stated deviations right.
    """
    errors, nees = ([side[key] for side in (without, written)] for key in ("rmse_3d", "nees_mean"))
    if gain(*errors) >= -LOSS or errors[1] - errors[0] < LEAST_LOSS:
        return None
    why = validation.why_without(errors[1], errors[0])
    if None in nees or abs(nees[1] - HONEST) >= abs(nees[0] - HONEST):
        return why
    return f"{why}. With it the stated deviations fit better (NEES {nees[0]:.1f} to {nees[1]:.1f})"


def unused_streams(config: FilterConfig) -> tuple[str, ...]:
    """Return the names of the streams of a Flight that the filter does not use."""
    return tuple(name for name in ("imu", *SENSOR_NAMES) if not getattr(config, f"use_{name}"))


def _unobservable(
    found: Attribution, unused: Sequence[str], refused: Sequence[Refused]
) -> list[Unobservable]:
    """Return what the flights do not determine, without effects that show in unused streams alone.

    An effect that a repeated search leaves out is refused; the flights do not lack its channel.
    """
    left_out = {one.what for one in refused}
    return [
        item
        for item in unobservable(found.selection, found.candidates)
        if not _only_of(unused, item.effect)
        and (item.direction is not None or item.effect not in left_out)
    ]


def _only_of(unused: Sequence[str], effect: str) -> bool:
    """Return whether an effect shows in unused streams alone."""
    channels = EFFECTS[effect].channels
    return all((CHANNELS[name].stream or name) in unused for name in channels)


class _Work(NamedTuple):
    """The arguments of `diagnose`."""

    reference: Reference
    base: EffectSet
    config: FilterConfig | None
    progress: Callable[[str], object]
    map_function: MapFunction

    def saying(self, what: str) -> Callable[[], object]:
        """Return a function that passes a text to `progress`."""
        return lambda: self.progress(what)

    def search(self, flights: Flights, base: EffectSet) -> EffectSearch:
        """Return the search for effects of Flights beyond the EffectSet `base`."""
        tracing = self.saying("tracing residuals to effects")
        return EffectSearch(
            flights, self.reference, base, progress=tracing, map_function=self.map_function
        )


@dataclass(frozen=True, eq=False)
class _Outcome:
    """The validated result of an Attribution.

    effects : EffectSet, the base and the added effects; refused : [Refused]
    sides : (before, after) and judged_on, as of Diagnosis
    attribution : Attribution with repairs of ids and signs; baseline : Baseline; changes :
        sentences
    cases : the judged ValidationCases; share : of the values that is applied
    """

    findings: list[EffectFinding]
    effects: EffectSet
    refused: list[Refused]
    sides: tuple[dict[str, Any], dict[str, Any]]
    judged_on: str
    attribution: Attribution
    baseline: comparison.Baseline
    cases: Sequence[comparison.ValidationCase]
    changes: tuple[str, ...] = ()
    share: float = 1.0


def _searched(
    work: _Work, flights: Flights, base: EffectSet
) -> tuple[Attribution, validation.ValidatedSelection]:
    """Return the Attribution of Flights with known errors, and what of it helps the filter.

    A declared effect can explain residuals in place of another one, and not help the filter. The
    search goes on without such effects, as long as the error falls by more than LOSS.
    """
    trying = work.saying("running the filter without each")
    baseline = comparison.Baseline(base, work.config)

    def judged(
        found: Attribution, poses: Sequence[FixedPoses | None] = (None,)
    ) -> validation.ValidatedSelection:
        # The report keeps a finding that does not help the filter, but it is not added.
        model = replace(found, selection=written(found.selection, found.candidates))
        return validation.select_by_error(
            model, flights, baseline, trying, work.map_function, poses=poses
        )

    search = work.search(flights, base)
    found = search.found()
    selected = judged(found)
    refused: tuple[Refused, ...] = ()
    while True:
        for names in _suspects(found, selected):
            fewer = search.without(names)
            other = fewer.found(found, selected.selection.own)
            trial = judged(other, selected.poses)
            if gain(selected.error, trial.error) > LOSS:
                break
        else:
            # A search keeps what belongs to these flights alone, and refuses it once more.
            together = dict.fromkeys((*refused, *selected.refused))
            return search.reported(found), replace(selected, refused=tuple(together))
        # The repeated search does not report these effects.
        known = [one for one in selected.refused if one.what in names]
        better = validation.why_without(selected.error, trial.error)
        others = sorted(names.difference(one.what for one in known))
        refused = (*refused, *known, *(Refused(name, better) for name in others))
        search, found, selected = fewer, other, trial


def _suspects(found: Attribution, selected: validation.ValidatedSelection) -> list[frozenset[str]]:
    """Return the names of effects to search without: errors of the reference, and misleading ones.

    The first are tried only if there are misleading ones. Nodes do not get them, and the values of
    other effects depend on them.
    """
    misleading = selected.misleading
    of_reference = {
        one.name
        for one in found.selection.chosen
        if one.terms[0].effect.needs_reference and not one.terms[0].effect.usable
    }
    return [frozenset(names) for names in (of_reference, misleading) if misleading and names]


def _by_error(
    work: _Work,
    found: Attribution,
    selected: validation.ValidatedSelection,
    fitted: Flights,
    held_out: Flights,
    repairs: dict[Detection, float],
) -> _Outcome:
    """Return the _Outcome if the position errors are known: effects are added if errors fall.

    fitted : Flights as recorded
    repairs : {Detection: worth, m}
    """
    base, config, map_function = work.base, work.config, work.map_function
    attribution, selected = repairing.before_others(found, selected, repairs)
    model = selected.applied(attribution)
    effects, baseline = (
        with_calibration(base, usable(model.effects).effects, model.covariance),
        comparison.Baseline(base, config),
    )
    work.progress("judging")
    cases, judged_on = validation.validation_cases(
        model, fitted, held_out, base, effects, selected.share
    )
    if not held_out:
        untold = selected.untold(attribution)
        cases = [replace(case, untold=untold) for case in cases]
    judged = partial(
        comparison.compare,
        baseline=baseline,
        progress=work.saying("judging"),
        shift_std=work.reference.shift_std,
        map_function=map_function,
    )
    before, after = judged(cases)
    refused = list(selected.refused)
    shift_std = max(work.reference.shift_std(flight.name).max() for flight in fitted)
    why_not = comparison.why_not(before, after, shift_std)
    if why_not and len(effects) > len(base) + len(
        attribution.of_floor
    ):  # errors in the air do not judge effects near the floor
        refused.append(Refused("all", why_not))
        selected = validation.ValidatedSelection(
            attribution.selection.only(()), (), (), selected.worth, selected.error
        )
        model = selected.applied(attribution)
        effects = with_calibration(base, attribution.of_floor, None)
        cases = [replace(case, effects=effects, untold=0.0) for case in cases]
        after = before
        if attribution.of_floor:
            before, after = judged(cases)
    findings = _findings(
        model.findings(), attribution.findings(), attribution.detections, selected.worth
    )
    sides = before, after
    return _Outcome(
        findings,
        effects,
        refused,
        sides,
        judged_on,
        attribution,
        baseline,
        cases,
        share=selected.share,
    )


def _by_self_calibration(
    work: _Work,
    found: Attribution,
    flights: tuple[Flights, Flights],
    held_out: Flights,
    rest: EffectSet,
) -> _Outcome:
    """Return the _Outcome if the position errors are unknown: anchors are calibrated, or nothing.

    Smaller innovations do not prove a correct model, because the estimate can follow a wrong model.
    On measured flights, functions of the place were fitted to some flights. They reduced the
    innovations of other flights and doubled the position error.
    """
    (fitted, sound), effects, baseline = (
        flights,
        work.base,
        comparison.Baseline(work.base, work.config),
    )
    added: list[EffectFinding] = []
    refused: list[Refused] = []
    changes: tuple[str, ...] = ()
    chosen, others = found.selection.chosen, found.findings()
    config = work.config or FilterConfig()
    ranged = any(
        may_have_offset(flight, config) for flight in sound
    )  # then the innovations are already free of the antenna delay of the tag
    if chosen or ranged or rest.covariance is not None or work.reference.constraints:
        calibration = _calibrated(work, sound, rest)
        if isinstance(calibration, str):
            refused = [
                Refused(
                    " + ".join([candidate.label for candidate in chosen] or OF_ANCHORS), calibration
                )
            ]
        else:
            several = calibration.found(calibration.shifts)
            effects = with_calibration(effects, several, calibration.covariance)
            evidence = {
                "slow_before": round(calibration.before, 4),
                "slow_left": round(calibration.left, 4),
            }
            alternatives = {other.effect.name: other.alternatives for other in others}
            added = [
                EffectFinding(
                    effect,
                    effect.channels[0],
                    evidence,
                    calibration.explained,
                    alternatives.get(effect.name, ()),
                    shares=calibration.shares.get(effect.name, ()),
                )
                for effect in several
            ]
            labels = [candidate.label for candidate in chosen if candidate.name not in OF_ANCHORS]
            refused = [
                Refused(label, CANNOT_JUDGE)
                for label in (*labels, *(one.effect.label for one in found.detections))
            ]
            changes = tuple(change.as_text() for change in calibration.changes)
    judged_on = (
        validation.HELD_OUT
        if held_out
        else "the flights that were fitted, by their innovations alone"
    )
    work.progress("judging")
    cases = [comparison.ValidationCase(flight, effects) for flight in held_out or fitted]
    sides = comparison.innovations(cases, baseline, work.saying("judging"), work.map_function)
    return _Outcome(
        _findings(added, others, (), {}),
        effects,
        refused,
        sides,
        judged_on,
        found,
        baseline,
        cases,
        changes,
    )


def _calibrated(work: _Work, flights: Flights, base: EffectSet) -> SelfCalibration | str:
    """Return the SelfCalibration of Flights with the EffectSet `base`, or why it is not applied."""
    known, trying = work.reference.constraints, work.saying("calibrating anchors")
    try:
        found = self_calibrate(flights, Tape(), base, work.config, known, trying, work.map_function)
    except InputError as error:  # flights too short for a self-calibration
        return str(error).rstrip(".")
    if found.why_not is None and found.explained < EXPLAINED:
        return (
            f"positions and delays of anchors explain {found.explained:.0%} of what is slow in "
            "the innovations"
        )
    return found.why_not or found


def _findings(
    model: Sequence[EffectFinding],
    others: Sequence[EffectFinding],
    detections: Sequence[Detection],
    worth: dict[Candidate | Detection, float],
) -> list[EffectFinding]:
    """Return the EffectFindings: first those in the written model, then the others.

    model : findings with the written values; others : all findings
    worth : as of ValidatedSelection, of candidates and detections
    """
    detected = {detection.effect.name: detection for detection in detections}

    def with_worth(finding: EffectFinding, added: bool) -> EffectFinding:
        tried = finding.candidates or [
            detected[name] for name in (finding.effect.name,) if name in detected
        ]
        known = [worth[each] for each in tried if each in worth]
        return replace(finding, added=added, worth=float(np.sum(known)) if known else None)

    out = [
        with_worth(
            finding, finding.effect.is_hypothesis if finding.on_floor else finding.effect.usable
        )
        for finding in model
    ]
    added = {finding.key for finding in out}
    return out + [with_worth(finding, False) for finding in others if finding.key not in added]
