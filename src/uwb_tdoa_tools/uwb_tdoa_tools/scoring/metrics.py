# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How far an estimate is from ground truth, and whether its covariance is honest: of one run, and of several together."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.common.sensors import LOCATING
from uwb_tdoa_bias.effects.samples import PoseColumns
from uwb_tdoa_ekf.core.memory import COMPENSATED, REJECTED, USED
from uwb_tdoa_ekf.offline import Run
from uwb_tdoa_ekf.results import Residuals, concatenated, rows_of

from ..choices import ALIGN
from ..cli import as_json
from .phases import TITLES, in_the_air, motion, phases

Spans = Sequence[tuple[float, float]]  # from when to when, s
# {flight: {share, None for no correction: 3D RMSE of the filter, m}}
Errors = dict[str, dict[float | None, float]]

SAME = 0.005  # share of the error: a smaller change rounds to 0 %
LOSS = 0.03  # share of the error: a smaller loss may be risked for a larger expected gain
NO_DIFFERENCE = "no difference that these flights can show"
SHARES = 0.0, 0.5, 0.75, 1.0


def gain(before: float, after: float) -> float:
    """Return the relative reduction of an error; negative if the error rises."""
    return 1.0 - after / before


def change_in_words(before: float, after: float) -> str:
    """Return how an error changes: "falls by 13 %", "rises by 20 %" or "stays"."""
    return gain_in_words(gain(before, after))


def gain_in_words(gained: float) -> str:
    """Return a `gain` in the same words."""
    return (
        "stays"
        if abs(gained) < SAME
        else f"{'falls' if gained > 0.0 else 'rises'} by {100.0 * abs(gained):.0f} %"
    )


def clear_change(before: float, after: float, interval: Sequence[float] | None = None) -> int:
    """Return 1 if an error clearly falls, -1 if it clearly rises, and 0 otherwise.

    A change is clear if its `interval` excludes zero. A gain is clear, too, if more than LOSS is
    expected, and the probability of a loss above LOSS is below 2.5 %. Without an interval a change
    is clear from SAME on.

    Parameters
    ----------
    before, after : float
        The error, in one unit.
    interval : (low, high), optional
        95 % interval of the `gain`.
    """
    gained = gain(before, after) if before else 0.0
    low, high = (gained - SAME, gained + SAME) if interval is None else interval
    expected, half_width = 0.5 * (low + high), 0.5 * (high - low)
    # With the second condition a loss of LOSS lies outside of the interval.
    worth_the_risk = interval is not None and expected > LOSS and expected + LOSS > half_width
    falls, rises = low > 0.0 or worth_the_risk, high < 0.0
    return int(falls) - int(rises)


@dataclass(frozen=True)
class Shrinkage:
    """Share of a correction that cross-validation over flights supports.

    Attributes
    ----------
    share : share of the prediction to subtract.
    errors : {flight: {share: 3D RMSE of the filter, m}}; the key None is without correction.
    """

    share: float
    errors: Errors

    @property
    def gains(self) -> np.ndarray:
        """Return the `gain` of each flight with the share: (n,)."""
        return np.array([gain(of[None], of[self.share]) for of in self.errors.values()])

    def as_text(self) -> str:
        """Return the expected gain as one sentence."""
        gains = self.gains
        return (
            f"expected of flights like these: the 3D RMSE {gain_in_words(gains.mean())} +- "
            f"{100.0 * _spread(gains):.0f} % "
            f"(of {len(gains)} flights, each left out; on the worst it {gain_in_words(gains.min())}), "
            f"with {self.share:g} of what is predicted taken out"
        )

    @property
    def parts(self) -> tuple[float, float]:
        """Return mean gains: of the larger deviation alone, share 0, and of the subtraction beyond it."""
        pairs = [(None, 0.0), (0.0, self.share)]
        widened, subtracted = (
            float(np.mean([gain(of[one], of[other]) for of in self.errors.values()]))
            for one, other in pairs
        )
        return widened, subtracted

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        gains = self.gains
        errors = {
            name: {str(share): error for share, error in of.items()}
            for name, of in self.errors.items()
        }
        return {
            "share": self.share,
            "gain": gains.mean(),
            "spread": _spread(gains),
            "worst": gains.min(),
            "left_out": errors,
        }


