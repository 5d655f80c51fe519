# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tags in halls with many anchors, tags that hear few TDOAs, and anchors in a plane.

`./dev study warehouse` gives the figures of many seeds.
"""

from halls import HALLS, fly, hall, room
import numpy as np
import pytest
from warehouse_judge import after_gaps, cost, heard_at_start, judge

from uwb_tdoa_ekf.core import workspace
from uwb_tdoa_ekf.core.config import SIDES, FilterConfig
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.estimator import Estimator

WITHOUT_IMU = FilterConfig(use_imu=False)
SLOW = {"duration": 12.0, "speed": 1.0}
LED_AWAY = 0.65  # m; 0.58 with Geman and McClure's loss, 0.72 with Huber's
PAIRS = 6  # largest number of pairs of runs to compare by processor time


def surroundings(positions, a, b, reach=30.0, tag_side="unknown"):
    """Return the bounds (2, 3), in m, after TDOAs of the anchors in rows a and b, and the state."""
    state, bounds = new_state(positions), np.empty((2, 3))
    window = structured(TDOA, 0.01 * np.arange(len(a)), a, b, np.zeros(len(a)))
    workspace.listen(state.record, window, state.anchors, reach, SIDES.index(tag_side))
    workspace.surround(state.record, 1.0, bounds)
    return bounds, state


def test_in_a_room_it_is_searched_in_the_whole_room_whoever_is_heard():
    positions, whole = room("corners").anchors.positions, np.empty((2, 3))
    workspace.set_bounds(new_state(positions).record.extent, 1.0, whole)
    np.testing.assert_array_equal(surroundings(positions, [0, 1], [1, 2])[0], whole)


def test_in_a_hall_it_is_searched_within_reach_of_all_that_are_heard():
    positions = np.array([[0.0, 0.0, 3.0], [10.0, 0.0, 1.0], [300.0, 0.0, 3.0], [0.0, 200.0, 5.0]])
    bounds, _ = surroundings(positions, [0], [1])
    np.testing.assert_allclose(bounds[:, :2], [[-1.0, -1.0], [30.0, 30.0]])
    # The anchors are farther apart than `reach`, so the reach is larger.
    bounds, _ = surroundings(positions, [0], [1], reach=5.0)
    np.testing.assert_allclose(bounds[:, 0], [10.0 - np.hypot(10.0, 2.0), np.hypot(10.0, 2.0)])


@pytest.mark.parametrize(
    ("name", "side", "axis", "sign"),
    [("ceiling, 4", "below", 2, -1), ("wall, 8", "+x", 0, 1), ("wall, 8", "-x", 0, -1)],
)
def test_a_side_that_is_told_bounds_the_search(name, side, axis, sign):
    positions = room(name).anchors.positions
    rows = np.arange(len(positions) - 1)
    bounds, state = surroundings(positions, rows, rows + 1, tag_side=side)
    assert (
        bounds[0 if sign > 0 else 1, axis] == pytest.approx(positions[0, axis])
        and not state.ekf["flat"][0][axis]
    )
    _, state = surroundings(positions, rows, rows + 1)
    assert state.ekf["flat"][0][axis]


@pytest.mark.parametrize("name", HALLS)
def test_a_tag_is_found_anywhere_in_a_hall(name):
    where = hall(name)
    for seed in range(3):
        flight = fly(where, seed, 4.0)
        found = judge(flight, FilterConfig())
        assert found["nees"] < 6.0
        assert found["at_2"] < 1.0 or heard_at_start(flight) < 8


@pytest.mark.parametrize("config", [FilterConfig(), WITHOUT_IMU])
@pytest.mark.parametrize("blinks", [0.5, 2.0])
def test_a_tag_that_blinks_starts_within_three_blinks(blinks, config):
    for seed in range(3):
        found = judge(fly(room("corners"), seed, blinks=blinks, **SLOW), config)
        assert found["stamps"] <= 3 and found["nees"] < 6.0


@pytest.mark.parametrize("config", [FilterConfig(), WITHOUT_IMU])
@pytest.mark.parametrize("rate", [2.0, 10.0])
def test_a_tag_of_few_tdoas_starts_within_twenty(rate, config):
    for seed in range(3):
        found = judge(fly(room("corners"), seed, rate=rate, duration=20.0, speed=1.0), config)
        assert found["spent"] < 20 and found["nees"] < 6.0


def test_outliers_do_not_lead_a_slow_tag_away():
    """A twentieth of the TDOAs is off by 2 m on average, with one blink a second and no IMU."""
    walks = [fly(room("corners"), seed, blinks=1.0, duration=40.0, speed=1.0) for seed in range(6)]
    found = [judge(walk, WITHOUT_IMU) for walk in walks]
    assert np.sqrt(np.mean([one["rmse"] ** 2 for one in found])) < LED_AWAY
    assert np.mean([one["nees"] for one in found]) < 3.0


@pytest.mark.parametrize(("name", "side"), [("ceiling, 8", "below"), ("wall, 8", "+x")])
def test_a_tag_stays_on_the_side_that_is_told(name, side):
    where = room(name)
    axis, sign = (2, -1.0) if side == "below" else (0, 1.0)
    for seed in range(3):
        found = judge(fly(where, seed, 10.0, speed=1.0), FilterConfig(tag_side=side))
        beyond = sign * (found["odometry"].x[:, axis] - where.anchors.positions[0, axis])
        assert (beyond > -0.3).all() and found["nees"] < 6.0


def test_an_estimator_names_the_parameter_where_the_side_is_not_known():
    flight = fly(room("ceiling, 4"), 0, 3.0, speed=1.0)
    for side, said in (("unknown", "set tag_side to below or above"), ("below", None)):
        estimator = Estimator(flight.anchors, FilterConfig(tag_side=side))
        estimator.add_imu(flight.imu.t, flight.imu.gyro, flight.imu.accel)
        estimator.add_tdoa(flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)
        estimator.finish()
        assert (said in estimator.side_unknown) if said else estimator.side_unknown is None


def test_after_a_silence_in_which_it_walked_a_tag_is_found_within_two_seconds():
    where = hall("100 x 60 m, 77 anchors")
    for seed in range(3):
        flight = fly(where, seed, 40.0, dead=[(15.0, 28.0)])
        found = judge(flight, WITHOUT_IMU)
        assert max(after_gaps(flight, found)) < 2.0 and found["nees"] < 6.0


def test_after_a_silence_no_tdoa_makes_a_wrong_place_certain():
    where = hall("100 x 60 m, 77 anchors")
    # The error once exceeded 5 deviations within 0.1 s for each seed.
    for seed in (3, 4, 15):
        flight = fly(where, seed, 17.0, dead=[(3.0, 16.3)])
        found = judge(flight, WITHOUT_IMU)
        assert (found["off"] / found["std"]).max() < 5.0, seed


def test_a_tag_that_walks_beyond_the_margin_is_found_after_a_silence():
    where = hall("100 x 60 m, 77 anchors")
    flight = fly(where, 18, 17.0, dead=[(3.0, 16.3)])
    over = (
        np.abs(flight.truth.p[-70:, :2] - 0.5 * np.array(where.size))
        - np.ptp(where.anchors.positions[:, :2], axis=0) / 2.0
    )
    # The path leaves the anchors, which bound the search, by more than 1 m.
    assert over.max() > 1.0
    found = judge(flight, WITHOUT_IMU)
    assert (found["off"][found["odometry"].t > 16.4] < 1.0).all()


def test_how_far_a_place_is_outside_and_one_that_is_no_number_is_nowhere():
    bounds = np.array([[0.0, 0.0, 0.0], [4.0, 4.0, 4.0]])
    for x, beyond in (
        ([2.0, 2.0, 3.0], -1.0),
        ([4.5, -0.2, 2.0], 0.5),
        ([2.0, -0.7, 5.0], 1.0),
        ([2.0, np.nan, 2.0], np.inf),
    ):
        assert workspace.distance_outside(bounds, np.array(x)) == pytest.approx(beyond)


@pytest.mark.slow
def test_ten_minutes_with_dead_zones_and_a_change_of_floor(config=WITHOUT_IMU):
    flight = fly(
        hall("100 x 60 m, 77 anchors", floors=2),
        0,
        600.0,
        dead=[(120.0, 133.3), (220.0, 233.3), (450.0, 463.3)],
        lift=300.0,
    )
    found = judge(flight, config)
    assert found["nees"] < 6.0 and max(after_gaps(flight, found)) < 2.0
    assert np.quantile(found["off"] / found["std"], 0.999) < 4.0


@pytest.mark.slow
def test_a_tag_costs_what_it_hears_and_not_what_is_installed():
    """The runs alternate until one pair is undisturbed.

    A cost that grows with the number of anchors, here up to 500 times larger, would show in every
    pair.
    """
    # The first run compiles all functions.
    cost(20, 5.0, 1)
    ratios = []
    while min(ratios, default=np.inf) >= 1.5 and len(ratios) < PAIRS:
        (few, low, _, one), (many, high, _, other) = (cost(n, 10.0, 1) for n in (20, 10_000))
        ratios.append(many / few)
    assert min(ratios) < 1.5, ratios
    # In bytes. An anchor takes at most 1000; there is no matrix over all pairs of anchors.
    assert high < low + 10_000 * 1000
    np.testing.assert_allclose(one.p, other.p, atol=0.05)


def test_a_side_of_anchors_that_are_in_no_plane_means_nothing():
    positions = room("corners").anchors.positions
    rows = np.arange(7)
    np.testing.assert_array_equal(
        surroundings(positions, rows, rows + 1, tag_side="below")[0],
        surroundings(positions, rows, rows + 1)[0],
    )
