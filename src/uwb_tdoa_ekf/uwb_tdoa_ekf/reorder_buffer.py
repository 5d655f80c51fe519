"""Put what arrives of all streams in order of stamps, and judge the clock of each stream on entry."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors import LOCATING
from uwb_tdoa_bias.common.stamps import (
    CONTRADICTED,
    LARGEST_STEP_BACK,
    StampGate,
    allowed_step,
    usual_step,
)

from .core import aids
from .core.memory import AID, IMU_SAMPLE, INVALID, LATE, TDOA, Measurements, joined

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

STREAMS = "imu", "tdoa", *aids.STREAMS
KINDS = IMU_SAMPLE, TDOA, *[AID] * len(aids.STREAMS)
IMU_STREAM, TDOA_STREAM, FIRST_AID = range(3)  # places in STREAMS
# one of these is the reference: its stamps are the time
LOCATING_STREAMS = (TDOA_STREAM, *map(STREAMS.index, LOCATING))
VELOCITY_STREAM = STREAMS.index("velocity")
ROOM = 256  # rows of a stream, to begin with
# messages of a stream: 2 s at 1 kHz; of one that stands still the first ones leave
MOST_WAITING = 2000
# s of stamps for which a stream counts as ahead after a row of it was refused for that
LATELY = 2.0
SILENT = 1.0  # s of stamps after which a stream is not waited for any more, until it is back
# share of `lag` for which sensors are waited for: bias_node's `hold` must outlast that by far
OF_AIDS = 0.5
TRIAL = 2.0  # s of stamps in order, after which a stream is trusted to go on so
# s by which each stream may be ahead of those that it is compared with. TDOAs that arrive 2 s after
# the inertial samples of their time are
# still used; other sensors are compared with the inertial samples, too.
LARGEST_LEADS = tuple(
    2.0 if place in (IMU_STREAM, *LOCATING_STREAMS) else 0.5 for place in range(len(STREAMS))
)
NO_AIDS = np.empty(0, AID)


class Restart(NamedTuple):
    """Why the filter starts anew. stream : name of the stream whose stamps fell back; step : s, by
    how much, below 0; at : s, stamp with which the new time begins; overtaken : another stream had
    moved the time ahead, and the stream itself did not jump.
    """

    stream: str
    step: float
    at: float
    overtaken: bool = False


class ReorderBuffer:
    """Streams of STREAMS. Rows, (n,) of their type in KINDS, come in any order and leave in the
    order of their stamps.

    Live, rows wait until every stream has passed them. A stream that is silent is waited for for
    `lag` seconds of stamps, one of the SENSORS for half of that, and after SILENT seconds not at
    all. `reorder` is waited for late siblings, unless they have come in order so far
    (LatenessPolicy). A row that is older than what was used is refused as late.

    The reference is the stream that locates the tag: TDOAs, or ranges without them. Its stamps are
    the time; while it is silent, those of inertial samples are, or without an IMU those of
    velocities. Only the reference can start the filter anew: when its clock falls back, or when
    another stream has moved the time ahead of it. Any other stream is judged by its lead over the
    reference: one that is too far ahead is refused as invalid, one that is behind as late, and
    neither moves the time. A recording is there as a whole: `load`.
    """

    def __init__(
        self,
        reorder: float,
        lag: float,
        use_imu: bool,
        refuse: Callable[[int, np.ndarray, int], None],
        restart: Callable[[Restart], None],
    ) -> None:
        """reorder, lag : s; use_imu : inertial samples are waited for; refuse(stream, rows,
        verdict) is called with what will not be used, restart(cause) when the filter has to start
        anew.
        """
        self.reorder, self.lag = reorder, lag
        self._awaited = TDOA_STREAM, *([IMU_STREAM] if use_imu else [])
        # by which time goes on while nothing locates
        self._moving = IMU_STREAM if use_imu else VELOCITY_STREAM
        self._leading = self._moving, *LOCATING_STREAMS
        self._refuse, self._restart = refuse, restart
        self.clear()

    @classmethod
    def of_recording(cls) -> ReorderBuffer:
        """For what is there as a whole: nothing is late."""
        return cls(0.0, 0.0, False, lambda stream, rows, verdict: None, lambda cause: None)

    def clear(self) -> None:
        """Forget everything."""
        self._streams = [_Stream(kind) for kind in KINDS]
        self._reference = TDOA_STREAM
        self.began = math.inf  # s, stamp of the first row of a leading stream
        # s: stamps of the first reference row that is overtaken, and of the IMU then
        self._overtaken: tuple[float, float] | None = None
        self.used_until = -math.inf  # s, stamp of the last row that was taken

    def __len__(self) -> int:
        """Rows that wait in order."""
        return sum(map(len, self._streams))

    @property
    def waiting(self) -> tuple[int, ...]:
        """Rows of each stream that neither left nor were refused yet."""
        return tuple(len(stream) + len(stream.gate) for stream in self._streams)

    @property
    def leads(self) -> tuple[float, ...]:
        """s by which each stream is ahead of the others, if rows of it have been refused for that
        lately; else 0.
        """
        newest = self.newest
        return tuple(
            stream.lead if stream.ahead and newest < stream.refused + LATELY else 0.0
            for stream in self._streams
        )

    @property
    def newest(self) -> float:
        """Stamp that the time has reached, s; -inf before the first row of a leading stream."""
        moving = self._streams[self._moving]
        return max(
            self._streams[self._reference].gate.newest,
            moving.gate.newest - (moving.lead if moving.lead > self.lag else 0.0),
        )

    @property
    def first(self) -> float:
        """Stamp of the oldest row that waits, s; inf if there is none."""
        return min(
            (float(stream.rows["t"][0]) for stream in self._streams if len(stream)),
            default=math.inf,
        )

    @property
    def watermark(self) -> float:
        """Stamp, s, up to which no row is to be expected any more; of more than MOST_WAITING of a
        leading stream the first may leave anyway.
        """
        newest, passed = self.newest, []
        for place in self._awaited:
            stream = self._streams[place]
            silent = stream.gate.newest < newest - SILENT and newest > self.began + SILENT
            if not silent:
                passed.append(max(stream.watermark(self.reorder), newest - self.lag))
        for place, stream in enumerate(self._streams[FIRST_AID:], FIRST_AID):
            if newest - SILENT < stream.gate.newest < newest:
                passed.append(max(stream.watermark(self.reorder), newest - OF_AIDS * self.lag))
            elif place in self._leading and stream.gate.newest >= newest:
                passed.append(stream.watermark(self.reorder))
        leading = (self._streams[place] for place in self._leading)
        too_many = (
            float(stream.rows["t"][-MOST_WAITING])
            for stream in leading
            if len(stream) > MOST_WAITING
        )
        return max(min(passed, default=newest), *too_many, -math.inf)

    def add(self, place: int, rows: np.ndarray, usable: np.ndarray) -> None:
        """Take rows (n,) of a stream in the order of their arrival; usable (n,) bool: of the others
        only the stamps count, and whoever adds them accounts for them.
        """
        if not len(rows):
            return
        if place in self._leading and self.began == math.inf and usable.any():
            self.began = float(rows["t"][usable][0])
        self._streams[place].seen = float(rows["t"][-1])
        if usable.all() and self._streams[place].append(rows, self.used_until, self._limit(place)):
            if place == self._reference:
                self._overtaken = None
        else:
            for k, (t, good) in enumerate(zip(rows["t"].tolist(), usable.tolist())):
                if good:
                    self._take_in(place, t, rows[k : k + 1])
                elif t <= self._limit(place):
                    # or whoever waits for our pose of this time waits for the next one
                    self._streams[place].gate.pass_time(t, self._reached(place))
        if place in self._leading:
            self._judge(place)
        else:
            self._refuse_too_many(place)

    def load(self, place: int, rows: np.ndarray) -> None:
        """Take rows (n,) of a stream of a recording, in the order of their stamps and not before
        those that came before. Those of all SENSORS may come as one, in the order of stamps and
        kinds.
        """
        self._streams[place].extend(rows)

    def take(self, until: float) -> Measurements:
        """Remove and return the rows stamped up to `until`, s; those of the SENSORS in the order of
        their stamps, then of STREAMS.
        """
        imu, tdoa, *parts = (stream.take(until) for stream in self._streams)
        parts = [part for part in parts if len(part)]
        felt = joined(AID, parts) if parts else NO_AIDS
        felt = felt[np.lexsort((felt["kind"], felt["t"]))] if len(parts) > 1 else felt
        for part in (imu, tdoa, felt):
            if len(part):
                self.used_until = max(self.used_until, float(part["t"][-1]))
        return Measurements(imu, tdoa, felt)

    def finish(self) -> None:
        """Nothing follows: refuse what waits for a neighbour of its stamp."""
        for place, stream in enumerate(self._streams):
            self._refuse_outliers(place, stream.gate.finish())

    def _limit(self, place: int) -> float:
        """Stamp, s, up to which rows of a stream are taken. It is infinite for a stream that agrees
        with the others: when these are silent, it goes on.
        """
        stream = self._streams[place]
        if place in (TDOA_STREAM, self._reference) or not (
            stream.ahead or stream.gate.newest == -math.inf
        ):
            return math.inf
        compared = self._compared(place)
        return math.inf if compared == -math.inf else compared + LARGEST_LEADS[place]

    def _compared(self, place: int) -> float:
        """Stamp, s, of those streams by which another one is judged: the reference, for sensors the
        inertial samples, too.
        """
        times = [self._streams[self._reference].gate.newest]
        moving = self._streams[self._moving]
        if place not in self._leading and not moving.ahead:
            times.append(moving.gate.newest)
        return max(times)

    def _judge(self, place: int) -> None:
        """Compare the other streams with a leading one, of which rows were added."""
        if place in LOCATING_STREAMS and place != self._reference:
            stream, reference = self._streams[place], self._streams[self._reference]
            if (
                place == TDOA_STREAM
                or stream.gate.newest - max(stream.lead, 0.0) > reference.gate.newest + SILENT
            ):
                self._reference = place
                stream.ahead, stream.lead = False, 0.0
        for other, stream in enumerate(self._streams):
            if (
                other == self._reference
                or stream.gate.newest == -math.inf
                or other in self._leading
                and place != self._reference
            ):
                continue
            if stream.ahead:
                continue  # its lead is that of the last row that was refused
            compared = self._compared(other)
            stream.lead = stream.gate.newest - compared
            if stream.lead > LARGEST_LEADS[other]:
                stream.ahead, stream.refused = True, compared
                self._refuse(other, stream.drop_after(compared + LARGEST_LEADS[other]), INVALID)

    def _refuse_too_many(self, place: int) -> None:
        """Bound what waits of a sensor while the streams that lead are silent."""
        stream = self._streams[place]
        if len(stream) > MOST_WAITING:
            self._refuse(place, stream.take_first(len(stream) - MOST_WAITING), LATE)

    def _take_in(self, place: int, t: float, row: np.ndarray) -> None:
        """Keep a row stamped t, s, and those that were held because of their stamps, if their
        stamps are accepted.
        """
        stream, limit = self._streams[place], self._limit(place)
        if t > limit:
            self._refuse_ahead(place, t, row)
            return
        stream.ahead = False
        newest, before = stream.gate.newest, self.newest
        accepted, outliers, jumped_back = stream.gate.take(t, row, self._reached(place))
        if len(accepted) > 1 and place != self._reference and self._is_heard(newest):
            self._refuse_outliers(place, outliers)
            self._jump(place, accepted, newest)
            return
        if jumped_back and place == self._reference:
            self._start_anew(
                place, Restart(STREAMS[place], accepted[0][0] - newest, accepted[0][0])
            )
            newest = -math.inf
            stream = self._streams[place]
        self._refuse_outliers(place, outliers)
        if accepted and self._is_overtaken(place, accepted[-1][0]):
            cause = Restart(STREAMS[place], accepted[0][0] - before, accepted[0][0], overtaken=True)
            self._start_anew(place, cause)
            newest = -math.inf
            stream = self._streams[place]
        for t, row in accepted:
            self._merge(place, t, row, newest)
            newest = max(newest, t)

    def _refuse_ahead(self, place: int, t: float, row: np.ndarray) -> None:
        """Refuse a row stamped t, s, of a stream that is too far ahead."""
        stream, compared = self._streams[place], self._compared(place)
        stream.ahead, stream.lead, stream.refused = True, t - compared, compared
        self._refuse(place, row, INVALID)

    def _is_heard(self, newest: float) -> bool:
        """Whether the reference goes on at a stamp that another stream has reached, s."""
        return self._streams[self._reference].gate.newest > newest - SILENT

    def _jump(self, place: int, accepted: list[tuple[float, np.ndarray]], newest: float) -> None:
        """Go on with a stream whose clock has jumped while that of the reference has not. newest :
        its newest stamp before, s. The time is that of the reference: a stream that is ahead does
        not move it.
        """
        stream, compared = self._streams[place], self._compared(place)
        stream.lead = max(0.0, accepted[-1][0] - compared)
        if stream.lead > LARGEST_LEADS[place]:
            stream.gate.newest = newest
            for t, row in accepted:
                self._refuse_ahead(place, t, row)
            return
        for t, row in accepted:
            self._merge(place, t, row, newest)
            newest = max(newest, t)

    def _merge(self, place: int, t: float, row: np.ndarray, newest: float) -> None:
        """Put a row stamped t, s, among those that wait, unless it is late. newest : stamp of its
        stream before it, s.
        """
        stream = self._streams[place]
        if stream.policy.is_late(t, newest) or t < self.used_until:
            self._refuse(place, row, LATE)
        else:
            stream.merge(row)

    def _reached(self, place: int) -> list[float]:
        """Stamps, s, that other leading streams have reached, or are about to jump to."""
        others = [self._streams[other].gate for other in self._leading if other != place]
        return [t for gate in others for t in (gate.newest, gate.held) if math.isfinite(t)]

    def _is_overtaken(self, place: int, t: float) -> bool:
        """Whether rows of the reference, of which the last is stamped t, s, have been far behind
        what was used for a while. Rows that were kept back and come all at once are not: time has
        not gone on meanwhile.
        """
        if place != self._reference or t >= self.used_until - LARGEST_STEP_BACK:
            if place == self._reference:
                self._overtaken = None
            return False
        seen = self._streams[self._moving].seen
        if self._overtaken is None or t < self._overtaken[0]:
            self._overtaken = t, seen
        since, then = self._overtaken
        return t - since >= CONTRADICTED and (seen - then >= CONTRADICTED or seen == then)

    def _refuse_outliers(self, place: int, outliers: Sequence[tuple[float, np.ndarray]]) -> None:
        """Refuse rows whose stamps are far from those of their neighbours."""
        for t, row in outliers:
            self._refuse(place, row, INVALID if t > self._streams[place].gate.newest else LATE)

    def _start_anew(self, place: int, cause: Restart) -> None:
        """Forget everything but the time that a stream has fallen back to."""
        for k, stream in enumerate(self._streams):
            if len(stream):
                self._refuse(k, stream.rows, LATE)
        held = [
            (k, *outlier)
            for k, stream in enumerate(self._streams)
            if k != place
            for outlier in stream.gate.finish()
        ]
        gate = self._streams[place].gate
        self.clear()
        self._streams[place].gate, self._reference = gate, place
        self._restart(cause)
        for k, t, row in held:  # was not plausible in the time that is over
            self._take_in(k, t, row)


class LatenessPolicy:
    """What of one stream is late. It is judged by the order of its messages alone, which is their
    sender's, never by when they arrive.

    The first message that breaks the order of a trusted stream counts as late, even if nothing
    newer has been used yet. From then on the stream is not trusted any more. If no stamp has come
    twice, none is waited for a second time: then the first that does counts as late, and from then
    on they are waited for.
    """

    def __init__(self) -> None:
        self._first, self._sorted, self._rising, self._closed = math.nan, True, True, -math.inf

    def trusted(self, newest: float) -> bool:
        """Whether nothing older than `newest`, s, the newest stamp so far, is to be expected."""
        return self._sorted and newest - self._first >= TRIAL

    def watermark(self, newest: float, reorder: float) -> float:
        """Stamp, s, up to which nothing is to be expected any more; newest : s, so far; reorder : s
        by which messages of a stream that is not trusted may be out of order.
        """
        if not self.trusted(newest):
            return math.nextafter(newest - reorder, -math.inf)
        return newest if self._rising else math.nextafter(newest, -math.inf)

    def begin(self, t: float) -> None:
        """A message stamped t, s, has come in order."""
        if self._first != self._first:
            self._first = t

    def is_late(self, t: float, newest: float) -> bool:
        """Whether a message stamped t, s, comes too late to be used; newest : s, before it, -inf
        for the first.
        """
        self.begin(t)
        if t > newest:
            return False
        if self.trusted(newest):
            self._closed = max(self._closed, self.watermark(newest, 0.0))
        self._sorted, self._rising = self._sorted and t == newest, False
        return t <= self._closed


class _Stream:
    """Rows of one structured type with a field t, in the order of their stamps. They come a few at
    a time, nearly always in order: then they are appended. gate : StampGate; policy :
    LatenessPolicy; lead : s, by which it was ahead of the streams it is compared with when these
    went on last; ahead : the last row was refused for that; refused : s, stamp of the others when
    that was;
    seen : s, stamp of the last row that came, whatever became of it.
    """

    def __init__(self, kind: np.dtype) -> None:
        self.gate, self.policy = StampGate(), LatenessPolicy()
        self.lead, self.ahead, self.refused, self.seen = 0.0, False, -math.inf, -math.inf
        self._room, self._first, self._end = np.empty(ROOM, kind), 0, 0
        self._none = np.empty(0, kind)

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def rows(self) -> np.ndarray:
        """(n,) of them, which the next call may change."""
        return self._room[self._first : self._end]

    def watermark(self, reorder: float) -> float:
        """Stamp, s, up to which nothing is to be expected any more."""
        return self.policy.watermark(self.gate.newest, reorder)

    def append(self, rows: np.ndarray, after: float, limit: float) -> bool:
        """Append rows (k,), k > 0, if their stamps rise, are not before `after`, s, nor after
        `limit`, s, but after the newest stamp of the stream, and plausible for it (see StampGate).
        Returns whether they were appended.
        """
        if len(self.gate) or self.ahead:
            return False
        self._make_room(len(rows))
        newest, usual = _append(
            self._room,
            self._first,
            self._end,
            rows,
            (self.gate.newest, self.gate.usual),
            after,
            limit,
        )
        if newest != newest:
            return False
        self._end += len(rows)
        self.gate.newest, self.gate.usual = newest, usual
        self.policy.begin(rows["t"][0])
        return True

    def extend(self, rows: np.ndarray) -> None:
        """Append rows (k,) whatever their stamps are; where there are none they become the room."""
        if self._first == self._end:
            self._room, self._first, self._end = rows, 0, len(rows)
            return
        self._make_room(len(rows))
        self._room[self._end : self._end + len(rows)] = rows
        self._end += len(rows)

    def merge(self, rows: np.ndarray) -> None:
        """Put rows among the others: by stamp, and by everything else where stamps are equal, not
        by when they came.
        """
        both = np.concatenate([self.rows, rows])
        columns = [
            column for name in both.dtype.names for column in both[name].reshape(len(both), -1).T
        ]
        self._first = self._end = 0
        self.extend(both[np.lexsort(columns[::-1])])

    def take(self, until: float) -> np.ndarray:
        """Remove and return the rows stamped up to `until`, s."""
        if self._first == self._end:
            return self._none
        stamps, n, step = self._room["t"][self._first : self._end], 0, ROOM
        while (
            n < len(stamps) and stamps[n] <= until
        ):  # a few at a time: numpy copies what it searches
            n += int(stamps[n : n + step].searchsorted(until, side="right"))
            step *= 2
        if not n:
            return self._none
        self._first += n
        return self._room[self._first - n : self._first]  # nothing is written there any more

    def take_first(self, n: int) -> np.ndarray:
        """Remove and return the first n rows."""
        self._first += n
        return self._room[self._first - n : self._first]

    def drop_after(self, t: float) -> np.ndarray:
        """Remove and return the rows stamped after t, s, and those that are held.

        The stream goes on from the last row that is left.
        """
        kept = int(self.rows["t"].searchsorted(t, side="right"))
        dropped = np.concatenate([self.rows[kept:], *(row for _, row in self.gate.finish())])
        self._end = self._first + kept
        self.gate.newest = float(self.rows["t"][-1]) if kept else -math.inf
        return dropped

    def _make_room(self, n: int) -> None:
        if self._end + n > len(self._room):
            kept = self.rows
            room = np.empty(max(ROOM, 2 * (len(kept) + n)), self._room.dtype)
            room[: len(kept)] = kept
            self._room, self._first, self._end = room, 0, len(kept)


@compiled
def _append(
    room: np.ndarray,
    first: int,
    end: int,
    rows: np.ndarray,
    clock: tuple[float, float],
    after: float,
    limit: float,
) -> tuple[float, float]:
    newest, usual = clock[0], clock[1]
    last = max(newest, room[end - 1].t) if end > first else newest
    if newest == -np.inf:
        newest = rows[0].t
    for k in range(len(rows)):
        t = rows[k].t
        if not last < t <= min(newest + allowed_step(usual), limit) or t < after:
            return np.nan, usual
        usual = usual_step(usual, t - newest)
        newest = last = t
    for k in range(len(rows)):
        room[end + k] = rows[k]
    return newest, usual
