# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Put the streams of a recording on one time if its clock restarted, wrapped or was set.

The evidence is the order of the messages in the file: sorted by stamp, a clock that restarts makes
one flight of two.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK

LEADING = "tdoa", "imu", "gyro", "acc", *LOCATING  # streams whose clock restarts the filter
AHEAD = 10.0  # s; a longer step forward of a quick stream is a pause, or a clock that was set
SLOW = 20.0  # usual steps; the same of a slow one
PAUSE = 3600.0  # s for which a recorder may pause if arrival times are unknown
# Fewest messages that begin another time: they agree with each other, and not with those before. Fewer
# are outliers.
FEW = 10
NEAR = 20  # messages on both sides of a jump by whose arrivals its size is known
TOGETHER = 5.0  # s by which a jump may differ between streams of one clock
# Largest number of jumps per message, or ten jumps. Several tags or a faulty driver cause more.
MOST = 0.01
WRAPS = {  # what counters of drivers hold: s
    "2^40 ticks of 15.65 ps": 2**40 / (128 * 499.2e6),
    "2^32 microseconds": 2**32 * 1e-6,
    "2^31 microseconds": 2**31 * 1e-6,
    "2^24 microseconds": 2**24 * 1e-6,
    "2^32 milliseconds": 2**32 * 1e-3,
    "2^31 milliseconds": 2**31 * 1e-3,
    "2^24 milliseconds": 2**24 * 1e-3,
    "2^16 milliseconds": 2**16 * 1e-3,
    "2^32 nanoseconds": 2**32 * 1e-9,
    "a day": 86400.0,
    "a week": 604800.0,
}
SPARSE = 50.0  # times of a grid for each message; where there are more, most are far from any
WRAP_TOLERANCE = 0.1  # s
WORDS = {
    "tdoa": "uwb/tdoa",
    "gyro": "imu/data",
    "acc": "imu/data",
    "imu": "imu/data",
    "pose": "ground_truth/pose",
} | {name: sensor.topics[0][0] for name, sensor in SENSORS.items()}  # topics of streams
RESTART, WRAP, SET, SILENCE = "restart", "wrap", "set", "silence"


class Jump(NamedTuple):
    """A jump of a clock.

    Attributes
    ----------
    kind : str
        RESTART, WRAP, SET (forward), or SILENCE (of all streams; a clock that was set looks the same).
    streams : tuple of str
        Names of the streams that jumped.
    message : int
        Number of the first message after the jump in the first of the streams, from 1.
    after : float
        Time from the first message of the recording to that message, s.
    by : float
        Size of the jump, s.
    at : float
        Corrected stamp of the first message after the jump, s.
    period : str
        Name of the period that wrapped.
    """

    kind: str
    streams: tuple[str, ...]
    message: int
    after: float
    by: float
    at: float
    period: str = ""

    @property
    def leads(self) -> bool:
        """Return whether a stream jumped whose clock restarts the filter."""
        return not set(self.streams).isdisjoint(LEADING)


