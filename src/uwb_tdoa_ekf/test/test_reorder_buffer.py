# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reorder buffer: order, waiting, and clocks that jump or drift."""

from dataclasses import dataclass, replace
import math

from flights import fly, kept
from hypothesis import Phase, example, given, settings, strategies as st
from live import IMU, TDOA, arriving, assert_same, assert_same_as_offline, feed, messages, send
import numpy as np
import pytest

from uwb_tdoa_bias.common.stamps import MOST_HELD
from uwb_tdoa_ekf.core.memory import IMU_SAMPLE, INVALID, LATE, SENSOR_ROW, TDOA as TDOA_ROW
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.finding import clock_ahead, restarted
from uwb_tdoa_ekf.reorder_buffer import (
    FIRST_SENSOR,
    IMU_STREAM,
    MOST_WAITING,
    SILENT,
    STREAMS,
    TDOA_STREAM,
    TRIAL,
    LatenessPolicy,
    ReorderBuffer,
)

# --- reorder buffer ---


def late(stamps):
    """Return whether each message is late, and whether the policy then trusts the stream."""
    policy, newest, out = LatenessPolicy(), -math.inf, []
    for t in stamps:
        out.append(policy.is_late(t, newest))
        newest = max(newest, t)
    return out, policy.trusted(newest)


def test_the_first_that_breaks_a_trusted_order_is_late_and_what_is_older_than_what_had_come():
    end = 2.0 * TRIAL
    stamps = [0.0, end, end - 0.001, end + 0.002, end + 0.001, end - 0.002, end]
    assert late(stamps) == ([False, False, True, False, False, True, True], False)
    # some stamps occur twice
    assert late([0.0, *stamps]) == (
        [False, False, False, True, False, False, True, False],
        False,
    )


def on_grid(flight, until):
    """Return the flight with stamps in multiples of 0.01 s.

    Before `until`, in s, TDOAs with equal stamps are removed.
    """
    imu, tdoa = (
        replace(part, t=np.round(100.0 * part.t) / 100.0) for part in (flight.imu, flight.tdoa)
    )
    apart = np.append(True, np.diff(tdoa.t) > 0.0) | (tdoa.t > until)
    return replace(flight, imu=imu, tdoa=kept(tdoa, apart))


def test_an_odometry_waits_for_nothing_where_no_stamp_comes_twice():
    flight = on_grid(fly(3, 4.0, imu_rate=100.0, tdoa_rate=50.0), math.inf)
    estimator, behind = Estimator(flight.anchors), []
    for t, stream, i in messages(flight):
        send(estimator, flight, stream, i)
        odometry, _ = estimator.advance()
        behind += [(t, t - stamp) for stamp in odometry.t]
    t, behind = np.transpose(behind)
    assert (behind[t > 3.0] == 0.0).any() and (behind[t < 1.9] > 0.0).all()
    assert_same_as_offline(flight)


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.2), st.sampled_from([IMU, TDOA]))
def test_the_first_stamp_that_comes_twice_late_in_a_flight_is_late_however_the_streams_arrive(
    seed, delay, behind
):
    rng, told = np.random.default_rng(seed), []
    flight = on_grid(fly(2, 2.6, imu_rate=100.0, tdoa_rate=60.0), 2.2)
    delays = {"imu_delay": delay} if behind == IMU else {"tdoa_delay": delay}
    for order in (messages(flight), arriving(flight, rng, **delays)):
        told.append(
            feed(Estimator(flight.anchors), flight, order=order, advance=lambda: rng.random() < 0.3)
        )
    assert_same(told[0][0], told[1][0])
    became = [
        sorted(zip(residuals.t, residuals.a, residuals.b, residuals.verdict))
        for _, residuals in told
    ]
    assert became[0] == became[1] and sum(verdict == LATE for *_, verdict in became[0]) == 1


def rows(kind, *stamps):
    """Return rows (n,) with these stamps, and that all are usable."""
    out = np.zeros(len(stamps), kind)
    out["t"] = stamps
    return out, np.ones(len(stamps), bool)


