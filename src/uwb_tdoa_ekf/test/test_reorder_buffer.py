from dataclasses import replace
import math

from flights import fly
from hypothesis import given, settings
from hypothesis import strategies as st
from live import IMU, TDOA, arriving, assert_same, assert_same_as_offline, feed, messages, send
import numpy as np

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_ekf.core.memory import AID, IMU_SAMPLE
from uwb_tdoa_ekf.core.memory import TDOA as TDOA_ROW
from uwb_tdoa_ekf.core.verdicts import INVALID, LATE
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.reorder_buffer import (
    FIRST_AID,
    IMU_STREAM,
    SILENT,
    TDOA_STREAM,
    TRIAL,
    LatenessPolicy,
    ReorderBuffer,
)


def late(stamps):
    """Whether each of them is late, and the LatenessPolicy after them."""
    policy, newest, out = LatenessPolicy(), -math.inf, []
    for t in stamps:
        out.append(policy.is_late(t, newest))
        newest = max(newest, t)
    return out, policy.trusted(newest)


def test_a_stream_is_trusted_when_it_has_been_in_order_for_a_while():
    assert not LatenessPolicy().trusted(-math.inf)
    assert late([5.0, 5.0, 5.0 + 0.9 * TRIAL]) == ([False] * 3, False)
    assert late([5.0, 5.0, 5.0 + TRIAL]) == late([5.0, 6.0, 5.0 + TRIAL]) == ([False] * 3, True)


def test_one_that_is_out_of_order_from_the_beginning_is_never_trusted_and_nothing_is_late():
    stamps = [0.002 * k + 0.003 * (k % 2) for k in range(2000)]
    assert late(stamps) == ([False] * 2000, False)


def test_the_first_that_breaks_a_trusted_order_is_late_and_what_is_older_than_what_had_come():
    end = 2.0 * TRIAL
    stamps = [0.0, end, end - 0.001, end + 0.002, end + 0.001, end - 0.002, end]
    assert late(stamps) == ([False, False, True, False, False, True, True], False)
    assert late([0.0, *stamps]) == (
        [False, False, False, True, False, False, True, False],
        False,
    )  # some come twice


@given(st.lists(st.floats(0.0, 3.0 * TRIAL), max_size=30))
def test_nothing_is_late_in_order(stamps):
    assert not any(late(sorted({*stamps}))[0])
    assert not any(late([0.0, *sorted([0.0, *stamps])])[0])


def test_a_stamp_that_has_never_come_twice_is_not_waited_for():
    policy, end = LatenessPolicy(), 2.0 * TRIAL
    for t, newest in ((0.0, -math.inf), (end, 0.0)):
        policy.is_late(t, newest)
    assert policy.watermark(end, 0.1) == end and LatenessPolicy().watermark(end, 0.1) < end - 0.1
    assert [policy.is_late(end, end) for _ in range(2)] == [True, True]  # whatever has been used
    assert end - 1e-9 < policy.watermark(end, 0.1) < end
    assert not policy.is_late(end + 1.0, end) and not policy.is_late(end + 1.0, end + 1.0)


def test_where_stamps_come_twice_from_the_beginning_nothing_is_late():
    stamps = [0.01 * (k // 2) for k in range(1000)]
    assert late(stamps) == ([False] * 1000, True)


def on_grid(flight, until):
    """The flight with stamps that are multiples of 0.01 s, without TDOAs that would share one with
    another before `until`, s.
    """
    imu, tdoa = (
        replace(part, t=np.round(100.0 * part.t) / 100.0) for part in (flight.imu, flight.tdoa)
    )
    kept = np.append(True, np.diff(tdoa.t) > 0.0) | (tdoa.t > until)
    return replace(
        flight, imu=imu, tdoa=Tdoas(*(column[kept] for column in (tdoa.t, tdoa.a, tdoa.b, tdoa.d)))
    )


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
    """(n,) of a structured type that are told apart by their stamps, and that all are usable."""
    out = np.zeros(len(stamps), kind)
    out["t"] = stamps
    return out, np.ones(len(stamps), bool)


def buffer_of(reorder=0.1, lag=1.0, use_imu=True):
    """(ReorderBuffer, what it refuses: [(stream, stamp, verdict)], stamps of its restarts)."""
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
    assert buffer.watermark < 0.0  # there may be inertial samples
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
    buffer.add(FIRST_AID, *rows(AID, 2.5 - 0.9 * SILENT))
    assert buffer.watermark == 2.5 - 0.5  # half of lag
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 3.0))
    assert buffer.watermark == 3.0


def test_a_stamp_that_is_no_number_begins_nothing():
    buffer, *_ = buffer_of(lag=0.4)
    buffer.add(IMU_STREAM, rows(IMU_SAMPLE, math.nan)[0], np.array([False]))
    assert buffer.began == math.inf and buffer.newest == -math.inf
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 0.0, 0.5, 1.0, 1.5, 2.0))
    assert (
        buffer.began == 0.0 and buffer.watermark == 2.0
    )  # nothing waits for an IMU of which no sample has come


def test_a_stamp_that_is_no_measurement_counts_and_a_lone_one_far_away_is_refused():
    buffer, refused, restarts = buffer_of()
    buffer.add(TDOA_STREAM, rows(TDOA_ROW, 1.0, 2.0)[0], np.array([True, False]))
    assert buffer.newest == 2.0 and len(buffer) == 1 and not refused
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 100.0, 2.1))
    assert refused == [(TDOA_STREAM, 100.0, INVALID)] and not restarts
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 200.0))
    buffer.finish()
    assert refused[1:] == [(TDOA_STREAM, 200.0, INVALID)]


def test_a_stream_that_falls_back_starts_anew_and_what_waited_is_late():
    buffer, refused, restarts = buffer_of()
    buffer.add(IMU_STREAM, *rows(IMU_SAMPLE, 50.0, 50.1))
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 50.0, 10.0, 10.1))
    assert not refused and not restarts  # it may be a few wrong stamps
    buffer.add(TDOA_STREAM, *rows(TDOA_ROW, 10.2, 10.3))
    assert sorted(refused) == [
        (IMU_STREAM, 50.0, LATE),
        (IMU_STREAM, 50.1, LATE),
        (TDOA_STREAM, 50.0, LATE),
    ]
    assert restarts == [("tdoa", -40.0, False)]
    assert buffer.take(math.inf).tdoa["t"].tolist() == [10.0, 10.1, 10.2, 10.3]


def test_of_a_recording_nothing_is_late():
    buffer = ReorderBuffer.of_recording()
    buffer.load(FIRST_AID + 1, rows(AID, 1.0, 2.0)[0])
    buffer.load(FIRST_AID, rows(AID, 1.5, 2.0)[0])
    buffer.load(TDOA_STREAM, rows(TDOA_ROW, 0.0, 3.0)[0])
    assert buffer.take(1.0).aids["t"].tolist() == [1.0] and buffer.used_until == 1.0
    buffer.load(TDOA_STREAM, rows(TDOA_ROW, 3.0, 4.0)[0])
    imu, tdoa, aids = buffer.take(math.inf)
    assert (len(imu), tdoa["t"].tolist(), aids["t"].tolist()) == (
        0,
        [3.0, 3.0, 4.0],
        [1.5, 2.0, 2.0],
    )
