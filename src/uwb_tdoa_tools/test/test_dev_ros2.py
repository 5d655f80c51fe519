# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev ros2` without ROS, in this process, against a live node."""

import re
import runpy
from threading import Thread

from documented import ROOT
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402

from uwb_tdoa_bias.common.errors import Failure  # noqa: E402
from uwb_tdoa_bias.ros.node import Parameter, declare_all  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa  # noqa: E402

SCRIPT = runpy.run_path(str(ROOT / ".dev" / "ros2.py"))
COMMANDS = {  # words: expected output as a regular expression
    "topic list -t": r"/tag1/uwb/tdoa \[uwb_tdoa_msgs/msg/Tdoa\]\n",
    "topic info -v /tag1/uwb/tdoa": (
        r"Type: uwb_tdoa_msgs/msg/Tdoa\nPublisher count: 1\n  /tag1/driver \[.*\]: "
        r"best_effort, volatile\nSubscription count: "
    ),
    "topic echo /tag1/uwb/tdoa --once": (
        r"frame_id: base_link[^$]*anchor_a: 3\n[^$]*distance_difference: 0.25\n[^$]*---\n"
    ),
    "topic hz /tag1/uwb/tdoa": r"average rate: [\d.]+  min: ",
    "node list": r"(?m)^/tag1/driver$",
    "param list": r"/tag1/driver:\n(  .*\n)*  gain\n",
    "param set tag1/driver gain 0.75": r"^Set parameter successful\n$",
    "param get tag1/driver gain": r"^0.75\n$",
    "param describe /tag1/driver limit": r"^limit: m; what is too far\n  from 0 to 9\n  read only\n$",
}
FAILURES = {
    "param set tag1/driver limit 2.0": "limit: not set: ",
    "param get /tag1/driver gian": "/tag1/driver has no parameter gian",
}


@pytest.fixture
def ask():
    """Return a function that runs words beside a node that publishes TDOAs, best effort."""
    rclpy.init()
    driver = rclpy.create_node("driver", namespace="tag1")
    parameters = {
        "gain": Parameter(0.5, "of nothing", 0.0, 1.0, settable=True),
        "limit": Parameter(3.0, "m; what is too far", 0.0, 9.0),
    }
    declare_all(driver, parameters)
    poor = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = driver.create_publisher(Tdoa, "uwb/tdoa", poor)
    message = Tdoa(anchor_a=3, distance_difference=0.25)
    message.header.frame_id = "base_link"
    driver.create_timer(0.02, lambda: publisher.publish(message))
    executor = SingleThreadedExecutor()
    executor.add_node(driver)
    spinning = Thread(target=executor.spin)
    spinning.start()
    asking, stop = rclpy.create_node("asking"), []

    def one(words):
        args = SCRIPT["parser"]().parse_args(words.split())
        if args.verb == "hz":
            asking.create_timer(3.0, lambda: stop.append("the rate is printed each second"))
        args.run(asking, stop, args)

    yield one
    executor.shutdown()
    spinning.join()
    for node in (driver, asking):
        node.destroy_node()
    rclpy.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("words", COMMANDS)
def test_commands(ask, capsys, words):
    if words.startswith("param get"):
        ask("param set tag1/driver gain 0.75")
    capsys.readouterr()
    ask(words)
    assert re.search(COMMANDS[words], capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("words", FAILURES)
def test_failures(ask, words):
    with pytest.raises(Failure, match=FAILURES[words]):
        ask(words)


def test_a_terminal_obeys_nothing_that_others_have_written(capsys):
    """`param get` of a text with escape sequences wrote to the clipboard."""
    SCRIPT["show"]("x\x1b]52;c;ZXZpbA==\x07\u202e\nforged")
    said = capsys.readouterr().out
    assert r"\x1b]52" in said and r"\nforged" in said and said.strip().isprintable()


def test_its_examples_are_command_lines():
    parser = SCRIPT["parser"]()
    for example in parser.epilog.splitlines()[1:]:
        parser.parse_args(example.split()[2:])
