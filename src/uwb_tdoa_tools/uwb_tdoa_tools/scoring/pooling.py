# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of one run as a record of fixed size, and figures of several runs together."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from ..choices import ALIGN
from ..outputs import as_json
from .phases import TITLES

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


class PooledErrors:
    """The figures of one phase, pooled over runs."""

    def __init__(self) -> None:
        self._columns: dict[str, list[float]] = defaultdict(list)  # of the runs

    def add(self, figures: dict[str, Any]) -> None:
        """Count the figures of one run, see `ErrorSeries.figures`."""
        for name in (*WHOLE, *ROOTS, "nees_mean", "max_3d", "step"):
            self._columns[name].append(figures[name])

    def figures(self) -> dict[str, Any]:
        """Return the figures of all samples, and median and maximum over the runs, as a dict."""
        of_runs = {name: np.array(values) for name, values in self._columns.items()}
        count = of_runs["count"]
        total = count.sum()
        out: dict[str, Any] = {"runs": len(count)}
        out |= {name: of_runs[name].sum().item() for name in WHOLE}
        some = {name: values[count > 0] for name, values in of_runs.items()}
        shares = some["count"] / max(total, 1)
        for name in ROOTS:
            out[name] = math.sqrt(shares @ some[name] ** 2) if total else math.nan
        out["nees_mean"] = float(shares @ some["nees_mean"]) if total else math.nan
        for name in ("max_3d", "step"):
            out[name] = or_nan(np.max, some[name])
        for name in ("rmse_3d", "nees_mean"):
            out[f"{name}_median_of_runs"] = or_nan(np.median, some[name])
            out[f"{name}_max_of_runs"] = or_nan(np.max, some[name])
        return out


@dataclass(frozen=True)
class Result:
    """One run as a record whose size does not depend on its length.

    Attributes
    ----------
    row : figures, see `Score.row`.
    sums : {name: sum over the samples}.
    distributions : {quantity: Distribution}.
    phases : figures of each phase, see `Score.phases`.
    aligned : `Alignment.as_dict` and the 3D RMSE, m, with each of ALIGN; empty if not computed.
    """

    row: dict[str, Any]
    sums: dict[str, float]
    distributions: dict[str, Distribution]
    phases: dict[str, dict[str, Any]]
    aligned: dict[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return all figures of the run for JSON; NaN becomes null."""
        return as_json({**self.row, "phases": self.phases, "aligned": self.aligned})


class Pool:
    """Pool the samples of several runs, one run after the other."""

    def __init__(self) -> None:
        self._rows: dict[str, list[float]] = defaultdict(list)  # figures of the runs
        self._sums: dict[str, Any] = Counter()  # numbers, some of them float
        self._distributions = {name: Distribution.of([]) for name in ("distance", "nees", "nis")}
        self._phases: dict[str, PooledErrors] = defaultdict(PooledErrors)
        self._aligned: dict[str, Any] = Counter()
        self.attitudes: dict[str, tuple[float, ...]] = {}  # {flight: ATTITUDE} where it is known

    def add(self, result: Result) -> None:
        """Count the Result of one run."""
        for name in ("rmse_3d", "start_delay", "ready_delay", "diverged", "late_start"):
            self._rows[name].append(result.row[name])
        attitude = tuple(result.row[name] for name in ATTITUDE)
        if not math.isnan(attitude[2]):
            self.attitudes[result.row["flight"]] = attitude
        self._sums.update(result.sums)
        for name, part in result.distributions.items():
            self._distributions[name] += part
        for name, figures in result.phases.items():
            self._phases[name].add(figures)
        for how in ALIGN if result.aligned else ():
            error = result.aligned[f"rmse_3d_{how}"]
            self._aligned[how] += math.nan if error is None else error

    @property
    def aligned(self) -> dict[str, float]:
        """Return {one of ALIGN: mean 3D RMSE of the runs, m}; NaN for a truth on another clock."""
        return {how: total / len(self._rows["rmse_3d"]) for how, total in self._aligned.items()}

    def phases(self) -> dict[str, dict[str, Any]]:
        """Return {name: figures, see `PooledErrors.figures`} of the phases that any run has."""
        return {name: self._phases[name].figures() for name in TITLES if name in self._phases}

    def figures(self) -> dict[str, Any]:
        """Return the figures of at least one run as a dict.

        They are those of `summary`, the coverage, mean and maximum of the 3D RMSE over runs, and
        the phases. Medians of samples are accurate to 1 %.
        """
        distance, errors = self._distributions["distance"], self._rows["rmse_3d"]
        count = distance.count
        shares = {name: total / count if count else math.nan for name, total in self._sums.items()}
        out: dict[str, Any] = {"flight": f"{len(errors)} pooled"}
        out |= {
            f"rmse_{name}": math.sqrt(shares[f"square_{name}"]) for name in ("x", "y", "z", "3d")
        }
        out |= {"median_3d": distance.median, "max_3d": distance.largest if count else math.nan}
        out["frac_gt_1m"] = shares["lost"] if count else 1.0
        for name in ("nees", "nis"):
            part = self._distributions[name]
            out |= {f"{name}_mean": part.mean, f"{name}_median": part.median}
        out |= {name: shares.get(name, math.nan) for name in COVERAGE}
        out["start_delay"] = max(self._rows["start_delay"])
        out["ready_delay"] = float(np.fmax.reduce(self._rows["ready_delay"]))  # NaN if unknown
        out |= {name: sum(self._rows[name]) for name in ("diverged", "late_start")}
        out["rmse_3d_mean_of_runs"] = sum(errors) / len(errors)
        out["rmse_3d_max_of_runs"] = float(np.max(errors))
        return {**out, "phases": self.phases()}
