# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rules over the streams: healthy streams give no finding, each fault gives its own."""

from dataclasses import replace
import math

from faults import ACCEL, ARRIVAL, GYRO, D, T, put
from flights import corners
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.monitoring.finding import ERROR, NOTE, SEVERITIES, WARNING, Finding, Steady
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules

# --- stream rules ---
GRAVITY = 9.81
ANCHORS = corners()  # ids differ from rows
RADIO = 0.05  # m, noise of a TDOA


def streams(seconds=20.0, imu_rate=500.0, tdoa_rate=300.0, seed=0):
    """Return the healthy columns of a tag that sways.

    These are imu (t, arrival, gyro, force) and tdoa (t, arrival, a, b, d).
    """
    rng = np.random.default_rng(seed)
    t = 100.0 + np.arange(int(seconds * imu_rate)) / imu_rate
    gyro = 0.2 * np.sin(np.outer(t, [0.9, 1.1, 0.4])) + 0.02 * rng.normal(size=(len(t), 3))
    force = (
        0.5 * np.sin(np.outer(t, [1.1, 0.7, 0.9]))
        + 0.2 * rng.normal(size=(len(t), 3))
        + [0.0, 0.0, GRAVITY]
    )
    imu = t, _arrival(t, rng), gyro, force
    t = (
        100.0
        + (np.arange(int(seconds * tdoa_rate)) + rng.uniform(0.1, 0.9, int(seconds * tdoa_rate)))
        / tdoa_rate
    )
    a = np.arange(len(t)) % 8
    b = (a + 1) % 8
    p = ANCHORS.positions.mean(axis=0) + np.sin(np.outer(t, [0.5, 0.7, 0.3])) * [1.5, 1.5, 0.8]
    d = tdoa(p, ANCHORS.positions[a], ANCHORS.positions[b]) + RADIO * rng.normal(size=len(t))
    return imu, (t, _arrival(t, rng), ANCHORS.ids[a], ANCHORS.ids[b], d)


def _arrival(t, rng):
    return np.maximum.accumulate(t + 0.002 + rng.exponential(0.001, len(t)))


def judged(imu, tdoa, arrivals=True):
    """Return {rule: Finding}. Without arrivals, the columns are as in a log."""
    rules = StreamRules(ANCHORS)
    for feed, (t, arrival, *values) in ((rules.feed_imu, imu), (rules.feed_tdoa, tdoa)):
        if len(t):
            feed(t, arrival if arrivals else np.full(len(t), np.nan), *values)
    rules.finish()
    return {finding.rule: finding for finding in rules.findings()}


A, B = 2, 3  # columns of the TDOAs


