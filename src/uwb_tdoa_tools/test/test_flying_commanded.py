import math

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.flying.mission import SETTLE, SINK
from uwb_tdoa_tools.flying.pilot import MAX_SPEED, CommandedPath

SIZE = (6.0, 6.0, 3.0)


@pytest.fixture
def up():
    """One that takes off at (1, -1, 0.03) with a yaw of 3 rad, to 1.2 m within 2.5 s."""
    made = CommandedPath(np.array([1.0, -1.0, 0.03]), 3.0, SIZE)
    made.take_off(1.2, 2.5)
    return made


def test_it_goes_up_and_stays(up):
    start, halfway, there, later = up.at(np.array([0.0, 1.25, 2.5, 60.0]))
    np.testing.assert_allclose(start, [[1.0, -1.0, 0.03], [0.0] * 3, [0.0] * 3], atol=1e-12)
    assert halfway[0, 2] == pytest.approx(0.615) and halfway[1, 2] == pytest.approx(
        15 / 8 * 1.17 / 2.5
    )
    for wanted in (there, later):
        np.testing.assert_allclose(wanted, [[1.0, -1.0, 1.2], [0.0] * 3, [0.0] * 3], atol=1e-9)
    assert up.duration == math.inf and up.yaw_offset(60.0) == pytest.approx(0.0)


def test_each_command_goes_on_from_where_the_last_one_has_it(up):
    before = up.at(np.array([1.3]))
    up.go_to(1.3, False, (0.0, 0.0, 1.5), -3.0, 3.0)
    np.testing.assert_allclose(up.at(np.array([1.3])), before, atol=1e-9)
    np.testing.assert_allclose(up.at(np.array([4.3]))[0, 0], [0.0, 0.0, 1.5], atol=1e-9)
    assert up.yaw_offset(4.3) == pytest.approx(2.0 * math.pi - 6.0)  # the shorter way around
    up.go_to(5.0, True, (0.5, 0.0, 0.0), 0.1, 2.0)
    np.testing.assert_allclose(up.at(np.array([7.0]))[0, 0], [0.5, 0.0, 1.5], atol=1e-9)
    assert up.yaw_offset(7.0) == pytest.approx(2.0 * math.pi - 5.9)
    np.testing.assert_allclose(
        up.at(np.array([1.25]))[0, 0, 2], 0.615
    )  # the past stays what it was


def test_it_comes_down_and_sinks_to_wherever_the_ground_is(up):
    up.land(4.0, 0.1, 2.0)
    assert up.duration == 6.0
    np.testing.assert_allclose(up.at(np.array([6.0]))[0, 0], [1.0, -1.0, 0.1 + SETTLE], atol=1e-9)
    sinking = up.at(np.array([6.5]))[0]
    assert np.isnan(sinking[0, 2]) and sinking[1, 2] == -SINK
    np.testing.assert_allclose(up.end, [1.0, -1.0])
    with pytest.raises(InputError, match="it lands already"):
        up.go_to(5.0, False, (0.0, 0.0, 1.0), 0.0, 5.0)


@pytest.mark.parametrize(
    "goal, seconds, why",
    [
        ((0.0, math.nan, 1.0), 5.0, "goal: .* not finite"),
        ((4.0, 0.0, 1.0), 5.0, r"goal: \(4.00, 0.00, 1.00\) m is outside the hall, 6 x 6 x 3 m"),
        ((0.0, 0.0, 1.0), 0.0, "duration: 0 s must be above 0"),
        ((1.0, -1.0, 2.2), 0.5, "duration: 0.5 s is too short for 1.00 m; give at least 2.2 s"),
    ],
)
def test_what_it_cannot_do_is_refused_and_changes_nothing(up, goal, seconds, why):
    with pytest.raises(InputError, match=why):
        up.go_to(3.0, False, goal, 3.0, seconds)
    np.testing.assert_allclose(up.at(np.array([9.0]))[0, 0], [1.0, -1.0, 1.2], atol=1e-9)


@pytest.mark.parametrize("height", [math.nan, -0.1, 2.0])
def test_it_lands_on_no_such_height(up, height):
    with pytest.raises(InputError, match="height: .* must be from 0 to 1 m"):
        up.land(4.0, height, 2.0)
    assert up.duration == math.inf


def test_what_is_allowed_is_never_faster_than_it_says(up):
    up.go_to(3.0, False, (-2.0, 2.0, 1.2), 3.0, 5.4)
    speed = np.linalg.norm(up.at(np.arange(3.0, 8.4, 0.01))[:, 1], axis=1)
    assert 0.9 * MAX_SPEED < speed.max() <= MAX_SPEED