def buffer_of(reorder=0.1, lag=1.0, use_imu=True):
    """Return (ReorderBuffer, refused rows [(stream, stamp, verdict)], causes of restarts)."""
    refused, restarts = [], []
    buffer = ReorderBuffer(
        reorder,
        lag,
        use_imu,
        lambda stream, gone, verdict: refused.extend(
            (stream, t, verdict) for t in gone["t"].tolist()
        ),
        lambda cause: restarts.append((cause.stream, round(cause.step, 9), cause.overtaken)),
    )
    return buffer, refused, restarts


def test_rows_leave_in_the_order_of_their_stamps_when_no_stream_can_precede_them():
    buffer, refused, _ = buffer_of()
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.0, 0.3, 0.2))
    assert buffer.watermark < 0.0  # inertial samples may still come
    buffer.add(IMU_STREAM, *rows(IMU_SAMPLE, 0.0, 0.5))
    assert 0.19 < buffer.watermark < 0.2 and buffer.waiting[:2] == (2, 3) and buffer.first == 0.0
    imu, tdoa, _ = buffer.take(buffer.watermark)
    assert (imu["t"].tolist(), tdoa["t"].tolist()) == ([0.0], [0.0]) and buffer.used_until == 0.0
    assert [part["t"].tolist() for part in buffer.take(math.inf)[:2]] == [[0.5], [0.2, 0.3]]
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.4))
    assert refused == [(TDOA_STREAM, 0.4, LATE)] and len(buffer) == 0


def test_a_silent_stream_is_waited_for_no_longer_than_lag_and_a_sensor_only_where_it_was_there():
    buffer, *_ = buffer_of(lag=0.4)
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.0, 0.5))
    assert buffer.watermark == 0.5 - 0.4
    buffer, *_ = buffer_of(use_imu=False, reorder=0.0)
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, *np.arange(0.0, 3.0, 0.5)))
    assert buffer.watermark == 2.5
    buffer.add(FIRST_SENSOR, *rows(SENSOR_ROW, 2.5 - 0.9 * SILENT))
    assert buffer.watermark == 2.5 - 0.5  # half of lag
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 3.0))
    assert buffer.watermark == 3.0


def test_inertial_samples_that_nobody_publishes_are_awaited_from_the_first_one_on():
    buffer, *_ = buffer_of(lag=0.4, reorder=0.0)
    buffer.imu_expected = False
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.0, 0.5))
    assert buffer.watermark == pytest.approx(0.5)
    buffer.add(IMU_STREAM, *rows(IMU_SAMPLE, 0.3))
    assert buffer.watermark == pytest.approx(0.3)


def test_a_stamp_that_is_no_number_begins_nothing():
    buffer, *_ = buffer_of(lag=0.4)
    buffer.add(IMU_STREAM, rows(IMU_SAMPLE, math.nan)[0], np.array([False]))
    assert buffer.began == math.inf and buffer.newest == -math.inf
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.0, 0.5, 1.0, 1.5, 2.0))
    # Without any inertial sample, nothing waits for the IMU.
    assert buffer.began == 0.0 and buffer.watermark == 2.0


def test_a_stamp_that_is_no_measurement_counts_and_a_lone_one_far_away_is_refused():
    buffer, refused, restarts = buffer_of()
    buffer.add(TDOA_STREAM, rows(TDOA_ROW, 1.0, 2.0)[0], np.array([True, False]))
    assert buffer.newest == 2.0 and len(buffer) == 1 and not refused
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 100.0, 2.1))
    assert refused == [(TDOA_STREAM, 100.0, INVALID)] and not restarts
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 200.0))
    buffer.finish()
    assert refused[1:] == [(TDOA_STREAM, 200.0, INVALID)]