@pytest.mark.parametrize("arrivals", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_said_of_a_healthy_recording(seed, arrivals):
    assert judged(*streams(seed=seed), arrivals) == {}


IMU_FAULTS = {
    "imu_force_unit": lambda c, rng: put(c, ACCEL, c[ACCEL] / GRAVITY),
    "imu_rate_unit": lambda c, rng: put(c, GYRO, np.rad2deg(c[GYRO])),
    "imu_no_gravity": lambda c, rng: put(c, ACCEL, c[ACCEL] - [0.0, 0.0, GRAVITY]),
    "imu_turned": lambda c, rng: put(c, ACCEL, c[ACCEL][:, [2, 0, 1]]),
    "imu_tilted": lambda c, rng: put(
        c, ACCEL, c[ACCEL] @ np.array([[1, 0, 0], [0, 0.7, 0.7], [0, -0.7, 0.7]])
    ),
    "imu_in_turns": lambda c, rng: put(
        put(c, ACCEL, c[ACCEL] * (np.arange(len(c[ACCEL])) % 2)[:, None]),
        GYRO,
        c[GYRO] * (np.arange(len(c[GYRO])) % 2 == 0)[:, None],
    ),
    "imu_silent": lambda c, rng: put(put(c, ACCEL, 0.0 * c[ACCEL]), GYRO, 0.0 * c[GYRO]),
    "imu_repeated": lambda c, rng: put(put(c, ACCEL, _held(c[ACCEL])), GYRO, _held(c[GYRO])),
    "imu_axis_dead": lambda c, rng: put(c, GYRO, c[GYRO] * [1.0, 0.0, 1.0]),
    "imu_invalid": lambda c, rng: put(
        c, GYRO, np.where(rng.random(c[GYRO].shape) < 0.01, np.nan, c[GYRO])
    ),
    "imu_shaking": lambda c, rng: put(c, ACCEL, c[ACCEL] + 3.0 * rng.normal(size=c[ACCEL].shape)),
    "imu_clipped": lambda c, rng: put(c, ACCEL, np.clip(c[ACCEL] + _bumps(c[T]), None, 19.6)),
    "stamps_zero": lambda c, rng: put(c, T, 0.0 * c[T]),
    "stamps_stand": lambda c, rng: put(c, T, 7.0 + 0.0 * c[T]),
    "stamps_coarse": lambda c, rng: put(c, T, np.floor(c[T] / 0.05) * 0.05),
    "stamps_fall": lambda c, rng: put(c, T, c[T] + 0.02 * rng.random(len(c[T]))),
    "stamps_jump": lambda c, rng: put(c, T, np.where(c[T] > 110.0, c[T] - 3.0, c[T])),
    "stamps_unit": lambda c, rng: put(c, T, 1e3 * c[T]),
    "stamps_apart": lambda c, rng: put(c, T, c[T] - 0.3),
    "clock_drift": lambda c, rng: put(c, T, c[T] + 0.003 * (c[T] - c[T][0])),
    "gap": lambda c, rng: tuple(column[(c[T] < 107.0) | (c[T] > 107.4)] for column in c),
    "rate": lambda c, rng: tuple(column[::20] for column in c),
    "blocks": lambda c, rng: put(c, ARRIVAL, np.ceil(2.0 * c[ARRIVAL]) / 2.0),
}
TDOA_FAULTS = {
    "tdoa_large": lambda c, rng: put(c, D, 1e3 * c[D]),
    "tdoa_outliers": lambda c, rng: put(c, D, np.where(rng.random(len(c[D])) < 0.1, 30.0, c[D])),
    "tdoa_of_one": lambda c, rng: put(c, A, np.where(rng.random(len(c[D])) < 0.1, c[B], c[A])),
    "tdoa_invalid": lambda c, rng: put(c, D, np.where(rng.random(len(c[D])) < 0.1, np.nan, c[D])),
    "tdoa_twice": lambda c, rng: tuple(np.repeat(column, 2, axis=0) for column in c),
    "tdoa_repeated": lambda c, rng: _repeated(c),
    "two_tags": lambda c, rng: put(c, D, c[D] + np.where(rng.random(len(c[D])) < 0.5, 1.5, 0.0)),
    "tdoa_one_sign": lambda c, rng: _both_orders(c, 1.0),
    "tdoa_rounded": lambda c, rng: put(c, D, np.round(c[D], 1)),
    "tdoa_clipped": lambda c, rng: put(c, D, np.clip(c[D], -1.0, 1.0)),
    "tdoa_frozen": lambda c, rng: put(c, D, standing(c, 112.0)),
    "few_anchors": lambda c, rng: put(put(c, A, np.full(len(c[D]), 10)), B, np.full(len(c[D]), 11)),
    "ids_unknown": lambda c, rng: put(c, A, np.where(c[A] == 12, 99, c[A])),
    "stamps_apart": lambda c, rng: put(c, T, c[T] + 10.0),
    "gap": lambda c, rng: tuple(column[(c[T] < 107.0) | (c[T] > 107.8)] for column in c),
    "rate": lambda c, rng: tuple(column[::30] for column in c),
}


def _held(values):
    return values[np.arange(len(values)) // 5 * 5]


def standing(columns, since):
    """Return TDOAs that keep the last value of their pair from a stamp on, in s."""
    d, pairs = columns[D].copy(), columns[A] * 1000 + columns[B]
    for pair in np.unique(pairs):
        rows = np.flatnonzero(pairs == pair)
        late = columns[T][rows] >= since
        d[rows[late]] = d[rows[~late][-1]]
    return d


def _bumps(t):
    return 12.0 * (np.sin(6.0 * t) > 0.8)[:, None] * [0.0, 0.0, 1.0]


def _repeated(columns):
    """Repeat each TDOA 2 ms later."""
    both = [np.concatenate([column, column]) for column in columns]
    n = len(columns[0])
    both[T][n:] += 0.002
    both[ARRIVAL][n:] += 0.002
    rows = np.argsort(both[T], kind="stable")
    return tuple(column[rows] for column in both)


def _both_orders(columns, sign):
    """Exchange the anchors of every second round of TDOAs, and multiply their values by `sign`."""
    t, arrival, a, b, d = columns
    odd = (np.arange(len(t)) // 8) % 2 == 1
    return t, arrival, np.where(odd, b, a), np.where(odd, a, b), np.where(odd, sign * d, d)


@pytest.mark.parametrize(
    ("stream", "rule"),
    [*(("imu", rule) for rule in IMU_FAULTS), *(("tdoa", rule) for rule in TDOA_FAULTS)],
)
def test_a_fault_of_a_stream_is_named(stream, rule):
    (imu, tdoa), rng = streams(), np.random.default_rng(1)
    if stream == "imu":
        found = judged(IMU_FAULTS[rule](imu, rng), tdoa)
    else:
        found = judged(imu, TDOA_FAULTS[rule](tdoa, rng))
    assert rule in found, found
    one = found[rule]
    assert one.severity in SEVERITIES and math.isfinite(one.value)
    assert one.cause and one.evidence and one.remedy


# m, range after which the 32-bit clock of a DW1000 starts again at 0
TICKS = 2.0**32 * 299792458.0 / (128 * 499.2e6)


@pytest.mark.parametrize(
    ("step", "share", "signs"),
    [(10.0, 0.08, (1.0, 1.0)), (299792.458, 0.3, (1.0, -1.0)), (TICKS, 0.2, (1.0, -1.0))],
)
def test_a_fixed_step_is_named_with_its_size_and_nothing_else(step, share, signs):
    imu, tdoa = streams()
    rng = np.random.default_rng(2)
    off = np.where(rng.random(len(tdoa[D])) < share, step * np.array(signs)[tdoa[A] % 2], 0.0)
    found = judged(imu, put(tdoa, D, tdoa[D] + off))
    assert found.keys() == {"tdoa_wraps"}, found
    assert found["tdoa_wraps"].value == pytest.approx(step, abs=0.5)
    assert ("2^32 ticks" in found["tdoa_wraps"].cause) == (step == TICKS)


def at_rest(imu, bias):
    """Return the samples of a tag that stands still.

    bias : of the gyroscope, in the unit of its message.
    """
    rng = np.random.default_rng(5)
    n = len(imu[T])
    still = put(imu, GYRO, bias + 0.01 * rng.normal(size=(n, 3)))
    return put(still, ACCEL, [0.1, -0.2, GRAVITY] + 0.03 * rng.normal(size=(n, 3)))


@pytest.mark.parametrize(
    "bias", [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01), (0.6, 0.0, 0.1), (1.5, -2.0, 0.7)]
)
def test_at_rest_no_unit_of_the_gyroscope_is_alleged(bias):
    imu, tdoa = streams()
    found = judged(at_rest(imu, np.array(bias)), tdoa)
    assert not any(finding.severity == "error" for finding in found.values()), found
    assert found.keys() == ({"imu_rate_offset"} if np.hypot(*bias[:2]) > 0.35 else set())


def test_pairs_in_both_orders_with_both_signs_are_healthy():
    imu, tdoa = streams()
    assert judged(imu, _both_orders(tdoa, -1.0)) == {}


def test_a_log_shows_an_offset_by_where_its_streams_begin_and_end():
    imu, tdoa = streams()
    assert judged(put(imu, T, imu[T] + 0.4), tdoa, arrivals=False)[
        "stamps_apart"
    ].value == pytest.approx(0.4, abs=0.02)
    # The IMU is switched on later; this is no offset.
    late = tuple(column[imu[T] > 104.0] for column in imu)
    assert judged(late, tdoa, arrivals=False).keys() == {"imu_partly"}


@pytest.mark.parametrize("blinks", [0.5, 3.0])
def test_blinks_have_one_stamp_and_slow_stamps_are_no_milliseconds(blinks):
    """All TDOAs of a blink are with the first anchor. Of pairs in a ring, they would be a packet."""
    imu, (t, arrival, a, b, d) = streams(tdoa_rate=7.0 * blinks, seconds=60.0)
    blink = np.floor(np.arange(len(t)) / 7.0) / blinks
    ids = np.tile(ANCHORS.ids[1:], len(t) // 7 + 1)[: len(t)]
    of_blinks = 100.0 + blink, 100.01 + blink, np.full(len(t), ANCHORS.ids[0]), ids, d
    assert not {"stamps_coarse", "stamps_unit"} & judged(imu, of_blinks).keys()
    assert "stamps_coarse" in judged(imu, (*of_blinks[:2], a, b, d))
    again = np.tile(ids[:3], len(t))[: len(t)]  # and a pair comes twice with one stamp
    assert "stamps_coarse" in judged(imu, (*of_blinks[:3], again, d))


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_a_tag_of_few_tdoas_is_slow_and_in_seconds(rate):
    imu, tdoa = streams(tdoa_rate=rate, seconds=60.0)
    found = judged(imu, tdoa)
    assert "rate" in found and "stamps_unit" not in found
    assert "stamps_unit" in judged(imu, put(tdoa, T, 1e3 * tdoa[T]), arrivals=False)


def test_both_streams_on_another_clock_than_the_recorder_is_a_note():
    imu, tdoa = streams()
    found = judged(put(imu, ARRIVAL, imu[ARRIVAL] + 1e6), put(tdoa, ARRIVAL, tdoa[ARRIVAL] + 1e6))
    assert {name: finding.severity for name, finding in found.items()} == {"other_clock": "note"}


def test_a_driver_that_sends_seconds_alone_is_unmasked_by_the_pace():
    imu, tdoa = streams()
    nanoseconds_for_microseconds = np.floor(imu[T]) + 1e-3 * (imu[T] % 1.0)
    assert "stamps_coarse" in judged(put(imu, T, nanoseconds_for_microseconds), tdoa)


def test_a_stray_stamp_far_ahead_does_no_harm():
    imu, tdoa = streams()
    t = tdoa[T].copy()
    t[3000] += 1e9
    assert judged(imu, put(tdoa, T, t)).keys() == {"stamps_jump"}


ANY = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(ANY, ANY, st.integers(0, 12), st.integers(0, 12), ANY), max_size=60),
    st.lists(st.tuples(*[ANY] * 8), max_size=60),
)
def test_nothing_that_arrives_breaks_it(tdoas, samples):
    rules = StreamRules(ANCHORS)
    columns = [np.array(column) for column in zip(*tdoas)] or [np.empty(0)] * 5
    rules.feed_tdoa(*columns[:2], columns[2].astype(int), columns[3].astype(int), columns[4])
    table = np.array(samples, dtype=float).reshape(-1, 8)
    rules.feed_imu(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:])
    rules.finish()
    for finding in rules.findings():
        assert finding.severity in SEVERITIES and finding.cause


