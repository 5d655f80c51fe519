import math

from hypothesis import given
from hypothesis import strategies as st

from uwb_tdoa_ekf.order import TRIAL, Order


def late(stamps):
    """Whether each of them is late, and the Order after them."""
    order, newest, out = Order(), -math.inf, []
    for t in stamps:
        out.append(order.is_late(t, newest))
        newest = max(newest, t)
    return out, order.trusted(newest)


def test_a_stream_is_trusted_when_it_has_been_in_order_for_a_while():
    assert not Order().trusted(-math.inf)
    assert late([5.0, 5.0, 5.0 + 0.9 * TRIAL]) == ([False] * 3, False)
    assert late([5.0, 5.0, 5.0 + TRIAL]) == ([False] * 3, True)


def test_one_that_is_out_of_order_from_the_beginning_is_never_trusted_and_nothing_is_late():
    stamps = [0.002 * k + 0.003 * (k % 2) for k in range(2000)]
    assert late(stamps) == ([False] * 2000, False)


def test_the_first_that_breaks_a_trusted_order_is_late_and_what_is_older_than_what_had_come():
    end = 2.0 * TRIAL
    stamps = [0.0, end, end - 0.001, end + 0.002, end + 0.001, end - 0.002, end]
    assert late(stamps) == ([False, False, True, False, False, True, False], False)


@given(st.lists(st.floats(0.0, 3.0 * TRIAL), max_size=30))
def test_nothing_is_late_in_order(stamps):
    assert not any(late(sorted(stamps))[0])
