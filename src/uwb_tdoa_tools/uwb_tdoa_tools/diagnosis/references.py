# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""References: the paths that flights are compared with, and their known coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Truth
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.sensor import shifted
from uwb_tdoa_ekf.core import auxiliary
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import without_unknown_offset
from uwb_tdoa_ekf.smoother import RANGES, TDOAS, Innovations, record_innovations, smooth

from ..choices import NONE
from ..clock import grid
from ..scoring.evaluation import align_truth
from ..scoring.metrics import scored_phase
from ..scoring.phases import AIRBORNE, TITLES
from .constraints import Constraint, Mark, OdometryPath

MARGIN = 0.5  # s left out at both ends of the phase that is diagnosed
SHORTEST = 5.0  # s that can be diagnosed
# smallest share of the stamps in the air, from the first to the last such stamp, of a vehicle that flies
FLOWN_SHARE = 0.25
TRUTHS = "_truth"  # end of the names of streams in which a simulation stores the truth
SPACING = 2.0  # s between the stamps at which an odometry is fitted
FEWEST = 5  # such stamps


@dataclass(frozen=True)
class ReferenceView:
    """The path of a flight by a reference.

    poses : Truth, known or estimated
    innovations : Innovations of the run that estimated the poses, None if they are known
    """

    poses: Truth
    innovations: Innovations | None = None


class Reference:
    """The path that flights are compared with; REFERENCES lists all kinds.

    `prepare` removes from a recording all that the reference must not use, before anything else
    reads it. By default it replaces the ground truth by the path that flights are compared with.
    """

    positions_known: ClassVar[tuple] = (True, True, True)  # x, y, z, world
    attitude_known: ClassVar[bool] = False
    knows_floor: ClassVar[bool] = False  # True: also before take-off and after landing
    tells_errors: ClassVar[bool] = True  # errors of the filter's positions are known with it
    left_out: ClassVar[tuple[str, ...]] = ()  # sensors that flights are not judged with
    words: str  # the reference, in reports

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
    ) -> None:
        """Take the FilterConfig of the filter that gives a path, and constraints."""
        self._config = config or FilterConfig()
        self.constraints = [one for one in constraints if not isinstance(one, OdometryPath)]

    def prepare(self, flight: Flight) -> Flight:
        """Return the Flight without all that must not be used.

        Raises InputError if it lacks the reference.
        """
        raise NotImplementedError

    def settled(
        self, flight: Flight, base: EffectSet, config: FilterConfig | None = None
    ) -> tuple[Flight, tuple[str, ...]]:
        """Return (the prepared Flight with obvious errors of the reference corrected, sentences).

        base : EffectSet of the model; config : FilterConfig
        """
        return flight, ()

    def view(self, flight: Flight, effects: EffectSet) -> ReferenceView:
        """Return the ReferenceView of a prepared Flight under the EffectSet `effects`."""
        truth = shifted(flight, "truth", -effects.stamp_offset("truth")).truth
        assert truth is not None  # `prepare` has refused a flight without
        return ReferenceView(truth)

    def shift_std(self, name: str) -> np.ndarray:
        """Return the standard deviation of the common shift of a prepared flight, (3,) m.

        name : of the flight
        """
        return np.zeros(3)

    def span(self, flight: Flight, poses: Truth) -> tuple[float, float]:
        """Return the (first, last) stamp, s, of the phase that is diagnosed.

        It is that of `scored_phase` (in the air, else in motion, else all) without MARGIN at both
        ends. Raises InputError if it is shorter than SHORTEST.
        flight : for its name; poses : Truth, known or estimated
        """
        phase, first, last = scored_phase(poses)
        least = SHORTEST + 2.0 * MARGIN
        if last - first < least:
            raise InputError(
                f"{flight.name}: {TITLES[phase]}: only {last - first:.1f} s; {least:g} s are needed."
            )
        return first + MARGIN, last - MARGIN


class GroundTruth(Reference):
    """The ground truth that the recording holds."""

    attitude_known = True
    knows_floor = True
    words = "the recorded ground truth"

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
        align: str = NONE,
    ) -> None:
        """Take `align`, as of `scoring.evaluation.align_truth`.

        The other arguments are not used.
        """
        super().__init__()
        self._align = align

    def prepare(self, flight: Flight) -> Flight:
        if flight.truth is None or len(flight.truth) < 2:
            raise InputError(
                f"{flight.name}: holds no ground truth to compare with; give --no-truth."
            )
        return flight

    def settled(
        self, flight: Flight, base: EffectSet, config: FilterConfig | None = None
    ) -> tuple[Flight, tuple[str, ...]]:
        return align_truth(flight, base, config, self._align)


def without_truth(flight: Flight) -> Flight:
    """Return the Flight without its ground truth."""
    extra = {name: stream for name, stream in flight.extra.items() if not name.endswith(TRUTHS)}
    return replace(flight, truth=None, extra=extra)


