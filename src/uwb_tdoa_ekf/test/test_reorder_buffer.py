from dataclasses import replace
import math

from flights import fly
from hypothesis import given, settings, strategies as st
from live import IMU, TDOA, arriving, assert_same, assert_same_as_offline, feed, messages, send
import numpy as np

from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_ekf.core.verdicts import LATE
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.reorder_buffer import TRIAL, LatenessPolicy


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
    assert late([0.0, *stamps]) == ([False, False, False, True, False, False, True, False], False)  # some come twice


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
    """The flight with stamps that are multiples of 0.01 s, without TDOAs that would share one with another before `until`, s."""
    imu, tdoa = (replace(part, t=np.round(100.0 * part.t) / 100.0) for part in (flight.imu, flight.tdoa))
    kept = np.append(True, np.diff(tdoa.t) > 0.0) | (tdoa.t > until)
    return replace(flight, imu=imu, tdoa=Tdoas(*(column[kept] for column in (tdoa.t, tdoa.a, tdoa.b, tdoa.d))))


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
def test_the_first_stamp_that_comes_twice_late_in_a_flight_is_late_however_the_streams_arrive(seed, delay, behind):
    rng, told = np.random.default_rng(seed), []
    flight = on_grid(fly(2, 2.6, imu_rate=100.0, tdoa_rate=60.0), 2.2)
    delays = {"imu_delay": delay} if behind == IMU else {"tdoa_delay": delay}
    for order in (messages(flight), arriving(flight, rng, **delays)):
        told.append(feed(Estimator(flight.anchors), flight, order=order, advance=lambda: rng.random() < 0.3))
    assert_same(told[0][0], told[1][0])
    became = [sorted(zip(residuals.t, residuals.a, residuals.b, residuals.verdict)) for _, residuals in told]
    assert became[0] == became[1] and sum(verdict == LATE for *_, verdict in became[0]) == 1
