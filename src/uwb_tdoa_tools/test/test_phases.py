from hand_made import flown, truth_of
import numpy as np
import pytest

from uwb_tdoa_tools.scoring.phases import TITLES, in_the_air, motion, phases


def test_phases_of_a_flight_are_those_of_the_data_and_leave_nothing_out():
    truth = flown()  # z > 0.1 m at 5.07 s, > 0.3 m at 5.27 s; 16.73 s and 16.93 s coming down
    found = phases(truth)
    expected = {
        "at_rest_earlier": (0.0, 3.07),
        "at_rest_before": (3.07, 5.07),
        "first_3_s": (5.07, 8.07),
        "to_0.3_m": (5.07, 5.27),
        "in_the_air": (5.27, 16.73),
        "last_3_s": (13.93, 16.93),
        "at_rest_after": (16.93, 21.0),
        "whole": (0.0, 21.0),
    }
    assert list(found) == list(expected)
    for name, span in expected.items():
        assert found[name] == pytest.approx(span, abs=0.025), name
    assert in_the_air(truth) == found["in_the_air"]


@pytest.mark.parametrize("floor", [-1.5, 0.0, 0.085])
def test_a_floor_that_is_not_at_zero_gives_the_same_departure(floor):
    """A vehicle at 0.085 m is not at lift-off because it is 1.5 cm above its floor."""
    truth = flown(floor)
    if floor < -1.0:
        truth.p[:, 2] += np.where(truth.p[:, 2] > -0.6, 1.0, 0.0)  # or it would never exceed 0.3 m
    assert motion(truth) == pytest.approx((5.07, 16.93), abs=0.025)


def test_a_short_rest_before_the_departure_is_told_as_it_is():
    found = phases(flown(rest=0.6))
    assert (
        found["at_rest_before"] == pytest.approx((0.0, 0.67), abs=0.025)
        and "at_rest_earlier" not in found
    )


def test_a_rover_departs_when_it_leaves_its_place_and_is_told_as_moving():
    truth = truth_of((0, 0, 0, 0.1), (4, 0, 0, 0.1), (14, 5, 0, 0.1), (20, 5, 0, 0.1))
    found = phases(truth)
    assert found["moving"] == pytest.approx((4.2, 13.8), abs=0.025) and "in_the_air" not in found
    assert (
        found["at_rest_before"] == pytest.approx((2.2, 4.2), abs=0.025)
        and found["at_rest_after"][1] == 20.0
    )
    assert (
        found["first_3_s"][0] == found["moving"][0] and found["last_3_s"][1] == found["moving"][1]
    )


def test_a_flight_that_begins_and_ends_in_the_air_has_no_rest():
    found = phases(truth_of((100, 0, 0, 1), (110, 8, 0, 1.5)))
    assert found["in_the_air"] == found["whole"] == pytest.approx((100.0, 110.0))
    assert found["first_3_s"] == pytest.approx((100.0, 103.0)) and found[
        "last_3_s"
    ] == pytest.approx((107.0, 110.0))
    assert set(found) == {"in_the_air", "whole", "first_3_s", "last_3_s"}


def test_a_start_on_a_table_is_a_rest_in_the_air():
    found = phases(
        truth_of(
            (0, 0, 0, 0.75),
            (6, 0, 0, 0.75),
            (7, 0, 0, 1.75),
            (17, 4, 0, 1.75),
            (18, 4, 0, 0.0),
            (20, 4, 0, 0.0),
        )
    )
    assert (
        found["at_rest_before"] == pytest.approx((4.1, 6.1), abs=0.025)
        and found["in_the_air"][0] == 0.0
    )
    assert found["at_rest_after"] == pytest.approx(
        (17.96, 20.0), abs=0.025
    )  # 0.07 m above the floor


def test_a_person_who_walks_leaves_by_distance():
    found = phases(truth_of((0, 0, 0, 1.2), (5, 0, 0, 1.2), (15, 10, 0, 1.2), (19, 10, 0, 1.2)))
    assert found["first_3_s"] == pytest.approx((5.1, 8.1), abs=0.025) and found["at_rest_after"][
        0
    ] == pytest.approx(14.9, abs=0.025)


@pytest.mark.parametrize("height", [0.0, 1.0])
def test_a_tag_that_never_moves_is_at_rest_all_the_time(height):
    found = phases(truth_of((0, 1, 2, height), (30, 1, 2, height)))
    assert found["at_rest_before"] == (0.0, 30.0) == found["whole"] and "first_3_s" not in found


def test_a_take_off_of_more_than_three_seconds_leaves_nothing_out():
    truth = truth_of(
        (0, 0, 0, 0),
        (5, 0, 0, 0),
        (6, 0, 0, 0.2),
        (16, 0, 0, 0.2),
        (17, 0, 0, 1),
        (27, 0, 0, 1),
        (28, 0, 0, 0),
        (30, 0, 0, 0),
    )
    found = phases(truth)
    assert (
        found["moving"] == motion(truth)
        and found["moving"][0] < found["first_3_s"][1] < found["in_the_air"][0]
    )


def covers(found):
    """Whether the phases but the whole leave nothing of it out."""
    begin, end = found["whole"]
    for first, last in sorted(span for name, span in found.items() if name != "whole"):
        if first > begin + 1e-9:
            return False
        begin = max(begin, last)
    return begin >= end - 1e-9


def test_random_paths_have_phases_that_leave_nothing_out():
    """Down to single poses; whatever the truth does, there is no traceback and no part of it that
    no phase holds.
    """
    rng = np.random.default_rng(0)
    for _ in range(300):
        count = int(rng.integers(1, 12))
        stamps = np.cumsum(rng.exponential(rng.choice([0.1, 2.0]), count))
        heights = np.where(
            rng.random(count) < 0.5, rng.uniform(-0.2, 0.4), rng.uniform(-0.5, 2.0, count)
        )
        sizes = rng.choice([0.0, 0.05, 3.0])
        truth = truth_of(
            *np.column_stack([stamps, *rng.normal(0.0, sizes, (2, count)), heights]),
            rate=rng.choice([2.0, 100.0]),
        )
        found = phases(truth)
        assert set(found) <= set(TITLES)
        if len(truth.t) > 1:
            assert covers(found), found
        else:
            assert not found
