# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Watch the residuals for changes since the start of the flight and deviations from the survey.

The Monitor works live and on recordings. It detects an anchor that is late or early, drifts, is
silent, was exchanged with another, or was moved. It also detects a changed bias of an IMU axis.

The innovations of half a second become a Slice. A ChangeDetector compares each slice with earlier
slices. A SurveyComparison compares the slices with the survey and the calibration. Each finding is
reported until it no longer holds, and stays in the history.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
import math
from typing import NamedTuple, TypeVar

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects.effect_set import Covariance

from ..anchor_table import AnchorTable
from ..core.initialization import LOST_TIME
from ..core.memory import REJECTED
from ..results import Odometry, Residuals, concatenated, rows_of
from .anchor_watch import LENGTH, Displaced, Slice, SurveyComparison, reduced, turned
from .change_detector import Change, ChangeDetector
from .finding import WARNING, Finding
from .inertial_rules import AXES
from .judge import exchanged
from .mixed_ids import Order, Piece, clear_order, residuals as residuals_of, suspects

# m/s, speed above which the tag is in motion; on the floor, residuals differ from those in the air
MOVING = 0.3
SETTLE = 8.0  # s in motion before the search for an onset starts
# statistic (`Change.ratio`) above which an anchor has changed: a tenth above the largest of sound flights of
# two days, see docs/notebook/reliability.md
LIMIT = 16.3
CLEARLY = 1.4  # factor by which this ratio must exceed the ratio of any other anchor
# largest mean square of the unexplained errors since the onset, over that before. If more is left,
# something else has happened too, as on a floor.
MOST_LEFT = 1.0
# smallest share of accepted TDOAs in a slice. If the filter rejects more, as on a floor, the cause
# is no change of a single anchor.
FEWEST_ACCEPTED = 1 / 3
# m; a smaller change is negligible, and a change that returns below it is over
SMALLEST_CHANGE = 0.15
SILENT, FEWEST = 4, 40  # slices without an anchor, and TDOAs of the other anchors in them
OFTEN = 0.5  # smallest share of slices in which the anchor was heard before
FORGET = 60  # slices between two checks which anchors the tag passed long ago
# share of the distance of the farthest anchor that is heard, within which a silent anchor must be
NEARER = 0.8
TOGETHER = 4  # slices in which the search for an exchange looks
# consecutive slices or comparisons until a finding is reported, and until a reported exchange is
# over
NAMED, HELD = (4, 8)
# slices between two comparisons with the survey, and fewest slices of a comparison with recent data
LOOK, YOUNG = (4, 40)
# standard deviations by which an anchor must differ from the survey, in addition to SMALLEST_CHANGE.
# Evidence for a change of x says nothing about a height that is uncertain by half a metre.
SURE = 2.0
MARGIN = 0.5  # m, beyond the anchors up to which slices are compared with the survey
TURN_APART = 3.0  # s of stamps between two sign flips of all TDOAs
# share of accepted TDOAs of a slice where the filter is right, and s since then within which a sign
# flip must occur, because it is an event. Near a floor, TDOAs that are metres too long may
# permanently look as if they had the other sign.
MOST, AGREED = 0.5, 1.1
MOST_EVENTS = 1000  # events that are stored
CALIBRATE = 15.0  # s in motion after which the IMU biases are the reference
# change of an estimated bias that is reported, and its unit, for each of AXES
BIAS_LIMITS = [(0.03, "rad/s")] * 3 + [(0.6, "m/s^2")] * 3

SURVEYING = "survey RECORDING"  # command that estimates anchor positions


Part = TypeVar("Part", "Odometry", "Residuals")


class Heard(NamedTuple):
    """Store when an anchor was heard.

    Attributes
    ----------
    slices : int
        Number of slices in which the anchor was heard.
    last : int
        Number of the last such slice.
    farthest : float
        Largest distance of the tag when the anchor was heard, in m.
    """

    slices: int = 0
    last: int = 0
    farthest: float = 0.0


class Event(NamedTuple):
    """Store a finding with its time.

    Attributes
    ----------
    finding : Finding
        Latest form of the finding.
    since, until : float
        Stamps between which the finding held, in s.
    """

    finding: Finding
    since: float
    until: float


