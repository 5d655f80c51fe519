# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sort the measurements of all streams by stamp and check the clock of each stream."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import NamedTuple

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

from .core import sensors
from .core.memory import IMU_SAMPLE, INVALID, LATE, SENSOR_ROW, TDOA, Measurements, joined

STREAMS = "imu", "tdoa", *sensors.STREAMS
KINDS = IMU_SAMPLE, TDOA, *[SENSOR_ROW] * len(sensors.STREAMS)
IMU_STREAM, TDOA_STREAM, FIRST_SENSOR = range(3)  # places in STREAMS
# the reference is among these streams; its stamps define the time
LOCATING_STREAMS = (TDOA_STREAM, *map(STREAMS.index, LOCATING))
VELOCITY_STREAM = STREAMS.index("velocity")
ROOM = 256  # initial capacity of a stream, in rows
# messages of a stream that may wait: 2 s at 1 kHz; beyond that, the oldest leave
MOST_WAITING = 2000
# s of stamps for which a stream counts as ahead after a refused row
LATELY = 2.0
SILENT = 1.0  # s of stamps after which the buffer stops waiting for a silent stream
# share of `lag` for which the buffer waits for SENSORS; `hold` of bias_node must be much longer
OF_SENSORS = 0.5
TRIAL = 2.0  # s of stamps in order after which the buffer assumes that a stream stays in order
# s of stamps of the reference that may come after a pause of the link, all at once; ratio of the paces
# of the stamps and of the time above which the reference catches up
LONGEST_PAUSE, CATCHING_UP = (5.0, 2.0)
# s, largest lead of each stream over the streams it is compared with. TDOAs that arrive 2 s after
# inertial samples of the same time are still used. Other sensors are compared with inertial samples
# too.
LARGEST_LEADS = tuple(
    2.0 if place in (IMU_STREAM, *LOCATING_STREAMS) else 0.5 for place in range(len(STREAMS))
)
NO_SENSORS = np.empty(0, SENSOR_ROW)


class Restart(NamedTuple):
    """Describe why the filter restarts.

    Attributes
    ----------
    stream : str
        Name of the stream whose stamps are behind the time: they jumped back, or see `overtaken`.
    step : float
        First stamp of the new time minus the newest stamp before, in s, below 0.
    at : float
        First stamp of the new time, in s.
    overtaken : bool
        True if another stream had moved the time ahead, and this stream itself did not jump.
    """

    stream: str
    step: float
    at: float
    overtaken: bool = False


