"""Watches the residuals, live and of recordings: what is not as it was when the flight began, or as
the survey has it? An anchor that is late or early, whose clock drifts, that is silent, was
exchanged with another or moved; an axis of the IMU.

The innovations of half a second become a Slice. A ChangeDetector compares slices with those before,
a SurveyComparison with the survey and the calibration. What they find is named until it has gone,
and stays in the history.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.geometry import tdoa

from ..core.memory import REJECTED
from .change import ChangeDetector
from .finding import ERROR, WARNING, Finding
from .reference import Displaced, SurveyComparison
from .signs import turned
from .slices import LENGTH, reduced
from .swap import clear_exchange, mean_of
from .swap import residuals as residuals_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.effects.effect_set import Covariance

    from ..anchor_table import AnchorTable
    from ..results import Odometry, Residuals
    from .change import Change
    from .slices import Slice
    from .swap import Residuals as SwapResiduals

MOVING = 0.3  # m/s; on the floor, residuals are not those of the air
SETTLE = 8.0  # s in motion before an onset is looked for
GAP = 30.0  # s without TDOAs after which a new flight begins
# ratio above which an anchor has changed: a tenth above the largest of sound flights of two days,
# see docs/reliability.md
LIMIT = 16.3
CLEARLY = 1.4  # how much larger it must be than that of any other anchor,
# and of the errors since then, over those before, what it may leave: else something else has
# happened too, as on a floor
MOST_LEFT = 1.0
# Share of the TDOAs of a slice; where the filter rejects more, as on a floor, it is no single
# anchor that has changed
FEWEST_ACCEPTED = 1 / 3
SMALLEST_CHANGE = 0.15  # m; less does not matter, and what has come back to that has gone
SILENT, FEWEST = 4, 40  # slices without an anchor, and the TDOAs of the others in them
OFTEN = 0.5  # share of the slices in which it was heard before
FORGET = 60  # slices between two looks at which of the anchors were passed long ago
# share of the distance of the farthest anchor that is heard, within which another must be
NEARER = 0.8
TOGETHER = 4  # slices in which a swap is looked for
# slices or comparisons in a row that must say so until it is named, and something else until a swap
# is no longer
NAMED, HELD = (4, 8)
# slices between two comparisons with the survey; and of a comparison with the latest, at least
LOOK, YOUNG = (4, 40)
SURE = 2.0  # standard deviations by which an anchor must be off the survey, beside SMALLEST_CHANGE
TURN_APART = 3.0  # s of stamps between two turns of all signs
# Share of the TDOAs of a slice that the filter accepts where it is right, and s since then, within
# which signs turn: it is an event. Near a
# floor, TDOAs that are metres too long may all the time look as if they had the other sign.
MOST, AGREED = 0.5, 1.1
MOST_EVENTS = 1000  # that are remembered
CALIBRATE = 15.0  # s in motion that count as calibration of the IMU
# rad/s and m/s^2, by which an estimated bias must have moved
BIAS_LIMITS = {"gyroscope": 0.03, "accelerometer": 0.6}

SURVEYING = "survey RECORDING"  # the command that says where it stands

NO_ODOMETRY = [np.empty(0), *[np.empty((0, 3))] * 4]  # t, p, v, gyro_bias, accel_bias
# t, a, b, innovation, whether it was accepted
NO_RESIDUALS = [np.empty(0), *[np.empty(0, int)] * 2, np.empty(0), np.empty(0, bool)]


class Heard(NamedTuple):
    """slices : in which an anchor was heard; last : number of the last one; farthest : m, of the
    tag when it was.
    """

    slices: int = 0
    last: int = 0
    farthest: float = 0.0


class Event(NamedTuple):
    """finding : Finding, as it was last; since, until : s, stamps between which it stood."""

    finding: Finding
    since: float
    until: float


class Monitor:
    """Feed it odometry and residuals, say until which stamp they are complete, ask for `alarms` and
    `delays`.
    """

    def __init__(
        self, anchors: Anchors | AnchorTable, calibrated: Covariance | None = None
    ) -> None:
        """anchors : Anchors, or AnchorTable, of which others may be there later; calibrated :
        Covariance of their positions and delays, as of their last calibration, or None.
        """
        self._anchors, self._calibrated = anchors, calibrated
        self._past: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._standing: dict[str, Event] = {}  # what stands at present, by its key
        # of the signs of all TDOAs in flight, and the stamp of the last, s
        self.turns, self._turned = (0, -math.inf)
        self._agreed = -math.inf  # s, end of the last slice in which the filter accepted most TDOAs
        self._forget()

    def _forget(self) -> None:
        self._odometry: list[list[np.ndarray]] = [NO_ODOMETRY]  # of the present slice and later
        self._residuals: list[list[np.ndarray]] = [NO_RESIDUALS]
        self._past += self._standing.values()
        self._standing = {}
        self._end: float | None = None  # s, stamps: at which the present slice ends,
        self._last = -math.inf  # and of what was added last
        self._detector = ChangeDetector()
        self._displaced: dict[
            int, Displaced
        ] = {}  # of anchors that are not as surveyed and calibrated, by row,
        self._suspected: dict[int, int] = {}  # and comparisons in a row that say so
        self._comparisons: list[SurveyComparison] = []
        self._compared = 0  # slices
        self._compare_anew()
        self._changes: dict[
            int, list[Change]
        ] = {}  # row: Changes of an anchor that is not what it was
        self._ever_changed: set[int] = set()  # rows
        self._latest_change: Change | None = None  # while its size is still found out
        self._latest: list[SwapResiduals] = []  # of the last slices in which something was far off
        self._slices = 0  # of all
        self._heard: dict[int, Heard] = {}  # by row
        self._counts: list[int] = []  # TDOAs of the last slices
        self._swapped: tuple[int, ...] = ()  # rows
        self._silent: tuple[int, ...] = ()
        # rows of another swap, or of none, and slices in a row that say so
        self._instead: tuple[tuple[int, ...], int] = ((), 0)
        self._moving_since = math.nan  # s, stamp
        self._bias: np.ndarray | None = None
        # (6,): gyroscope, accelerometer; as calibrated, and the latest
        self._bias_now: np.ndarray | None = None
        self._bias_calibration: list[np.ndarray] = []

    def forget(self, gone: np.ndarray) -> None:
        """Anchors, by their rows (k,), are not there any more: nothing is said of them, nor what
        their last TDOAs show used.
        """
        rows, ids = set(gone.tolist()), self._anchors.ids[gone]
        kept = [~(np.isin(part[1], ids) | np.isin(part[2], ids)) for part in self._residuals]
        self._residuals = [
            [column[some] for column in part] for part, some in zip(self._residuals, kept)
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
        if rows & {*self._swapped, *self._instead[0]}:
            self._swapped, self._instead, self._latest = (), ((), 0), []

    @property
    def end(self) -> float:
        """Stamp, s, at which the present slice ends; inf before the first TDOA."""
        return math.inf if self._end is None else self._end

    @property
    def delays(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the anchors that are not what they were, at the present stamp: (N,) m, and their
        variances (N,) m^2.
        """
        delays, variances = np.zeros((2, len(self._anchors)))
        changed = [*self._changes]
        delays[changed] = self._detector.delays_at(self.end, changed)
        variances[changed] = [
            delays[row] ** 2 / found[-1].ratio for row, found in self._changes.items()
        ]
        return delays, variances

    def add(self, odometry: Odometry, residuals: Residuals) -> None:
        """Take Odometry and the Residuals that came with it."""
        if self._end is not None and len(residuals.t) and residuals.t[0] > self._last + GAP:
            # of the flight before; no slice is tested for each half second of a gap
            self.update(math.inf)
        if len(odometry):
            self._odometry.append(
                [odometry.t, odometry.p, odometry.v, odometry.gyro_bias, odometry.accel_bias]
            )
        began, reached = self._end is not None, np.isfinite(residuals.innovation)  # the filter
        if reached.any():
            columns = (
                residuals.t,
                residuals.a,
                residuals.b,
                residuals.innovation,
                residuals.verdict != REJECTED,
            )
            self._residuals.append([column[reached] for column in columns])
            t = self._residuals[-1][0]
            self._last = float(t[-1])
            if self._end is None:
                self._end = (math.floor(t[0] / LENGTH) + 1.0) * LENGTH
        if not began:
            self._keep_one_slice()

    def _keep_one_slice(self) -> None:
        """Forget the odometry before the first slice, or before the one that it would be in if it
        began now.
        """
        odometry = [np.concatenate(columns) for columns in zip(*self._odometry)]
        if len(odometry[0]):
            begin = (
                math.floor(odometry[0][-1] / LENGTH) * LENGTH
                if self._end is None
                else self._end - LENGTH
            )
            self._odometry = [[column[odometry[0] >= begin] for column in odometry]]

    def update(self, until: float) -> None:
        """Everything stamped before `until`, s, was added: test the slices that end there or
        earlier.
        """
        if self._end is None or until < self._end:
            return
        residuals, odometry = (
            [np.concatenate(columns) for columns in zip(*parts)]
            for parts in (self._residuals, self._odometry)
        )
        while self._end <= min(until, self._last + GAP):
            now, of_now = residuals[0] < self._end, odometry[0] < self._end
            self._test(
                self._end,
                [column[now] for column in residuals],
                [column[of_now] for column in odometry],
            )
            residuals, odometry = [c[~now] for c in residuals], [c[~of_now] for c in odometry]
            self._end += LENGTH
        self._residuals, self._odometry = [residuals], [odometry]
        if self._end <= until:  # nothing came for too long
            self._forget()
            self._odometry = [odometry]
            self._keep_one_slice()

    def _test(self, end: float, residuals: list[np.ndarray], odometry: list[np.ndarray]) -> None:
        """One slice that ends at `end`, s: its columns."""
        self._judge(end, residuals, odometry)
        self._keep_history(end)

    def _judge(self, end: float, residuals: list[np.ndarray], odometry: list[np.ndarray]) -> None:
        _, a, b, innovation, accepted = residuals
        a, b = self._anchors.index(a), self._anchors.index(b)
        t, p, v, gyro_bias, accel_bias = odometry
        self._listen(a, b, p.mean(axis=0) if len(t) else None)
        if len(t) and len(a):
            recent = end <= self._agreed + AGREED and end > self._turned + TURN_APART
            if recent and turned(
                innovation,
                tdoa(p.mean(axis=0), self._anchors.positions[a], self._anchors.positions[b]),
            ):
                self.turns, self._turned = self.turns + 1, end
            if np.mean(accepted) > MOST:
                self._agreed = end
        if math.isnan(self._moving_since) and (np.linalg.norm(v, axis=1) > MOVING).any():
            self._moving_since = end
        if math.isnan(self._moving_since) or not (len(t) and len(a)):
            return
        self._follow_biases(end, np.concatenate([gyro_bias[-1], accel_bias[-1]]))
        place = p.mean(axis=0)
        swap = self._look_for_swap(a, b, innovation, place) or self._swapped
        if not swap and accepted.mean() >= FEWEST_ACCEPTED:
            piece = reduced(end - 0.5 * LENGTH, place, self._anchors.positions, a, b, innovation)
            self._detector.add(piece)
            self._look_for_change(end)
            if np.linalg.norm(v, axis=1).max() > MOVING:
                self._compare(piece)

    def _compare(self, piece: Slice) -> None:
        """Compare the flight, with a Slice more, with the survey; an anchor that has changed in
        flight is named by that alone.
        """
        delays = self._detector.delays_at(piece.t, piece.rows)
        if delays.any():
            piece = replace(piece, vector=piece.vector - piece.information @ delays)
        if (
            self._compared % YOUNG == 0 and self._calibrated is not None
        ):  # what moved on the way stood right for long
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
        """What was not as it is now says nothing of the survey."""
        # with all slices, and with the last YOUNG to 2 YOUNG, and YOUNG at most
        self._comparisons = [self._new_comparison()]
        self._displaced, self._suspected, self._compared = {}, {}, 0

    def _new_comparison(self) -> SurveyComparison:
        return SurveyComparison(self._anchors, self._calibrated)

    def _look_for_swap(
        self, a: np.ndarray, b: np.ndarray, innovation: np.ndarray, place: np.ndarray
    ) -> bool:
        """Whether this slice looks like one: it is named once several do, and until others say in a
        row that it is not.
        """
        positions, named = self._anchors.positions, self._swapped
        left = residuals_of(
            positions, a, b, innovation + tdoa(place, positions[a], positions[b]), place, named
        )
        if not left:
            return False
        self._latest = [*self._latest[1 - TOGETHER :], left]
        mean = mean_of(self._latest)
        found = clear_exchange(mean) if len(self._latest) == TOGETHER else ()
        if found == named or (named and not found and mean.get(named, 0.0) < mean[()]):
            self._instead = (), 0
            return bool(found)
        other, count = self._instead
        self._instead = found, count + 1 if found == other else 1
        if self._instead[1] >= (HELD if named else NAMED):
            self._swapped, self._instead = found, ((), 0)
            self._changes = {
                row: changes for row, changes in self._changes.items() if row not in found
            }
            self._ever_changed |= set(found)
            self._compare_anew()
        return bool(found)

    def _listen(self, a: np.ndarray, b: np.ndarray, place: np.ndarray | None) -> None:
        """Which anchors are not heard any more, while others are? Not those that the tag has left
        behind: one must be nearer to its place (3,), m, None: not known, than where the anchor was
        heard, or than those that are.
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
        if self._slices % FORGET == 0:  # of a hall, those that were passed
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

    def _follow_biases(self, end: float, bias: np.ndarray) -> None:
        if end < self._moving_since + CALIBRATE:
            self._bias_calibration.append(bias)
        elif self._bias is None and self._bias_calibration:
            self._bias = np.mean(self._bias_calibration[len(self._bias_calibration) // 2 :], axis=0)
        self._bias_now = bias

    @property
    def alarms(self) -> list[str]:
        """Sentences on what has changed, and on what is not as surveyed; empty while nothing is."""
        return [*(finding.brief for finding in self._found().values()), *self._axis_alarms()]

    @property
    def exchanged(self) -> Finding | None:
        """Finding on two anchors that were exchanged, or None."""
        return self._swap() if self._swapped else None

    def _found(self) -> dict[str, Finding]:
        """{key: Finding} of anchors, of what stands at present."""
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
        """All Events of anchors, in the order in which they began."""
        return sorted([*self._past, *self._standing.values()], key=lambda event: event.since)

    def _keep_history(self, end: float) -> None:
        """Enter what stands at a stamp, s."""
        before, found = self._standing, self._found()
        self._past += [event for key, event in before.items() if key not in found]
        self._standing = {
            key: Event(finding, before[key].since if key in before else end, end)
            for key, finding in found.items()
        }

    def _swap(self) -> Finding:
        one, other = self._anchors.ids[[*self._swapped]].tolist()
        what = f"two anchors are exchanged, {one} and {other}"
        evidence, remedy = (
            "each TDOA with one of them fits the place of the other",
            "correct their ids, or their positions on uwb/anchors",
        )
        return Finding("ids_exchanged", ERROR, what, evidence, remedy, float(one))

    def _silence(self, row: int) -> Finding:
        number = self._anchors.ids[row]
        what = f"anchor {number} is not heard any more"
        return Finding(
            "anchor_silent",
            WARNING,
            what,
            "others as far away are heard",
            "check its power and sight",
            float(number),
        )

    def _change(self, row: int, found: list[Change]) -> Finding:
        end, number = self.end, self._anchors.ids[row]
        size = float(self._detector.delays_at(end, [row])[0])
        again = [
            change for change in found if change.at(end) * size > 0.0
        ]  # further in the same direction
        if found[-1].slope or len(again) > 1:
            what = f"its clock drifts ({size / (end - again[0].since):+.3f} m/s)"
        elif size > 0.0:
            what = "it is late: blocked (NLOS), moved, or its delay has changed"
        else:
            what = "it is early: moved, or its delay has changed"
        cause = f"anchor {number}: {size:+.2f} m since the start of the flight: {what}"
        remedy = "look at it; survey it again if it was moved"
        return Finding(
            "anchor_changed", WARNING, cause, "no error of the position explains that", remedy, size
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
        remedy = f"{SURVEYING} --survey anchors.yaml{effects} --out surveyed/  # or {again}"
        return Finding("anchor_displaced", WARNING, what, evidence, remedy, off)

    def _axis_alarms(self) -> list:
        if self._bias is None or self._bias_now is None:
            return []
        change, out = self._bias_now - self._bias, []
        for k, (name, limit) in enumerate(BIAS_LIMITS.items()):
            for axis, value in zip("xyz", change[3 * k : 3 * k + 3].tolist()):
                if abs(value) > limit:
                    unit = "rad/s" if name == "gyroscope" else "m/s^2"
                    out.append(
                        f"{name} {axis}: bias moved by {value:+.3f} {unit} since the start of "
                        "the flight"
                    )
        return out


def _surest(displaced: Iterable[Displaced]) -> dict[int, Displaced]:
    """Return {row: Displaced} of several comparisons, without the doubts that another settles."""
    found: dict[int, Displaced] = {}
    for one in sorted(displaced, key=lambda one: len(one.others)):
        if found.keys().isdisjoint((one.row, *one.others)):
            found[one.row] = one
    return found


def _matters(one: Displaced) -> bool:
    """Whether an anchor is off by more than does not matter, and more than by chance."""
    off = float(np.linalg.norm(one.shift))
    return max(off, abs(one.later)) > SMALLEST_CHANGE and (
        bool(one.later) or off > SURE * float(np.linalg.norm(one.std)) / math.sqrt(3.0)
    )


def _is_clear(change: Change) -> bool:
    """Whether a Change is large, of one anchor alone, and all that has happened."""
    return change.ratio > max(LIMIT, CLEARLY * change.rival) and change.left < MOST_LEFT