def test_of_a_recording_nothing_is_late():
    buffer = ReorderBuffer.of_recording()
    buffer.load(FIRST_SENSOR + 1, rows(SENSOR_ROW, 1.0, 2.0)[0])
    buffer.load(FIRST_SENSOR, rows(SENSOR_ROW, 1.5, 2.0)[0])
    buffer.load(TDOA_STREAM, rows(TDOA_ROW, 0.0, 3.0)[0])
    assert buffer.take(1.0).sensors["t"].tolist() == [1.0] and buffer.used_until == 1.0
    buffer.load(TDOA_STREAM, rows(TDOA_ROW, 3.0, 4.0)[0])
    imu, tdoa, sensors = buffer.take(math.inf)
    assert (len(imu), tdoa["t"].tolist(), sensors["t"].tolist()) == (
        0,
        [3.0, 3.0, 4.0],
        [1.5, 2.0, 2.0],
    )


# --- clocks ---
RANGE_STREAM, VELOCITY_STREAM, HEIGHT_STREAM = map(STREAMS.index, ("range", "velocity", "height"))
KIND = {IMU_STREAM: IMU_SAMPLE, TDOA_STREAM: TDOA_ROW}
RATE = {
    IMU_STREAM: 50.0,
    TDOA_STREAM: 40.0,
    RANGE_STREAM: 20.0,
    VELOCITY_STREAM: 25.0,
    HEIGHT_STREAM: 10.0,
}  # Hz
LAG, LATENCY, LENGTH, BEGIN, END = 0.25, 0.02, 14.0, 5.0, 9.0  # s; a fault lasts from BEGIN to END
SCATTER = 0.1  # s, standard deviation of arrival stamps on a busy computer
# s, longest time without a used TDOA if another stream fails, or if all jump
DECIDED = 1.1


@dataclass
class Fault:
    """A fault of the stamps and messages of a stream from `begin` to `end`, in s."""

    kind: str
    size: float = 0.0
    begin: float = BEGIN
    end: float = END

    def apply(self, t, rng):
        """Return (stamps, which messages come, delays) of messages measured at t (n,), in s."""
        at, stamps, kept, delays = (
            (t >= self.begin) & (t < self.end),
            t.copy(),
            np.ones(len(t), bool),
            np.zeros(len(t)),
        )
        if self.kind == "offset":
            stamps[at] += self.size
        elif self.kind == "drift":
            stamps[at] += 1e-3 * self.size * (t[at] - self.begin)
        elif self.kind == "lone":
            stamps[np.flatnonzero(at)[:1]] += self.size
        elif self.kind == "each":
            # one per second
            stamps[np.flatnonzero(at)[:: int(np.sum(at) / (self.end - self.begin))]] += self.size
        elif self.kind == "few":
            # messages of 0.1 s
            stamps[np.flatnonzero(at)[: 1 + int(0.1 * np.sum(at) / (self.end - self.begin))]] += (
                self.size
            )
        elif self.kind == "standing":
            stamps[at] = self.begin + self.size
        elif self.kind == "scattered":
            stamps[at] += np.clip(self.size, -SCATTER, SCATTER) * rng.standard_normal(np.sum(at))
        elif self.kind == "silent":
            kept[at] = False
        elif self.kind == "wrap":
            stamps[at] -= 4294.967296
        elif self.kind == "burst":
            delays[at] = np.ceil(t[at] / 0.2) * 0.2 - t[at]
        return stamps, kept, delays


HEALTHY = Fault("healthy")
sizes = (
    st.floats(0.6, 3600.0)
    | st.floats(-3600.0, -0.6)
    | st.sampled_from([-5.0, 5.0, 60.0, 2.5, -1.5])
)
kinds = st.sampled_from(
    ["offset", "drift", "lone", "each", "few", "standing", "scattered", "silent", "wrap", "burst"]
)
faults = st.builds(Fault, kinds, sizes) | st.builds(
    Fault, kinds, sizes, st.just(0.0), st.just(LENGTH)
)
seeds = st.integers(0, 2**32 - 1)