class ReorderBuffer:
    """Sort rows of all STREAMS by their stamps.

    Rows are (n,) arrays of the type in KINDS. A live row waits until every stream has passed its
    stamp. The buffer waits `lag` s of stamps for a silent stream, and half of that for a sensor in
    SENSORS. After SILENT s it stops waiting. It waits `reorder` s for rows out of order, unless a
    stream has been in order so far (LatenessPolicy). A row older than the rows already used is
    refused as late.

    The reference is the stream that locates the tag: TDOAs, or ranges without TDOAs. Its stamps
    define the time. While the reference is silent, inertial samples define the time, or velocities
    without an IMU.

    Only the reference can restart the filter. The filter restarts if the reference clock jumps
    back, or if another stream has moved the time ahead. Every other stream is compared with the
    reference. Rows too far ahead are refused as invalid, rows behind as late, and neither moves the
    time. A recording is added with `load`.

    Attributes
    ----------
    imu_expected : bool
        False: do not wait for inertial samples before the first one. Nobody publishes them.
    """

    def __init__(
        self,
        reorder: float,
        lag: float,
        use_imu: bool,
        refuse: Callable[[int, np.ndarray, int], None],
        restart: Callable[[Restart], None],
    ) -> None:
        """Create an empty buffer.

        Parameters
        ----------
        reorder, lag : float
            Waiting times, in s of stamps.
        use_imu : bool
            Wait for inertial samples.
        refuse : callable
            `refuse(stream, rows, verdict)` receives rows that will not be used.
        restart : callable
            `restart(cause)` is called when the filter must restart.
        """
        self.reorder, self.lag = reorder, lag
        self.imu_expected = True
        self._awaited = TDOA_STREAM, *([IMU_STREAM] if use_imu else [])
        # stream that defines the time while no stream locates the tag
        self._moving = IMU_STREAM if use_imu else VELOCITY_STREAM
        self._leading = self._moving, *LOCATING_STREAMS
        self._refuse, self._restart = refuse, restart
        self.clear()

    @classmethod
    def of_recording(cls) -> ReorderBuffer:
        """Return a buffer for a recording, in which no row is late."""
        return cls(0.0, 0.0, False, lambda stream, rows, verdict: None, lambda cause: None)

    def clear(self) -> None:
        """Remove all rows and reset the clocks of all streams."""
        self._streams = [_Stream(kind) for kind in KINDS]
        self._reference = TDOA_STREAM
        self.began = math.inf  # s, stamp of the first row of a leading stream
        # s: stamp of the first reference row behind the time, and of the IMU then
        self._overtaken: tuple[float, float] | None = None
        self.used_until = -math.inf  # s, stamp of the last row that was taken

    def __len__(self) -> int:
        """Return the number of rows that wait in order."""
        return sum(map(len, self._streams))

    @property
    def waiting(self) -> tuple[int, ...]:
        """Return the number of rows of each stream that were neither taken nor refused yet."""
        return tuple(len(stream) + len(stream.gate) for stream in self._streams)

    @property
    def leads(self) -> tuple[float, ...]:
        """Return the lead of each stream over the others, in s.

        The lead is 0 unless rows of the stream were refused for it within the last LATELY s.
        """
        newest = self.newest
        return tuple(
            stream.lead if stream.ahead and newest < stream.refused + LATELY else 0.0
            for stream in self._streams
        )

    @property
    def newest(self) -> float:
        """Return the stamp that the time has reached, in s; -inf before the first leading row."""
        moving = self._streams[self._moving]
        return max(
            self._streams[self._reference].gate.newest,
            moving.gate.newest - (moving.lead if moving.lead > self.lag else 0.0),
        )

    @property
    def first(self) -> float:
        """Return the stamp of the oldest waiting row, in s; inf if no row waits."""
        return min(
            (float(stream.rows["t"][0]) for stream in self._streams if len(stream)),
            default=math.inf,
        )

    @property
    def watermark(self) -> float:
        """Return the stamp, in s, up to which no further row is expected.

        If more than MOST_WAITING rows of a leading stream wait, the oldest may leave anyway.
        """
        newest, passed = self.newest, []
        for place in self._awaited:
            stream = self._streams[place]
            silent = stream.gate.newest < newest - SILENT and newest > self.began + SILENT
            if place == IMU_STREAM and not self.imu_expected and stream.gate.newest == -math.inf:
                silent = True
            if not silent:
                passed.append(max(stream.watermark(self.reorder), newest - self.lag))
        for place, stream in enumerate(self._streams[FIRST_SENSOR:], FIRST_SENSOR):
            if newest - SILENT < stream.gate.newest < newest:
                passed.append(max(stream.watermark(self.reorder), newest - OF_SENSORS * self.lag))
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
        """Add rows of a stream in the order of their arrival.

        Parameters
        ----------
        place : int
            Place of the stream in STREAMS.
        rows : (n,) array
            Rows of the type in KINDS.
        usable : (n,) bool array
            Rows that can be measurements. Only the stamps of the others count, and the caller
            counts these rows as invalid.
        """
        if not len(rows):
            return
        if place in self._leading and self.began == math.inf and usable.any():
            self.began = float(rows["t"][usable][0])
        self._streams[place].seen = float(rows["t"][-1])
        if usable.all() and self._streams[place].append(
            rows, self.used_until, self._largest_stamp(place)
        ):
            if place == self._reference:
                self._overtaken = None
        else:
            for k, (t, good) in enumerate(zip(rows["t"].tolist(), usable.tolist())):
                if good:
                    self._take_in(place, t, rows[k : k + 1])
                elif t <= self._largest_stamp(place):
                    # pass the time on: bias_node may wait for the pose of this stamp
                    self._streams[place].gate.pass_time(t, self._reached(place))
        stream = self._streams[place]
        if place in self._leading:
            self._judge(place)
        elif len(stream) > MOST_WAITING:  # the leading streams are silent
            self._refuse(place, stream.take_first(len(stream) - MOST_WAITING), LATE)

    def load(self, place: int, rows: np.ndarray) -> None:
        """Add rows of a recorded stream, sorted by stamp and not before earlier rows.

        Rows of all SENSORS may be merged, sorted by stamp and kind.

        Parameters
        ----------
        place : int
            Place of the stream in STREAMS.
        rows : (n,) array
            Rows of the type in KINDS.
        """
        self._streams[place].extend(rows)

    def take(self, until: float) -> Measurements:
        """Remove and return the rows with stamps up to `until`, in s.

        Rows of SENSORS are merged and sorted by stamp, then by kind.
        """
        imu, tdoa, *parts = (stream.take(until) for stream in self._streams)
        parts = [part for part in parts if len(part)]
        felt = joined(SENSOR_ROW, parts) if parts else NO_SENSORS
        if len(parts) > 1:
            felt = felt[np.lexsort((felt["kind"], felt["t"]))]
        for part in (imu, tdoa, felt):
            if len(part):
                self.used_until = max(self.used_until, float(part["t"][-1]))
        return Measurements(imu, tdoa, felt)

    def finish(self) -> None:
        """Refuse rows that wait for a neighbour with a similar stamp, because no row follows."""
        for place, stream in enumerate(self._streams):
            self._refuse_outliers(place, stream.gate.finish())

    def _largest_stamp(self, place: int) -> float:
        """Return the largest stamp, in s, of a row that a stream may add.

        Only a stream that is ahead, or has no stamp yet, has a limit: LARGEST_LEADS after the stamp
        with which it is compared. A stream that agrees with the others may continue while they are
        silent.
        """
        stream = self._streams[place]
        if place in (TDOA_STREAM, self._reference) or not (
            stream.ahead or stream.gate.newest == -math.inf
        ):
            return math.inf
        compared = self._compared(place)
        return math.inf if compared == -math.inf else compared + LARGEST_LEADS[place]

    def _compared(self, place: int) -> float:
        """Return the stamp, in s, with which a stream is compared.

        It is the stamp of the reference. Sensors are compared with inertial samples too.
        """
        times = [self._streams[self._reference].gate.newest]
        moving = self._streams[self._moving]
        if place not in self._leading and not moving.ahead:
            times.append(moving.gate.newest)
        return max(times)

    def _judge(self, place: int) -> None:
        """Compare the other streams with a leading stream to which rows were added."""
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
                continue  # keep the lead of the last row that was refused
            compared = self._compared(other)
            stream.lead = stream.gate.newest - compared
            if stream.lead > LARGEST_LEADS[other]:
                stream.ahead, stream.refused = True, compared
                self._refuse(other, stream.drop_after(compared + LARGEST_LEADS[other]), INVALID)

    def _take_in(self, place: int, t: float, row: np.ndarray) -> None:
        """Add one row if its stamp is accepted, with rows that were held because of their stamps.

        Parameters
        ----------
        place : int
            Place of the stream in STREAMS.
        t : float
            Stamp of the row, in s.
        row : (1,) array
            Row of the type in KINDS.
        """
        stream, limit = self._streams[place], self._largest_stamp(place)
        if t > limit:
            self._refuse_ahead(place, t, row)
            return
        stream.ahead = False
        newest, before = stream.gate.newest, self.newest
        accepted, outliers, jumped_back = stream.gate.take(t, row, self._reached(place))
        self._refuse_outliers(place, outliers)
        # the reference is heard while the clock of this stream has jumped: it defines the time
        heard = self._streams[self._reference].gate.newest > newest - SILENT
        jumped = len(accepted) > 1 and place != self._reference and heard
        if jumped and self._refuse_jump(place, accepted, newest):
            return
        cause: Restart | None = None
        if jumped_back and place == self._reference:
            cause = Restart(STREAMS[place], accepted[0][0] - newest, accepted[0][0])
        elif accepted and self._is_overtaken(place, accepted[-1][0]):
            cause = Restart(STREAMS[place], accepted[0][0] - before, accepted[0][0], overtaken=True)
        if cause is not None:
            self._start_anew(place, cause)
            newest, stream = -math.inf, self._streams[place]
        for t, row in accepted:
            if stream.policy.is_late(t, newest) or t < self.used_until:
                self._refuse(place, row, LATE)
            else:
                stream.merge(row)
            newest = max(newest, t)

    def _refuse_ahead(self, place: int, t: float, row: np.ndarray) -> None:
        """Refuse a row with stamp t, in s, of a stream that is too far ahead."""
        stream, compared = self._streams[place], self._compared(place)
        stream.ahead, stream.lead, stream.refused = True, t - compared, compared
        self._refuse(place, row, INVALID)

    def _refuse_jump(
        self, place: int, accepted: list[tuple[float, np.ndarray]], newest: float
    ) -> bool:
        """Refuse rows of a stream whose clock has jumped ahead; return whether it has.

        Parameters
        ----------
        place : int
            Place of the stream in STREAMS.
        accepted : list of (float, (1,) array)
            Stamps, in s, and rows after the jump.
        newest : float
            Newest stamp of the stream before the jump, in s.
        """
        stream, compared = self._streams[place], self._compared(place)
        stream.lead = max(0.0, accepted[-1][0] - compared)
        if stream.lead <= LARGEST_LEADS[place]:
            return False
        stream.gate.newest = newest
        for t, row in accepted:
            self._refuse_ahead(place, t, row)
        return True

    def _reached(self, place: int) -> list[float]:
        """Return the stamps, in s, that other leading streams have reached or may jump to."""
        others = [self._streams[other].gate for other in self._leading if other != place]
        return [t for gate in others for t in (gate.newest, gate.held) if math.isfinite(t)]

    def _is_overtaken(self, place: int, t: float) -> bool:
        """Return whether the reference has been far behind the used rows for a while.

        Rows that were delayed and arrive all at once do not count: their stamps rise faster than
        the time. If nothing else advances the time, they count after LONGEST_PAUSE.

        Parameters
        ----------
        place : int
            Place of the stream in STREAMS.
        t : float
            Stamp of the last row, in s.
        """
        if place != self._reference:
            return False
        if t >= self.used_until - LARGEST_STEP_BACK:
            self._overtaken = None
            return False
        seen = self._streams[self._moving].seen
        if self._overtaken is None or t < self._overtaken[0]:
            self._overtaken = t, seen
        gone, passed = t - self._overtaken[0], seen - self._overtaken[1]
        if not passed:
            return gone >= LONGEST_PAUSE
        return min(gone, passed) >= CONTRADICTED and gone <= CATCHING_UP * passed

    def _refuse_outliers(self, place: int, outliers: Sequence[tuple[float, np.ndarray]]) -> None:
        """Refuse rows whose stamps are far from the neighbouring stamps."""
        for t, row in outliers:
            self._refuse(place, row, INVALID if t > self._streams[place].gate.newest else LATE)

    def _start_anew(self, place: int, cause: Restart) -> None:
        """Clear the buffer and keep only the new time of one stream."""
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
        for k, t, row in held:  # these rows were not plausible in the old time
            self._take_in(k, t, row)


