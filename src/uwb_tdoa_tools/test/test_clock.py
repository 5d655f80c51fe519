# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Continuous time from clocks that restart, wrap or are set, by the order of the messages."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_tools.clock import (
    FEW,
    RESTART,
    SET,
    SILENCE,
    WRAP,
    WRAPS,
    is_grouped,
    sentences,
    straightened,
)

YEARS = 55 * 365.25 * 86400.0
RATES = {"imu": 100.0, "tdoa": 50.0, "height": 10.0}


def stamps_of(duration=20.0, rates=RATES, start=3.0, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: start
        + (np.arange(int(duration * rate)) + rng.uniform(-0.2, 0.2, int(duration * rate))) / rate
        for name, rate in rates.items()
    }


def moved(stamps, at, by):
    """Return stamps of a clock that jumps by `by`, s, when it would show `at`, s."""
    return {name: np.where(t < at, t, t + by) for name, t in stamps.items()}


def whole(stamps, found):
    """Return {stream: stamps on the continuous time, without outliers}."""
    return {
        name: (t + found.shifts.get(name, 0.0))[found.kept.get(name, slice(None))]
        for name, t in stamps.items()
    }


def assert_continuous(stamps, found, true):
    """Assert that all streams continue as in reality, except for the length of each jump.

    Only the usual interval between messages determines this length.
    """
    for name, t in whole(stamps, found).items():
        kept = true[name][found.kept.get(name, slice(None))]
        off = t - kept
        assert np.ptp(off) < 0.05 * (1 + len(found.jumps)), name
    shifts = [
        np.median(
            (whole(stamps, found)[name] - true[name][found.kept.get(name, slice(None))])[-FEW:]
        )
        for name in ("imu", "tdoa")
    ]
    assert abs(shifts[0] - shifts[1]) < 1e-6  # streams of one clock stay synchronous


@pytest.mark.parametrize(
    "by, kind",
    [
        (-8.0, RESTART),
        (-1.8e9, RESTART),
        (YEARS, SET),
        (10 * 86400.0, SET),
        *((-length, WRAP) for length in WRAPS.values()),
    ],
)
def test_a_jump_is_recognised_and_undone(by, kind):
    true = stamps_of()
    stamps = moved(true, 12.0, by)
    found = straightened(stamps)
    (jump,) = found.jumps
    assert jump.kind == kind and set(jump.streams) == set(RATES)
    assert jump.by == pytest.approx(by, abs=0.2)
    assert jump.message == 1 + np.count_nonzero(true["imu"] < 12.0)
    assert jump.after == pytest.approx(9.0, abs=0.2)
    assert (len(found.restarts) == 1) == (kind == RESTART)
    assert_continuous(stamps, found, true)
    assert len(list(sentences(found))) == 1


def test_a_wrap_is_undone_by_its_exact_size():
    true = stamps_of()
    period = 2**32 * 1e-6
    found = straightened(moved(true, 12.0, -period))
    np.testing.assert_array_equal(found.shifts["tdoa"][-1], period)


@pytest.mark.parametrize("name", ["2^40 ticks of 15.65 ps", "2^24 microseconds"])
def test_slow_streams_take_the_nearest_of_two_wraps(name):
    """Their periods differ by 0.43 s, less than the tolerance of streams of 5 Hz."""
    true = stamps_of(rates={"imu": 5.0, "tdoa": 4.0})
    (jump,) = straightened(moved(true, 18.0, -WRAPS[name])).jumps
    assert (jump.kind, jump.period) == (WRAP, name)


