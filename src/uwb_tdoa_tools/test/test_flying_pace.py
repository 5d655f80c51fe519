"""When the next turn may come, by a clock of the test."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwb_tdoa_tools.flying.over_topics import (
    IMPATIENCE,
    LARGEST_CATCH_UP,
    PATIENCE,
    Lockstep,
    RealTime,
)
from uwb_tdoa_tools.flying.simulator import SensorReadings

TURN = 0.01


@pytest.fixture
def clock():
    made = SimpleNamespace(t=100.0)
    made.now = lambda: made.t
    return made


def stream(*t):
    return SimpleNamespace(t=np.array(t), __len__=None)


def measured(now, tdoa=True):
    return SensorReadings(
        stream(now - 0.005, now), stream(*([now - 0.004, now - 0.001] if tdoa else [])), {}
    )


@pytest.fixture
def running(clock):
    """A Lockstep in step with a filter of 200 Hz, at 5 s."""
    made = Lockstep(clock.now)
    for k in range(1, 501):
        made.sent(TURN * k, measured(TURN * k))
        for stamp in (TURN * k - 0.01, TURN * k - 0.005):
            made.heard(stamp)
        assert made.may_go_on()
    return made


def test_it_waits_for_the_odometry_that_is_due(running, clock):
    running.sent(5.01, measured(5.01))
    assert not running.may_go_on()
    running.heard(5.0)
    assert not running.may_go_on()  # 5.005 is before the newest TDOA, 5.009
    clock.t += 0.9 * PATIENCE
    assert not running.may_go_on()
    running.heard(5.005)
    assert running.may_go_on()


def test_one_that_does_not_come_is_not_waited_for_any_longer(running, clock):
    running.sent(5.01, measured(5.01))
    clock.t += PATIENCE
    assert running.may_go_on()
    running.sent(5.02, measured(5.02))
    assert not running.may_go_on()
    clock.t += IMPATIENCE
    assert running.may_go_on()
    running.sent(5.03, measured(5.03))
    running.heard(5.025)
    assert running.may_go_on()
    running.sent(5.04, measured(5.04))
    clock.t += 2.0 * IMPATIENCE
    assert not running.may_go_on()  # it is waited for again


def test_in_a_silence_nothing_is_due_until_the_filter_goes_on_without(running):
    for k in range(501, 530):
        running.sent(TURN * k, measured(TURN * k, tdoa=False))
        assert running.may_go_on()
    running.sent(5.4, measured(5.4, tdoa=False))
    assert not running.may_go_on()
    running.heard(5.1)
    assert running.may_go_on()


def test_before_the_filter_starts_turns_are_slow(clock):
    pace = Lockstep(clock.now)
    assert pace.may_go_on()
    pace.sent(TURN, measured(TURN))
    assert not pace.may_go_on()
    clock.t += IMPATIENCE
    assert pace.may_go_on()


def test_in_real_time_each_turn_has_its_time_and_a_delay_shifts_the_others(clock):
    pace = RealTime(clock.now)
    assert pace.may_go_on()
    pace.sent(TURN, measured(TURN))
    assert not pace.may_go_on()
    clock.t += 1.01 * TURN
    assert pace.may_go_on()
    clock.t += 10.0
    turns = 0
    while pace.may_go_on():
        turns += 1
        pace.sent(TURN * (turns + 1), measured(TURN))
    assert turns == pytest.approx(LARGEST_CATCH_UP / TURN, abs=1.5)
