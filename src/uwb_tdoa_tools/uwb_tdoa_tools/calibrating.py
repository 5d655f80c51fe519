"""Calibrate a tag and its anchors from recordings, and validate that on hold-out flights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import AIDS, Flight, Truth
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.monitoring.finding import ERROR

from .checking.ordered import OrderedRecording, displacement
from .diagnosis import diagnose, output
from .diagnosis.references import Nothing
from .diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from .diagnosis.self_calibration.equations import measured_noise, slow_innovations
from .diagnosis.self_calibration.solve import IMPROVED, LEFT
from .estimate import FlightEstimator
from .scoring.evaluation import score_of
from .scoring.gains import change_in_words
from .surveying.report import as_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from uwb_tdoa_ekf.monitoring.finding import Finding

    from .checking.recording import Recording


# the rule of `check` for a survey that does not fit without another mistake
MISFIT = "survey_misfit"
# largest median shift of the anchors, in standard deviations, that a calibration can correct
LARGEST_SHIFT = 3.0
# smallest ratio of the slow innovations before and after, on hold-out data without ground truth
SMALLEST_RATIO = 1.5
# share of the last flight that is fitted without a hold-out flight; the rest validates
FITTED_SHARE = 2.0 / 3.0
SECONDS = 60.0  # of a flight that are looked at
SMALLEST_EXTENT = 0.25  # smallest extent of a path along an axis, relative to the anchors
SMALLEST_IMPROVED_SHARE = 0.5  # share of the coordinates that must improve
STREAMS = "tdoa", "imu", "truth", *AIDS


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration and its validation.

    Attributes
    ----------
    anchors, effects : calibrated.
    tdoa_std : m, for the filter, or None.
    measure : name of the figure that validates it.
    before, after : m, this figure on the hold-out data.
    judged_on : names of the hold-out data.
    why_not : sentence on why it must not be used, or None.
    text : report of the step that found it.
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
        """Return the figures for JSON."""
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
        """Return the gain as one line."""
        change = f" (it {change_in_words(self.before, self.after)})" if self.before else ""
        return (
            f"{self.measure} {100 * self.before:.1f} -> {100 * self.after:.1f} cm{change} on "
            f"{self.judged_on}"
        )


def blocking_errors(recording: Recording, findings: Iterable[Finding], std: float) -> list[Finding]:
    """Return the Findings of `check` that a calibration cannot correct.

    These are all errors, except for a survey within the accuracy `std`, m, of a coordinate.
    """
    errors = [finding for finding in findings if finding.severity == ERROR]
    if any(finding.rule == MISFIT for finding in errors):
        fit = OrderedRecording.of(recording).survey_fit
        if np.median(displacement(fit.positions, fit.all_moved[1])) <= LARGEST_SHIFT * std:
            errors = [finding for finding in errors if finding.rule != MISFIT]
    return errors


def with_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> Calibration:
    """Calibrate with ground truth, by `diagnose`.

    It is validated on `holdout`, or on halves of a single flight.
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
    return _validated(calibration, len(found.effects) > len(base))


def without_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    tape: Tape = Tape(),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
) -> Calibration:
    """Calibrate without ground truth, by `self_calibrate`.

    It is validated on `holdout`, or on the end of the last flight. Wrong anchors leave slowly
    varying innovations: these must decrease.
    """
    judges, fitted, on = holdout, flights, _names(holdout)
    if not holdout:
        *fitted, last = flights
        first, rest = split(last, FITTED_SHARE)
        judges, fitted, on = [rest], [*fitted, first], f"the last third of {last.name}"
    report = partial(progress, "solving")
    found = self_calibrate(fitted, tape, base, config, (), report)
    progress("judging")
    before = slow_innovations(judges, base, config)
    after = slow_innovations(
        [replace(one, anchors=found.anchors) for one in judges], found.effects, config
    )
    if not holdout and found.why_not is None and after <= before:
        found = self_calibrate(flights, tape, base, config, (), report)  # the same on all data
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
    calibration = _validated(calibration, True)
    return (
        calibration
        if calibration.why_not
        else replace(calibration, why_not=_reason_against_unverified(calibration))
    )


def _reason_against_unverified(calibration: Calibration) -> str | None:
    """Return why a Calibration may do harm although the innovations decrease, or None."""
    if calibration.after > LEFT:
        return (
            f"{100 * calibration.after:.1f} cm of the innovations are slow with it on "
            f"{calibration.judged_on}, more than {100 * LEFT:.1f} cm: something "
            "else is wrong too, of which anchors may take the place; record ground truth, or "
            "give survey some --marks"
        )
    if calibration.before < SMALLEST_RATIO * calibration.after:
        return (
            f"it gains too little to be sure that it does no harm: {calibration.as_text()}; "
            "record more, or keep what there is"
        )
    return None


def _validated(calibration: Calibration, any_effect: bool) -> Calibration:
    """Return the Calibration with the reason against its use, if there is one.

    `any_effect` is whether the calibration changes anything.
    """
    if calibration.why_not is not None:
        return calibration
    if not any_effect:
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
    """Return the 3D RMSE of all Flights together, m."""
    errors = [score_of(flight, FlightEstimator(config, effects))[0].error for flight in flights]
    return float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))))