class LatenessPolicy:
    """Decide which messages of one stream are late.

    The decision depends only on the order of messages, which the sender determines. It does not
    depend on arrival times.

    The first message that breaks the order of a trusted stream is late, even if nothing newer was
    used yet. After that the stream is not trusted. If no stamp has occurred twice so far, the
    buffer does not wait for a second message of a stamp. The first such message is late. After that
    the buffer waits for them.
    """

    def __init__(self) -> None:
        self._first, self._sorted, self._rising, self._closed = math.nan, True, True, -math.inf

    def trusted(self, newest: float) -> bool:
        """Return whether no message older than the newest stamp `newest`, in s, is expected."""
        return self._sorted and newest - self._first >= TRIAL

    def watermark(self, newest: float, reorder: float) -> float:
        """Return the stamp, in s, up to which no further message is expected.

        Parameters
        ----------
        newest : float
            Newest stamp so far, in s.
        reorder : float
            Waiting time for messages of an untrusted stream, in s.
        """
        if not self.trusted(newest):
            return math.nextafter(newest - reorder, -math.inf)
        return newest if self._rising else math.nextafter(newest, -math.inf)

    def begin(self, t: float) -> None:
        """Register a message with stamp t, in s, that is in order."""
        if self._first != self._first:
            self._first = t

    def is_late(self, t: float, newest: float) -> bool:
        """Return whether a message is too late to be used.

        Parameters
        ----------
        t : float
            Stamp of the message, in s.
        newest : float
            Newest stamp before this message, in s; -inf for the first message.
        """
        self.begin(t)
        if t > newest:
            return False
        if self.trusted(newest):
            self._closed = max(self._closed, self.watermark(newest, 0.0))
        self._sorted, self._rising = self._sorted and t == newest, False
        return t <= self._closed