@pytest.mark.parametrize("by", [-5.0, 40.0, 2000.0, YEARS])
def test_arrivals_determine_the_size_of_a_jump(by):
    true = {
        name: np.where(t < 12.0, t, t + 3.0) for name, t in stamps_of().items()
    }  # the recorder receives nothing for 3 s
    stamps = moved(true, 13.0, by)
    rng = np.random.default_rng(1)
    arrived = {name: 1e3 + t + 0.02 + 0.001 * rng.random(len(t)) for name, t in true.items()}
    arrived = {name: np.maximum.accumulate(t) for name, t in arrived.items()}
    found = straightened(stamps, arrived)
    (jump,) = found.jumps
    assert jump.kind == (RESTART if by < 0.0 else SET)
    for name, t in whole(stamps, found).items():
        np.testing.assert_allclose(t, true[name], atol=5e-3)


def test_a_pause_is_named_and_moves_nothing():
    stamps = moved(stamps_of(), 12.0, 60.0)
    found = straightened(stamps)
    assert (
        [jump.kind for jump in found.jumps] == [SILENCE] and not found.shifts and not found.restarts
    )
    arrived = {
        name: t + 0.01 for name, t in stamps.items()
    }  # arrival times show that there is no jump
    assert not straightened(stamps, arrived).jumps


def test_a_stamp_that_is_no_number_is_no_jump():
    stamps = stamps_of()
    arrived = {name: t + 0.01 for name, t in stamps.items()}
    stamps["tdoa"][[300, 500, 503]] = np.nan
    stamps["tdoa"][310] += 50.0
    found = straightened(stamps, arrived)
    assert not found.jumps and found.outliers == {"tdoa": 1}


def test_a_silent_stream_is_not_changed():
    stamps = stamps_of(60.0)
    stamps["tdoa"] = stamps["tdoa"][(stamps["tdoa"] < 20.0) | (stamps["tdoa"] > 45.0)]
    found = straightened(stamps)
    assert not found.jumps and not found.shifts and not found.kept


def test_rare_messages_are_no_outliers():
    stamps = stamps_of(100.0)
    t = stamps["tdoa"]
    stamps["tdoa"] = t[(t < 20.0) | ((t > 40.0) & (t < 40.1)) | (t > 70.0)]
    found = straightened(stamps)
    assert not found.jumps and not found.kept


def test_the_clock_of_one_stream_is_set_alone():
    true = stamps_of(60.0)
    stamps = {**true, "imu": np.where(true["imu"] < 30.0, true["imu"], true["imu"] + 100.0)}
    found = straightened(stamps)
    assert [(jump.kind, jump.streams) for jump in found.jumps] == [(SET, ("imu",))] and set(
        found.shifts
    ) == {"imu"}
    np.testing.assert_allclose(stamps["imu"] + found.shifts["imu"], true["imu"], atol=0.02)


def test_a_restart_of_an_optional_sensor_restarts_nothing():
    true = stamps_of(60.0)
    stamps = {
        **true,
        "height": np.where(true["height"] < 30.0, true["height"], true["height"] - 20.0),
    }
    found = straightened(stamps)
    assert [(jump.kind, jump.streams) for jump in found.jumps] == [
        (RESTART, ("height",))
    ] and not found.restarts


def test_a_stream_that_begins_after_the_jump_is_shifted_with_the_others():
    true = stamps_of()
    true["height"] = true["height"][true["height"] > 15.0]
    stamps = moved(true, 12.0, YEARS)
    found = straightened(stamps)
    assert_continuous(stamps, found, true)


@pytest.mark.parametrize("by", [-3.0, -1e6, 12.0, 500.0, 1e6])
@pytest.mark.parametrize("places", [[0], [400], [400, 401], [200, 500, 700], [-1]])
def test_few_wild_stamps_are_left_out(by, places):
    stamps = stamps_of()
    if (by, places) in ((-3.0, [0]), (12.0, [-1])):
        return  # a pause looks the same
    stamps["tdoa"][places] += by
    found = straightened(stamps)
    assert found.outliers == {"tdoa": len(places)} and not found.jumps
    assert not found.kept["tdoa"][places].any()


def test_two_tags_on_one_topic_are_not_changed():
    one = stamps_of()["tdoa"]
    both = np.column_stack([one, one + 500.0]).ravel()
    found = straightened({"tdoa": both})
    assert not found.jumps and not found.kept and not found.shifts


