"""A calibration of a tag and its anchors, and what it is worth where it took no part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.streams import ERROR

from ..checking.ordered import OrderedRecording, displacement
from ..diagnosis import diagnose, output
from ..diagnosis.self_calibration import Tape, self_calibrate
from ..diagnosis.self_calibration.equations import measured_noise, slow_innovations
from ..diagnosis.self_calibration.solve import LEFT
from ..estimate import FlightEstimator
from ..scoring.evaluation import score_of
from ..scoring.gains import change_of
from ..surveying.report import as_text
from .parts import split

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.streams.finding import Finding

    from ..checking.recording import Recording

# the rule of `check` of a survey that does not fit, though no other mistake explains it
MISFIT = "survey_misfit"
# standard deviations of a coordinate that anchors may be off by, in the median, and be of the same
# room
OFF = 3.0
# slow innovations before over those after, where it took no part, that tell without ground truth
# that a calibration does good
GAINED = 1.5
FITTED = 2.0 / 3.0  # of the time of a single flight without ground truth; the rest judges


@dataclass(frozen=True, eq=False)
class Calibration:
    """anchors : Anchors; effects : EffectSet; tdoa_std : m, for the filter, or None; before, after
    : m, of what `measure` says, on what `judged_on` says; why_not : a sentence on why it is not to
    be used, or None; text : what the step that found it says.
    """

    anchors: Anchors
    effects: EffectSet
    tdoa_std: float | None
    measure: str
    before: float
    after: float
    judged_on: str
    why_not: str | None
    text: str

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "offered": self.why_not is None,
            "why_not": self.why_not,
            "measure": self.measure,
            "before": self.before,
            "after": self.after,
            "judged_on": self.judged_on,
            "tdoa_std": self.tdoa_std,
        }

    def as_text(self) -> str:
        """What it is worth, in a line."""
        change = f" (it {change_of(self.before, self.after)})" if self.before else ""
        return (
            f"{self.measure} {100 * self.before:.1f} -> {100 * self.after:.1f} cm{change} on "
            f"{self.judged_on}"
        )


def stopping(recording: Recording, findings: Iterable[Finding], std: float) -> list[Finding]:
    """Those Findings of `check` in a Recording that a calibration cannot put right: all errors, but
    for a survey that does not fit by as much as a tape may be off. std : m, of a coordinate.
    """
    errors = [finding for finding in findings if finding.severity == ERROR]
    if any(finding.rule == MISFIT for finding in errors):
        fit = OrderedRecording.of(recording).survey_fit
        if np.median(displacement(fit.positions, fit.all_moved[1])) <= OFF * std:
            errors = [finding for finding in errors if finding.rule != MISFIT]
    return errors


def with_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> Calibration:
    """Calibration of Flights with ground truth, by `diagnose`, judged on Flights of `holdout`, or
    on halves of a single flight.
    """
    found = diagnose(flights, holdout, base, config, None, progress)
    progress("measuring the noise")
    std = measured_noise(found.flights, found.effects, config)
    calibration = Calibration(
        flights[0].anchors,
        found.effects,
        std,
        "3D RMSE",
        found.before["pooled"]["rmse_3d"],
        found.after["pooled"]["rmse_3d"],
        found.judged_on,
        None,
        output.as_text(found),
    )
    if holdout:
        progress("judging")
        before, after = (
            _rmse(holdout, *side)
            for side in ((base, config), (found.effects, _with_noise(config, std)))
        )
        calibration = replace(calibration, before=before, after=after, judged_on=_names(holdout))
    return _assessed(calibration, len(found.effects) > len(base))


def without_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    tape: Tape = Tape(),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> Calibration:
    """Calibration of Flights, whose ground truth is not used, by `self_calibrate`, judged on
    Flights of `holdout`, or on the end of a single flight: by how much of the innovations is slow,
    as anchors that are wrong make them.
    """
    judges, fitted, on = holdout, flights, _names(holdout)
    if not holdout:
        *fitted, last = flights
        first, rest = split(last, FITTED)
        judges, fitted, on = [rest], [*fitted, first], f"the last third of {last.name}"
    said = partial(progress, "solving")
    found = self_calibrate(fitted, tape, base, config, (), said)
    progress("judging")
    before = slow_innovations(judges, base, config)
    after = slow_innovations(
        [replace(one, anchors=found.anchors) for one in judges], found.effects, config
    )
    if not holdout and found.why_not is None and after <= before:
        found = self_calibrate(
            flights, tape, base, config, (), said
        )  # what was judged, of all of it
    calibration = Calibration(
        found.anchors,
        found.effects,
        found.tdoa_std,
        "slow innovations",
        before,
        after,
        on,
        found.why_not,
        as_text(found),
    )
    calibration = _assessed(calibration, True)
    return (
        calibration
        if calibration.why_not
        else replace(calibration, why_not=_why_not_blindly(calibration))
    )


def _why_not_blindly(calibration: Calibration) -> str | None:
    """Why a Calibration that was judged by innovations alone may do harm, though they are smaller;
    or None.
    """
    if calibration.after > LEFT:
        return (
            f"{100 * calibration.after:.1f} cm of the innovations are slow with it on "
            f"{calibration.judged_on}, more than {100 * LEFT:.1f} cm: something "
            "else is wrong too, of which anchors may take the place; record ground truth, or "
            "give survey some --marks"
        )
    if calibration.before < GAINED * calibration.after:
        return (
            f"it gains too little to be sure that it does no harm: {calibration.as_text()}; fly "
            "more, or keep what there is"
        )
    return None


def _assessed(calibration: Calibration, something: bool) -> Calibration:
    """The Calibration with why it is not to be used; something : whether there is anything to use."""
    if calibration.why_not is not None:
        return calibration
    if not something:
        return replace(
            calibration,
            why_not="nothing was found that makes the error smaller where it took no part",
        )
    if not calibration.after <= calibration.before:
        return replace(
            calibration,
            why_not=f"it makes things worse where it took no part: {calibration.as_text()}",
        )
    return calibration


def _rmse(flights: Sequence[Flight], effects: EffectSet, config: FilterConfig | None) -> float:
    """m, 3D RMSE of all Flights together, by an estimate with an EffectSet."""
    errors = [score_of(flight, FlightEstimator(config, effects))[0].error for flight in flights]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))))


def _with_noise(config: FilterConfig | None, std: float | None) -> FilterConfig:
    """FilterConfig with tdoa_std, m, unless that is None."""
    config = config or FilterConfig()
    changed: dict[str, Any] = {} if std is None else {"tdoa_std": round(std, 3)}
    return replace(config, **changed)


def _names(flights: Sequence[Flight]) -> str:
    return ", ".join(flight.name for flight in flights)