def test_tdoas_that_come_late_are_late_and_the_imu_is_not_blamed():
    imu, tdoa = streams()
    found = judged(imu, put(tdoa, ARRIVAL, tdoa[ARRIVAL] + 0.6))["stamps_apart"]
    assert (
        "TDOAs arrive 0.6" in found.cause
        and "-p lag:=0.9" in found.remedy
        and "t_imu" not in found.remedy
    )
    ahead = judged(put(imu, T, imu[T] + 0.6), tdoa)["stamps_apart"]
    assert "imu/data" in ahead.cause and "t_imu" in ahead.remedy


@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize(
    ("rule", "spoil"),
    [
        ("tdoa_invalid", lambda c, bad: put(c, D, np.where(bad, np.nan, c[D]))),
        ("tdoa_of_one", lambda c, bad: put(c, A, np.where(bad, c[B], c[A]))),
    ],
)
def test_no_share_is_above_all(rule, spoil, share):
    imu, tdoa = streams()
    bad = np.random.default_rng(0).random(len(tdoa[T])) < share
    assert judged(imu, spoil(tdoa, bad))[rule].value == pytest.approx(share, abs=0.05)


# --- finding ---


def finding(rule, severity=ERROR, value=1.0):
    return Finding(rule, severity, "cause", "evidence", "remedy", value)


