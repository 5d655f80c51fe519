"""Which stamps are accepted, and when."""

from hypothesis import given
from hypothesis import strategies as st

from uwb_tdoa_bias.foundation.stamps import LARGEST_STEP_AHEAD, LARGEST_STEP_BACK, StampGate


def through(stamps):
    """(accepted, outliers, places at which the stream jumped back) of stamps fed one after the other."""
    gate, accepted, outliers, back = StampGate(), [], [], []
    for place, t in enumerate(stamps):
        good, bad, jumped_back = gate.take(t, place)
        accepted += good
        outliers += bad
        back += [place] * jumped_back
    return accepted, outliers + gate.finish(), back


def test_a_stream_that_goes_on_is_accepted_at_once():
    gate = StampGate()
    for t in (5.0, 5.1, 5.05, 5.1 - LARGEST_STEP_BACK, 5.1 + LARGEST_STEP_AHEAD):
        assert gate.take(t, "x") == ([(t, "x")], [], False) and len(gate) == 0


def test_one_wrong_stamp_is_an_outlier():
    for wrong in (-100.0, 100.0):
        assert through([0.0, 0.1, wrong, 0.2]) == ([(0.0, 0), (0.1, 1), (0.2, 3)], [(wrong, 2)], [])


def test_two_that_agree_are_another_time():
    assert through([50.0, 1.0, 1.1, 1.2]) == ([(50.0, 0), (1.0, 1), (1.1, 2), (1.2, 3)], [], [2])
    assert through([0.0, 60.0, 60.1]) == ([(0.0, 0), (60.0, 1), (60.1, 2)], [], [])


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
