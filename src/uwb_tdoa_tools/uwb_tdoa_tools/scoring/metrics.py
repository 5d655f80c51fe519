"""How far an estimate is from ground truth, and whether its covariance is honest."""

from collections import Counter
from dataclasses import dataclass
import math

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.verdicts import REJECTED, USED

from .distribution import Distribution

AIRBORNE = 0.3  # m; errors count from the first to the last instant above this height
LOST = 1.0  # m; a larger error is no estimate
LOST_SHARE = 0.25  # of the airborne time; more is a diverged run
HOLE = 0.5  # s without a true pose, and SPARSE times their usual interval, over which none is interpolated
SPARSE = 4.0
START_GRACE = 1.0  # s into the airborne part by which the first estimate must have come


def airborne(truth):
    """(first, last) stamp of the truth, s, with z above 0.3 m. Raises InputError if it never is."""
    above = np.flatnonzero(truth.p[:, 2] > AIRBORNE)
    if len(above) == 0:
        raise InputError(f"truth: z never exceeds {AIRBORNE} m, so that no part of this flight counts; is it a flight?")
    return truth.t[above[0]], truth.t[above[-1]]


def position_at(t, truth):
    """True positions at stamps t (n,), s: (n, 3) m, linear in between."""
    return np.stack([np.interp(t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)


def position_errors(odometry, truth):
    """Errors over the airborne part, the truth interpolated to the stamps of the estimate, except in holes of it.

    Returns (t (n,) s, error (n, 3) m, covariance (n, 3, 3) m^2 of the position).
    """
    first, last = airborne(truth)
    chosen = (odometry.t >= first) & (odometry.t <= last) & ~_in_holes(odometry.t, truth.t)
    t = odometry.t[chosen]
    covariance = getattr(odometry, "covariance", getattr(odometry, "pose_covariance", None))
    return t, odometry.p[chosen] - position_at(t, truth), covariance[chosen, :3, :3]


def _in_holes(t, known):
    """Which stamps t (n,) s lie in holes between the stamps `known` (m,), s, of the truth: (n,) bool."""
    apart = np.diff(known)
    if not len(apart):
        return np.zeros(len(t), bool)
    k = np.clip(np.searchsorted(known, t, side="right") - 1, 0, len(apart) - 1)
    return (apart > max(HOLE, SPARSE * np.median(apart)))[k] & (t > known[k]) & (t < known[k + 1])


def nees(error, covariance):
    """Normalised estimation error squared, e' P^-1 e: (n,), expected 3 for an honest 3D covariance (Bar-Shalom et al.,
    Estimation with Applications to Tracking and Navigation, sec. 5.4)."""
    out = np.full(len(error), np.nan)
    usable = np.linalg.det(covariance) > 0.0
    solved = np.linalg.solve(covariance[usable], error[usable, :, None])[:, :, 0]
    out[usable] = np.einsum("ni,ni->n", error[usable], solved)
    return out


def nis(residuals):
    """Normalised innovation squared of every TDOA that reached the filter: (n,), expected 1."""
    reached = (residuals.verdict == USED) | (residuals.verdict == REJECTED)
    return residuals.innovation[reached] ** 2 / residuals.variance[reached]


def summary(errors, normalised, innovations):
    """The figures of one run, or of several pooled: errors (n, 3) m, NEES (n,), NIS (k,). A dict of floats."""
    distance = np.linalg.norm(errors, axis=1)
    finite = np.isfinite(distance)
    out = {f"rmse_{axis}": _rms(errors[:, k]) for k, axis in enumerate("xyz")}
    out["rmse_3d"] = _rms(distance)
    out["median_3d"], out["max_3d"] = _or_nan(np.median, distance), _or_nan(np.max, distance)
    out["frac_gt_1m"] = float(np.mean(~(distance <= LOST))) if len(distance) else 1.0
    out["diverged"] = bool(out["frac_gt_1m"] > LOST_SHARE or not finite.all())
    out["nees_mean"], out["nees_median"] = _or_nan(np.mean, normalised), _or_nan(np.median, normalised)
    out["nis_mean"], out["nis_median"] = _or_nan(np.mean, innovations), _or_nan(np.median, innovations)
    return out


def coverage(error, covariance, sigmas=3.0):
    """Share of errors within `sigmas` predicted standard deviations, per axis: (3,); honest and Gaussian: 0.997."""
    std = np.sqrt(np.einsum("nii->ni", covariance))
    return np.mean(np.abs(error) <= sigmas * std, axis=0) if len(error) else np.full(3, np.nan)


class Score:
    """Errors of one run against its ground truth.

    t (n,) s; p (n, 3) m, true positions; error (n, 3) m; covariance (n, 3, 3) m^2; first, last : s, in the air.
    """

    def __init__(self, name, odometry, truth, residuals=None):
        """name : of the flight; odometry : Odometry; truth : Truth; residuals : Residuals or None."""
        self.name = name
        self.t, self.error, self.covariance = position_errors(odometry, truth)
        self.p = position_at(self.t, truth)
        self.first, self.last = airborne(truth)
        self.nees = nees(self.error, self.covariance)
        self.nis = nis(residuals) if residuals is not None else np.empty(0)

    def row(self):
        """The figures of this run: a dict. "late_start": nothing but that has made it a diverged run."""
        out = {"flight": self.name, **summary(self.error, self.nees, self.nis)}
        late = not len(self.t) or self.t[0] > self.first + START_GRACE
        lost = out["diverged"] or not len(self.t) or self.t[-1] < self.last - START_GRACE
        out["diverged"], out["late_start"] = bool(lost or late), bool(late and not lost)
        out["start_delay"] = float(max(0.0, self.t[0] - self.first)) if len(self.t) else float("inf")
        return {**out, **_named(coverage(self.error, self.covariance))}

    def result(self):
        """Result: this run as the figures of many need it."""
        distance, count = np.linalg.norm(self.error, axis=1), len(self.t)
        sums = {f"square_{axis}": float(np.sum(self.error[:, k] ** 2)) for k, axis in enumerate("xyz")}
        sums |= {"square_3d": float(np.sum(distance**2)), "lost": float(np.sum(~(distance <= LOST)))}
        if count:
            sums |= {name: count * share for name, share in _named(coverage(self.error, self.covariance)).items()}
        samples = {"distance": distance, "nees": self.nees, "nis": self.nis}
        return Result(self.row(), sums, {name: Distribution.of(values) for name, values in samples.items()})


@dataclass(frozen=True)
class Result:
    """What a run leaves for the figures of many, of a size that does not depend on its length. row : Score.row; sums : {name: sum
    over its samples}; distributions : {quantity: Distribution}."""

    row: dict
    sums: dict
    distributions: dict

    def as_dict(self):
        """For JSON, without loss."""
        parts = {name: part.as_list() for name, part in self.distributions.items()}
        return {"row": _as_texts(self.row), "sums": _as_texts(self.sums), "distributions": parts}

    @classmethod
    def from_dict(cls, content):
        """Of what `as_dict` gives."""
        parts = {name: Distribution.from_list(numbers) for name, numbers in content["distributions"].items()}
        return cls(_from_texts(content["row"]), _from_texts(content["sums"]), parts)


class Pool:
    """The figures of all samples of several runs together, one run after the other."""

    def __init__(self):
        self._sums, self._distributions, self._runs, self._total, self._largest = Counter(), {}, 0, 0.0, 0.0
        self._row = {"start_delay": 0.0, "diverged": 0, "late_start": 0}

    def add(self, result):
        """Count a Result."""
        row, known = result.row, self._distributions
        self._runs += 1
        self._sums.update(result.sums)
        self._distributions = {name: known[name] + part if name in known else part for name, part in result.distributions.items()}
        self._total, self._largest = self._total + row["rmse_3d"], float(np.max([self._largest, row["rmse_3d"]]))
        self._row["start_delay"] = max(self._row["start_delay"], row["start_delay"])
        for key in ("diverged", "late_start"):
            self._row[key] += row[key]

    def figures(self):
        """A dict: those of `summary`, coverage, mean and largest of the runs' 3D RMSE. Medians are right to 1 %. Of one run at least."""
        distance, count = self._distributions["distance"], self._distributions["distance"].count
        shares = {name: total / count if count else math.nan for name, total in self._sums.items()}
        out = {"flight": f"{self._runs} pooled"}
        out |= {f"rmse_{name}": math.sqrt(shares[f"square_{name}"]) for name in ("x", "y", "z", "3d")}
        out |= {"median_3d": distance.median, "max_3d": distance.largest if count else math.nan}
        out["frac_gt_1m"] = shares["lost"] if count else 1.0
        for name in ("nees", "nis"):
            part = self._distributions[name]
            out |= {f"{name}_mean": part.mean, f"{name}_median": part.median}
        out |= {name: shares.get(name, math.nan) for name in _named(np.zeros(3))} | self._row
        out["rmse_3d_mean_of_runs"], out["rmse_3d_max_of_runs"] = self._total / self._runs, self._largest
        return out


def pooled(scores):
    """The figures of all samples of several Scores together, see Pool: a dict."""
    pool = Pool()
    for score in scores:
        pool.add(score.result())
    return pool.figures()


def as_json(row):
    """JSON has no NaN and no infinity: null."""
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()}


def _as_texts(numbers):
    """Floats as texts: JSON has no NaN."""
    return {key: repr(value) if isinstance(value, float) else value for key, value in numbers.items()}


def _from_texts(numbers):
    return {key: float(value) if isinstance(value, str) and key != "flight" else value for key, value in numbers.items()}


def _named(shares):
    return {f"coverage_3sigma_{axis}": float(share) for axis, share in zip("xyz", shares)}


def _rms(values):
    return _or_nan(lambda v: np.sqrt(np.mean(v**2)), values)


def _or_nan(function, values):
    return float(function(values)) if len(values) else float("nan")