@pytest.mark.parametrize(
    ("found", "with_imu", "without_imu"),
    [
        *(
            (finding(rule), True, True)
            for rule in (
                "tdoa_sign",
                "tdoa_large",
                "tdoa_unit",
                "two_tags",
                "ids_exchanged",
                "survey_misfit",
                "survey_unit",
            )
        ),
        (finding("tdoa_sign", WARNING), False, False),
        (finding("survey_misfit", NOTE), False, False),
        # The filter runs without the IMU.
        (finding("imu_turned"), True, False),
        (finding("imu_left_out"), False, False),
        # Unknown ids count if they are the majority.
        *((finding("ids_unknown", value=share), False, False) for share in (0.05, 0.49)),
        *((finding("ids_unknown", value=share), True, True) for share in (0.51, 1.0)),
        # dropped or slow messages
        *(
            (finding(rule), False, False)
            for rule in ("tdoa_twice", "gap", "rate", "blocks", "few_anchors", "tdoa_of_one")
        ),
    ],
)
def test_what_the_position_is_computed_from_makes_it_wrong(found, with_imu, without_imu):
    assert (found.position_wrong(True), found.position_wrong(False)) == (with_imu, without_imu)


def test_the_text_of_what_goes_on_stays_until_it_is_over_or_much_else():
    steady = Steady()
    first, next_one = (
        finding("imu_turned", value=2.0),
        replace(finding("imu_turned", value=2.1), evidence="a little else"),
    )
    assert steady([first]) == [first] and steady([next_one]) == [first]
    worse = replace(next_one, value=4.0)
    assert (
        steady([worse]) == [worse]
        and steady([replace(worse, severity=WARNING)])[0].severity == WARNING
    )
    assert steady([]) == [] and steady([next_one]) == [next_one]
    nothing = finding("dead", value=float("nan"))
    assert steady([nothing]) == [nothing] and steady([replace(nothing, evidence="else")]) == [
        nothing
    ]


