# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Figures of one run as a record of fixed size, figures of several runs together, and how they change."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from ..choices import ALIGN
from ..cli import as_json
from .phases import TITLES

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