def best_share(errors: Errors) -> float:
    """Return the share with the smallest relative error, one standard deviation above its mean.

    Mean and standard deviation are over the left-out flights in `errors`, see Shrinkage. Errors are
    relative to no correction. The mean alone would favour a model that gains much on three flights
    and harms the fourth. Future flights vary more than these.
    """
    ratios = {
        share: np.array([of[share] / of[None] for of in errors.values()])
        for share in SHARES
        if all(share in of for of in errors.values())
    }
    return min(ratios, key=lambda share: ratios[share].mean() + _spread(ratios[share]))


def _spread(gains: np.ndarray) -> float:
    return float(gains.std(ddof=1)) if len(gains) > 1 else 0.0


RATIO = 1.01  # ratio of the limits of a bin
SMALLEST = 1e-9  # smaller samples count as this
WHOLE = ("duration", "count", "without_estimate", "without_truth")  # sums over runs
ROOTS = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "std_3d")  # root mean squares
# degrees, but the last
ATTITUDE = "median_roll", "median_pitch", "median_yaw", "std_yaw", "nees_attitude"
COVERAGE = ("coverage_3sigma_x", "coverage_3sigma_y", "coverage_3sigma_z")


def or_nan(function: Callable[[np.ndarray], float], values: np.ndarray) -> float:
    """Return function(values); NaN without values."""
    return float(function(values)) if len(values) else math.nan


@dataclass
class Distribution:
    """Distribution of samples as a histogram whose size does not depend on their number.

    Attributes
    ----------
    count, total, largest : number, sum and maximum of the samples.
    bins : {k: number of samples from RATIO**k to RATIO**(k + 1)}.
    """

    count: int
    total: float
    largest: float
    bins: Counter[int]

    @classmethod
    def of(cls, values: np.ndarray | Sequence[float]) -> Distribution:
        """Count values (n,) of at least 0; NaN makes all figures NaN."""
        if not len(values):
            return cls(0, 0.0, -math.inf, Counter())
        sizes = np.clip(np.nan_to_num(values), SMALLEST, 1.0 / SMALLEST)
        places, counts = np.unique(
            np.floor(np.log(sizes) / math.log(RATIO)).astype(int), return_counts=True
        )
        return cls(
            len(values),
            float(np.sum(values)),
            float(np.max(values)),
            Counter(dict(zip(places.tolist(), counts.tolist()))),
        )

    def __add__(self, other: Distribution) -> Distribution:
        largest = float(np.max([self.largest, other.largest]))  # NaN if one is NaN
        return Distribution(
            self.count + other.count, self.total + other.total, largest, self.bins + other.bins
        )

    @property
    def mean(self) -> float:
        """Return the mean; NaN without samples."""
        return self.total / self.count if self.count else math.nan

    @property
    def median(self) -> float:
        """Return the median to 1 %; NaN without samples."""
        if not self.count or math.isnan(self.total):
            return math.nan
        half, below = 0.5 * self.count, 0
        for place in sorted(self.bins):
            if below + self.bins[place] >= half:
                return RATIO ** (place + (half - below) / self.bins[place])
            below += self.bins[place]
        raise AssertionError("the bins hold fewer than were counted")


