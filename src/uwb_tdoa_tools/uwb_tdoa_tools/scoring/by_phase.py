"""How right an estimate is in each phase of a recording: figures of one run, and of several
together.
"""

from __future__ import annotations

from collections import Counter
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from .distribution import Distribution

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    Spans = Sequence[tuple[float, float]]  # from when to when, s

VALID_FOR = (
    0.1  # s, and SPARSE times the usual interval of the odometry, that an estimate stands for
)
SPARSE = 4.0
EVERYTHING = ((-math.inf, math.inf),)  # spans, s


class ErrorSeries:
    """Errors of an odometry wherever there is ground truth. t (n,) s; error (n, 3) m; nees (n,);
    covariance (n, 3, 3) m^2; step (n,) m, by how much the error differs from that of the estimate
    before, 0 for the first; known : [(begin, end)], s, with ground truth;
    covered : [(begin, end)], s, for which there is an estimate.
    """

    def __init__(
        self,
        t: np.ndarray,
        error: np.ndarray,
        covariance: np.ndarray,
        normalised: np.ndarray,
        stamps: np.ndarray,
        known: np.ndarray,
    ) -> None:
        """stamps (m,) : of the odometry, s, including those that cannot be judged."""
        self.t, self.error, self.covariance, self.nees, self.known = (
            t,
            error,
            covariance,
            normalised,
            known,
        )
        self.step = np.linalg.norm(np.diff(error, axis=0, prepend=error[:1]), axis=1)
        usual = np.median(np.diff(stamps)) if len(stamps) > 1 else 0.0
        ends = stamps + max(VALID_FOR, SPARSE * usual)
        self.covered = np.column_stack([stamps, np.minimum(ends, np.append(stamps[1:], np.inf))])

    def figures(self, begin: float, end: float, spans: Spans = EVERYTHING) -> dict[str, Any]:
        """A dict of one phase, from `begin` to `end`, s; what is not in `spans`, ((first, last),
        ...) s, does not count.
        """
        parts = [(max(begin, first), min(end, last)) for first, last in spans]
        parts = [(first, last) for first, last in parts if last > first]
        chosen = (
            np.any([(self.t >= first) & (self.t <= last) for first, last in parts], axis=0)
            if parts
            else np.zeros(len(self.t), bool)
        )
        error, duration = self.error[chosen], sum(last - first for first, last in parts)
        distance = np.linalg.norm(error, axis=1)
        out: dict[str, Any] = {"begin": begin, "duration": duration, "count": int(chosen.sum())}
        out |= {f"rmse_{axis}": rms(error[:, k]) for k, axis in enumerate("xyz")}
        out |= {"rmse_3d": rms(distance), "max_3d": or_nan(np.max, distance)}
        out["std_3d"] = or_nan(
            lambda P: np.sqrt(np.mean(np.einsum("nii->n", P))), self.covariance[chosen]
        )
        out["nees_mean"], out["step"] = (
            or_nan(np.mean, self.nees[chosen]),
            or_nan(np.max, self.step[chosen]),
        )
        for name, covered in (("without_estimate", self.covered), ("without_truth", self.known)):
            out[name] = max(
                0.0, duration - sum(_overlap(covered, first, last) for first, last in parts)
            )
        return out


class PooledErrors:
    """The figures of one phase of several runs, one run after the other."""

    def __init__(self) -> None:
        self._runs, self._largest = 0, {"max_3d": math.nan, "step": math.nan}
        self._sums: dict[str, Any] = Counter()  # of numbers, not all of them whole
        self._of_runs = {name: Distribution.of([]) for name in ("rmse_3d", "nees_mean")}

    def add(self, figures: dict[str, Any]) -> None:
        """Count the figures of one run."""
        count, self._runs = figures["count"], self._runs + 1
        added = {
            name: figures[name]
            for name in ("duration", "count", "without_estimate", "without_truth")
        }
        if count:
            added |= {
                name: count * figures[name] ** 2
                for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "std_3d")
            }
            added["nees_mean"] = count * figures["nees_mean"]
            self._largest = {
                name: _larger(known, figures[name]) for name, known in self._largest.items()
            }
            self._of_runs = {
                name: known + Distribution.of([figures[name]])
                for name, known in self._of_runs.items()
            }
        self._sums.update(added)

    def figures(self) -> dict[str, Any]:
        """A dict: those of `ErrorSeries.figures` of all samples, and median and largest of the
        runs'. Medians are right to 1 %.
        """
        sums, count = self._sums, self._sums["count"]
        out: dict[str, Any] = {"runs": self._runs, "duration": sums["duration"], "count": count}
        for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "std_3d"):
            out[name] = math.sqrt(sums[name] / count) if count else math.nan
        out["nees_mean"] = sums["nees_mean"] / count if count else math.nan
        out |= self._largest | {name: sums[name] for name in ("without_estimate", "without_truth")}
        for name, part in self._of_runs.items():
            out[f"{name}_median_of_runs"] = part.median
            out[f"{name}_max_of_runs"] = part.largest if part.count else math.nan
        return out


def _overlap(spans: np.ndarray, begin: float, end: float) -> float:
    """s of spans (n, 2) that lie from `begin` to `end`."""
    return float(
        np.sum(np.maximum(0.0, np.minimum(spans[:, 1], end) - np.maximum(spans[:, 0], begin)))
    )


def _larger(one: float, other: float) -> float:
    """The larger of two, of which the first is NaN where there was none."""
    return other if math.isnan(one) else float(np.max([one, other]))


def rms(values: np.ndarray) -> float:
    """Root mean square; NaN of nothing."""
    return or_nan(lambda v: np.sqrt(np.mean(v**2)), values)


def or_nan(function: Callable[[np.ndarray], float], values: np.ndarray) -> float:
    """function(values); NaN of nothing."""
    return float(function(values)) if len(values) else math.nan