def _with_noise(config: FilterConfig | None, std: float | None) -> FilterConfig:
    """Return the FilterConfig with tdoa_std, m, unless it is None."""
    config = config or FilterConfig()
    changed: dict[str, Any] = {} if std is None else {"tdoa_std": round(std, 3)}
    return replace(config, **changed)


def _names(flights: Sequence[Flight]) -> str:
    return ", ".join(flight.name for flight in flights)


@dataclass(frozen=True, eq=False)
class Prospect:
    """Expected result of a calibration.

    Attributes
    ----------
    seconds, total : s in motion, analysed and available.
    given, expected : (N, 3) m, standard deviations of the anchors, as given and after all flights.
    before, left : m, slow innovations before and after.
    path, hall : (3,) m, extent of the path and of the anchors.
    axes : names of the axes along which the tag can move, "xy" on a floor.
    ids : of the anchors.
    why_not : reason against the use of a survey so far, or None.
    """

    seconds: float
    total: float
    given: np.ndarray
    expected: np.ndarray
    before: float
    left: float
    path: np.ndarray
    hall: np.ndarray
    axes: str
    ids: tuple[int, ...]
    why_not: str | None

    @property
    def better(self) -> np.ndarray:
        """Return the coordinates that will improve: (N, 3) bool."""
        return self.expected < IMPROVED * self.given

    @property
    def exciting(self) -> bool:
        """Return whether the flights determine enough coordinates."""
        return bool(self.better.mean() >= SMALLEST_IMPROVED_SHARE)

    def sentences(self) -> list[str]:
        """Return the prospect as sentences."""
        lines = [
            f"from {self.seconds:.0f} s of {self.total:.0f} s in motion: of the innovations "
            f"{100 * self.before:.1f} cm are slow with the anchors as "
            f"given, and {100 * self.left:.1f} cm with others",
            f"all flights are likely to improve {int(self.better.sum())} of {self.better.size} "
            "coordinates: "
            f"{100 * np.median(self.expected):.0f} cm in the median instead of "
            f"{100 * np.median(self.given):.0f} cm",
        ]
        if self.why_not:
            lines.append(f"so far nothing would be applied: {self.why_not}")
        unseen = [str(i) for i, row in zip(self.ids, self.better) if not row.any()]
        if unseen:
            lines.append(
                f"the flights do not improve anchors {listed(unseen)}: move closer to them, on all "
                "sides, high and low"
            )
        for axis, size, room in zip(self.axes, self.path, self.hall):
            if size < SMALLEST_EXTENT * room:
                lines.append(
                    f"along {axis} the tag moves by {size:.1f} m among anchors that are "
                    f"{room:.1f} m apart: move farther along it"
                )
        lines.append(
            "the flights are exciting enough"
            if self.exciting
            else "the flights are not exciting enough: move more, and elsewhere"
        )
        return lines


def prospect(
    flights: Sequence[Flight],
    tape: Tape = Tape(),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Prospect:
    """Predict the result of a calibration without ground truth from a part of the flights.

    Raises InputError if the flights are too short.
    """
    longest = max(flights, key=_duration)
    middle = 0.5 * (longest.start + longest.end)
    part = between(longest, middle - 0.5 * SECONDS, middle + 0.5 * SECONDS)
    found = self_calibrate([part], tape, base, config, (), progress)
    seconds = found.seconds
    total = max(seconds, sum(map(_duration, flights)) * seconds / max(_duration(part), 1e-9))
    estimate = FlightEstimator(config, base)(part).odometry
    path = np.quantile(estimate.p, [0.02, 0.98], axis=0)
    on_floor = Nothing(config).on_floor(Truth(estimate.t, estimate.p, estimate.q))
    anchors = longest.anchors
    return Prospect(
        seconds,
        total,
        found.given_std,
        _expected(found, total / seconds),
        found.before,
        found.left,
        np.ptp(path, axis=0),
        np.ptp(anchors.positions, axis=0),
        "xy" if on_floor else "xyz",
        tuple(anchors.ids.tolist()),
        found.why_not,
    )


def _duration(flight: Flight) -> float:
    """Return the time in which a Flight has TDOAs or ranges, s."""
    return flight.end - flight.start


def _expected(found: SelfCalibration, more: float) -> np.ndarray:
    """Return the standard deviations after `more` times the analysed data: (N, 3) m.

    The information adds up.
    """
    prior = np.linalg.inv(found.prior.covariance)
    values, vectors = np.linalg.eigh(np.linalg.inv(found.solution.covariance) - prior)
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    covariance = np.linalg.inv(prior + more * information)
    return np.sqrt(np.diag(covariance))[: 3 * len(found.given)].reshape(-1, 3)


def between(flight: Flight, first: float, last: float) -> Flight:
    """Return the part of a Flight stamped from `first` to before `last`, s."""
    cut = {}
    for name in STREAMS:
        stream = getattr(flight, name)
        if stream is not None:
            inside = (stream.t >= first) & (stream.t < last)
            cut[name] = type(stream)(*(column[inside] for column in vars(stream).values()))
    return replace(flight, extra={}, **cut)


def split(flight: Flight, share: float) -> tuple[Flight, Flight]:
    """Split a Flight at a share of its located time."""
    middle = flight.start + share * (flight.end - flight.start)
    return between(flight, -np.inf, middle), between(flight, middle, np.inf)