def pooled_errors(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of one phase of all samples, and median and maximum over the runs.

    runs : figures of each run, see `ErrorSeries.figures`.
    """
    of_runs = {
        name: np.array([figures[name] for figures in runs if figures["count"]])
        for name in ("rmse_3d", "nees_mean", "max_3d", "step")
    }
    out: dict[str, Any] = {"runs": len(runs)}
    out |= {name: sum(figures[name] for figures in runs) for name in WHOLE}
    out |= _of_all_samples(runs, (*ROOTS, "nees_mean"))
    for name in ("max_3d", "step"):
        out[name] = or_nan(np.max, of_runs[name])
    for name in ("rmse_3d", "nees_mean"):
        out[f"{name}_median_of_runs"] = or_nan(np.median, of_runs[name])
        out[f"{name}_max_of_runs"] = or_nan(np.max, of_runs[name])
    return out


def _of_all_samples(runs: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, float]:
    """Return {name: mean of the samples of all runs}, NaN without any; of ROOTS the root mean square.

    runs : figures of each run, and the "count" of its samples.
    """
    some, out = [figures for figures in runs if figures["count"]], {}
    count = [figures["count"] for figures in some]
    for name in names:
        power = 2 if name in ROOTS else 1
        values = np.array([figures[name] for figures in some]) ** power
        mean = float(np.average(values, weights=count)) if some else math.nan
        out[name] = mean ** (1 / power)
    return out


@dataclass(frozen=True)
class Result:
    """One run as a record whose size does not depend on its length.

    Attributes
    ----------
    row : figures, see `Score.row`.
    distributions : {quantity: Distribution}.
    phases : figures of each phase, see `Score.phases`.
    aligned : `Alignment.as_dict` and the 3D RMSE, m, with each of ALIGN; empty if not computed.
    """

    row: dict[str, Any]
    distributions: dict[str, Distribution]
    phases: dict[str, dict[str, Any]]
    aligned: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return all figures of the run for JSON; NaN becomes null."""
        return as_json({**self.row, "phases": self.phases, "aligned": self.aligned})


class Pool:
    """Pool the samples of several runs, one run after the other."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []  # figures of the runs, with "count", of their errors
        self._distributions = {name: Distribution.of([]) for name in ("distance", "nees", "nis")}
        self._phases: dict[str, list[dict[str, Any]]] = defaultdict(list)  # figures of the runs
        self._aligned: dict[str, Any] = Counter()

    def add(self, result: Result) -> None:
        """Count the Result of one run."""
        self._rows.append({**result.row, "count": result.distributions["distance"].count})
        for name, part in result.distributions.items():
            self._distributions[name] += part
        for name, figures in result.phases.items():
            self._phases[name].append(figures)
        for how in ALIGN if result.aligned else ():
            error = result.aligned[f"rmse_3d_{how}"]
            self._aligned[how] += math.nan if error is None else error

    @property
    def attitudes(self) -> dict[str, tuple[float, ...]]:
        """Return {flight: ATTITUDE} of the runs in which it is known."""
        return {
            row["flight"]: tuple(row[name] for name in ATTITUDE)
            for row in self._rows
            if not math.isnan(row["median_yaw"])
        }

    @property
    def aligned(self) -> dict[str, float]:
        """Return {one of ALIGN: mean 3D RMSE of the runs, m}; NaN for a truth on another clock."""
        return {how: total / len(self._rows) for how, total in self._aligned.items()}

    def phases(self) -> dict[str, dict[str, Any]]:
        """Return {name: figures, see `pooled_errors`} of the phases that any run has."""
        return {name: pooled_errors(self._phases[name]) for name in TITLES if name in self._phases}

    def figures(self) -> dict[str, Any]:
        """Return the figures of at least one run as a dict.

        They are those of `summary`, the coverage, mean and maximum of the 3D RMSE over runs, and
        the phases. Medians of samples are accurate to 1 %.
        """
        distance, errors = self._distributions["distance"], [row["rmse_3d"] for row in self._rows]
        out: dict[str, Any] = {"flight": f"{len(errors)} pooled"}
        out |= _of_all_samples(
            self._rows, ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "frac_gt_1m", *COVERAGE)
        )
        out["median_3d"] = distance.median
        out["max_3d"] = distance.largest if distance.count else math.nan
        out["frac_gt_1m"] = out["frac_gt_1m"] if distance.count else 1.0
        for name in ("nees", "nis"):
            part = self._distributions[name]
            out |= {f"{name}_mean": part.mean, f"{name}_median": part.median}
        out["start_delay"] = max(row["start_delay"] for row in self._rows)
        ready = [row["ready_delay"] for row in self._rows]
        out["ready_delay"] = float(np.fmax.reduce(ready))  # NaN if unknown
        out |= {name: sum(row[name] for row in self._rows) for name in ("diverged", "late_start")}
        out["rmse_3d_mean_of_runs"] = sum(errors) / len(errors)
        out["rmse_3d_max_of_runs"] = float(np.max(errors))
        return {**out, "phases": self.phases()}


# s that an estimate stands for; at least SPARSE times the usual interval of the odometry
VALID_FOR = 0.1
EVERYTHING = ((-math.inf, math.inf),)  # spans, s
LOST = 1.0  # m; a larger error is no estimate
LOST_SHARE = 0.25  # of the airborne time; more is a diverged run
# s without a true pose, and SPARSE times the usual interval: the truth is not interpolated there
HOLE = 0.5
SPARSE = 4.0
START_GRACE = 1.0  # s into the airborne part by which the first estimate must have come
READY = 100  # TDOAs that a filter may take to begin with


class Estimate(PoseColumns, Protocol):
    """Poses with the covariance (n, k, k), whose first three rows and columns are the position, m^2."""

    @property
    def covariance(self) -> np.ndarray: ...


def rms(values: np.ndarray) -> float:
    """Return the root mean square; NaN without values."""
    return or_nan(lambda v: np.sqrt(np.mean(v**2)), values)


def scored_phase(truth: Truth) -> tuple[str, float, float]:
    """Return (name, first, last) of the phase that the figures of a whole run are from.

    It is the time in the air. A tag that is never in the air is scored while it moves, a tag that
    never moves over the whole recording. Stamps in s.
    """
    found = {
        "in_the_air": in_the_air(truth),
        "moving": motion(truth),
        "whole": (truth.t[0], truth.t[-1]),
    }
    name, (first, last) = next((name, span) for name, span in found.items() if span)
    return name, first, last


def position_at(t: np.ndarray, truth: PoseColumns) -> np.ndarray:
    """Interpolate the position linearly at stamps t (n,), s: (n, 3) m."""
    return np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)


def position_errors(
    odometry: Estimate, truth: Truth, first: float, last: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the position errors from `first` to `last`, s.

    The truth is interpolated at the stamps of the estimate, except in holes of the truth.

    Returns
    -------
    t : (n,) s.
    error : (n, 3) m, estimate minus truth, in the world frame.
    covariance : (n, 3, 3) m^2, of the position.
    """
    chosen = (odometry.t >= first) & (odometry.t <= last) & ~_in_holes(odometry.t, truth.t)
    t = odometry.t[chosen]
    return t, odometry.p[chosen] - position_at(t, truth), odometry.covariance[chosen, :3, :3]


def _in_holes(t: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return which stamps t (n,) s lie in a hole of the truth with stamps `known` (m,) s: (n,) bool."""
    if len(known) < 2:
        return np.zeros(len(t), bool)
    k = np.clip(np.searchsorted(known, t, side="right") - 1, 0, len(known) - 2)
    return _holes(known)[k] & (t > known[k]) & (t < known[k + 1])


def _holes(known: np.ndarray) -> np.ndarray:
    """Return after which stamps `known` (m,) s of a truth a hole follows: (m - 1,) bool."""
    apart = np.diff(known)
    return apart > max(HOLE, SPARSE * np.median(apart)) if len(apart) else np.zeros(0, bool)


def _known_spans(known: np.ndarray) -> np.ndarray:
    """Return the spans without holes, (k, 2) s, of the stamps `known` (m,) s of a truth."""
    last = np.append(_holes(known), True)
    return np.column_stack([known[np.append(True, last[:-1])], known[last]])


def within(t: np.ndarray, spans: Spans) -> np.ndarray:
    """Return which stamps t (n,) s lie within spans ((first, last), ...), s: (n,) bool."""
    inside = np.zeros(len(t), bool)
    for first, last in spans:
        inside |= (t >= first) & (t <= last)
    return inside


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the normalised estimation error squared, e' P^-1 e: (n,).

    An honest 3D covariance gives 3 on average (Bar-Shalom et al., Estimation with Applications to
    Tracking and Navigation, sec. 5.4). A singular covariance gives NaN.

    Parameters
    ----------
    error : (n, 3) m.
    covariance : (n, 3, 3) m^2.
    """
    out = np.full(len(error), np.nan)
    usable = np.linalg.det(covariance) > 0.0
    solved = np.linalg.solve(covariance[usable], error[usable, :, None])[:, :, 0]
    out[usable] = np.einsum("ni,ni->n", error[usable], solved)
    return out


def attitude_figures(
    odometry: Estimate, truth: Truth, first: float, last: float
) -> dict[str, float]:
    """Return the errors of roll, pitch and yaw from `first` to `last`, s; NaN without true attitudes.

    Returns
    -------
    dict
        "median_roll", "median_pitch", "median_yaw": of the magnitude, degrees, intrinsic z-y-x;
        large errors before the yaw is known do not count. "std_yaw": the stated deviation about the
        vertical of the body, median, degrees. "nees_attitude": mean of e' P^-1 e of the rotation, 3
        if the covariance is honest.
    """
    known = np.isfinite(truth.q).all(axis=1) & (np.abs(truth.q).max(axis=1) > 0.0)
    t, rows = np.unique(truth.t[known], return_index=True)
    if len(t) < 2:
        return dict.fromkeys(ATTITUDE, math.nan)
    chosen = (odometry.t >= max(first, t[0])) & (odometry.t <= min(last, t[-1]))
    chosen &= ~_in_holes(odometry.t, t)
    if not chosen.any():
        return dict.fromkeys(ATTITUDE, math.nan)
    true = Slerp(t, Rotation.from_quat(truth.q[known][rows]))(odometry.t[chosen])
    estimated = Rotation.from_quat(odometry.q[chosen])
    apart = (estimated.as_euler("ZYX") - true.as_euler("ZYX"))[:, ::-1]  # roll, pitch, yaw
    degrees = np.rad2deg((apart + np.pi) % (2.0 * np.pi) - np.pi)
    covariance = odometry.covariance[chosen, -3:, -3:]
    if odometry.covariance.shape[1] == 6:  # of a message: about the axes of the world
        rotated = (estimated * true.inv()).as_rotvec()
    else:
        rotated = (true.inv() * estimated).as_rotvec()
    stated = np.rad2deg(np.sqrt(np.maximum(covariance[:, 2, 2], 0.0)))
    values = *np.median(np.abs(degrees), axis=0).tolist(), float(np.median(stated))
    return dict(zip(ATTITUDE, (*values, or_nan(np.nanmean, nees(rotated, covariance)))))


def radio_residuals(flight: Flight, run: Run) -> Residuals:
    """Return the Residuals of the TDOAs and ranges of a Run; a range has a = b."""
    parts = [run.residuals]
    for name in LOCATING:
        if name in run.sensors:
            stream = getattr(flight, name)
            parts.append(
                Residuals.from_rows(stream.t, stream.anchor, stream.anchor, run.sensors[name])
            )
    return concatenated(parts)


def nis(residuals: Residuals) -> np.ndarray:
    """Return the normalised innovation squared of every measurement in the filter: (n,).

    Outliers count in full. An honest filter gives 1 on average. All tools ask for it with
    `radio_residuals`: of TDOAs and ranges.
    """
    there = has_innovation(residuals)
    return residuals.innovation[there] ** 2 / residuals.variance[there]


def has_innovation(residuals: Residuals) -> np.ndarray:
    """Return which measurements had an innovation in the filter: (n,) bool."""
    return np.isin(residuals.verdict, (USED, REJECTED, COMPENSATED))


def summary(errors: np.ndarray, normalised: np.ndarray, innovations: np.ndarray) -> dict[str, Any]:
    """Return the figures of one run, or of several pooled, as a dict of floats.

    Parameters
    ----------
    errors : (n, 3) m.
    normalised : (n,) NEES.
    innovations : (k,) NIS.
    """
    distance = np.linalg.norm(errors, axis=1)
    finite = np.isfinite(distance)
    out = {f"rmse_{axis}": rms(errors[:, k]) for k, axis in enumerate("xyz")}
    out["rmse_3d"] = rms(distance)
    out["median_3d"], out["max_3d"] = or_nan(np.median, distance), or_nan(np.max, distance)
    out["frac_gt_1m"] = float(np.mean(~(distance <= LOST))) if len(distance) else 1.0
    out["diverged"] = bool(out["frac_gt_1m"] > LOST_SHARE or not finite.all())
    for name, values in (("nees", normalised), ("nis", innovations)):
        out[f"{name}_mean"] = or_nan(np.mean, values)
        out[f"{name}_median"] = or_nan(np.median, values)
    return out


def coverage(error: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    """Return the share of errors within 3 predicted standard deviations, for each of COVERAGE.

    An honest Gaussian estimate gives 0.997.
    """
    std = np.sqrt(np.einsum("nii->ni", covariance))
    inside = np.abs(error) <= 3.0 * std
    return {name: or_nan(np.mean, inside[:, k]) for k, name in enumerate(COVERAGE)}


class ErrorSeries:
    """Errors of an odometry over the whole ground truth.

    Attributes
    ----------
    t : (n,) s.
    error : (n, 3) m.
    nees : (n,).
    covariance : (n, 3, 3) m^2.
    step : (n,) m, change of the error from the previous estimate; 0 for the first.
    known : (k, 2) s, spans with ground truth.
    covered : (m, 2) s, spans with an estimate.
    """

    def __init__(self, odometry: Estimate, truth: Truth) -> None:
        """Compare an odometry with the whole truth."""
        self.t, self.error, self.covariance = position_errors(
            odometry, truth, truth.t[0], truth.t[-1]
        )
        self.nees = nees(self.error, self.covariance)
        self.step = np.linalg.norm(np.diff(self.error, axis=0, prepend=self.error[:1]), axis=1)
        self.known = _known_spans(truth.t)
        stamps = odometry.t
        usual = np.median(np.diff(stamps)) if len(stamps) > 1 else 0.0
        ends = stamps + max(VALID_FOR, SPARSE * usual)
        self.covered = np.column_stack([stamps, np.minimum(ends, np.append(stamps[1:], np.inf))])

    def figures(self, begin: float, end: float, spans: Spans = EVERYTHING) -> dict[str, Any]:
        """Return the figures of one phase, from `begin` to `end`, s, as a dict.

        Only the parts within `spans`, ((first, last), ...) s, count.
        """
        parts = [(max(begin, first), min(end, last)) for first, last in spans]
        parts = [(first, last) for first, last in parts if last > first]
        chosen, duration = within(self.t, parts), sum(last - first for first, last in parts)
        error = self.error[chosen]
        distance = np.linalg.norm(error, axis=1)
        out: dict[str, Any] = {"begin": begin, "duration": duration, "count": int(chosen.sum())}
        out |= {f"rmse_{axis}": rms(error[:, k]) for k, axis in enumerate("xyz")}
        out |= {"rmse_3d": rms(distance), "max_3d": or_nan(np.max, distance)}
        out["std_3d"] = or_nan(
            lambda P: np.sqrt(np.mean(np.einsum("nii->n", P))), self.covariance[chosen]
        )
        out["nees_mean"] = or_nan(np.mean, self.nees[chosen])
        out["step"] = or_nan(np.max, self.step[chosen])
        for name, covered in (("without_estimate", self.covered), ("without_truth", self.known)):
            out[name] = max(
                0.0, duration - sum(_overlap(covered, first, last) for first, last in parts)
            )
        return out


def _overlap(spans: np.ndarray, begin: float, end: float) -> float:
    """Return the seconds of spans (n, 2) s that lie from `begin` to `end`."""
    return float(
        np.sum(np.maximum(0.0, np.minimum(spans[:, 1], end) - np.maximum(spans[:, 0], begin)))
    )


class Score:
    """Errors of one run against its ground truth.

    Attributes
    ----------
    part : name of the scored phase, see `scored_phase`.
    first, last : s, of that phase.
    t : (n,) s.
    p : (n, 3) m, true positions.
    error : (n, 3) m.
    covariance : (n, 3, 3) m^2.
    nis : (k,).
    """

    def __init__(
        self,
        name: str,
        odometry: Estimate,
        truth: Truth,
        residuals: Residuals | None = None,
        heard: np.ndarray | None = None,
        spans: Spans | None = None,
        reach: Spans = EVERYTHING,
    ) -> None:
        """Compare an odometry with the truth.

        Parameters
        ----------
        name : name of the flight.
        heard : (n,) s, stamps of the TDOAs; gives the time to the first estimate.
        spans : ((first, last), ...) s, parts of the scored phase that count; None for all.
        reach : the same for the figures of all phases.
        """
        self.name, self._whole, self._heard, self._reach = name, (odometry, truth), heard, reach
        if spans is not None:  # the truth must not be interpolated between spans
            estimates: Any = odometry
            odometry = rows_of(estimates, within(odometry.t, spans))
            truth = rows_of(truth, within(truth.t, spans))
        self.part, self.first, self.last = scored_phase(truth)
        self.t, self.error, self.covariance = position_errors(
            odometry, truth, self.first, self.last
        )
        self.p = position_at(self.t, truth)
        self.nis = nis(residuals) if residuals is not None else np.empty(0)

    @cached_property
    def nees(self) -> np.ndarray:
        """Return the NEES of each error: (n,)."""
        return nees(self.error, self.covariance)

    @cached_property
    def attitude(self) -> dict[str, float]:
        """Return the errors of the attitude in the scored phase, see `attitude_figures`."""
        return attitude_figures(*self._whole, self.first, self.last)

    @property
    def rmse_3d(self) -> float:
        """Return the 3D RMSE, m, as in `row`."""
        return rms(np.linalg.norm(self.error, axis=1))

    @cached_property
    def series(self) -> ErrorSeries:
        """Return the errors of the whole recording."""
        return ErrorSeries(*self._whole)

    def phases(self) -> dict[str, dict[str, Any]]:
        """Return {name of the phase: figures, see `ErrorSeries.figures`}."""
        return {
            name: self.series.figures(*span, self._reach)
            for name, span in phases(self._whole[1]).items()
        }

    def row(self) -> dict[str, Any]:
        """Return the figures of the scored phase as a dict.

        "late_start": the run counts as diverged only because it started late. "ready_delay": s from
        the 100th TDOA to the first estimate, negative if the estimate came first.
        """
        out = {"flight": self.name, "part": self.part, **summary(self.error, self.nees, self.nis)}
        late = not len(self.t) or self.t[0] > self.first + START_GRACE
        lost = out["diverged"] or not len(self.t) or self.t[-1] < self.last - START_GRACE
        out["diverged"], out["late_start"] = bool(lost or late), bool(late and not lost)
        out["start_delay"] = float(max(0.0, self.t[0] - self.first)) if len(self.t) else math.inf
        out["ready_delay"] = self._ready_delay()
        out |= self.attitude
        return {**out, **coverage(self.error, self.covariance)}

    def _ready_delay(self) -> float:
        """Return the seconds from the 100th TDOA to the first estimate.

        NaN with fewer TDOAs or unknown TDOAs; inf without an estimate.
        """
        stamps = self._whole[0].t
        if self._heard is None or len(self._heard) < READY:
            return math.nan
        return float(stamps[0] - np.sort(self._heard)[READY - 1]) if len(stamps) else math.inf

    def result(self) -> Result:
        """Return the Result of this run, from which `Pool` makes the figures of many runs."""
        distance = np.linalg.norm(self.error, axis=1)
        samples = {"distance": distance, "nees": self.nees, "nis": self.nis}
        of_samples = {name: Distribution.of(values) for name, values in samples.items()}
        return Result(self.row(), of_samples, self.phases())


def pooled(scores: Iterable[Score]) -> dict[str, Any]:
    """Return the figures of all samples of several Scores together, see `Pool.figures`."""
    pool = Pool()
    for score in scores:
        pool.add(score.result())
    return pool.figures()
