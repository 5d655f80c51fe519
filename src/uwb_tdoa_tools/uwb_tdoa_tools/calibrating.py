# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrate a tag and its anchors from recordings, and validate that on hold-out flights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.base import counted
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding
from uwb_tdoa_ekf.results import rows_of

from . import cli, command_lines
from .checking.check import MISFIT, check, different_surveys, misfit_beyond, remark_on_surveys
from .checking.recording import Recording, read_recording
from .diagnosis import diagnose, output, with_noise
from .diagnosis.attribution import first_fit
from .diagnosis.comparison import Baseline, compare
from .diagnosis.noise import write_parameters
from .diagnosis.references import GroundTruth, Nothing, without_truth as without_truth_of
from .diagnosis.report.verdict import percent, worse_phases
from .diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from .diagnosis.self_calibration.equations import slow_innovations
from .diagnosis.self_calibration.solve import CLEARLY_OF_RANGES, IMPROVED, LEFT, MEASURE
from .diagnosis.validation import cross_fitted
from .estimate import FlightEstimator
from .parallel import MapFunction
from .readers.inputs import Reading, Recording as ReadingPair
from .scoring.metrics import NO_DIFFERENCE, change_in_words, clear_change
from .surveying.report import as_text
from .surveying.stream import PIECE, SMALLEST_RATIO

RMSE = "3D RMSE"  # name of the figure with ground truth
# share of the last flight that is fitted without a hold-out flight; the rest validates
FITTED_SHARE = 2.0 / 3.0
SECONDS = 60.0  # of a flight that are looked at
FORECAST_FLIGHTS = 3  # largest number of flights that are looked at with ground truth
SMALLEST_EXTENT = 0.25  # smallest extent of a path along an axis, relative to the anchors
SMALLEST_IMPROVED_SHARE = 0.5  # share of the coordinates that must improve


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
    interval : (low, high), 95 % interval of the gain, a share of `before`; None if unknown.
    worse : sentences on phases of the hold-out data in which the error grows.
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
    interval: tuple[float, float] | None = None
    worse: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {
            "offered": self.why_not is None,
            "why_not": self.why_not,
            "measure": self.measure,
            "before": self.before,
            "after": self.after,
            "gain_interval": self.interval,
            "judged_on": self.judged_on,
            "worse": list(self.worse),
            "tdoa_std": self.tdoa_std,
        }

    def as_text(self) -> str:
        """Return the gain as one line."""
        change = f"it {change_in_words(self.before, self.after)}" if self.before else ""
        if self.interval is not None:
            change += f", 95 % interval of the gain {percent(self.interval)}"
        return (
            f"{self.measure} {100 * self.before:.1f} -> {100 * self.after:.1f} cm"
            f"{change and f' ({change})'} on {self.judged_on}"
        )

    def save(self, folder: Path, config: FilterConfig, has_imu: bool) -> tuple[Path, Path, Path]:
        """Write anchors.yaml, effects.yaml and ekf_node.yaml, and return their paths.

        config : FilterConfig of the calibration; has_imu : whether a recording has inertial samples
        """
        anchors, effects = folder / "anchors.yaml", folder / "effects.yaml"
        self.anchors.to_yaml(anchors)
        self.effects.to_yaml(effects)
        parameters = write_parameters(folder / "ekf_node.yaml", self.tdoa_std, config, has_imu)
        return anchors, effects, parameters


def blocking_errors(recording: Recording, findings: Iterable[Finding], std: float) -> list[Finding]:
    """Return the Findings of `check` that a calibration cannot correct.

    These are all errors, except for a survey within the accuracy `std`, m, of a coordinate.
    """
    errors = [finding for finding in findings if finding.severity == ERROR]
    if misfit_beyond(recording, errors, std) is None:
        errors = [finding for finding in errors if finding.rule != MISFIT]
    return errors


