from dataclasses import replace

from flights import corners, fly, position_at, with_aids
from hypothesis import given, settings
from hypothesis import strategies as st
from live import (
    FIRST_AID,
    IMU,
    TDOA,
    arriving,
    assert_same,
    assert_same_as_offline,
    feed,
    joined,
    messages,
    send,
)
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_bias.foundation.sensors import SENSORS
from uwb_tdoa_bias.foundation.stamps import LARGEST_STEP_BACK
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.verdicts import INVALID, LATE, STARTUP, USED
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import VERDICTS, rows_of

seeds = st.integers(0, 2**32 - 1)
REST = (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)
FIRST, SECOND, THIRD = corners().ids[:3].tolist()


def received(estimator):
    """(IMU, TDOA) messages that the accounts and the buffers tell of."""
    counts, (imu, tdoa, *_) = estimator.counts, estimator.waiting
    return sum(counts[name] for name in ("imu_used", "imu_late", "imu_invalid")) + imu, sum(
        counts[name] for name in VERDICTS.values()
    ) + tdoa


def test_in_order_it_is_the_offline_engine():
    assert_same_as_offline(fly(1, 4.0, outliers=0.05))


AIDS = "height", "pressure", "velocity"


def assert_aids_as_offline(flight, config=None, **feeding):
    estimator = Estimator(flight.anchors, config)
    odometry, _ = feed(estimator, flight, **feeding)
    expected = run_offline(flight, config)
    assert_same(odometry, expected.odometry)
    for name in AIDS:
        verdicts = expected.aids[name]["verdict"].tolist()
        counts = {said: estimator.counts[f"{name}_{said}"] for said in VERDICTS.values()}
        assert (
            counts == {said: verdicts.count(value) for value, said in VERDICTS.items()}
            and counts["used"] > 0
        )
    return estimator


def spoiled(flight):
    """Some of every aid cannot be measurements."""
    height, pressure, velocity = flight.height, flight.pressure, flight.velocity
    height.range[10:13], pressure.pressure[10:12], velocity.v[10] = (
        [np.nan, np.inf, -1.0],
        [0.0, np.nan],
        np.nan,
    )
    return flight


def test_with_height_pressure_and_velocity_it_is_the_offline_engine():
    estimator = assert_aids_as_offline(spoiled(with_aids(fly(1, 4.0))))
    assert [estimator.counts[f"{name}_invalid"] for name in AIDS] == [3, 2, 1]


@settings(max_examples=5)
@given(seeds, st.floats(0.0, 0.2))
def test_with_aids_too_skew_changes_nothing(seed, delay):
    flight, rng = with_aids(fly(2, 2.0)), np.random.default_rng(seed)
    order = arriving(flight, rng, imu_delay=delay)
    assert_aids_as_offline(flight, order=order, advance=lambda: rng.random() < 0.3)


@settings(max_examples=5)
@given(seeds)
def test_batches_are_what_their_messages_are_one_by_one(seed):
    flight, rng, parts = spoiled(with_aids(fly(2, 2.0))), np.random.default_rng(seed), []
    estimator, cut = Estimator(flight.anchors), flight.imu.t[0]
    while cut <= flight.imu.t[-1]:
        before, cut = cut, cut + rng.choice([0.001, 0.01, 0.1])
        for name in ("imu", "tdoa", *AIDS):
            part = getattr(flight, name)
            some = (part.t >= before) & (part.t < cut)
            columns = [column[some] for key, column in vars(part).items() if key != "variance"]
            if some.any() and name in AIDS:
                estimator.add(name, type(part)(*columns))
            elif some.any():
                getattr(estimator, f"add_{name}")(*columns)
        parts.append(estimator.advance()[0])
    expected = run_offline(flight)
    assert_same(joined([*parts, estimator.finish()[0]]), expected.odometry)
    assert {name: estimator.counts[name] for name in VERDICTS.values()} == expected.counts