@settings(max_examples=60, deadline=None)
@given(
    jumps=st.lists(
        st.tuples(
            st.floats(0.5, 4.0), st.sampled_from([-2.0, -50.0, -1e9, YEARS, 1e5, -(2**32) * 1e-6])
        ),
        max_size=4,
    ),
    wild=st.sets(st.integers(0, 999), max_size=8),
    far=st.floats(20.0, 1e9) | st.floats(-1e9, -20.0),
    drop=st.floats(0.0, 0.5),
    seed=st.integers(0, 100),
)
def test_every_message_is_counted_and_time_is_continuous(jumps, wild, far, drop, seed):
    rng = np.random.default_rng(seed)
    true = {name: t[rng.random(len(t)) >= drop] for name, t in stamps_of(20.0, seed=seed).items()}
    stamps, at = dict(true), 3.0
    shift = {name: np.zeros(len(t)) for name, t in true.items()}
    for after, by in jumps:
        at += after
        shift = {name: s + np.where(true[name] < at, 0.0, by) for name, s in shift.items()}
    stamps = {name: true[name] + shift[name] for name in true}
    apart = sorted(place for place in wild if place < len(stamps["tdoa"]))
    apart = [place for k, place in enumerate(apart) if not k or place - apart[k - 1] > 3]
    # The first messages do not determine which of two times is right. If two of the first five are
    # from one wrong time, the three between them are left out, too.
    apart = [place for place in apart if place > 4]
    stamps["tdoa"] = stamps["tdoa"].copy()
    stamps["tdoa"][apart] += far
    found = straightened(stamps)
    for name, count in found.outliers.items():  # a short piece of time cannot be assigned
        assert count <= len(apart) * (name == "tdoa") + FEW * len(jumps)
    for name, t in whole(stamps, found).items():
        # every message is accounted for
        assert len(t) + found.outliers.get(name, 0) == len(stamps[name])
        steps = np.diff(t)
        assert steps.min() > -1.0 and steps.max() < 2.0  # continuous
    assert sum(jump.kind == RESTART for jump in found.jumps) >= len(found.restarts)


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(0.2, 500.0),
    seed=st.integers(0, 1000),
    drop=st.floats(0.0, 0.9),
    late=st.floats(0.0, 0.4),
    pauses=st.integers(0, 3),
)
def test_a_healthy_recording_is_not_changed(rate, seed, drop, late, pauses):
    rng = np.random.default_rng(seed)
    t = 1.7e9 + np.arange(400) / rate
    for _ in range(pauses):
        t[rng.integers(400) :] += rng.uniform(0.0, 9.0)
    t = t[rng.random(400) >= drop]
    # messages overtake each other
    order = np.argsort(t + rng.uniform(0.0, late, len(t)), kind="stable")
    stamps = {"tdoa": t[order], "imu": np.arange(t[0], t[-1], 0.05)} if len(t) else {"tdoa": t}
    found = straightened(stamps)
    assert not found.shifts and not found.kept and not found.restarts and not found.jumps


def test_tables_in_the_order_of_anchors_are_no_restarts():
    t = np.arange(0.0, 20.0, 0.1)
    a, b = np.arange(200) % 4, np.arange(200) % 3
    for keys in ((t, a), (t, b, a), (t, a, b)):  # the last key counts most
        order = np.lexsort(keys)
        assert is_grouped(t[order], a[order], b[order])
    assert not is_grouped(t, a, b)
    restarted = np.concatenate([t[:100], t[:100]])
    assert not is_grouped(restarted, a) and not is_grouped(restarted, a, b)
    assert not is_grouped(restarted, np.zeros(200), b)  # one reference


def test_empty_recordings_are_not_changed():
    assert not straightened({}).jumps
    assert not straightened({"tdoa": np.empty(0), "imu": np.array([1.0])}).jumps
    assert not straightened({"tdoa": np.array([np.nan, 1.0, 2.0])}).kept