class Played:
    """Streams with faults, played to a ReorderBuffer.

    used : {stream: [(time of measurement, time of release)]}, in s, by arrival.
    refused : number of refused rows of each stream.
    restarts : (s, cause) of each restart.
    """

    def __init__(self, streams, seed, everything=None):
        """Play the streams.

        streams : {place: Fault}.
        everything : Fault of all streams together, optional.
        """
        rng, self.refused, self.restarts, self.used = (
            np.random.default_rng(seed),
            dict.fromkeys(streams, 0),
            [],
            {k: [] for k in streams},
        )
        self.buffer = ReorderBuffer(
            0.003, LAG, True, self._refuse, lambda cause: self.restarts.append((self.now, cause))
        )
        arrivals, self.sent = [], dict.fromkeys(streams, 0)
        for place, fault in streams.items():
            measured = np.arange(0.0, LENGTH, 1.0 / RATE[place])
            # Stamps are unique, whatever the fault.
            measured += 0.3 / RATE[place] * rng.random() + 1e-4 * rng.random(len(measured))
            stamps, kept, delays = fault.apply(measured, rng)
            if everything is not None:
                stamps = stamps + everything.apply(measured, rng)[0] - measured
            arrival = np.maximum.accumulate(measured + delays + LATENCY * rng.random(len(measured)))
            arrivals += [
                (a, place, t, m) for a, t, m, k in zip(arrival, stamps, measured, kept) if k
            ]
            self.sent[place] = int(kept.sum())
        self.most_waiting, self.lowest_lead, self._measured = 0, 0.0, {}
        for self.now, place, t, measured in sorted(arrivals):
            rows = np.zeros(1, KIND.get(place, SENSOR_ROW))
            rows["t"] = t
            if place >= 2:
                rows["kind"] = place - 2
            self._measured.setdefault((place, t), []).append(measured)
            self.buffer.add(place, rows, np.ones(1, bool))
            self._take(self.buffer.watermark)
            self.most_waiting = max(self.most_waiting, *self.buffer.waiting)
            self.lowest_lead = min(self.lowest_lead, *self.buffer.leads)
        self.buffer.finish()
        self._take(np.inf)

    def _refuse(self, place, rows, verdict):
        if len(rows):
            self.refused[place] += len(rows)

    def _take(self, until):
        imu, tdoa, sensors = self.buffer.take(until)
        parts = [
            (IMU_STREAM, imu),
            (TDOA_STREAM, tdoa),
            *((2 + kind, sensors[sensors["kind"] == kind]) for kind in np.unique(sensors["kind"])),
        ]
        for place, rows in parts:
            assert (np.diff(rows["t"]) >= 0.0).all()
            if len(rows):
                self.used[place] += [
                    (self._measured[place, t].pop(0), self.now) for t in rows["t"].tolist()
                ]

    def gap(self, place):
        """Return the longest time between two releases of rows of a stream, in s."""
        return float(np.diff([0.0, *(given for _, given in self.used[place]), LENGTH]).max())

    def check_accounts(self):
        for place, sent in self.sent.items():
            assert len(self.used[place]) + self.refused[place] == sent
        assert self.most_waiting <= MOST_WAITING + MOST_HELD


@pytest.mark.slow
@settings(max_examples=30, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.sampled_from([VELOCITY_STREAM, HEIGHT_STREAM, RANGE_STREAM]), faults, seeds)
def test_no_clock_of_a_sensor_costs_a_tdoa_or_an_inertial_sample(place, fault, seed):
    """The buffer waits for ranges as for TDOAs."""
    played = Played({IMU_STREAM: HEALTHY, TDOA_STREAM: HEALTHY, place: fault}, seed)
    played.check_accounts()
    assert not played.restarts and played.refused[TDOA_STREAM] == 0
    if place == RANGE_STREAM:
        assert played.gap(TDOA_STREAM) < DECIDED
        return
    assert played.refused[IMU_STREAM] == 0 and played.gap(TDOA_STREAM) < LAG
    assert all(given - measured < LAG for measured, given in played.used[TDOA_STREAM])


