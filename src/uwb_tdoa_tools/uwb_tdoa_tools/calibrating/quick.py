"""What a calibration is likely to bring, from a part of the flights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.wording import listed
from uwb_tdoa_bias.foundation.flight import Truth

from ..diagnosis.references import Nothing
from ..diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from ..diagnosis.self_calibration.solve import IMPROVED
from ..estimate import FlightEstimator
from .parts import between

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

SECONDS = 60.0  # of a flight that are looked at
MOVES = (
    0.25  # of the extent of the anchors that a path must have along an axis to tell much of them
)
ENOUGH = 0.5  # of the coordinates that must become known better


@dataclass(frozen=True, eq=False)
class Prospect:
    """seconds : s in the air that were looked at, and `total` that there are; given, expected : (N,
    3) m, standard deviations of the anchors before, and as they are to be expected of all flights;
    before, left : m, of the slow innovations; path : (3,) m, its extent;
    hall : (3,) m, of the anchors; axes : names of those that it can move along, "xy" on a floor;
    ids : of the anchors; why_not : what keeps a survey from being
        applied so far, or None.
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
        """(N, 3) bool: coordinates that are to become known better."""
        return self.expected < IMPROVED * self.given

    @property
    def exciting(self) -> bool:
        """Whether the flights tell enough."""
        return bool(self.better.mean() >= ENOUGH)

    def sentences(self) -> list[str]:
        """For people."""
        lines = [
            f"from {self.seconds:.0f} s of {self.total:.0f} s in motion: of the innovations "
            f"{100 * self.before:.1f} cm are slow with the anchors as "
            f"given, and {100 * self.left:.1f} cm with others",
            f"all flights are likely to tell {int(self.better.sum())} of {self.better.size} "
            "coordinates better: "
            f"{100 * np.median(self.expected):.0f} cm in the median instead of "
            f"{100 * np.median(self.given):.0f} cm",
        ]
        if self.why_not:
            lines.append(f"so far nothing would be applied: {self.why_not}")
        unseen = [str(i) for i, row in zip(self.ids, self.better) if not row.any()]
        if unseen:
            lines.append(
                f"nothing is told of anchors {listed(unseen)}: move closer to them, on all "
                "sides, high and low"
            )
        for axis, size, room in zip(self.axes, self.path, self.hall):
            if size < MOVES * room:
                lines.append(
                    f"along {axis} the tag moves by {size:.1f} m among anchors that are "
                    f"{room:.1f} m apart: move over more of it"
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
    """Prospect of a calibration of Flights without their ground truth.

    Raises InputError where they are too short to say.
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
    """s in which a Flight is located."""
    return flight.end - flight.start


def _expected(found: SelfCalibration, more: float) -> np.ndarray:
    """(N, 3) m: standard deviations after `more` times what was looked at for a SelfCalibration, as
    its information adds up.
    """
    prior = np.linalg.inv(found.prior.covariance)
    values, vectors = np.linalg.eigh(np.linalg.inv(found.solution.covariance) - prior)
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    covariance = np.linalg.inv(prior + more * information)
    return np.sqrt(np.diag(covariance))[: 3 * len(found.given)].reshape(-1, 3)
