"""What has arrived of each stream, put in the order of its stamps, until nothing older is to be expected."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled
from uwb_tdoa_bias.foundation.sensors import LOCATING
from uwb_tdoa_bias.foundation.stamps import LARGEST_STEP_AHEAD, StampGate

from .core import aids
from .core.memory import AID, IMU_SAMPLE, TDOA, Measurements, joined
from .core.verdicts import INVALID, LATE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

STREAMS = "imu", "tdoa", *aids.STREAMS
KINDS = IMU_SAMPLE, TDOA, *[AID] * len(aids.STREAMS)
IMU_STREAM, TDOA_STREAM, FIRST_AID = range(3)  # places in STREAMS
LEADING = IMU_STREAM, TDOA_STREAM, *map(STREAMS.index, LOCATING)  # by whose stamps time goes on
ROOM = 256  # rows of a stream, to begin with
MOST_WAITING = 2000  # messages of a stream: 2 s at 1 kHz; those of one stamp for ever, or a nanosecond apart, would never be passed
SILENT = 1.0  # s of stamps after which a sensor is not waited for any more, until it is back
OF_AIDS = 0.5  # share of `lag` for which they are waited for: bias_node's `hold` must outlast that by far
TRIAL = 2.0  # s of stamps in order, after which a stream is trusted to go on so
NO_AIDS = np.empty(0, AID)


class ReorderBuffer:
    """The streams of STREAMS. Rows, (n,) of their type in KINDS, come in any order and leave in the order of their stamps.

    Live, rows wait until every stream has passed them. A stream that is silent is waited for for `lag` seconds of stamps, one of the
    SENSORS for half of that, and only if it was there a second ago; `reorder` more for late siblings, unless they have come in order so far
    (LatenessPolicy). What is older than what was used is refused as late. A stream that falls back in time starts all anew; a single
    stamp far from its neighbours is refused as late, or as invalid if it lies ahead. A recording is there as a whole: `load`.
    """

    def __init__(
        self, reorder: float, lag: float, use_imu: bool, refuse: Callable[[int, np.ndarray, int], None], restart: Callable[[], None]
    ) -> None:
        """reorder, lag : s; use_imu : inertial samples are waited for; refuse(stream, rows, verdict) is called with what will not be used,
        restart() when a stream has fallen back in time."""
        self.reorder, self.lag = reorder, lag
        self._awaited = TDOA_STREAM, *([IMU_STREAM] if use_imu else [])
        self._refuse, self._restart = refuse, restart
        self.clear()

    @classmethod
    def of_recording(cls) -> ReorderBuffer:
        """For what is there as a whole: nothing is late."""
        return cls(0.0, 0.0, False, lambda stream, rows, verdict: None, lambda: None)

    def clear(self) -> None:
        """Forget everything."""
        self._streams = [_Stream(kind) for kind in KINDS]
        self.used_until = -math.inf  # s, stamp of the last row that was taken

    def __len__(self) -> int:
        """Rows that wait in order."""
        return sum(map(len, self._streams))

    @property
    def waiting(self) -> tuple[int, ...]:
        """Rows of each stream that neither left nor were refused yet."""
        return tuple(len(stream) + len(stream.gate) for stream in self._streams)

    @property
    def newest(self) -> float:
        """Stamp of the newest row, s; -inf before the first."""
        return max(stream.gate.newest for stream in self._streams)

    @property
    def first(self) -> float:
        """Stamp of the oldest row that waits, s; inf if there is none."""
        return min((float(stream.rows["t"][0]) for stream in self._streams if len(stream)), default=math.inf)

    @property
    def watermark(self) -> float:
        """Stamp, s, up to which no row is to be expected any more; of more than MOST_WAITING of a stream the first may leave anyway."""
        newest = max(self._streams[place].gate.newest for place in LEADING)
        passed = [self._streams[place].watermark(self.reorder) for place in self._awaited]
        for stream in self._streams[FIRST_AID:]:
            if newest - SILENT < stream.gate.newest < newest:
                passed.append(max(stream.watermark(self.reorder), newest - OF_AIDS * self.lag))
        too_many = (float(stream.rows["t"][-MOST_WAITING]) for stream in self._streams if len(stream) > MOST_WAITING)
        return max(min(passed), newest - self.lag, *too_many)

    def add(self, place: int, rows: np.ndarray, usable: np.ndarray) -> None:
        """Take rows (n,) of a stream in the order of their arrival; usable (n,) bool: of the others only the stamps
        count, and whoever adds them accounts for them."""
        if len(rows) and usable.all() and self._streams[place].append(rows, self.used_until):
            return
        for k, (t, good) in enumerate(zip(rows["t"].tolist(), usable.tolist())):
            if good:
                self._take_in(place, t, rows[k : k + 1])
            else:
                self._streams[place].gate.pass_time(t)  # or whoever waits for our pose of this time waits for the next one

    def load(self, place: int, rows: np.ndarray) -> None:
        """Take rows (n,) of a stream of a recording, in the order of their stamps and not before those that came before. Those of all
        SENSORS may come as one, in the order of stamps and kinds."""
        self._streams[place].extend(rows)

    def take(self, until: float) -> Measurements:
        """Remove and return the rows stamped up to `until`, s; those of the SENSORS in the order of their stamps, then of STREAMS."""
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

    def _take_in(self, place: int, t: float, row: np.ndarray) -> None:
        """Keep a row stamped t, s, and one that was held because of its stamp, if their stamps are accepted."""
        stream = self._streams[place]
        newest = stream.gate.newest
        accepted, outliers, jumped_back = stream.gate.take(t, row)
        if jumped_back:
            self._start_anew(place)
            newest = -math.inf
            stream = self._streams[place]
        self._refuse_outliers(place, outliers)
        for t, row in accepted:
            if stream.policy.is_late(t, newest) or t < self.used_until:
                self._refuse(place, row, LATE)
            else:
                stream.merge(row)
            newest = max(newest, t)

    def _refuse_outliers(self, place: int, outliers: Sequence[tuple[float, np.ndarray]]) -> None:
        """Refuse rows whose stamps are far from those of their neighbours."""
        for t, row in outliers:
            self._refuse(place, row, INVALID if t > self._streams[place].gate.newest else LATE)

    def _start_anew(self, place: int) -> None:
        """Forget everything but the time that a stream has fallen back to."""
        for k, stream in enumerate(self._streams):
            self._refuse(k, stream.rows, LATE)
        held = [(k, *outlier) for k, stream in enumerate(self._streams) if k != place for outlier in stream.gate.finish()]
        gate = self._streams[place].gate
        self.clear()
        self._streams[place].gate = gate
        self._restart()
        for k, t, row in held:  # was not plausible in the time that is over
            self._take_in(k, t, row)


class LatenessPolicy:
    """What of one stream is late. It is judged by the order of its messages alone, which is their sender's, never by when they arrive.

    The first message that breaks the order of a trusted stream counts as late, even if nothing newer has been used yet. From
    then on the stream is not trusted any more. If no stamp has come twice, none is waited for a second time: then the first that
    does counts as late, and from then on they are waited for.
    """

    def __init__(self) -> None:
        self._first, self._sorted, self._rising, self._closed = math.nan, True, True, -math.inf

    def trusted(self, newest: float) -> bool:
        """Whether nothing older than `newest`, s, the newest stamp so far, is to be expected."""
        return self._sorted and newest - self._first >= TRIAL

    def watermark(self, newest: float, reorder: float) -> float:
        """Stamp, s, up to which nothing is to be expected any more; newest : s, so far; reorder : s by which messages of a stream
        that is not trusted may be out of order."""
        if not self.trusted(newest):
            return math.nextafter(newest - reorder, -math.inf)
        return newest if self._rising else math.nextafter(newest, -math.inf)

    def begin(self, t: float) -> None:
        """A message stamped t, s, has come in order."""
        if self._first != self._first:
            self._first = t

    def is_late(self, t: float, newest: float) -> bool:
        """Whether a message stamped t, s, comes too late to be used; newest : s, before it, -inf for the first."""
        self.begin(t)
        if t > newest:
            return False
        if self.trusted(newest):
            self._closed = max(self._closed, self.watermark(newest, 0.0))
        self._sorted, self._rising = self._sorted and t == newest, False
        return t <= self._closed


class _Stream:
    """Rows of one structured type with a field t, in the order of their stamps. They come a few at a time, nearly always in order: then
    they are appended. gate : StampGate; policy : LatenessPolicy."""

    def __init__(self, kind: np.dtype) -> None:
        self.gate, self.policy = StampGate(), LatenessPolicy()
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

    def append(self, rows: np.ndarray, after: float) -> bool:
        """Append rows (k,), k > 0, if their stamps rise, are not before `after`, s, but after the newest stamp of the stream, and plausible
        for it (see StampGate). Returns whether they were appended."""
        if self.gate:
            return False
        self._make_room(len(rows))
        newest = _append(self._room, self._first, self._end, rows, self.gate.newest, after)
        if newest != newest:
            return False
        self._end += len(rows)
        self.gate.newest = newest
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
        """Put rows among the others: by stamp, and by everything else where stamps are equal, not by when they came."""
        both = np.concatenate([self.rows, rows])
        columns = [column for name in both.dtype.names for column in both[name].reshape(len(both), -1).T]
        self._first = self._end = 0
        self.extend(both[np.lexsort(columns[::-1])])

    def take(self, until: float) -> np.ndarray:
        """Remove and return the rows stamped up to `until`, s."""
        if self._first == self._end:
            return self._none
        stamps, n, step = self._room["t"][self._first : self._end], 0, ROOM
        while n < len(stamps) and stamps[n] <= until:  # a few at a time: numpy copies what it searches
            n += int(stamps[n : n + step].searchsorted(until, side="right"))
            step *= 2
        if not n:
            return self._none
        self._first += n
        return self._room[self._first - n : self._first]  # nothing is written there any more

    def _make_room(self, n: int) -> None:
        if self._end + n > len(self._room):
            kept = self.rows
            room = np.empty(max(ROOM, 2 * (len(kept) + n)), self._room.dtype)
            room[: len(kept)] = kept
            self._room, self._first, self._end = room, 0, len(kept)


@compiled
def _append(room: np.ndarray, first: int, end: int, rows: np.ndarray, newest: float, after: float) -> float:
    last = max(newest, room[end - 1].t) if end > first else newest
    if newest == -np.inf:
        newest = rows[0].t
    for k in range(len(rows)):
        t = rows[k].t
        if not last < t <= newest + LARGEST_STEP_AHEAD or t < after:
            return np.nan
        newest = last = t
    for k in range(len(rows)):
        room[end + k] = rows[k]
    return newest