@pytest.mark.slow
@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(faults, seeds, st.booleans())
def test_a_clock_of_the_imu_starts_the_filter_anew_once_at_most_and_costs_no_second_of_tdoas(
    fault, seed, sensor
):
    streams = {IMU_STREAM: fault, TDOA_STREAM: HEALTHY} | (
        {VELOCITY_STREAM: HEALTHY} if sensor else {}
    )
    played = Played(streams, seed)
    played.check_accounts()
    assert len(played.restarts) <= 1 and played.gap(TDOA_STREAM) < DECIDED
    assert played.refused[TDOA_STREAM] <= DECIDED * RATE[TDOA_STREAM]
    if fault.end < LENGTH:
        used = [measured for measured, _ in played.used[IMU_STREAM] if measured >= END + DECIDED]
        assert len(used) >= (LENGTH - END - DECIDED) * RATE[IMU_STREAM] - 1.0


@pytest.mark.slow
@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(kinds, sizes, seeds)
def test_a_clock_of_the_tdoas_costs_them_no_more_than_the_fault_and_a_second(kind, size, seed):
    played = Played(
        {IMU_STREAM: HEALTHY, TDOA_STREAM: Fault(kind, size), VELOCITY_STREAM: HEALTHY}, seed
    )
    played.check_accounts()
    after = [measured for measured, _ in played.used[TDOA_STREAM] if measured >= END + DECIDED]
    assert len(after) >= (LENGTH - END - DECIDED) * RATE[TDOA_STREAM] - 1.0
    if kind in ("lone", "each", "few"):
        assert (
            not played.restarts
            and played.refused[TDOA_STREAM] <= 10
            and played.refused[IMU_STREAM] == 0
        )
    elif kind == "offset":
        assert len(played.restarts) <= 2 and played.gap(TDOA_STREAM) < DECIDED  # one jump each way


@pytest.mark.slow
@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(sizes, seeds)
@example(-0.9, 0)  # time that falls back by less is late, and no restart
def test_a_jump_of_all_clocks_starts_the_filter_anew_only_where_time_falls_back_and_costs_no_second(
    size, seed
):
    jump = Fault("offset", size, BEGIN, LENGTH)
    played = Played(
        {IMU_STREAM: HEALTHY, TDOA_STREAM: HEALTHY, VELOCITY_STREAM: HEALTHY}, seed, jump
    )
    played.check_accounts()
    assert len(played.restarts) == (size < -1.0) and played.gap(TDOA_STREAM) < DECIDED
    for at, cause in played.restarts:
        assert (
            at < BEGIN + DECIDED
            and cause.stream == "tdoa"
            and cause.step == pytest.approx(size, abs=0.1)
        )
        assert (
            f"the stamps of uwb/tdoa fell back by {-cause.step:.3g} s" in restarted(cause).sentence
        )


@pytest.mark.parametrize(
    "place, most", [(VELOCITY_STREAM, 3600.0), (HEIGHT_STREAM, 60.0), (IMU_STREAM, 60.0)]
)
def test_a_clock_that_is_ahead_is_named_while_it_is(place, most):
    leads = []
    for end in (LENGTH, END):
        played = Played(
            {IMU_STREAM: HEALTHY, TDOA_STREAM: HEALTHY, place: Fault("offset", most, 0.0, end)}, 1
        )
        leads.append(played.buffer.leads[place])
    assert leads == [pytest.approx(most, abs=0.1), 0.0] and played.lowest_lead == 0.0
    assert f"{most:.3g} s ahead" in clock_ahead(STREAMS[place], most, 7).sentence


def test_with_ranges_alone_nothing_waits_for_tdoas_and_after_the_imu_has_stopped_nothing_waits_for_it():
    alone = Played({RANGE_STREAM: HEALTHY}, 2)
    alone.check_accounts()
    behind = [given - measured for measured, given in alone.used[RANGE_STREAM] if measured > 2.0]
    assert max(behind) < LATENCY + 2.0 / RATE[RANGE_STREAM]
    stopped = Played({IMU_STREAM: Fault("silent", 0.0, BEGIN, LENGTH), TDOA_STREAM: HEALTHY}, 3)
    behind = [
        given - measured for measured, given in stopped.used[TDOA_STREAM] if measured > BEGIN + 1.5
    ]
    assert max(behind) < LATENCY + 2.0 / RATE[TDOA_STREAM]
