"""How far an estimate is from ground truth, and whether its covariance is honest."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from uwb_tdoa_bias.effects.samples import PoseColumns
from uwb_tdoa_ekf.core.verdicts import COMPENSATED, REJECTED, USED
from uwb_tdoa_ekf.results import rows_of

from ..outputs import as_json
from .by_phase import EVERYTHING, ErrorSeries, PooledErrors, or_nan, rms
from .distribution import Distribution
from .phases import TITLES, in_the_air, motion, phases

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uwb_tdoa_bias.foundation.flight import Truth
    from uwb_tdoa_ekf.results import Residuals

    from .by_phase import Spans


class Estimate(PoseColumns, Protocol):
    """Poses, and how far to trust them: covariance (n, k, k), its first three rows and columns of
    the position, m^2.
    """

    @property
    def covariance(self) -> np.ndarray: ...


ALIGN = "none", "time", "frame"  # what of a ground truth is moved before it judges
LOST = 1.0  # m; a larger error is no estimate
LOST_SHARE = 0.25  # of the airborne time; more is a diverged run
# s without a true pose, and SPARSE times their usual interval, over which none is interpolated
HOLE = 0.5
SPARSE = 4.0
START_GRACE = 1.0  # s into the airborne part by which the first estimate must have come
FIGURES = 3  # version of what a Result holds
READY = 100  # TDOAs that a filter may take to begin with


def judged_part(truth: Truth) -> tuple[str, float, float]:
    """(name, first, last) of the phase that the figures of a whole run are of: in the air; moving,
    where that never is; or all, where the tag does not move at all.
    """
    found = {
        "in_the_air": in_the_air(truth),
        "moving": motion(truth),
        "whole": (truth.t[0], truth.t[-1]),
    }
    name, (first, last) = next((name, span) for name, span in found.items() if span)
    return name, first, last


def position_at(t: np.ndarray, truth: PoseColumns) -> np.ndarray:
    """True positions at stamps t (n,), s: (n, 3) m, linear in between."""
    return np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)


def position_errors(
    odometry: Estimate, truth: Truth, first: float, last: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors from `first` to `last`, s, the truth interpolated to the stamps of the estimate,
    except in holes of it.

    Returns (t (n,) s, error (n, 3) m, covariance (n, 3, 3) m^2 of the position).
    """
    chosen = (odometry.t >= first) & (odometry.t <= last) & ~_in_holes(odometry.t, truth.t)
    t = odometry.t[chosen]
    return t, odometry.p[chosen] - position_at(t, truth), odometry.covariance[chosen, :3, :3]