def test_an_aid_that_stops_is_waited_for_for_half_of_the_lag_and_after_a_second_done_without():
    flight = with_aids(fly(3, 6.0))
    estimator, behind = Estimator(flight.anchors), {}
    for t, stream, i in messages(flight):
        if stream in (IMU, TDOA) or (stream == FIRST_AID and t < 2.0):
            send(estimator, flight, stream, i)
            odometry, _ = estimator.advance()
            if len(odometry):
                behind[t] = t - odometry.t[-1]
    late = np.array(list(behind.values()))
    at = np.array(list(behind))
    waiting = late[(at > 2.5) & (at < 2.9)]
    assert 0.1 < waiting.min() and waiting.max() < 0.14 and late[at > 3.2].max() < 0.05
    assert estimator.counts["height_used"] + estimator.counts["height_startup"] == np.sum(
        flight.height.t < 2.0
    )


def test_an_aid_that_is_not_used_changes_nothing():
    flight = with_aids(fly(1, 3.0))
    odometry, _ = feed(
        Estimator(flight.anchors, FilterConfig(**{f"use_{name}": False for name in AIDS})), flight
    )
    assert_same(odometry, run_offline(fly(1, 3.0)).odometry)


@settings(max_examples=10)
@given(seeds, st.floats(0.0, 0.2), st.sampled_from([0, 1]), st.floats(0.0, 0.0029))
def test_neither_skew_of_the_streams_nor_disorder_within_reorder_changes_anything(
    seed, delay, behind, jitter
):
    flight, rng = fly(2, 2.0), np.random.default_rng(seed)
    delays = {"imu_delay": delay} if behind == IMU else {"tdoa_delay": delay}
    order = arriving(flight, rng, tdoa_jitter=jitter, **delays)
    assert_same_as_offline(flight, order=order, advance=lambda: rng.random() < 0.3)


@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_inertial_samples_may_come_out_of_order_too(delay):
    flight = fly(2, 2.0, imu_rate=1000.0)
    order = arriving(flight, np.random.default_rng(0), imu_jitter=0.0029, imu_delay=delay)
    assert_same_as_offline(flight, order=order)


def test_the_order_in_which_siblings_of_one_stamp_come_changes_nothing():
    flight = fly(3, 2.0)
    flight = replace(
        flight, tdoa=replace(flight.tdoa, t=np.floor(flight.tdoa.t * 50.0) / 50.0 + 0.0013)
    )
    backwards = sorted(messages(flight), key=lambda m: (m[0], m[1], -m[2]))
    one, _ = feed(Estimator(flight.anchors), flight)
    other, _ = feed(Estimator(flight.anchors), flight, order=backwards)
    assert_same(one, other, 1e-12)


def test_without_use_of_the_imu_inertial_messages_change_nothing():
    assert_same_as_offline(fly(4, 3.0), FilterConfig(use_imu=False))


def test_without_use_of_the_imu_nothing_waits_for_it():
    estimator = Estimator(corners(), FilterConfig(use_imu=False))
    estimator.add_tdoa(1.0, FIRST, SECOND, 0.0)
    estimator.add_tdoa(1.006, FIRST, SECOND, 0.0)
    _, residuals = estimator.advance()
    assert residuals.t.tolist() == [1.0]


def test_tdoas_wait_for_the_imu_to_pass_them():
    estimator = Estimator(corners())
    estimator.add_imu(0.9, *REST)
    for t in (1.0, 1.01, 1.1):
        estimator.add_tdoa(t, FIRST, SECOND, 0.0)
    assert len(estimator.advance()[1].t) == 0
    estimator.add_imu(1.007, *REST)
    assert estimator.advance()[1].t.tolist() == [1.0]
    assert estimator.waiting[TDOA] == 2