@dataclass(frozen=True)
class Straightened:
    """Result of `straightened`.

    Attributes
    ----------
    shifts : dict
        {stream: (n,) s to add to its stamps} of streams with a jump.
    kept : dict
        {stream: (n,) bool} of streams with outliers.
    jumps : tuple of Jump
        In the order of time.
    restarts : tuple of float
        Stamps, s, at which the clock of a leading stream restarted.
    """

    shifts: dict[str, np.ndarray]
    kept: dict[str, np.ndarray]
    jumps: tuple[Jump, ...] = ()
    restarts: tuple[float, ...] = ()

    def columns(self, name: str, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the columns of a stream, with "t", s, on the continuous time, without outliers."""
        if name in self.shifts:
            columns = {**columns, "t": columns["t"] + self.shifts[name]}
        return (
            {key: values[self.kept[name]] for key, values in columns.items()}
            if name in self.kept
            else columns
        )

    @property
    def outliers(self) -> dict[str, int]:
        """Return {stream: number of messages with stamps far from their neighbours}."""
        return {name: int(np.count_nonzero(~kept)) for name, kept in self.kept.items()}


def straightened(
    stamps: Mapping[str, np.ndarray], arrived: Mapping[str, np.ndarray] | None = None
) -> Straightened:
    """Put the streams of a recording on one continuous time.

    The stamps after a persistent jump are shifted, by the same for all streams that jumped together:
    by the arrivals where they are known, else to the usual step. A pause moves nothing. Few stamps
    far from their neighbours are outliers.

    Parameters
    ----------
    stamps : mapping
        {stream: (n,) s, in the order of the file}.
    arrived : mapping or None
        {stream: (n,) s, when the messages were recorded, NaN where unknown}.
    """
    found = {name: _Stream(name, t, (arrived or {}).get(name)) for name, t in stamps.items()}
    ends = {name: float(stream.t[-1]) for name, stream in found.items() if stream.steady}
    for name, stream in found.items():
        stream.cut([end for other, end in ends.items() if other != name])
    groups = [(_of_group(group, found), group) for group in _groups([*found.values()])]
    for stream in found.values():
        _join_late(stream, found)
    shifts = {name: stream.shift() for name, stream in found.items()}
    whole = {name: t + shifts[name] for name, t in stamps.items()}
    begin = min(
        (np.min(t[found[name].kept], initial=np.inf) for name, t in whole.items()), default=0.0
    )
    jumps = []
    for jump, group in groups:
        at = min(float(whole[stream.name][stream.place[one.first]]) for stream, one in group)
        if jump is not None:
            jumps.append(jump._replace(at=at, after=at - float(begin)))
    jumps.sort(key=lambda jump: jump.at)
    restarts = {jump.at for jump in jumps if jump.kind == RESTART and jump.leads}
    return Straightened(
        {name: shift for name, shift in shifts.items() if shift.any()},
        {name: stream.kept for name, stream in found.items() if not stream.kept.all()},
        tuple(jumps),
        tuple(sorted(restarts)),
    )


def is_grouped(t: np.ndarray, *ids: np.ndarray) -> bool:
    """Return whether the rows of a table are in the order of anchors, then of time.

    Time then falls back at most changes of the anchor, or of the pair, and nowhere else. A clock that
    restarts falls once while the anchors take turns.

    Parameters
    ----------
    t : (n,) s, in the order of the file
    ids : (n,) each, of the anchor, or of both anchors of the pair
    """
    falls = np.diff(t) < -LARGEST_STEP_BACK
    changes = [np.diff(column) != 0 for column in ids]
    return bool(falls.any()) and any(
        changed[falls].all() and 2 * falls.sum() >= changed.sum()
        for changed in (*changes, np.any(changes, axis=0))
    )


@dataclass
class _Break:
    """Place where the time of a stream jumps.

    first, last : numbers of the stamp after and of the last one before; by : s, of the clock;
    sure : false if the stream may also have been silent.
    """

    first: int
    last: int
    by: float
    sure: bool
    shift: float = 0.0  # s, of what follows


class _Stream:
    """Finite stamps t (m,) s of one stream, in the order of the file, with its breaks.

    place : (m,) in the file; kept : (n,) bool, of all messages; arrived : (m,) s or None; steady :
    whether the stamps have neither jumps nor pauses.
    """

    def __init__(self, name: str, t: np.ndarray, arrived: np.ndarray | None) -> None:
        self.place = np.flatnonzero(np.isfinite(t))
        self.name, self.t, self.kept = name, t[self.place], np.ones(len(t), bool)
        self.breaks: list[_Break] = []
        self.offset = 0.0  # s, added to every stamp
        # Arrivals count if they are known and never fall.
        known = arrived is not None and (np.diff(arrived, prepend=-np.inf) >= 0.0).all()
        self.arrived = arrived[self.place] if arrived is not None and known else None
        steps = np.diff(self.t)
        rising = steps[steps > 0.0]
        self.usual = float(np.median(rising)) if len(rising) else 0.0  # s
        self.limit = max(AHEAD, SLOW * self.usual)
        self.steady = len(self.t) > 0 and self._follows(steps).all()
        # Steps forward count too: they lead back from a wild stamp.
        forward = steps > max(LARGEST_STEP_BACK, 1.5 * self.usual)
        far = np.flatnonzero((steps < -LARGEST_STEP_BACK) | forward) + 1
        self._pieces = list(zip([0, *far.tolist()], [*far.tolist(), len(self.t)]))

    def _follows(self, step: np.ndarray | float) -> np.ndarray:
        """Return whether steps, s, are usual of messages that follow each other."""
        return np.asarray((-LARGEST_STEP_BACK <= step) & (step <= self.limit))

    def cut(self, ends: Sequence[float]) -> None:
        """Find the breaks and the outliers.

        A piece between two large steps is accepted if it continues the time of the last accepted one.
        Otherwise it begins another time if many messages agree with it. All other pieces are outliers.

        ends : s, last stamps of other streams that are steady
        """
        if len(self._pieces) == 1:
            return
        last = -1  # the last accepted stamp; -1 before the first
        breaks, kept = list[_Break](), self.kept.copy()
        for number, (first, end) in enumerate(self._pieces):
            later = self.t[[begin for begin, _ in self._pieces[number + 1 : number + 4]]]
            many = self._lasts(self._pieces[number:], last)
            if last < 0:  # the first messages may be outliers, too
                continues = bool(self._follows(later - self.t[end - 1]).any())
            else:
                sure = self._is_sure(last, first, later, ends)
                continues = self._continues(last, first, later, ends, many, sure)
                if many and not continues:
                    by = min(self._ahead(last, first, NEAR), float(self.t[first] - self.t[last]))
                    breaks.append(_Break(first, last, by, sure))
            if many or continues:
                last = end - 1
            else:
                kept[self.place[first:end]] = False
        outliers = np.count_nonzero(~kept)
        if last < 0 or len(breaks) > max(10, MOST * len(kept)) or outliers > 0.1 * len(kept):
            return  # no clock explains that: the stamps stay as they are
        self.breaks, self.kept = breaks, kept

    def _lasts(self, pieces: Sequence[tuple[int, int]], last: int) -> bool:
        """Return whether the first piece, with the pieces that continue it, has many messages.

        Pieces that belong to the time of the stamp `last` are not counted.
        """
        few, t = min(FEW, max(2, len(self.t) // 20)), self.t
        (start, behind), *more = pieces
        count = behind - start
        for begin, end in more:
            back = last >= 0 and t[start] < t[last] <= t[begin]
            if count >= few or back or not self._follows(t[begin] - t[behind - 1]):
                break
            count, behind = count + end - begin, end
        return count >= few

    def _continues(
        self,
        last: int,
        first: int,
        later: np.ndarray,
        ends: Sequence[float],
        many: bool,
        sure: bool,
    ) -> bool:
        """Return whether the stamp `first`, of many or few, continues the time of the stamp `last`."""
        t, step = self.t, self.t[first] - self.t[last]
        if step < -LARGEST_STEP_BACK:
            return False
        if self.arrived is not None:
            return self._ahead(last, first, NEAR if many else 1) < LARGEST_STEP_BACK
        if step <= self.limit:
            return True
        if many:
            others_continued = any(end > t[last] + self.limit for end in ends)
            return others_continued and step <= PAUSE and not sure
        if not len(later):
            return any(end + self.limit > t[first] for end in ends)
        return bool(step <= PAUSE and -LARGEST_STEP_BACK <= later[0] - t[first] <= PAUSE)

    def _is_sure(self, last: int, first: int, later: np.ndarray, ends: Sequence[float]) -> bool:
        """Return whether a step between two messages certainly comes from the clock.

        Three cases are certain: the arrivals show it, the stamps fall back soon, or the stream ends with
        others only without the step.
        """
        step, off = float(self.t[first] - self.t[last]), self.t[-1] - np.array(ends)
        falls = step < 0.0 or bool((later[:1] < self.t[first] - LARGEST_STEP_BACK).any())
        without = (abs(off - step) < TOGETHER).any() and not (abs(off) < 0.5 * step).any()
        return self.arrived is not None or falls or bool(without)

    def _ahead(self, last: int, first: int, near: int) -> float:
        """Return the size of a jump of the clock, s.

        It is known from the arrivals of the `near` messages on both sides, or from the usual step.
        """
        if self.arrived is None:
            return float(self.t[first] - self.t[last]) - self.usual
        ahead = self.t - self.arrived
        before = np.median(ahead[max(0, last + 1 - near) : last + 1])
        return float(np.median(ahead[first : first + near]) - before)

    def shift(self) -> np.ndarray:
        """Return (n,) s to add to the stamps."""
        out = np.full(len(self.kept), self.offset)
        for one in self.breaks:
            out[self.place[one.first] :] += one.shift
        return out


_Member = tuple[_Stream, _Break]


def _groups(streams: list[_Stream]) -> Iterator[list[_Member]]:
    """Yield the breaks of several streams that are one jump of their clock.

    The first stream is the quickest of LEADING, or of all if none of LEADING jumped.
    """
    ordered = sorted(streams, key=lambda stream: (stream.name not in LEADING, stream.usual))
    left = [(stream, one) for stream in ordered for one in stream.breaks]
    while left:
        stream, one = left[0]
        group = [left[0]]
        for other in streams:
            near = (
                (of, its)
                for of, its in left
                if of is other is not stream
                and abs(its.by - one.by) < TOGETHER
                and abs(of.t[its.last] - stream.t[one.last]) < TOGETHER + of.usual
            )
            group += islice(near, 1)
        left = [member for member in left if member not in group]
        yield group


def _of_group(group: list[_Member], every: Mapping[str, _Stream]) -> Jump | None:
    """Return the Jump of one clock, and shift its streams; None for a silence of some streams.

    Two fields of the Jump are NaN until `straightened` knows all shifts.
    """
    # The smallest size: after the shift no stream of the group falls. Arrivals, of the quickest stream
    # that has them, are better than usual steps.
    by = min(one.by for _, one in group)
    known = [(stream, one) for stream, one in group if stream.arrived is not None]
    if known:
        stream, one = min(known, key=lambda member: member[0].usual)
        by = min(one.by, *(float(of.t[its.first] - of.t[its.last]) for of, its in group))
    kind, period = (RESTART, "") if by < 0.0 else (SET, "")
    tolerance = WRAP_TOLERANCE + 3.0 * min(stream.usual for stream, _ in group)
    name, length = min(WRAPS.items(), key=lambda wrap: abs(by + wrap[1]))
    if abs(by + length) < tolerance:
        kind, by, period = WRAP, -length, name
    if kind == SET and by <= PAUSE and not any(one.sure for _, one in group):
        kind = SILENCE
    for _, one in group:
        one.shift = 0.0 if kind == SILENCE else -by
    stream, one = group[0]
    names = tuple(stream.name for stream, _ in group)
    # while a leading stream goes on, a silence of others is no event of the clock
    if kind == SILENCE and not {name for name in every if name in LEADING} <= set(names):
        return None
    return Jump(kind, names, int(stream.place[one.first]) + 1, np.nan, by, np.nan, period)


def _join_late(stream: _Stream, every: Mapping[str, _Stream]) -> None:
    """Shift a stream without a break that has only messages after a jump of the other streams."""
    if stream.breaks or not len(stream.t):
        return
    for other in every.values():
        firsts = [0, *(one.first for one in other.breaks)]  # of each time of its clock
        lasts = [*(one.last for one in other.breaks), -1]
        if other.breaks:
            fits = (other.t[firsts] - TOGETHER <= stream.t[0]) & (
                stream.t[-1] <= other.t[lasts] + TOGETHER
            )
            if np.count_nonzero(fits) == 1:
                stream.offset = float(other.shift()[other.place[firsts]][fits][0])
                return


def sentences(clock: Straightened) -> Iterator[str]:
    """Yield a sentence for each correction of the clock of a recording."""
    for jump in clock.jumps:
        cause, done = in_words(jump)
        yield f"{cause}: {done}."
    for name, count in clock.outliers.items():
        of = f"{count} of {len(clock.kept[name])} messages"
        yield (
            f"{WORDS.get(name, name)}: {of} left out, their stamps are far from those of their "
            "neighbours."
        )


def in_words(jump: Jump) -> tuple[str, str]:
    """Return (cause, correction) of a Jump in words."""
    who = " and ".join(dict.fromkeys(WORDS.get(name, name) for name in jump.streams))
    where = (
        f"at message {jump.message} of {WORDS.get(jump.streams[0], jump.streams[0])}, "
        f"{jump.after:.1f} s after the first"
    )
    shifted = f"the stamps after it are shifted by {-jump.by:+.3f} s"
    anew = ", and the filter starts anew there" if jump.leads else ""
    return {
        WRAP: (
            f"the clock of {who} wraps at {jump.period} ({-jump.by:.3f} s) {where}",
            shifted,
        ),
        RESTART: (
            f"the clock of {who} started again {where}: it fell back by {_long(-jump.by)}",
            shifted + anew,
        ),
        SET: (f"the clock of {who} was set forward {where}, by {_long(jump.by)}", shifted),
        SILENCE: (
            f"the recorder paused, or the clock of {who} was set forward, by {_long(jump.by)} "
            f"{where}",
            "no stamp is changed",
        ),
    }[jump.kind]


def _long(seconds: float) -> str:
    for size, unit in ((365.25 * 86400.0, "years"), (86400.0, "days")):
        if seconds > 2.0 * size:
            return f"{seconds:.3f} s ({seconds / size:.1f} {unit})"
    return f"{seconds:.3f} s"


def apart(stamps: Mapping[str, np.ndarray]) -> Iterator[tuple[str, float, int]]:
    """Yield the streams whose stamps miss the time of the TDOAs.

    Either no message lies within the time of the TDOAs. Or the stream begins and ends later, or
    earlier, by about the same time.

    Parameters
    ----------
    stamps : mapping
        {stream: (n,) s}, including "tdoa".

    Yields
    ------
    name : str
        The stream.
    ahead : float
        s by which its stamps are ahead.
    count : int
        Number of its messages.
    """
    tdoa = stamps["tdoa"][np.isfinite(stamps["tdoa"])]
    if not len(tdoa):
        return
    first, last = float(tdoa.min()), float(tdoa.max())
    for name, t in stamps.items():
        t = t[np.isfinite(t)]
        if name == "tdoa" or not len(t):
            continue
        begin, end = float(t.min()) - first, float(t.max()) - last
        outside = t.min() > last or t.max() < first
        alike = (
            begin * end > 0.0
            and min(abs(begin), abs(end)) > LARGEST_STEP_BACK
            and abs(end - begin) < 0.3 * abs(begin + end) / 2.0
        )
        if outside or (alike and name == "imu"):
            yield name, 0.5 * (begin + end), len(t)


def sentence_on(name: str, ahead: float, count: int, first: str = "TDOAs") -> str:
    """Return the sentence about a stream that `apart` yields."""
    return (
        f"the stamps of {WORDS.get(name, name)} are {abs(ahead):.3f} s "
        f"{'ahead of' if ahead > 0.0 else 'behind'} those of the {first}: "
        f"none of its {count} messages can be used as they are; check names the remedy"
    )


def numbered(t: np.ndarray, length: float) -> np.ndarray:
    """Return the number of the interval of each time, from 0.

    Empty intervals have no number if most would be empty: an array with a place for each interval
    is never larger than `t`.

    Parameters
    ----------
    t : (n,) array
        Times, s.
    length : float
        Length of an interval, s.

    Returns
    -------
    (n,) array of int
    """
    number = (
        ((t - np.min(t, initial=np.inf)) / length).astype(np.int64)
        if len(t)
        else np.zeros(0, np.int64)
    )
    if len(t) and number.max() >= len(t):
        number = np.unique(number, return_inverse=True)[1].reshape(-1)
    return number


def grid(begin: float, end: float, step: float, t: np.ndarray) -> np.ndarray:
    """Return times from `begin` to before `end`, every `step`, s.

    Grid times far from every time of `t`, (n,) s, are left out if they would be most.
    """
    if end - begin <= step * SPARSE * max(len(t), 1000):
        return np.arange(begin, max(begin, end), step)
    inside = t[(t >= begin) & (t < end)]
    return begin + step * np.unique(np.floor((inside - begin) / step))
