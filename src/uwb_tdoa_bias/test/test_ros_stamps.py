import math

from hypothesis import given
from hypothesis import strategies as st
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time  # noqa: E402
from geometry_msgs.msg import Quaternion  # noqa: E402

from uwb_tdoa_bias.foundation.ros_stamps import Epoch, orientation_of  # noqa: E402

NANOSECONDS = st.integers(0, 10**9 - 1)
MONTH = 30 * 86400


@given(
    st.integers(0, 2**31 - 1 - 2 * MONTH),
    st.lists(st.tuples(st.integers(-MONTH, MONTH), NANOSECONDS), min_size=1),
)
def test_stamps_survive_to_the_nanosecond(first, others):
    epoch = Epoch()
    epoch.seconds(Time(sec=first, nanosec=999_999_999))
    for second, nanosecond in others:
        if first + second >= 0:
            stamp = Time(sec=first + second, nanosec=nanosecond)
            assert epoch.stamp(epoch.seconds(stamp)) == stamp


@given(st.integers(0, 2**31 - 10), st.lists(st.tuples(st.integers(0, 9), NANOSECONDS), min_size=2))
def test_seconds_do_not_depend_on_the_epoch(first, stamps):
    now, long_ago = Epoch(), Epoch()
    a = [now.seconds(Time(sec=first + second, nanosec=nanosecond)) for second, nanosecond in stamps]
    b = [long_ago.seconds(Time(sec=second, nanosec=nanosecond)) for second, nanosecond in stamps]
    assert a == b


def test_an_orientation_of_zeros_is_not_known():
    assert orientation_of(Quaternion(x=0.1, y=0.2, z=0.3, w=0.4)) == (0.1, 0.2, 0.3, 0.4)
    assert orientation_of(Quaternion()) == (
        0.0,
        0.0,
        0.0,
        1.0,
    )  # the default of ROS is the identity
    assert all(map(math.isnan, orientation_of(Quaternion(w=0.0))))