def test_a_silent_stream_is_waited_for_no_longer_than_the_lag():
    estimator = Estimator(corners(), lag=0.25)
    for k in range(40):
        estimator.add_tdoa(0.01 * k, FIRST, SECOND, 0.0)
    _, residuals = estimator.advance()
    assert residuals.t[-1] == pytest.approx(0.39 - 0.25)
    assert estimator.waiting[:2] == (0, 25)
    estimator = Estimator(corners(), lag=0.25)
    for k in range(40):
        estimator.add_imu(0.01 * k, *REST)
    estimator.advance()
    assert estimator.counts["imu_used"] == 15


def test_what_is_older_than_what_was_used_is_late_and_harmless():
    flight = fly(5, 3.0)
    order = messages(flight)
    moved = [m for m in order if m[1] == TDOA and m[0] > 1.5][::20]
    kept = [m for m in order if m not in moved]
    straggling = sorted(order, key=lambda m: m[0] + (0.1 if m in moved else 0.0))
    estimator = Estimator(flight.anchors)
    odometry, residuals = feed(estimator, flight, order=straggling)
    assert estimator.counts["late"] == len(moved) == np.sum(residuals.verdict == LATE)
    assert sorted(residuals.t[residuals.verdict == LATE]) == [m[0] for m in moved]
    expected, _ = feed(Estimator(flight.anchors), flight, order=kept)
    assert_same(odometry, expected)
    late = residuals.verdict == LATE
    assert np.isnan(residuals.innovation[late]).all() and (residuals.weight[late] == 0.0).all()


def test_late_inertial_samples_are_counted():
    estimator = Estimator(corners())
    estimator.add_imu(1.0, *REST)
    estimator.add_tdoa(1.1, FIRST, SECOND, 0.0)
    estimator.add_imu(1.2, *REST)
    estimator.finish()
    estimator.add_imu(0.99, *REST)
    assert estimator.counts["imu_late"] == 1 and received(estimator) == (3, 1)


@pytest.mark.parametrize(
    "t, a, b, d, variance",
    [
        (1.0, FIRST, SECOND, np.nan, 0.0),
        (1.0, FIRST, SECOND, np.inf, 0.0),
        (1.0, FIRST, SECOND, 0.0, np.nan),
        (1.0, FIRST, SECOND, 0.0, -1.0),
        (np.nan, FIRST, SECOND, 0.0, 0.0),
        (np.inf, FIRST, SECOND, 0.0, 0.0),
        (1.0, 999, SECOND, 0.0, 0.0),
        (1.0, FIRST, 999, 0.0, 0.0),
        (1.0, FIRST, FIRST, 0.0, 0.0),
        (1.0, FIRST, SECOND, 12.0, 0.0),
    ],
)
def test_what_cannot_be_a_measurement_is_invalid(t, a, b, d, variance):
    estimator = Estimator(corners())
    estimator.add_tdoa(t, a, b, d, variance)
    _, residuals = estimator.advance()
    assert residuals.verdict.tolist() == [INVALID]
    assert (residuals.a[0], residuals.b[0]) == (a, b) and residuals.weight[0] == 0.0
    assert estimator.counts["invalid"] == 1 and received(estimator) == (0, 1)


def test_an_inertial_sample_that_is_not_finite_is_as_if_it_had_never_come():
    flight, rng = fly(6, 3.0), np.random.default_rng(0)
    bad = rng.choice(len(flight.imu), 30, replace=False)
    estimator = Estimator(flight.anchors)
    broken = replace(
        flight, imu=replace(flight.imu, gyro=flight.imu.gyro.copy(), accel=flight.imu.accel.copy())
    )
    broken.imu.gyro[bad[:15], 1] = np.nan
    broken.imu.accel[bad[15:], 2] = [np.inf, -np.inf, np.nan] * 5
    odometry, _ = feed(estimator, broken)
    assert estimator.counts["imu_invalid"] == 30
    kept = [m for m in messages(flight) if m[1] == TDOA or m[2] not in bad]
    expected, _ = feed(Estimator(flight.anchors), flight, order=kept)
    assert_same(odometry, expected)
    estimator.add_imu(np.nan, *REST)
    assert estimator.counts["imu_invalid"] == 31