def usable_paths(
    reading: Reading,
    recordings: tuple[Sequence[ReadingPair], Sequence[ReadingPair]],
    estimator: FlightEstimator,
    std: float,
    keep: bool = False,
    effects: str | None = None,
) -> tuple[list[Path], list[Path]]:
    """Print what check finds, and return the paths that permit a calibration: to fit, held out.

    A recording with an error is named with the rule, and left out. Raises InputError if those that
    are left have different surveys.

    Parameters
    ----------
    recordings : (sequence, sequence) of (path, survey)
        Recordings to fit and to hold out, with the paths of their surveys.
    estimator : FlightEstimator
        Estimator with the given effects.
    std : float
        Standard deviation of a coordinate of an anchor, m.
    keep : bool
        Whether to use recordings with an error, too.
    effects : str or None
        File of the given effects.
    """
    found, held = recordings
    usable: dict[Path, Recording] = {}
    with cli.Progress("calibrate", len(found) + len(held), "recording") as progress:
        for path, survey in (*found, *held):
            recording = read_recording(reading, path, survey)
            line = command_lines.survey_line(path, survey, effects)
            result = check(recording, (), estimator, line)
            cli.show(result.text())
            remarks = estimator.remarks(recording.anchors)
            cli.say("calibrate", *(f"{recording.name}: {remark}" for remark in remarks))
            errors = blocking_errors(recording, result.findings, std)
            if errors:
                named = "; ".join(f"{finding.cause} ({finding.rule})" for finding in errors)
                what = (
                    "it is used all the same, as --keep asks for"
                    if keep
                    else "it is left out; put that right, or use it as it is with --keep"
                )
                cli.say("calibrate", f"{recording.name}: check finds an error: {named}: {what}.")
            if keep or not errors:
                usable[path] = recording
            progress.update()
    for finding in different_surveys(list(usable.values())):
        raise InputError(f"{finding.cause}: {finding.evidence}; {finding.remedy}.")
    surveys = [survey for path, survey in (*found, *held) if path in usable]
    cli.say("calibrate", *remark_on_surveys(surveys, list(usable.values())))
    paths, judges = ([path for path, _ in some if path in usable] for some in recordings)
    if held and paths and not judges:
        cli.say("calibrate", "no flight of --holdout is left: the last of the others judges.")
    return paths, judges


def with_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
    map_function: MapFunction = map,
) -> Calibration:
    """Calibrate with ground truth, by `diagnose`.

    It is validated on `holdout`, or on halves of a single flight, with what the files hold.

    map_function : as of `diagnose`
    """
    found = diagnose(flights, holdout, base, config, None, progress, map_function)
    progress("measuring the noise")
    found = with_noise(found, config, map_function)
    before, after = found.before["pooled"], (found.written or found.after)["pooled"]
    interval = after.get("rmse_3d_gain_ci")
    calibration = Calibration(
        flights[0].anchors,
        found.effects,
        found.tdoa_std,
        RMSE,
        before["rmse_3d"],
        after["rmse_3d"],
        _names(holdout) if holdout else found.judged_on,
        None,
        output.as_text(found),
        None if interval is None else (interval[0], interval[1]),
        tuple(worse_phases(found.before, found.written or found.after)),
    )
    return _validated(calibration, len(found.effects) > len(base))


def without_truth(
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    tape: Tape = Tape(),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[str], object] = lambda what: None,
    map_function: MapFunction = map,
) -> Calibration:
    """Calibrate without ground truth, by `self_calibrate`.

    It is validated on `holdout`, or on the end of the last flight. Wrong anchors leave slowly
    varying innovations: these must decrease.

    map_function : as of `diagnose`
    """
    judges, fitted, on = holdout, flights, _names(holdout)
    if not holdout:
        *fitted, last = flights
        first, rest = split(last, FITTED_SHARE)
        judges, fitted, on = [rest], [*fitted, first], f"the last third of {last.name}"
    report = partial(progress, "solving")
    found = self_calibrate(fitted, tape, base, config, (), report, map_function)
    progress("judging")
    before = slow_innovations(judges, base, config)
    after = slow_innovations(
        [replace(one, anchors=found.anchors) for one in judges], found.effects, config
    )
    if not holdout and found.why_not is None and after <= before:
        # the same on all data
        found = self_calibrate(flights, tape, base, config, (), report, map_function)
    calibration = Calibration(
        found.anchors,
        found.effects,
        found.tdoa_std,
        "slow innovations",
        before,
        after,
        on,
        found.why_not or _reason_against_unverified(before, after, found.tdoa_std is None, on),
        as_text(found),
    )
    return _validated(calibration, True)


