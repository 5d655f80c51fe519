# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Accepted stamps, and the pose that belongs to a stamp."""

from hypothesis import given, strategies as st
import pytest

from uwb_tdoa_bias.common.stamps import (
    CONTRADICTED,
    LARGEST_STEP_AHEAD,
    LARGEST_STEP_BACK,
    MOST_HELD,
    STEP_AHEAD,
    UNCONTRADICTED,
    PoseQueue,
    StampGate,
)

# --- stamps ---


def through(stamps, reached=()):
    """Feed stamps one by one. Return (accepted, outliers, places of jumps back)."""
    gate, accepted, outliers, back = StampGate(), [], [], []
    for place, t in enumerate(stamps):
        good, bad, jumped_back = gate.take(t, place, reached)
        accepted += good
        outliers += bad
        back += [place] * jumped_back
    return accepted, outliers + gate.finish(), back


def test_a_stream_that_goes_on_is_accepted_at_once():
    gate = StampGate()
    for t in (5.0, 5.1, 5.05, 5.1 - LARGEST_STEP_BACK, 5.1 + STEP_AHEAD):
        assert gate.take(t, "x") == ([(t, "x")], [], False) and len(gate) == 0


@pytest.mark.parametrize(
    "stamps, reached, outliers, back",
    [
        ([50.0, 1.0, 1.1], [], [], [2]),
        ([0.0, 60.0, 60.0, 60.1], [], [], []),
        # A jump must last longer if another stream continues without it.
        ([50.0, 1.0, 1.1, 1.2, 1.3], [50.1], [], [4]),
        ([50.0, 1.0, 1.1, 1.2, 50.1], [50.1], [1, 2, 3], []),
        # It counts at once if another stream has made it.
        ([0.0, 60.0], [60.1], [], []),
        ([50.0, 1.0, 1.1], [1.0], [], [2]),
    ],
)
def test_a_jump_that_persists_is_another_time(stamps, reached, outliers, back):
    items = list(zip(stamps, range(len(stamps))))
    accepted = [item for item in items if item[1] not in outliers]
    assert through(stamps, reached) == (accepted, [items[place] for place in outliers], back)


@given(st.floats(0.6, 1e6) | st.floats(-1e6, -1.3), st.integers(1, 25))
def test_a_burst_of_wrong_stamps_shorter_than_a_jump_costs_its_messages_alone(off, count):
    """Stamps come at 100 Hz. Thirty wrong ones in a row would be a jump."""
    stamps = [0.01 * k for k in range(200)]
    wrong = [t + off for t in stamps[100 : 100 + count]]
    accepted, outliers, back = through([*stamps[:100], *wrong, *stamps[100 + count :]], [1.0])
    assert [place for place, _ in enumerate(stamps) if not 100 <= place < 100 + count] == [
        place for _, place in accepted
    ]
    assert [t for t, _ in outliers] == wrong and not back


def test_a_stream_that_stands_still_at_another_time_never_jumps_and_does_not_grow():
    gate = StampGate()
    gate.take(100.0, "x")
    for _ in range(2 * MOST_HELD):
        assert not gate.take(50.0, "x")[2] and len(gate) <= MOST_HELD
    assert gate.newest == 100.0


def test_a_slow_stream_goes_on_at_once_and_a_fast_one_makes_no_step_of_a_second():
    slow, fast = StampGate(), StampGate()
    for k in range(100):
        assert slow.take(0.45 * k, "x")[0] and fast.take(0.01 * k, "x")[0]
    assert slow.newest + 3.9 * 0.45 < slow.limit < slow.newest + LARGEST_STEP_AHEAD
    assert fast.limit == fast.newest + STEP_AHEAD and UNCONTRADICTED < CONTRADICTED < 1.0


def test_the_time_of_useless_items_is_noted():
    gate = StampGate()
    gate.take(1.0, "x")
    for t, newest in ((float("nan"), 1.0), (1.5, 1.5), (1.2, 1.5), (500.0, 1.5), (-500.0, 1.5)):
        gate.pass_time(t)
        assert gate.newest == newest


@given(st.lists(st.floats(-1e6, 1e6) | st.floats(0.0, 3.0)))
def test_nothing_is_lost_or_told_twice(stamps):
    accepted, outliers, _ = through(stamps)
    assert sorted(place for _, place in accepted + outliers) == list(range(len(stamps)))


# --- pose queue ---


def test_after_a_gap_what_counts_is_the_item_before_it():
    hold = PoseQueue(limit=10.0)
    hold.add(1.0, "a")
    hold.add(5.0, "b")
    assert hold.take(lambda preceding: preceding < 2.0) == [(1.0, "a", True), (5.0, "b", True)]
    hold.add(5.1, "c")  # b has left, and still counts
    assert hold.take(lambda preceding: preceding < 5.0) == []


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), max_size=40))
def test_every_item_leaves_once_in_order_and_not_before_its_time(steps):
    hold, out, before = PoseQueue(limit=0.2), [], []
    for number, (t, progress) in enumerate(steps):
        hold.add(t, number)
        newest = max([t, *before])
        before.append(t)
        for stamp, item, ready in hold.take(lambda preceding: preceding <= progress):
            assert ready == (min(stamp, max(before[:item], default=stamp)) <= progress)
            assert ready or newest - stamp > 0.2
            out.append(item)
        assert out == list(range(len(out)))
        assert len(hold) + len(out) == number + 1


def test_leaves_unready_when_a_newer_one_is_too_far_ahead():
    hold = PoseQueue(limit=0.25)
    hold.add(1.0, "a")
    hold.add(1.25, "b")
    assert hold.take(lambda t: False) == []
    hold.add(1.375, "c")
    assert hold.take(lambda t: False) == [(1.0, "a", False)]