def test_an_absurd_inertial_sample_is_treated_as_offline():
    flight = fly(6, 3.0)
    flight.imu.gyro[300, 0], flight.imu.accel[400, 1] = 1e30, -1e200
    assert_same_as_offline(flight)


@settings(max_examples=40)
@given(seeds, st.booleans())
def test_every_message_is_accounted_for_once(seed, use_imu):
    """Any disorder, any nonsense, at any moment: accounts plus buffers are what was received."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(corners(), FilterConfig(use_imu=use_imu))
    sent, clock, parts = [0, 0], 0.0, []
    for _ in range(300):
        clock += rng.choice([0.0, 0.001, 0.01, 0.5, -3.0 * (rng.random() < 0.05)])
        t = clock - rng.choice([0.0, 0.0, 0.004, 0.3])
        if rng.random() < 0.5:
            t, wrong = (np.nan if rng.random() < 0.05 else t), rng.random() < 0.05
            estimator.add_imu(t, (np.nan if wrong else 0.1, 0.0, 0.0), REST[1])
            sent[IMU] += 1
        else:
            a, b = rng.choice([*estimator.anchors.ids, 99], 2).tolist()
            estimator.add_tdoa(t, a, b, rng.choice([0.0, 1.0, 30.0, np.nan]))
            sent[TDOA] += 1
        if rng.random() < 0.4:
            parts.append(estimator.advance())
        told = sum(len(residuals.t) for _, residuals in parts)
        assert told == sum(estimator.counts[name] for name in VERDICTS.values())
    parts.append(estimator.finish())
    assert not any(estimator.waiting) and received(estimator) == tuple(sent)
    residuals = joined([part[1] for part in parts])
    for value, name in VERDICTS.items():
        assert np.sum(residuals.verdict == value) == estimator.counts[name]
    assert np.isfinite(joined([part[0] for part in parts]).p).all()


def test_a_clock_that_falls_back_starts_anew_and_keeps_the_accounts():
    first, again = fly(7, 3.0, begin=1000.0), fly(7, 3.0)
    estimator = Estimator(first.anchors)
    for t, stream, i in messages(
        first
    ):  # not finished: some are still waiting when the clock falls back
        if stream == IMU:
            estimator.add_imu(t, first.imu.gyro[i], first.imu.accel[i])
        else:
            estimator.add_tdoa(t, int(first.tdoa.a[i]), int(first.tdoa.b[i]), first.tdoa.d[i])
    estimator.advance()
    waiting = estimator.waiting
    assert estimator.running and waiting[TDOA] > 0
    odometry, residuals = feed(estimator, again)
    assert estimator.counts["restarts"] >= 1
    dropped = residuals.t > 900.0
    assert (residuals.verdict[dropped] == LATE).all() and np.sum(dropped) == waiting[TDOA]
    assert received(estimator) == (2 * len(first.imu), 2 * len(first.tdoa))
    assert_same(odometry, run_offline(again).odometry)


def test_falling_back_by_less_is_late_not_a_restart():
    flight = fly(8, 2.0)
    estimator = Estimator(flight.anchors)
    feed(estimator, flight)
    estimator.add_tdoa(flight.tdoa.t[-1] - 0.9 * LARGEST_STEP_BACK, FIRST, SECOND, 0.0)
    estimator.add_imu(flight.imu.t[-1] - 0.9 * LARGEST_STEP_BACK, *REST)
    _, residuals = estimator.advance()
    assert residuals.verdict.tolist() == [LATE]
    assert (
        estimator.running
        and estimator.counts["restarts"] == 0
        and estimator.counts["imu_late"] == 1
    )


@pytest.mark.parametrize(
    "off, verdict, count",
    [
        (-500.0, LATE, "imu_late"),
        (-5.0, LATE, "imu_late"),
        *((off, INVALID, "imu_invalid") for off in (2.0, 9.0, 500.0)),
    ],
)
def test_one_stamp_far_from_its_neighbours_changes_nothing(off, verdict, count):
    flight = fly(8, 3.0)
    half = len(flight.tdoa) // 2
    plain, clean = feed(Estimator(flight.anchors), flight)
    estimator, parts = Estimator(flight.anchors), []
    for t, stream, i in messages(flight):
        if stream == IMU:
            estimator.add_imu(t, flight.imu.gyro[i], flight.imu.accel[i])
            if i == len(flight.imu) // 2:
                estimator.add_imu(t + off, *REST)
        else:
            estimator.add_tdoa(t, int(flight.tdoa.a[i]), int(flight.tdoa.b[i]), flight.tdoa.d[i])
            if i in (half, len(flight.tdoa) - 1):  # the last has no successor that would tell
                estimator.add_tdoa(t + off, FIRST, SECOND, 0.0)
        parts.append(estimator.advance())
    assert estimator.waiting[TDOA] > 0
    parts.append(estimator.finish())
    assert_same(joined([part[0] for part in parts]), plain)
    residuals = joined([part[1] for part in parts])
    stray = ~np.isin(residuals.t, flight.tdoa.t)
    assert (
        residuals.verdict[stray].tolist() == [verdict, verdict]
        and len(residuals.t) == len(clean.t) + 2
    )
    assert estimator.counts[count] == 1 and estimator.counts["restarts"] == 0


def test_what_is_invalid_does_not_hold_up_the_others():
    flight = fly(8, 2.0)
    estimator = Estimator(flight.anchors, lag=10.0)
    for t, gyro, accel in zip(flight.imu.t, flight.imu.gyro, flight.imu.accel):
        estimator.add_imu(t, gyro, accel)
    half, last = len(flight.tdoa) // 2, flight.imu.t[-1]
    for t, a, b, d in zip(flight.tdoa.t[:half], flight.tdoa.a, flight.tdoa.b, flight.tdoa.d):
        estimator.add_tdoa(t, int(a), int(b), d)
    assert estimator.advance()[0].t[-1] < flight.tdoa.t[half]
    estimator.add_tdoa(last, FIRST, SECOND, 1e3)
    odometry, residuals = estimator.advance()
    assert odometry.t[-1] > last - 0.02 and residuals.verdict[residuals.t == last].tolist() == [
        INVALID
    ]


def test_rates_are_those_measured_last():
    flight = fly(8, 1.0)
    estimator = Estimator(flight.anchors)
    odometry, _ = feed(estimator, flight)
    last, t = rows_of(odometry, slice(-2, None)), flight.imu.t[-1]
    assert np.isnan(Estimator(flight.anchors).rates_at(last)[0]).all()
    rates, variances = estimator.rates_at(replace(last, t=np.array([t, t + 1.0])))
    np.testing.assert_array_equal(rates, [flight.imu.gyro[-1] - last.gyro_bias[0], [np.nan] * 3])
    one = FilterConfig().gyro_noise ** 2 * 200.0  # of one sample at 200 Hz
    np.testing.assert_allclose(variances, [[one] * 3, [np.nan] * 3])


@pytest.mark.parametrize("compensating", [False, True])
def test_rates_are_known_for_all_odometry_that_waited(compensating):
    flight = fly(8, 2.0)
    estimator = Estimator(flight.anchors, FilterConfig(compensate_changes=compensating))
    for _t, stream, i in messages(flight):
        send(estimator, flight, stream, i)
    for give in (estimator.advance, estimator.reset):
        odometry, _ = give()
        rates, variances = estimator.rates_at(odometry)
        last = np.searchsorted(flight.imu.t, odometry.t, side="right") - 1
        assert len(odometry) and np.isfinite(variances).all()
        np.testing.assert_array_equal(rates, flight.imu.gyro[last] - odometry.gyro_bias)


def test_finish_leaves_nothing_behind():
    flight = fly(9, 2.0)
    estimator = Estimator(flight.anchors)
    feed(estimator, flight, advance=lambda: False)
    assert not any(estimator.waiting)
    odometry, residuals = estimator.finish()
    assert len(odometry) == len(residuals.t) == 0


def test_nothing_in_nothing_out():
    estimator = Estimator(corners())
    for odometry, residuals in (estimator.advance(), estimator.finish()):
        assert len(odometry) == len(residuals.t) == 0
        assert odometry.p.shape == (0, 3) and odometry.covariance.shape == (0, 9, 9)
    assert (
        not estimator.running
        and estimator.recoveries == 0
        and set(estimator.counts.values()) == {0}
    )


def test_residuals_carry_ids_not_rows():
    flight = fly(10, 1.5)
    _, residuals = feed(Estimator(flight.anchors), flight)
    np.testing.assert_array_equal(residuals.a, flight.tdoa.a)
    np.testing.assert_array_equal(residuals.b, flight.tdoa.b)
    np.testing.assert_array_equal(residuals.t, flight.tdoa.t)
    assert set(np.unique(residuals.verdict)) == {USED, STARTUP}


def test_the_order_of_the_anchors_changes_nothing():
    flight = fly(11, 2.0)
    mixed = np.random.default_rng(0).permutation(len(flight.anchors))
    anchors = Anchors.from_positions(flight.anchors.positions[mixed], flight.anchors.ids[mixed])
    one, _ = feed(Estimator(flight.anchors), flight)
    other, _ = feed(Estimator(anchors), flight)
    assert_same(one, other, 1e-9)


def test_a_doubtful_measurement_counts_less():
    flight = fly(12, 3.0)
    spreads = []
    for variance in (0.0, 1.0):
        estimator = Estimator(flight.anchors)
        for t, stream, i in messages(flight):
            if stream == IMU:
                estimator.add_imu(t, flight.imu.gyro[i], flight.imu.accel[i])
            else:
                a, b, d = int(flight.tdoa.a[i]), int(flight.tdoa.b[i]), flight.tdoa.d[i]
                estimator.add_tdoa(t, a, b, d, variance)
        odometry, residuals = estimator.finish()
        used = residuals.verdict == USED
        assert residuals.variance[used].min() > 0.25**2 + variance
        spreads.append(np.trace(odometry.covariance[-1, :3, :3]))
    assert spreads[1] > 1.5 * spreads[0]


def test_five_anchors_and_an_imu_of_100_hz_are_enough():
    anchors = corners()
    five = Anchors.from_positions(anchors.positions[[0, 3, 5, 6, 1]], anchors.ids[[0, 3, 5, 6, 1]])
    flight = fly(13, 8.0, imu_rate=100.0, tdoa_rate=60.0, anchors=five)
    odometry, _ = feed(Estimator(five), flight)
    late = odometry.t > 3.0
    assert (
        np.linalg.norm(odometry.p[late] - position_at(flight, odometry.t[late]), axis=1).max() < 0.4
    )


def test_streams_of_columns_that_are_no_floats_are_taken_as_numbers():
    """A driver may hand over what numpy or a message gives it: np.float32, np.uint16, tuples,
    arrays.
    """
    flight = fly(14, 1.5)
    flight = replace(
        flight, tdoa=Tdoas(*(column for column in (flight.tdoa.t, *_ids(flight), flight.tdoa.d)))
    )
    estimator, parts = Estimator(flight.anchors), []
    for t, stream, i in messages(flight):
        if stream == IMU:
            estimator.add_imu(
                np.float64(t), tuple(flight.imu.gyro[i]), flight.imu.accel[i].tolist()
            )
        else:
            estimator.add_tdoa(np.float64(t), flight.tdoa.a[i], flight.tdoa.b[i], flight.tdoa.d[i])
        parts.append(estimator.advance())
    parts.append(estimator.finish())
    assert_same(joined([part[0] for part in parts]), run_offline(flight).odometry)


def _ids(flight):
    return flight.tdoa.a.astype(np.uint16), flight.tdoa.b.astype(np.uint16)


@pytest.mark.parametrize("ahead", [60.0, 3600.0])
def test_a_sensor_whose_clock_is_ahead_costs_its_own_messages_and_is_named(ahead):
    """At 100 Hz. More than 2000 of them moved the time of all streams, once."""
    flight = fly(8, 24.0, imu_rate=50.0, tdoa_rate=50.0)
    estimator, velocity, parts = Estimator(flight.anchors), SENSORS["velocity"], []
    for k, (t, stream, i) in enumerate(messages(flight)):
        send(estimator, flight, stream, i)
        fields = {name: np.ones((1, n) if n > 1 else 1) for name, n in velocity.fields.items()}
        estimator.add("velocity", velocity.read(np.array([t + ahead]), fields))
        parts.append(estimator.advance())
        if k == 2300:
            (finding,) = estimator.clocks
            assert (
                finding.rule == "clock_ahead"
                and "velocity" in finding.sentence
                and finding.value == pytest.approx(ahead, abs=0.1)
            )
    parts.append(estimator.finish())
    assert estimator.counts["velocity_invalid"] > 2300 and estimator.counts["velocity_used"] == 0
    assert (
        estimator.counts["late"]
        == estimator.counts["imu_late"]
        == estimator.counts["restarts"]
        == 0
    )
    expected, _ = feed(Estimator(flight.anchors), flight)
    assert_same(joined([part[0] for part in parts]), expected)


def test_a_few_stamps_of_a_sensor_that_fell_back_start_nothing_anew():
    flight = fly(8, 3.0)
    estimator, pressure = Estimator(flight.anchors), SENSORS["pressure"]
    for t, stream, i in messages(flight):
        send(estimator, flight, stream, i)
        if stream == TDOA and i % 4 == 0:
            late = 5.0 if 100 <= i < 108 else 0.0
            estimator.add(
                "pressure",
                pressure.read(
                    np.array([t - late]), {name: np.full(1, 1e5) for name in pressure.fields}
                ),
            )
        estimator.advance()
    assert (
        estimator.counts["restarts"] == 0
        and estimator.counts["pressure_late"] == 2
        and estimator.running
    )


def test_a_restart_is_named_for_a_while():
    first, again = fly(7, 3.0, begin=1000.0), fly(7, 12.0, imu_rate=50.0, tdoa_rate=50.0)
    estimator = Estimator(first.anchors)
    feed(estimator, first)
    assert estimator.restarted is None
    named = []
    for t, stream, i in messages(again):
        send(estimator, again, stream, i)
        named.append((t, estimator.restarted))
    assert "uwb/tdoa fell back by 1e+03 s" in named[20][1].sentence and named[-1][1] is None
    assert max(t for t, finding in named if finding is not None) == pytest.approx(10.0, abs=0.2)


def test_anchors_that_are_sent_again_with_jitter_are_those_that_were_there():
    flight, rng = fly(8, 3.0), np.random.default_rng(4)
    expected, _ = feed(Estimator(flight.anchors), flight)
    estimator, parts = Estimator(flight.anchors), []
    for k, (_t, stream, i) in enumerate(messages(flight)):
        send(estimator, flight, stream, i)
        if k % 50 == 0:
            places = flight.anchors.positions
            estimator.change_anchors(
                flight.anchors.at(places + rng.uniform(-0.002, 0.002, places.shape))
            )
        parts.append(estimator.advance())
    parts.append(estimator.finish())
    assert_same(joined([part[0] for part in parts]), expected)
