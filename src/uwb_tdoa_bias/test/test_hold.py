from hypothesis import given
from hypothesis import strategies as st
from uwb_tdoa_bias.hold import Hold


def test_leaves_when_ready_in_order_of_arrival():
    hold = Hold(limit=1.0)
    for t, item in ((0.3, "a"), (0.1, "b"), (0.4, "c")):
        hold.add(t, item)
    assert hold.take(lambda t: t < 0.2) == []  # b is ready but waits behind a
    assert hold.take(lambda t: t < 0.35) == [(0.3, "a", True), (0.1, "b", True)]
    assert len(hold) == 1


def test_leaves_unready_when_a_newer_one_is_too_far_ahead():
    hold = Hold(limit=0.25)
    hold.add(1.0, "a")
    hold.add(1.25, "b")
    assert hold.take(lambda t: False) == []
    hold.add(1.375, "c")
    assert hold.take(lambda t: False) == [(1.0, "a", False)]


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), max_size=40))
def test_every_item_leaves_once_in_order_and_not_before_its_time(steps):
    hold, out, newest = Hold(limit=0.2), [], 0.0
    for number, (t, progress) in enumerate(steps):
        hold.add(t, number)
        newest = max(newest, t)
        for stamp, item, ready in hold.take(lambda stamp: stamp <= progress):
            assert ready == (stamp <= progress)
            assert ready or newest - stamp > 0.2
            out.append(item)
        assert out == list(range(len(out)))
        assert len(hold) + len(out) == number + 1