class Nothing(Reference):
    """No reference: the residuals are the innovations of the filter.

    They are of TDOAs, or of ranges in a flight without TDOAs. The estimate follows an effect in
    part, so regressors are computed for innovations. A common offset of all ranges is corrected
    first, because it bends the path; `self_calibrate` estimates it.
    """

    positions_known = (False, False, False)
    tells_errors = False
    words = "nothing but the flights themselves"

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint] = (),
        streams: Sequence[str] = (),
        derivatives: bool = True,
    ) -> None:
        """Run the filter with a FilterConfig.

        streams : with innovations that are residuals, as of `record_innovations`; the offset of
            ranges is kept then. By default as described above.
        derivatives : whether the innovations give derivatives, too
        """
        super().__init__(config, constraints)
        self._streams, self._derivatives = tuple(streams), derivatives

    def prepare(self, flight: Flight) -> Flight:
        return without_truth(flight)

    def on_floor(self, poses: Truth) -> bool:
        """Return whether estimated poses belong to a vehicle that never leaves the floor.

        The estimated height of such a vehicle exceeds AIRBORNE now and then, but not for long.
        """
        part, first, last = scored_phase(poses)
        if self._config.planar or part != "in_the_air":
            return True
        inside = (poses.t >= first) & (poses.t <= last)
        return bool(np.mean(poses.p[inside, 2] > AIRBORNE) < FLOWN_SHARE)

    def span(self, flight: Flight, poses: Truth) -> tuple[float, float]:
        if not len(poses):
            raise InputError(
                f"{flight.name}: its TDOAs give no estimate; record motion for longer."
            )
        flat = replace(poses, p=poses.p * [1.0, 1.0, 0.0]) if self.on_floor(poses) else poses
        return super().span(flight, flat)

    def view(self, flight: Flight, effects: EffectSet) -> ReferenceView:
        config, streams, by = self._config, self._streams, Corrector(flight.anchors, effects)
        if not streams:
            flight = without_unknown_offset(flight, config, by)
            config = replace(config, **auxiliary.NONE)  # the offset is corrected
            streams = (TDOAS,) if len(flight.tdoa) else (RANGES,)
        innovations = record_innovations(flight, config, by, streams, self._derivatives)
        estimate = innovations.run.odometry
        return ReferenceView(Truth(estimate.t, estimate.p, estimate.q), innovations)


class Marks(Nothing):
    """Marks as constraints; the residuals are the innovations of the filter.

    With marks, positions and delays of anchors are observable.
    """

    words = "places measured beforehand where the tag stood or passed, and the flights themselves"


class Heights(Reference):
    """The smoothed path of a filter that uses the height; the diagnosed flight does not use it.

    Anchors at walls err mostly in z, and a height shows that. x and y of the path follow from
    uncorrected TDOAs: an error in x and y is not observable.
    """

    positions_known = (False, False, True)
    left_out = SENSOR_NAMES
    words = "heights that a range finder measured; x and y are the filter's own"

    def prepare(self, flight: Flight) -> Flight:
        if not self._config.use_height:  # type: ignore[attr-defined]  # as of SENSORS
            raise InputError(
                "--without height: --reference heights compares with it; give one of the two."
            )
        if flight.height is None or not len(flight.height):
            raise InputError(
                f"{flight.name}: holds no height to compare with; record a range finder, or "
                "give --no-truth."
            )
        alone = without_truth(flight)
        path = smooth(alone, self._config, Corrector(flight.anchors)).odometry
        return replace(alone.without(*self.left_out), truth=Truth(path.t, path.p, path.q))


class OdometryReference(Reference):
    """The path of another odometry, fitted to the path of the filter and to marks.

    Without marks a common shift and yaw of a flight are not observable: the filter sets them. Marks
    at take-off and landing are enough.
    """

    def __init__(
        self,
        config: FilterConfig | None = None,
        constraints: Sequence[Constraint | OdometryPath] = (),
    ) -> None:
        """Run the filter with a FilterConfig.

        constraints : OdometryPaths, and Marks on them
        """
        super().__init__(config, constraints)
        self._paths = {path.flight: path for path in constraints if isinstance(path, OdometryPath)}
        self._marks = [mark for mark in constraints if isinstance(mark, Mark)]
        self._shift_std: dict[str, float] = {}
        through = "laid beside the filter's path: a shift of all of a flight is not seen"
        if self._marks:
            through = "laid through marks"
        self.words = f"another odometry in a frame of its own, {through}"

    def prepare(self, flight: Flight) -> Flight:
        path = self._paths.get(flight.name)
        if path is None:
            raise InputError(
                f"{flight.name}: --odometry holds no path of it; record one, or give --no-truth."
            )
        alone = without_truth(flight)
        own = smooth(alone, self._config, Corrector(flight.anchors)).odometry
        # By the path alone: after a fit that is too high, the floor would count as air.
        first, last = path.aloft or (0.0, 0.0)
        chosen = (own.t >= first) & (own.t <= last)
        t = own.t[chosen]
        if len(t):
            t = grid(t[0], t[-1], SPACING, t)
        if len(t) < FEWEST:
            raise InputError(
                f"{flight.name}: its odometry is above the floor for {len(t)} stamps only; "
                "fly for half a minute."
            )
        estimate = np.stack([np.interp(t, own.t, column) for column in own.p.T], axis=1)
        marks = [mark for mark in self._marks if mark.flight == flight.name]
        begin = float(flight.tdoa.t[0])
        p, self._shift_std[flight.name] = path.laid(t, estimate, marks, begin, own.t[chosen])
        return replace(alone, truth=Truth(own.t[chosen], p, own.q[chosen]))

    def shift_std(self, name: str) -> np.ndarray:
        return np.full(3, self._shift_std[name])


# {value of --reference: kind}; each is made of a FilterConfig and constraints
REFERENCES = {
    "truth": GroundTruth,
    "heights": Heights,
    "marks": Marks,
    "odometry": OdometryReference,
    "nothing": Nothing,
}
