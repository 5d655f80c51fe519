"""Which stamps are believed, and when."""

from hypothesis import given
from hypothesis import strategies as st

from uwb_tdoa_bias.foundation.stamps import AHEAD, BACK, StampWatch


def through(stamps):
    """(believed, strays, places at which the stream fell back) of stamps fed one after the other."""
    watch, believed, strays, back = StampWatch(), [], [], []
    for place, t in enumerate(stamps):
        good, bad, fell_back = watch.take(t, place)
        believed += good
        strays += bad
        back += [place] * fell_back
    return believed, strays + watch.finish(), back


def test_a_stream_that_goes_on_is_believed_at_once():
    watch = StampWatch()
    for t in (5.0, 5.1, 5.05, 5.1 - BACK, 5.1 + AHEAD):
        assert watch.take(t, "x") == ([(t, "x")], [], False) and len(watch) == 0


def test_one_wrong_stamp_is_a_stray():
    for wrong in (-100.0, 100.0):
        assert through([0.0, 0.1, wrong, 0.2]) == ([(0.0, 0), (0.1, 1), (0.2, 3)], [(wrong, 2)], [])


def test_two_that_agree_are_another_time():
    assert through([50.0, 1.0, 1.1, 1.2]) == ([(50.0, 0), (1.0, 1), (1.1, 2), (1.2, 3)], [], [2])
    assert through([0.0, 60.0, 60.1]) == ([(0.0, 0), (60.0, 1), (60.1, 2)], [], [])


def test_the_time_of_useless_items_is_seen():
    watch = StampWatch()
    watch.take(1.0, "x")
    for t, newest in ((float("nan"), 1.0), (1.5, 1.5), (1.2, 1.5), (500.0, 1.5), (-500.0, 1.5)):
        watch.see(t)
        assert watch.newest == newest


@given(st.lists(st.floats(-1e6, 1e6) | st.floats(0.0, 3.0)))
def test_nothing_is_lost_or_told_twice(stamps):
    believed, strays, _ = through(stamps)
    assert sorted(place for _, place in believed + strays) == list(range(len(stamps)))