class _Stream:
    """Store rows of one structured type with a field t, sorted by stamp.

    Rows arrive a few at a time and nearly always in order. Then they are appended.

    Attributes
    ----------
    gate : StampGate
        Check of the stamps.
    policy : LatenessPolicy
        Decision which rows are late.
    lead : float
        Lead over the compared streams when these last advanced, in s.
    ahead : bool
        True if the last row was refused because of its lead.
    refused : float
        Stamp of the compared streams at that refusal, in s.
    seen : float
        Stamp of the last row, used or not, in s.
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
        """Return a view of the waiting rows, (n,), which the next call may change."""
        return self._room[self._first : self._end]

    def watermark(self, reorder: float) -> float:
        """Return the stamp, in s, up to which no further row is expected."""
        return self.policy.watermark(self.gate.newest, reorder)

    def append(self, rows: np.ndarray, after: float, limit: float) -> bool:
        """Append rows if they are in order and plausible; return whether they were appended.

        If not, nothing is stored: add the rows one by one. `_append` repeats the rules of the StampGate.

        Parameters
        ----------
        rows : (k,) array
            At least one row. Stamps must rise, follow the newest stamp of the stream, and be
            plausible.
        after, limit : float
            Smallest and largest stamp that is allowed, in s.
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
        """Append rows (k,) without any check; an empty stream uses their memory."""
        if self._first == self._end:
            self._room, self._first, self._end = rows, 0, len(rows)
            return
        self._make_room(len(rows))
        self._room[self._end : self._end + len(rows)] = rows
        self._end += len(rows)

    def merge(self, rows: np.ndarray) -> None:
        """Sort rows into the waiting rows by stamp, then by all other fields.

        The order of arrival does not matter.
        """
        both = np.concatenate([self.rows, rows])
        columns = [
            column for name in both.dtype.names for column in both[name].reshape(len(both), -1).T
        ]
        self._first = self._end = 0
        self.extend(both[np.lexsort(columns[::-1])])

    def take(self, until: float) -> np.ndarray:
        """Remove and return the rows with stamps up to `until`, in s."""
        if self._first == self._end:
            return self._none
        stamps, n, step = self._room["t"][self._first : self._end], 0, ROOM
        while (
            n < len(stamps) and stamps[n] <= until
        ):  # search a few at a time, because numpy copies the array that it searches
            n += int(stamps[n : n + step].searchsorted(until, side="right"))
            step *= 2
        if not n:
            return self._none
        self._first += n
        return self._room[self._first - n : self._first]  # these rows are never overwritten

    def take_first(self, n: int) -> np.ndarray:
        """Remove and return the first n rows."""
        self._first += n
        return self._room[self._first - n : self._first]

    def drop_after(self, t: float) -> np.ndarray:
        """Remove and return the rows with stamps after t, in s, and the rows that are held.

        The stream continues from its last remaining row.
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
    # Copy rows to room[end:] if all their stamps pass, see _Stream.append. Return the newest stamp
    # and the usual step of the clock, in s; the stamp is NaN if a row fails.
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