@pytest.mark.parametrize("rate", [0.5, 2.2, 4.3, 8.0])
def test_a_tag_that_tumbles_feels_gravity(rate):
    """At 4.3 rad/s "gravity was taken out": the mean of the force over a second is small."""
    (t, arrival, gyro, _), tdoas = streams()
    angle = rate * (t - t[0])
    force = GRAVITY * np.column_stack([np.zeros(len(t)), np.sin(angle), np.cos(angle)])
    imu = t, arrival, gyro * 0.0 + [rate, 0.0, 0.0], force + 0.1 * np.sin(np.outer(t, [70, 80, 90]))
    assert not judged(imu, tdoas).keys() & {"imu_no_gravity", "imu_force_unit", "imu_rate_unit"}


@pytest.mark.parametrize("arrivals", [True, False])
@pytest.mark.parametrize("first, last", [(0.4, 1.0), (0.0, 0.5), (0.0, 1.0)])
def test_an_imu_that_covers_a_part_of_a_recording_is_named(first, last, arrivals):
    imu, tdoas = streams()
    count = len(imu[0])
    part = tuple(column[int(first * count) : int(last * count)] for column in imu)
    named = {"imu_partly"} if last - first < 1.0 else set()
    assert set(judged(part, tdoas, arrivals)) == named