def _reason_against_unverified(before: float, after: float, of_ranges: bool, on: str) -> str | None:
    """Return why a calibration may do harm although the innovations decrease, or None.

    before, after : m, slow innovations without and with it; of_ranges : without TDOAs
    on : names of the hold-out data
    """
    if after <= LEFT or (of_ranges and before > CLEARLY_OF_RANGES * after):
        return None
    return (
        f"{100 * after:.1f} cm of the innovations are slow with it on {on}, more than "
        f"{100 * LEFT:.1f} cm: something else is wrong too, of which anchors may take the place; "
        f"{MEASURE}"
    )


def _validated(calibration: Calibration, changes_anything: bool) -> Calibration:
    """Return the Calibration with the reason against its use, if there is one.

    `changes_anything` is whether anchors or effects differ from those given.
    """
    if calibration.why_not is not None:
        return calibration
    if not changes_anything:
        return replace(
            calibration,
            why_not="no effect was found that reduces the error on data that was not used to fit it",
        )
    before, after = calibration.before, calibration.after
    if calibration.interval is not None or calibration.measure == RMSE:
        change = clear_change(before, after, calibration.interval)
    elif max(before, after) < SMALLEST_RATIO * min(before, after):
        change = 0  # without ground truth only a large change of the innovations counts
    else:
        change = int(np.sign(before - after))
    if change > 0:  # the error falls
        return calibration
    why = f"it makes {NO_DIFFERENCE}" if change == 0 else "it makes things worse"
    return replace(calibration, why_not=f"{why}: {calibration.as_text()}")


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
        """Return the prospect as sentences; the last one alone judges the motion."""
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
        lacking = self.lacking()
        if not lacking:
            lines.append("the flights are exciting enough")
        elif self.exciting:
            lines.append(f"the flights determine most coordinates; for the others {lacking}")
        else:
            lines.append(f"the flights are not exciting enough: {lacking}")
        return lines

    def lacking(self) -> str:
        """Return which motion the flights lack, as clauses; "" if they lack none."""
        unseen = [str(i) for i, row in zip(self.ids, self.better) if not row.any()]
        clauses = []
        if unseen:
            clauses.append(
                f"move closer to {counted(unseen, 'anchor')}, on all sides, high and low"
            )
        for axis, size, room in zip(self.axes, self.path, self.hall):
            if size < SMALLEST_EXTENT * room:
                clauses.append(
                    f"move farther along {axis}, where the tag moves by {size:.1f} m among anchors "
                    f"that are {room:.1f} m apart"
                )
        if not clauses and not self.exciting:
            clauses.append("move more, and elsewhere")
        return "; ".join(clauses)


