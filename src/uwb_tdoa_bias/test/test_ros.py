import math

from hypothesis import given
from hypothesis import strategies as st
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import Quaternion  # noqa: E402
from rclpy.qos import QoSCompatibility, QoSPresetProfiles, QoSProfile, qos_check_compatible  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from uwb_tdoa_bias.foundation import ros  # noqa: E402

NANOSECONDS = st.integers(0, 10**9 - 1)
MONTH = 30 * 86400


@given(st.integers(0, 2**31 - 1 - 2 * MONTH), st.lists(st.tuples(st.integers(-MONTH, MONTH), NANOSECONDS), min_size=1))
def test_stamps_survive_to_the_nanosecond(first, others):
    epoch = ros.Epoch()
    epoch.seconds(ros.Time(sec=first, nanosec=999_999_999))
    for second, nanosecond in others:
        if first + second >= 0:
            stamp = ros.Time(sec=first + second, nanosec=nanosecond)
            assert epoch.stamp(epoch.seconds(stamp)) == stamp


@given(st.integers(0, 2**31 - 10), st.lists(st.tuples(st.integers(0, 9), NANOSECONDS), min_size=2))
def test_seconds_do_not_depend_on_the_epoch(first, stamps):
    now, long_ago = ros.Epoch(), ros.Epoch()
    a = [now.seconds(ros.Time(sec=first + second, nanosec=nanosecond)) for second, nanosecond in stamps]
    b = [long_ago.seconds(ros.Time(sec=second, nanosec=nanosecond)) for second, nanosecond in stamps]
    assert a == b


def test_an_orientation_of_zeros_is_not_known():
    assert ros.orientation_of(Quaternion(x=0.1, y=0.2, z=0.3, w=0.4)) == (0.1, 0.2, 0.3, 0.4)
    assert ros.orientation_of(Quaternion()) == (0.0, 0.0, 0.0, 1.0)  # the default of ROS is the identity
    assert all(map(math.isnan, ros.orientation_of(Quaternion(w=0.0))))


def test_stream_subscriptions_match_every_usual_publisher():
    usual = [QoSPresetProfiles.SENSOR_DATA.value, QoSPresetProfiles.SYSTEM_DEFAULT.value, QoSProfile(depth=10)]
    for publisher in [*usual, ros.STREAM_QOS]:
        assert qos_check_compatible(publisher, ros.STREAM_QOS)[0] != QoSCompatibility.ERROR
    assert ros.STREAM_QOS.reliability == ros.ReliabilityPolicy.BEST_EFFORT


def test_every_usual_subscriber_matches_what_is_published():
    usual = [QoSPresetProfiles.SENSOR_DATA.value, QoSPresetProfiles.SYSTEM_DEFAULT.value, QoSProfile(depth=10)]
    for subscriber in [*usual, ros.STREAM_QOS]:
        assert qos_check_compatible(ros.OUTPUT_QOS, subscriber)[0] != QoSCompatibility.ERROR
    assert ros.OUTPUT_QOS.reliability == ros.ReliabilityPolicy.RELIABLE


def test_simulated_time_that_stands_still_or_is_missing_is_said():
    rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true"])
    node, other = rclpy.create_node("on_simulated_time"), rclpy.create_node("player", use_global_arguments=False)
    try:
        wall = [0.0]
        clock, source = ros.SimulatedClock(node, lambda: wall[0]), other.create_publisher(Clock, "/clock", 10)
        level, text = clock.status()
        assert level == DiagnosticStatus.WARN and "nobody publishes /clock" in text
        paused = DiagnosticStatus.OK, "paused: /clock stands still"
        for wall[0], second, expected in (
            (0.0, 5, None), (0.2, 6, None), (0.6, 6, None), (0.8, 6, paused), (9.0, 6, paused), (9.2, 7, None), (9.4, 7, None),
            (10.2, 8, None), (11.2, 9, None), (12.2, 9, None), (13.0, 9, None), (13.3, 9, paused),  # once a second: runs, too
        ):  # fmt: skip
            for _ in range(200):
                source.publish(Clock(clock=ros.Time(sec=second)))
                rclpy.spin_once(node, timeout_sec=0.05)
                if node.get_clock().now().nanoseconds == second * 10**9:
                    break
            assert clock.status() == expected, wall
    finally:
        for each in (node, other):
            each.destroy_node()
        rclpy.shutdown()


def test_the_log_says_each_kind_of_thing_once_in_a_while():
    """38 warnings in 38 s, because a percentage changed."""
    saying = ros.Saying()
    lines = [
        saying.anew(f"{40 + second} % of the TDOAs of anchor 3 are late by {0.1 * second:.2f} s", 1.0 * second) for second in range(38)
    ]
    assert lines == [True] + 37 * [False]
    assert saying.anew("40 % of the TDOAs of anchor 4 are late by 0.10 s", 38.0)  # another anchor is another thing
    flips = [saying.anew(("running", "anchors 1 and 2 are exchanged")[second % 2], 40.0 + second) for second in range(20)]
    assert flips == [True, True] + 18 * [False]
    assert saying.anew("running", 75.0)  # what stays is said in the end
    assert not saying.anew("running", 200.0)
