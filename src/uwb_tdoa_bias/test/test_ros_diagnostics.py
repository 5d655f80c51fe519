import time

import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time  # noqa: E402
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402

from uwb_tdoa_bias.foundation.ros_diagnostics import Saying, SimulatedClock  # noqa: E402


def test_simulated_time_that_stands_still_or_is_missing_is_said():
    rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true"])
    node, other = (
        rclpy.create_node("on_simulated_time"),
        rclpy.create_node("player", use_global_arguments=False),
    )
    try:
        wall = [0.0]
        clock, source = (
            SimulatedClock(node, lambda: wall[0]),
            other.create_publisher(Clock, "/clock", 10),
        )
        level, text = clock.status()
        assert level == DiagnosticStatus.WARN and "nobody publishes /clock" in text
        paused = DiagnosticStatus.OK, "paused: /clock stands still"
        for wall[0], second, expected in (
            (0.0, 5, None),
            (0.2, 6, None),
            (0.6, 6, None),
            (0.8, 6, paused),
            (9.0, 6, paused),
            (9.2, 7, None),
            (9.4, 7, None),
            (10.2, 8, None),
            (11.2, 9, None),
            (12.2, 9, None),
            (13.0, 9, None),
            (13.3, 9, paused),  # once a second: runs, too
        ):
            for _ in range(200):
                source.publish(Clock(clock=Time(sec=second)))
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
    saying = Saying()
    lines = [
        saying.anew(
            f"{40 + second} % of the TDOAs of anchor 3 are late by {0.1 * second:.2f} s",
            1.0 * second,
        )
        for second in range(38)
    ]
    assert lines == [True] + 37 * [False]
    assert saying.anew(
        "40 % of the TDOAs of anchor 4 are late by 0.10 s", 38.0
    )  # another anchor is another thing
    flips = [
        saying.anew(("running", "anchors 1 and 2 are exchanged")[second % 2], 40.0 + second)
        for second in range(20)
    ]
    assert flips == [True, True] + 18 * [False]
    assert saying.anew("running", 75.0)  # what stays is said in the end
    assert not saying.anew("running", 200.0)


@pytest.mark.parametrize(
    "text",
    [
        "9" * 20_000,
        "9" * 20_000 + " m",
        "1.5 " * 5_000,
        "- " * 10_000,
        "9" + " " * 20_000,
        "9 " + "9" * 20_000 + "x",
    ],
)
def test_long_numbers_take_no_time(text):
    """A pattern that tried again at each of 20 000 digits took 8 s."""
    began = time.process_time()
    Saying().anew(text, 0.0)
    assert time.process_time() - began < 0.2