@dataclass(frozen=True)
class Forecast:
    """Expected gain of a diagnosis with ground truth.

    Attributes
    ----------
    seconds : s in the air, analysed.
    flights : number of analysed flights.
    before, after : m, 3D RMSE without and with a first fit, on data that it was not fitted to.
    interval : (low, high), 95 % interval of the gain, a share of `before`; None if unknown.
    """

    seconds: float
    flights: int
    before: float
    after: float
    interval: tuple[float, float] | None

    @property
    def fitted(self) -> str:
        """Return what is fitted: maps need several flights."""
        return "positions and delays" if self.flights == 1 else "positions, delays and maps"

    def sentences(self) -> list[str]:
        """Return the forecast as sentences."""
        flights = "1 flight" if self.flights == 1 else f"{self.flights} flights"
        gain = change_in_words(self.before, self.after)
        if self.interval is not None:
            gain += f", 95 % interval of the gain {percent(self.interval)}"
        lines = [
            f"from {self.seconds:.0f} s of {flights}, by ground truth: the position error (3D RMSE) is "
            f"{100 * self.before:.1f} cm",
            f"a first fit of {self.fitted} of all anchors leaves "
            f"{100 * self.after:.1f} cm on data that it was not fitted to ({gain})",
        ]
        change = clear_change(self.before, self.after, self.interval)
        if change > 0:  # the error falls
            lines.append("a calibration with --out is likely to gain about as much")
        elif change == 0:
            lines.append(f"that is {NO_DIFFERENCE}; a calibration may find other effects")
        else:
            lines.append(
                f"{self.fitted} of anchors do not describe these flights; a calibration may find "
                "other effects"
            )
        return lines


def forecast(
    flights: Sequence[Flight],
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Forecast:
    """Predict the gain of a calibration with ground truth from parts of a few flights.

    Positions, delays and maps of anchors make most of the gain. They are fitted at once, without
    the search of a diagnosis, and judged on data that they were not fitted to (`cross_fitted`).
    Raises InputError if the flights are too short.
    """
    count = min(len(flights), FORECAST_FLIGHTS)
    chosen = [flights[k * len(flights) // count] for k in range(count)]
    reference, parts = GroundTruth(config), []
    for flight in chosen:
        middle = 0.5 * (flight.start + flight.end)
        part = between(flight, middle - 0.5 * SECONDS, middle + 0.5 * SECONDS)
        parts.append(reference.settled(reference.prepare(part), base, config)[0])
        progress()
    fitted = first_fit(parts, reference, base)
    progress()
    cases = cross_fitted(fitted, parts, base, fitted.selection.chosen, ())
    before, after = compare(cases, Baseline(base, config), progress)
    interval = after["pooled"]["rmse_3d_gain_ci"]
    spans = {score.name: (score.first, score.last) for score in before["scores"]}
    return Forecast(
        sum(last - first for first, last in spans.values()),
        len(parts),
        before["pooled"]["rmse_3d"],
        after["pooled"]["rmse_3d"],
        None if interval is None else (interval[0], interval[1]),
    )


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
    longest = max(flights, key=lambda flight: flight.duration)
    middle = 0.5 * (longest.start + longest.end)
    part = between(longest, middle - 0.5 * SECONDS, middle + 0.5 * SECONDS)
    found = self_calibrate([part], tape, base, config, (), progress)
    seconds = found.seconds
    of_all = sum(flight.duration for flight in flights)
    total = max(seconds, of_all * seconds / max(part.duration, 1e-9))
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
    cut = {
        name: rows_of(stream, (stream.t >= first) & (stream.t < last))
        for name, stream in flight.streams.items()
    }
    return replace(flight, extra={}, **cut)


def split(flight: Flight, share: float) -> tuple[Flight, Flight]:
    """Split a Flight at a share of its located time."""
    middle = flight.start + share * flight.duration
    return between(flight, -np.inf, middle), between(flight, middle, np.inf)


def in_pieces(flight: Flight) -> Iterator[Flight]:
    """Yield the pieces of PIECE s of a Flight, cut by its stamps alone, without ground truth."""
    for number, first in enumerate(np.arange(flight.start, flight.end, PIECE).tolist()):
        if (piece := cut(flight, number, first)) is not None:
            yield piece


def cut(flight: Flight, number: int, first: float) -> Flight | None:
    """Return PIECE s of a Flight from a stamp, s, without ground truth; None without TDOAs.

    number : of the piece, from 0, for its name
    """
    piece = without_truth_of(between(flight, first, first + PIECE))
    if not len(piece.streams) or not piece.duration > 0.0:
        return None
    return replace(piece, name=f"{flight.name}-{number + 1}")