def _in_holes(t: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which stamps t (n,) s lie in holes between the stamps `known` (m,), s, of the truth: (n,)
    bool.
    """
    if len(known) < 2:
        return np.zeros(len(t), bool)
    k = np.clip(np.searchsorted(known, t, side="right") - 1, 0, len(known) - 2)
    return _holes(known)[k] & (t > known[k]) & (t < known[k + 1])


def _holes(known: np.ndarray) -> np.ndarray:
    """After which of the stamps `known` (m,), s, of a truth is a hole: (m - 1,) bool."""
    apart = np.diff(known)
    return apart > max(HOLE, SPARSE * np.median(apart)) if len(apart) else np.zeros(0, bool)


def _known_spans(known: np.ndarray) -> np.ndarray:
    """(k, 2) s: from where to where the stamps `known` (m,), s, of a truth have no holes."""
    last = np.append(_holes(known), True)
    return np.column_stack([known[np.append(True, last[:-1])], known[last]])


def _inside(part: Any, spans: Spans) -> Any:
    """What of a Truth or an Odometry is stamped within spans ((first, last), ...), s."""
    if not (np.diff(part.t) >= 0.0).all():
        return rows_of(
            part, np.any([(part.t >= first) & (part.t <= last) for first, last in spans], axis=0)
        )
    inside = np.zeros(len(part.t), bool)
    for first, last in spans:
        inside[np.searchsorted(part.t, first) : np.searchsorted(part.t, last, side="right")] = True
    return rows_of(part, inside)


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Normalised estimation error squared, e' P^-1 e: (n,), expected 3 for an honest 3D covariance
    (Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, sec. 5.4).
    """
    out = np.full(len(error), np.nan)
    usable = np.linalg.det(covariance) > 0.0
    solved = np.linalg.solve(covariance[usable], error[usable, :, None])[:, :, 0]
    out[usable] = np.einsum("ni,ni->n", error[usable], solved)
    return out


def nis(residuals: Residuals) -> np.ndarray:
    """Normalised innovation squared of every measurement that reached the filter, outliers in full:
    (n,), expected 1.
    """
    there = reached(residuals)
    return residuals.innovation[there] ** 2 / residuals.variance[there]


def reached(residuals: Residuals) -> np.ndarray:
    """Which measurements had a residual in the filter: (n,) bool."""
    return np.isin(residuals.verdict, (USED, REJECTED, COMPENSATED))


def summary(errors: np.ndarray, normalised: np.ndarray, innovations: np.ndarray) -> dict[str, Any]:
    """The figures of one run, or of several pooled: errors (n, 3) m, NEES (n,), NIS (k,).

    A dict of floats.
    """
    distance = np.linalg.norm(errors, axis=1)
    finite = np.isfinite(distance)
    out = {f"rmse_{axis}": rms(errors[:, k]) for k, axis in enumerate("xyz")}
    out["rmse_3d"] = rms(distance)
    out["median_3d"], out["max_3d"] = or_nan(np.median, distance), or_nan(np.max, distance)
    out["frac_gt_1m"] = float(np.mean(~(distance <= LOST))) if len(distance) else 1.0
    out["diverged"] = bool(out["frac_gt_1m"] > LOST_SHARE or not finite.all())
    out["nees_mean"], out["nees_median"] = (
        or_nan(np.mean, normalised),
        or_nan(np.median, normalised),
    )
    out["nis_mean"], out["nis_median"] = (
        or_nan(np.mean, innovations),
        or_nan(np.median, innovations),
    )
    return out


def coverage(error: np.ndarray, covariance: np.ndarray, sigmas: float = 3.0) -> np.ndarray:
    """Share of errors within `sigmas` predicted standard deviations, per axis: (3,); honest and
    Gaussian: 0.997.
    """
    std = np.sqrt(np.einsum("nii->ni", covariance))
    return np.mean(np.abs(error) <= sigmas * std, axis=0) if len(error) else np.full(3, np.nan)


class Score:
    """Errors of one run against its ground truth.

    part : what they are of, see judged_part; t (n,) s; p (n, 3) m, true positions; error (n, 3) m;
        covariance (n, 3, 3) m^2;
    first, last : s, of that part.
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
        """name : of the flight; odometry : Odometry; truth : Truth; residuals : Residuals or None;
        heard : (n,) s, stamps of the TDOAs, or None; spans : ((first, last), ...) s, what of the
        part counts, None for all; reach : the same of the phases.
        """
        self.name, self._whole, self._heard, self._reach = name, (odometry, truth), heard, reach
        if (
            spans is not None
        ):  # both, as the truth would be interpolated over what lies between spans
            truth, odometry = (_inside(part, spans) for part in (truth, odometry))
        self.part, self.first, self.last = judged_part(truth)
        self.t, self.error, self.covariance = position_errors(
            odometry, truth, self.first, self.last
        )
        self.p = position_at(self.t, truth)
        self.nis = nis(residuals) if residuals is not None else np.empty(0)

    @cached_property
    def nees(self) -> np.ndarray:
        """(n,), of each error."""
        return nees(self.error, self.covariance)

    @property
    def rmse_3d(self) -> float:
        """m: that of `row`, alone."""
        return rms(np.linalg.norm(self.error, axis=1))

    @cached_property
    def series(self) -> ErrorSeries:
        """ErrorSeries: the errors of all of the recording."""
        odometry, truth = self._whole
        t, error, covariance = position_errors(odometry, truth, truth.t[0], truth.t[-1])
        return ErrorSeries(
            t, error, covariance, nees(error, covariance), odometry.t, _known_spans(truth.t)
        )

    def phases(self) -> dict[str, dict[str, Any]]:
        """The figures of each phase of this run: {name: dict of `ErrorSeries.figures`}."""
        return {
            name: self.series.figures(*span, self._reach)
            for name, span in phases(self._whole[1]).items()
        }

    def row(self) -> dict[str, Any]:
        """The figures of this run, of its part: a dict. "late_start": nothing but that has made it
        a diverged run; "ready_delay": s from the 100th TDOA to the first estimate, below 0 if that
        came before.
        """
        out = {"flight": self.name, "part": self.part, **summary(self.error, self.nees, self.nis)}
        late = not len(self.t) or self.t[0] > self.first + START_GRACE
        lost = out["diverged"] or not len(self.t) or self.t[-1] < self.last - START_GRACE
        out["diverged"], out["late_start"] = bool(lost or late), bool(late and not lost)
        out["start_delay"] = float(max(0.0, self.t[0] - self.first)) if len(self.t) else math.inf
        out["ready_delay"] = self._ready_delay()
        return {**out, **_named(coverage(self.error, self.covariance))}

    def _ready_delay(self) -> float:
        """s from the 100th TDOA to the first estimate; NaN where nobody knows the TDOAs, or there
        are fewer, inf without an estimate.
        """
        stamps = self._whole[0].t
        if self._heard is None or len(self._heard) < READY:
            return math.nan
        return float(stamps[0] - np.sort(self._heard)[READY - 1]) if len(stamps) else math.inf

    def result(self) -> Result:
        """Result: this run as the figures of many need it."""
        distance, count = np.linalg.norm(self.error, axis=1), len(self.t)
        sums = {
            f"square_{axis}": float(np.sum(self.error[:, k] ** 2)) for k, axis in enumerate("xyz")
        }
        sums |= {
            "square_3d": float(np.sum(distance**2)),
            "lost": float(np.sum(~(distance <= LOST))),
        }
        if count:
            sums |= {
                name: count * share
                for name, share in _named(coverage(self.error, self.covariance)).items()
            }
        samples = {"distance": distance, "nees": self.nees, "nis": self.nis}
        return Result(
            self.row(),
            sums,
            {name: Distribution.of(values) for name, values in samples.items()},
            self.phases(),
        )


@dataclass(frozen=True)
class Result:
    """What a run leaves for the figures of many, of a size that does not depend on its length. row
    : Score.row; sums : {name: sum over its samples}; distributions : {quantity: Distribution};
    phases : Score.phases; aligned : where its ground truth is beside the estimate, as of
    `Alignment.as_dict`, and its 3D RMSE with each of ALIGN, m; {} where nobody looked.
    """

    row: dict[str, Any]
    sums: dict[str, float]
    distributions: dict[str, Distribution]
    phases: dict[str, dict[str, Any]]
    aligned: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON, without loss."""
        parts = {name: part.as_list() for name, part in self.distributions.items()}
        of_phases = {name: _as_texts(figures) for name, figures in self.phases.items()}
        return {
            "row": _as_texts(self.row),
            "sums": _as_texts(self.sums),
            "distributions": parts,
            "phases": of_phases,
            "aligned": as_json(self.aligned),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Result:
        """Of what `as_dict` gives."""
        parts = {
            name: Distribution.from_list(numbers)
            for name, numbers in content["distributions"].items()
        }
        of_phases = {name: _from_texts(figures) for name, figures in content["phases"].items()}
        return cls(
            _from_texts(content["row"]),
            _from_texts(content["sums"]),
            parts,
            of_phases,
            content["aligned"],
        )

    def as_json(self) -> dict[str, Any]:
        """All figures of the run, as JSON takes them."""
        return as_json({**self.row, "phases": self.phases, "aligned": self.aligned})


class Pool:
    """The figures of all samples of several runs together, one run after the other."""

    def __init__(self) -> None:
        self._sums: dict[str, Any] = Counter()  # of numbers, not all of them whole
        self._distributions: dict[str, Distribution] = {}
        self._runs, self._total, self._largest = 0, 0.0, 0.0
        self._row: dict[str, Any] = {"start_delay": 0.0, "diverged": 0, "late_start": 0}
        self._ready = math.nan
        self._phases: dict[str, PooledErrors] = {}
        self._aligned: dict[str, Any] = Counter()

    def add(self, result: Result) -> None:
        """Count a Result."""
        row, known = result.row, self._distributions
        self._runs += 1
        self._sums.update(result.sums)
        self._distributions = {
            name: known[name] + part if name in known else part
            for name, part in result.distributions.items()
        }
        self._total, self._largest = (
            self._total + row["rmse_3d"],
            float(np.max([self._largest, row["rmse_3d"]])),
        )
        self._row["start_delay"] = max(self._row["start_delay"], row["start_delay"])
        self._ready = float(
            np.fmax(self._ready, row["ready_delay"])
        )  # NaN of those that cannot tell
        for key in ("diverged", "late_start"):
            self._row[key] += row[key]

        for how in ALIGN if result.aligned else ():
            error = result.aligned[f"rmse_3d_{how}"]
            self._aligned[how] += math.nan if error is None else error
        for name, figures in result.phases.items():
            self._phases.setdefault(name, PooledErrors()).add(figures)

    @property
    def aligned(self) -> dict[str, float]:
        """{one of ALIGN: mean 3D RMSE of the runs, m, with that of their ground truth moved}; NaN
        where it is of another clock.
        """
        return {how: total / self._runs for how, total in self._aligned.items()}

    def phases(self) -> dict[str, dict[str, Any]]:
        """{name of a phase: dict of `PooledErrors.figures`}, of those that any of the runs has."""
        return {name: self._phases[name].figures() for name in TITLES if name in self._phases}

    def figures(self) -> dict[str, Any]:
        """A dict: those of `summary`, coverage, mean and largest of the runs' 3D RMSE, phases.
        Medians are right to 1 %. Of one run at least.
        """
        distance, count = self._distributions["distance"], self._distributions["distance"].count
        shares = {name: total / count if count else math.nan for name, total in self._sums.items()}
        out: dict[str, Any] = {"flight": f"{self._runs} pooled"}
        out |= {
            f"rmse_{name}": math.sqrt(shares[f"square_{name}"]) for name in ("x", "y", "z", "3d")
        }
        out |= {"median_3d": distance.median, "max_3d": distance.largest if count else math.nan}
        out["frac_gt_1m"] = shares["lost"] if count else 1.0
        for name in ("nees", "nis"):
            part = self._distributions[name]
            out |= {f"{name}_mean": part.mean, f"{name}_median": part.median}
        out |= (
            {name: shares.get(name, math.nan) for name in _named(np.zeros(3))}
            | self._row
            | {"ready_delay": self._ready}
        )
        out["rmse_3d_mean_of_runs"], out["rmse_3d_max_of_runs"] = (
            self._total / self._runs,
            self._largest,
        )
        return {**out, "phases": self.phases()}


def pooled(scores: Iterable[Score]) -> dict[str, Any]:
    """The figures of all samples of several Scores together, see Pool: a dict."""
    pool = Pool()
    for score in scores:
        pool.add(score.result())
    return pool.figures()


def _as_texts(numbers: dict[str, Any]) -> dict[str, Any]:
    """Floats as texts: JSON has no NaN."""
    return {
        key: repr(value) if isinstance(value, float) else value for key, value in numbers.items()
    }


def _from_texts(numbers: dict[str, Any]) -> dict[str, Any]:
    """Of what `_as_texts` gives; those that were texts before stay."""
    return {
        key: float(value) if isinstance(value, str) and key not in ("flight", "part") else value
        for key, value in numbers.items()
    }


def _named(shares: np.ndarray) -> dict[str, float]:
    return {f"coverage_3sigma_{axis}": float(share) for axis, share in zip("xyz", shares)}
