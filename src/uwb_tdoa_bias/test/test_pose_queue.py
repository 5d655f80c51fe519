from hypothesis import given
from hypothesis import strategies as st

from uwb_tdoa_bias.correction.poses import PoseQueue


def test_after_a_gap_what_counts_is_the_item_before_it():
    hold = PoseQueue(limit=10.0)
    hold.add(1.0, "a")
    hold.add(5.0, "b")
    assert hold.take(lambda before: before < 2.0) == [(1.0, "a", True), (5.0, "b", True)]
    hold.add(5.1, "c")  # b has left, and still counts
    assert hold.take(lambda before: before < 5.0) == []


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), max_size=40))
def test_every_item_leaves_once_in_order_and_not_before_its_time(steps):
    hold, out, before = PoseQueue(limit=0.2), [], []
    for number, (t, progress) in enumerate(steps):
        hold.add(t, number)
        newest = max([t, *before])
        before.append(t)
        for stamp, item, ready in hold.take(lambda before: before <= progress):
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