class Monitor:
    """Search odometry and residuals for changes.

    Call `add` with data and `update` with the stamp up to which they are complete. Then read
    `alarms` and `delays`.
    """

    def __init__(
        self, anchors: Anchors | AnchorTable, calibrated: Covariance | None = None
    ) -> None:
        """Create a monitor without data.

        Parameters
        ----------
        anchors : Anchors or AnchorTable
            Anchors; an AnchorTable may change later.
        calibrated : Covariance or None
            Covariance of anchor positions and delays from the last calibration.
        """
        self._anchors, self._calibrated = anchors, calibrated
        self._past: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._standing: dict[str, Event] = {}  # events that hold now, by key
        # number of sign flips of all TDOAs, and the stamp of the last, in s
        self.turns, self._turned = (0, -math.inf)
        self._agreed = -math.inf  # s, end of the last slice in which the filter accepted most TDOAs
        self.restart()

    def restart(self) -> None:
        """Reset everything that belongs to one flight, or to one calibration; the history stays."""
        # data of the current slice and later
        self._odometry: list[Odometry] = []
        self._residuals: list[Residuals] = []
        self._past += self._standing.values()
        self._standing = {}
        self._end: float | None = None  # s, stamp of the end of the current slice
        self._last = -math.inf  # s, stamp of the newest TDOA
        self._detector = ChangeDetector()
        self._displaced: dict[
            int, Displaced
        ] = {}  # {row: anchor that differs from the survey or calibration}
        # {row: consecutive comparisons that found this anchor}
        self._suspected: dict[int, int] = {}
        self._comparisons: list[SurveyComparison] = []
        self._compared = 0  # slices compared since the last restart
        self._compare_anew()
        self._changes: dict[
            int, list[Change]
        ] = {}  # {row: Changes of an anchor in flight that still hold}
        self._ever_changed: set[int] = set()  # rows of anchors that changed at any time
        self._latest_change: Change | None = None  # the newest change, whose size is refined
        # the last slices with large errors, and the rows of anchors whose ids may be wrong
        self._latest: list[tuple[Piece, set[int]]] = []
        self._slices = 0  # slices so far
        self._heard: dict[int, Heard] = {}  # by row of the anchor
        self._counts: list[int] = []  # TDOAs of the last slices
        self._swapped: Order = ()  # anchors whose ids are mixed up
        # number of the last slice with small errors or a clear order, and the position then, m
        self._known_place = -HELD, np.zeros(3)
        self._silent: tuple[int, ...] = ()
        # another order, or none, that slices suggest instead, and how many consecutive ones
        self._instead: tuple[Order, int] = ((), 0)
        self._moving_since = math.nan  # s, stamp of the first motion
        # (6,) biases of gyroscope, rad/s, and accelerometer, m/s^2, body: reference, and change
        self._bias, self._bias_moved = np.zeros((2, 6))

    def forget(self, gone: np.ndarray) -> None:
        """Remove anchors that are gone from all results and stored data.

        Parameters
        ----------
        gone : (k,) int array
            Rows of the anchors.
        """
        rows, ids = set(gone.tolist()), self._anchors.ids[gone]
        self._residuals = [
            rows_of(part, ~(np.isin(part.a, ids) | np.isin(part.b, ids)))
            for part in self._residuals
        ]
        self._heard = {row: was for row, was in self._heard.items() if row not in rows}
        self._changes = {row: found for row, found in self._changes.items() if row not in rows}
        self._silent = tuple(row for row in self._silent if row not in rows)
        self._displaced = {
            row: one.without(rows) for row, one in self._displaced.items() if row not in rows
        }
        for comparison in self._comparisons:
            comparison.forget(rows)
        if self._latest_change is not None and self._latest_change.row in rows:
            self._latest_change = None
        if rows & dict([*self._swapped, *self._instead[0]]).keys():
            self._swapped, self._instead, self._latest = (), ((), 0), []

    @property
    def end(self) -> float:
        """Return the end of the current slice as a stamp, in s; inf before the first TDOA."""
        return math.inf if self._end is None else self._end

    @property
    def delays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the delays of changed anchors now, (N,) m, and their variances, (N,) m^2."""
        delays, variances = np.zeros((2, len(self._anchors)))
        changed = [*self._changes]
        delays[changed] = self._detector.delays_at(self.end, changed)
        variances[changed] = [
            delays[row] ** 2 / found[-1].ratio for row, found in self._changes.items()
        ]
        return delays, variances

    def add(self, odometry: Odometry, residuals: Residuals) -> None:
        """Add Odometry and the Residuals that belong to it."""
        if self._end is not None and len(residuals.t) and residuals.t[0] > self._last + LOST_TIME:
            # No TDOA came for LOST_TIME: end the flight before. These data start the next one.
            self.update(math.inf)
        self._odometry.append(odometry)
        began = self._end is not None
        # those for which the filter computed an innovation
        reached = rows_of(residuals, np.isfinite(residuals.innovation))
        if len(reached):
            self._residuals.append(reached)
            self._last = float(reached.t[-1])
            if self._end is None:
                self._end = (math.floor(reached.t[0] / LENGTH) + 1.0) * LENGTH
        if not began:
            self._keep_one_slice()

    def _keep_one_slice(self) -> None:
        """Drop odometry older than the current slice, or than the slice of a TDOA that came now."""
        odometry, begin = concatenated(self._odometry), -math.inf
        if self._end is not None:
            begin = self._end - LENGTH
        elif len(odometry):
            begin = math.floor(odometry.t[-1] / LENGTH) * LENGTH
        self._odometry = [rows_of(odometry, odometry.t >= begin)]

    def update(self, until: float) -> None:
        """Test all slices that end by `until`, in s; all data up to then must be added.

        The flight ends if no TDOA came for LOST_TIME, or if `until` is inf. Then everything but the
        history is forgotten.
        """
        if self._end is None or until < self._end:
            return
        residuals, odometry = concatenated(self._residuals), concatenated(self._odometry)
        while self._end <= min(until, self._last + LOST_TIME):
            now, residuals = _split(residuals, self._end)
            of_now, odometry = _split(odometry, self._end)
            self._judge(self._end, now, of_now)
            self._keep_history(self._end)
            self._end += LENGTH
        self._residuals, self._odometry = [residuals], [odometry]
        # the loop has stopped before `until`, at LOST_TIME after the last TDOA: the flight is over
        if self._end <= until:
            self.restart()
            self._odometry = [odometry]
            self._keep_one_slice()

    def _judge(self, end: float, residuals: Residuals, odometry: Odometry) -> None:
        # Test the slice that ends at `end`, in s, for exchanges, changes and deviations.
        a, b = self._anchors.index(residuals.a), self._anchors.index(residuals.b)
        place = odometry.p.mean(axis=0) if len(odometry) else None
        self._listen(a, b, place)
        accepted = float(np.mean(residuals.verdict != REJECTED)) if len(a) else 0.0
        innovation, positions = residuals.innovation, self._anchors.positions
        if place is not None and len(a):
            recent = end <= self._agreed + AGREED and end > self._turned + TURN_APART
            if recent and turned(innovation, tdoa(place, positions[a], positions[b])):
                self.turns, self._turned = self.turns + 1, end
            if accepted > MOST:
                self._agreed = end
        speed = np.linalg.norm(odometry.v, axis=1).max(initial=0.0)
        if math.isnan(self._moving_since) and speed > MOVING:
            self._moving_since = end
        if math.isnan(self._moving_since) or place is None or not len(a):
            return
        bias = np.concatenate([odometry.gyro_bias[-1], odometry.accel_bias[-1]])
        self._bias = bias if end < self._moving_since + CALIBRATE else self._bias
        self._bias_moved = bias - self._bias
        swap = self._look_for_swap(a, b, innovation, place, speed > MOVING) or self._swapped
        if not swap and accepted >= FEWEST_ACCEPTED:
            piece = reduced(end - 0.5 * LENGTH, place, positions, a, b, innovation)
            self._detector.add(piece)
            self._look_for_change(end)
            if speed > MOVING and self._is_among(place):
                self._compare(piece)

    def _is_among(self, place: np.ndarray) -> bool:
        """Return whether a place (3,) m is within the anchors, seen from above.

        Outside of them, errors that depend on the place look like anchors elsewhere.
        """
        away = self._anchors.positions[:, :2] - place[:2]
        return bool((away.min(axis=0) < MARGIN).all() and (away.max(axis=0) > -MARGIN).all())

    def _compare(self, piece: Slice) -> None:
        """Add a Slice to the comparisons with the survey; look at their results every LOOK slices.

        The delays of changes in flight are taken out first. An anchor that has changed in flight is
        reported for that change only.
        """
        delays = self._detector.delays_at(piece.t, piece.rows)
        if delays.any():
            piece = replace(piece, vector=piece.vector - piece.information @ delays)
        # An anchor moved in flight was where the calibration says before, so recent slices find it
        # sooner. A tape is off everywhere and does not tell that.
        if self._calibrated is not None and self._compared % YOUNG == 0:
            self._comparisons = [
                self._comparisons[0],
                *self._comparisons[1:][-1:],
                self._new_comparison(),
            ]
        for comparison in self._comparisons:
            comparison.add(piece)
        self._compared += 1
        if self._compared % LOOK:
            return
        displaced = [
            one.without(self._ever_changed)
            for comparison in self._comparisons[:2]
            for one in comparison.find()
            if _matters(one) and one.row not in self._ever_changed
        ]
        found = _surest(displaced)
        self._suspected = {row: self._suspected.get(row, 0) + 1 for row in found}
        self._displaced = {row: one for row, one in found.items() if self._suspected[row] >= NAMED}

    def _look_for_change(self, end: float) -> None:
        # Find a new Change, else refine the size of the newest. Drop changes whose anchor has a
        # negligible delay again; the detector goes on subtracting them.
        change = self._detector.find(self._moving_since + SETTLE)
        if change is not None and _is_clear(change) and abs(change.at(end)) > SMALLEST_CHANGE:
            self._detector.compensate(change)
            self._changes[change.row] = [*self._changes.get(change.row, ()), change]
            self._latest_change = change
            self._ever_changed.add(change.row)
            self._compare_anew()
        elif self._latest_change is not None:
            self._latest_change = self._detector.refined(self._latest_change)
        delays = self._detector.delays_at(end, [*self._changes])
        self._changes = {
            row: found
            for (row, found), delay in zip(self._changes.items(), delays)
            if abs(delay) > SMALLEST_CHANGE
        }

    def _compare_anew(self) -> None:
        """Restart the comparison with the survey, because earlier slices are no longer valid."""
        # comparisons of all slices; of the last YOUNG to 2 YOUNG, before 2 YOUNG slices of all; and one
        # that is collecting, and is not asked yet
        self._comparisons = [self._new_comparison()]
        self._displaced, self._suspected, self._compared = {}, {}, 0

    def _new_comparison(self) -> SurveyComparison:
        return SurveyComparison(self._anchors, self._calibrated)

    def _look_for_swap(
        self,
        a: np.ndarray,
        b: np.ndarray,
        innovation: np.ndarray,
        place: np.ndarray,
        moving: bool,
    ) -> bool:
        """Return whether this slice suggests that ids of anchors are mixed up.

        An order is reported after several such slices. It is reported until several consecutive
        slices contradict it. At rest on a floor, where anchors are late, some permutation fits.

        Parameters
        ----------
        a, b : (n,) int array
            Rows of the anchors of each TDOA.
        innovation : (n,) array
            Innovations, in m.
        place : (3,) array
            Position of the filter in the world frame, in m.
        moving : bool
            Whether the tag moves. A tag at rest shows no permutation of more than two.
        """
        positions, named = self._anchors.positions, self._swapped
        d = innovation + tdoa(place, positions[a], positions[b])
        recent = self._slices - self._known_place[0] <= HELD
        piece = Piece(a, b, d, place, self._known_place[1] if recent else place)
        tried = suspects(positions, piece, named)
        if not tried:
            self._known_place = self._slices, place
            return False
        self._latest = [*self._latest[1 - TOGETHER :], (piece, tried)]
        pieces, rows = zip(*self._latest)
        before = self._instead[0] or named
        left, places = residuals_of(positions, pieces, set.intersection(*rows), before)
        found = clear_order(left, before) if len(self._latest) == TOGETHER else ()
        if found != named and not moving and len(found) > 2:
            found = ()
        if found:
            self._known_place = self._slices, places[found]
        if found == named or (named and not found and left.get(named, 0.0) < left[()]):
            self._instead = (), 0
            return bool(found)
        other, count = self._instead
        self._instead = found, count + 1 if found == other else 1
        if self._instead[1] >= (HELD if named else NAMED):
            self._swapped, self._instead = found, ((), 0)
            self._changes = {
                row: changes for row, changes in self._changes.items() if row not in dict(found)
            }
            self._ever_changed |= dict(found).keys()
            self._compare_anew()
        return bool(found)

    def _listen(self, a: np.ndarray, b: np.ndarray, place: np.ndarray | None) -> None:
        """Find anchors that the tag no longer hears although it hears other anchors.

        Anchors that the tag has left behind do not count. An anchor counts if it was heard at this
        distance before. It also counts if it is clearly closer than the farthest anchor that is
        heard.

        Parameters
        ----------
        a, b : (n,) int array
            Rows of the anchors of each TDOA.
        place : (3,) array or None
            Position of the tag, in m; None if unknown.
        """
        rows = np.unique(np.concatenate([a, b])).tolist()
        self._slices += 1
        self._counts = [*self._counts[1 - SILENT :], len(a)]
        away = {} if place is None else self._distances([*{*rows, *self._heard}], place)
        for row in rows:
            was = self._heard.get(row, Heard())
            self._heard[row] = Heard(
                was.slices + 1, self._slices, max(was.farthest, away.get(row, 0.0))
            )
        reach = NEARER * max((away.get(row, 0.0) for row in rows), default=0.0)
        silent = [
            row
            for row, was in self._heard.items()
            if self._is_silent(was, away.get(row, 0.0), reach)
        ]
        if self._slices % FORGET == 0:  # in a hall: drop anchors that the tag has passed
            self._heard = {
                row: was
                for row, was in self._heard.items()
                if self._was_often(was) or self._slices - was.last < FORGET
            }
        self._silent = tuple(sorted(silent)) if sum(self._counts) >= FEWEST else ()

    def _is_silent(self, was: Heard, away: float, reach: float) -> bool:
        return (
            self._slices - was.last >= SILENT
            and self._was_often(was)
            and away <= max(was.farthest, reach)
        )

    def _was_often(self, was: Heard) -> bool:
        return was.slices > OFTEN * max(was.last, SILENT)

    def _distances(self, rows: list[int], place: np.ndarray) -> dict[int, float]:
        return dict(
            zip(rows, np.linalg.norm(self._anchors.positions[rows] - place, axis=1).tolist())
        )

    @property
    def alarms(self) -> list[str]:
        """Return sentences on changes and on deviations from the survey."""
        return [finding.brief for finding in self._anchor_findings().values()] + [
            f"{axis}: bias moved by {moved:+.3f} {unit} since the first {CALIBRATE:g} s in motion"
            for axis, moved, (limit, unit) in zip(AXES, self._bias_moved.tolist(), BIAS_LIMITS)
            if abs(moved) > limit
        ]

    @property
    def exchanged(self) -> Finding | None:
        """Return the Finding on ids that are mixed up, or None."""
        return self._swap() if self._swapped else None

    def _anchor_findings(self) -> dict[str, Finding]:
        """Return {key: Finding} of all findings on anchors that hold now."""
        found = {f"exchanged {self._swapped}": self._swap()} if self._swapped else {}
        found |= {
            f"changed {row}": self._change(row, changes) for row, changes in self._changes.items()
        }
        found |= {f"silent {row}": self._silence(row) for row in self._silent}
        return found | {
            f"displaced {row}": self._displacement(one) for row, one in self._displaced.items()
        }

    @property
    def history(self) -> list[Event]:
        """Return all Events of anchors, sorted by their start."""
        return sorted([*self._past, *self._standing.values()], key=lambda event: event.since)

    def _keep_history(self, end: float) -> None:
        """Update the history with the findings that hold at the stamp `end`, in s."""
        before, found = self._standing, self._anchor_findings()
        self._past += [event for key, event in before.items() if key not in found]
        self._standing = {
            key: Event(finding, before[key].since if key in before else end, end)
            for key, finding in found.items()
        }

    def _swap(self) -> Finding:
        ids = self._anchors.ids
        table = {int(ids[one]): int(ids[at]) for one, at in self._swapped}
        found = exchanged(table, "each TDOA with one of them fits the place of another")
        if len(table) == 2:
            return found
        return replace(
            found,
            evidence="most TDOAs contradict the survey; in half of such flights another order is right",
            remedy="record half a minute in motion with these ids, and let check name their order",
        )

    def _silence(self, row: int) -> Finding:
        number = self._anchors.ids[row]
        return Finding(
            "anchor_silent",
            WARNING,
            cause=f"anchor {number} is not heard any more",
            evidence="others as far away are heard",
            remedy="check its power and sight",
            value=float(number),
        )

    def _change(self, row: int, found: list[Change]) -> Finding:
        end, number = self.end, self._anchors.ids[row]
        size = float(self._detector.delays_at(end, [row])[0])
        again = [
            change for change in found if change.at(end) * size > 0.0
        ]  # changes in the same direction
        if len(again) > 1:
            what = f"its clock drifts ({size / (end - again[0].since):+.3f} m/s)"
        elif size > 0.0:
            what = "it is late: blocked (NLOS), moved, or its delay has changed"
        else:
            what = "it is early: moved, or its delay has changed"
        return Finding(
            "anchor_changed",
            WARNING,
            cause=f"anchor {number}: {size:+.2f} m since the start of the flight: {what}",
            evidence="no error of the position explains that",
            remedy="look at it; survey it again if it was moved",
            value=size,
        )

    def _displacement(self, one: Displaced) -> Finding:
        number = self._anchors.ids[one.row]
        *some, last = self._anchors.ids[[one.row, *one.others]].tolist()
        named = f"{', '.join(map(str, some))} or {last}" if some else str(last)
        off = float(np.linalg.norm(one.shift))
        by, std = (
            ", ".join(f"{value:{form}}" for value in values)
            for values, form in ((one.shift, "+.2f"), (one.std, ".2f"))
        )
        which = f" if it is anchor {number}," if some else ""
        what = f"anchor {named} does not stand where the survey has it, but{which} about ({by}) m from there"
        if one.later and off < SMALLEST_CHANGE:
            what = f"anchor {named} is later than it was calibrated,{which} by {one.later:+.2f} m"
        evidence = (
            f"standard deviations {std} m; {one.odds / math.log(10.0):.0f} powers of ten more "
            "probable than that it is not"
        )
        evidence += "; or it is later than it was calibrated" * one.either
        evidence += "; the TDOAs do not separate these anchors" * bool(some)
        effects = " --effects effects.yaml" if self._calibrated is not None else ""
        again = f"measure {'them' if some else 'it'} again"
        return Finding(
            "anchor_displaced",
            WARNING,
            cause=what,
            evidence=evidence,
            remedy=f"{SURVEYING} --survey anchors.yaml{effects} --out surveyed/  # or {again}",
            value=off,
        )


def _split(part: Part, end: float) -> tuple[Part, Part]:
    """Return the rows of Odometry or Residuals before the stamp `end`, in s, and the others."""
    count = int(np.searchsorted(part.t, end))
    return rows_of(part, slice(count)), rows_of(part, slice(count, None))


def _surest(displaced: Iterable[Displaced]) -> dict[int, Displaced]:
    """Return {row: Displaced} of several comparisons, without doubts that another one resolves."""
    found: dict[int, Displaced] = {}
    for one in sorted(displaced, key=lambda one: len(one.others)):
        if found.keys().isdisjoint((one.row, *one.others)):
            found[one.row] = one
    return found


def _matters(one: Displaced) -> bool:
    """Return whether the deviation of an anchor is relevant and statistically significant."""
    off = float(np.linalg.norm(one.shift))
    return max(off, abs(one.later)) > SMALLEST_CHANGE and (
        bool(one.later) or off > SURE * float(np.linalg.norm(one.std)) / math.sqrt(3.0)
    )


def _is_clear(change: Change) -> bool:
    """Return whether a Change is large, clearly of one anchor, and explains most of the errors."""
    return change.ratio > max(LIMIT, CLEARLY * change.rival) and change.left < MOST_LEFT


# Run the Monitor on a recording, with the results of ekf_node and their times.


def watched(
    anchors: Anchors,
    odometry: Odometry,
    residuals: Residuals,
    calibrated: Covariance | None = None,
    restarts: Sequence[float] = (),
) -> list[Event]:
    """Return the Events of a recording.

    Parameters
    ----------
    anchors : Anchors
        Anchors in the world frame.
    odometry : Odometry
        Estimates.
    residuals : Residuals
        Outcome of each TDOA.
    calibrated : Covariance or None
        As for Monitor.
    restarts : sequence of float
        Stamps at which the filter restarts, in s.
    """
    odometry, residuals = _sorted(odometry), _sorted(residuals)
    events: list[Event] = []
    for low, high in pairwise([-math.inf, *restarts, math.inf]):
        monitor, t = Monitor(anchors, calibrated), _between(residuals, low, high).t
        for begin, end in pairwise([low, *t[1:][np.diff(t) > LOST_TIME].tolist(), high]):
            heard = _between(residuals, begin, end)
            monitor.add(_between(odometry, begin, end), heard)
            monitor.update(float(heard.t[-1]) if len(heard) else low)
        events += monitor.history
    return events


def _sorted(part: Part) -> Part:
    """Return Odometry or Residuals in the order of their stamps."""
    return rows_of(part, np.argsort(part.t, kind="stable"))


def _between(part: Part, low: float, high: float) -> Part:
    """Return the rows of sorted Odometry or Residuals with stamps from `low` to `high`, in s."""
    return rows_of(part, slice(*np.searchsorted(part.t, [low, high])))
