# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev ros2` without ROS, as processes against a live node; commands of the documentation."""

import argparse
from pathlib import Path
import re
import runpy
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rcl_interfaces.msg import (
    FloatingPointRange,
    ParameterDescriptor,
    ParameterType,
    ParameterValue,
)  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402

from uwb_tdoa_bias.ros.parameters import Parameter, declare_all  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa, TdoaResidual  # noqa: E402
from uwb_tdoa_tools.bags.files import open_bag  # noqa: E402

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / ".dev" / "ros2.py"
COMMANDS = {  # words: (expected output as a regular expression, exit code)
    "topic list -t": (r"/tag1/uwb/tdoa \[uwb_tdoa_msgs/msg/Tdoa\]\n", 0),
    "topic info -v /tag1/uwb/tdoa": (
        (
            r"Type: uwb_tdoa_msgs/msg/Tdoa\nPublisher count: 1\n  /tag1/driver \[.*\]: "
            r"best_effort, volatile\nSubscription count: "
        ),
        0,
    ),
    "topic echo /tag1/uwb/tdoa --once": (
        r"frame_id: base_link[^$]*anchor_a: 3\n[^$]*distance_difference: 0.25\n[^$]*---\n",
        0,
    ),
    "node list": (r"(?m)^/tag1/driver$", 0),
    "param list": (r"/tag1/driver:\n(  .*\n)*  gain\n", 0),
    "param set tag1/driver gain 0.75": (r"^Set parameter successful\n$", 0),
    "param set tag1/driver limit 2.0": (r"error: limit: not set: ", 1),
    "param describe /tag1/driver limit": (
        r"^limit: m; what is too far\n  from 0 to 9\n  read only\n$",
        0,
    ),
    "param get /tag1/driver gian": (r"error: /tag1/driver has no parameter gian", 1),
}


PATIENCE = 300.0  # s
# Runs the script with this patience for nodes that do not answer, s.
IMPATIENT = """
import runpy, sys
path, patience, *sys.argv[1:] = sys.argv[1:]
script = runpy.run_path(path)
script["_run"].__globals__["PATIENCE"] = float(patience)
sys.exit(script["cli"].run(script["_run"], script["parser"]()))
"""


def spin_until(node, condition, what=lambda: "it did not happen"):
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until, what()
        rclpy.spin_once(node, timeout_sec=0.02)


@pytest.fixture
def driver():
    """A node with two parameters that publishes TDOAs at 50 Hz, best effort."""
    rclpy.init()
    node = rclpy.create_node("driver", namespace="tag1")
    parameters = {
        "gain": Parameter(0.5, "of nothing", 0.0, 1.0, settable=True),
        "limit": Parameter(3.0, "m; what is too far", 0.0, 9.0),
    }
    declare_all(node, parameters)
    poor = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher, message = (
        node.create_publisher(Tdoa, "uwb/tdoa", poor),
        Tdoa(anchor_a=3, distance_difference=0.25),
    )
    message.header.frame_id = "base_link"
    node.create_timer(0.02, lambda: publisher.publish(message))
    yield node
    node.destroy_node()
    rclpy.shutdown()


def start(words, stdout=subprocess.PIPE, patience=None):
    """Start `./dev ros2 WORDS`. patience : s, in place of that of the script"""
    script = [SCRIPT] if patience is None else ["-c", IMPATIENT, SCRIPT, str(patience)]
    return subprocess.Popen(
        [sys.executable, "-u", *script, *words.split()],
        stdout=stdout,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.slow
def test_commands(driver):
    """Repeat each command until its answer is correct.

    On a loaded machine, a command may end before it has discovered the node.
    """
    asked, said = {words: start(words) for words in COMMANDS}, {}

    def all_are_answered():
        for words, process in list(asked.items()):
            if process.poll() is None:
                continue
            said[words] = process.communicate()[0], process.returncode
            expected, code = COMMANDS[words]
            if re.search(expected, said[words][0]) and process.returncode == code:
                del asked[words]
            else:
                asked[words] = start(words)
        return not asked

    try:
        spin_until(driver, all_are_answered, lambda: {words: said.get(words) for words in asked})
    finally:
        for process in asked.values():
            process.kill()
            process.communicate()
    assert driver.get_parameter("gain").value == 0.75


@pytest.mark.slow
def test_a_node_that_does_not_answer_does_not_hide_the_others(driver):
    context = rclpy.Context()
    rclpy.init(context=context)
    silent = rclpy.create_node("a_silent_one", context=context)  # it is not spun
    listed, asked = [], [start("param list", patience=5.0)]

    def both_are_seen():
        """Ask again where discovery has not shown both nodes to the command."""
        if asked[-1].poll() is None:
            return False
        listed[:] = asked[-1].communicate()[0], asked[-1].returncode
        both = "/tag1/driver" in listed[0] and "a_silent_one" in listed[0]
        if not both:
            asked.append(start("param list", patience=5.0))
        return both

    try:
        spin_until(driver, both_are_seen, lambda: listed)
    finally:
        asked[-1].kill()
        asked[-1].wait()
        silent.destroy_node()
        rclpy.shutdown(context=context)
    said, code = listed
    assert re.search(COMMANDS["param list"][0], said) and "a_silent_one:\n" not in said
    assert "/a_silent_one: does not answer" in said and code == 1


@pytest.mark.slow
def test_the_rate_of_a_topic(driver, tmp_path):
    said = tmp_path / "hz.txt"
    with said.open("w") as file:
        hz = start("topic hz /tag1/uwb/tdoa", file)
        try:  # a loaded machine reaches 50 Hz later
            spin_until(
                driver, lambda: any(abs(rate - 50.0) < 15.0 for rate in rates_in(said.read_text()))
            )
        finally:
            hz.terminate()
            hz.wait()
    assert hz.returncode in (0, -signal.SIGTERM), said.read_text()


@pytest.mark.slow
def test_messages_are_recorded_until_a_signal(driver, tmp_path):
    said, bag = tmp_path / "record.txt", tmp_path / "minute.bag"
    got = []
    with said.open("w") as file:
        record = start(f"bag record -o {bag} /tag1/uwb/tdoa /tag1/imu/data", file)
        driver.create_timer(0.02, lambda: got.append(driver.count_subscribers("/tag1/uwb/tdoa")))
        try:
            spin_until(driver, lambda: sum(map(bool, got)) > 100, said.read_text)
            record.send_signal(signal.SIGINT)
            spin_until(driver, lambda: record.poll() is not None, said.read_text)
        finally:
            record.kill()
            record.wait()
    found = re.search(r"/tag1/uwb/tdoa: (\d+) messages", said.read_text())
    assert record.returncode == 0 and found and int(found[1]) > 20, said.read_text()
    assert "/tag1/imu/data: nobody published it" in said.read_text()
    with open_bag(bag) as reader:
        (connection,) = reader.connections
        assert (connection.topic, connection.msgcount) == ("/tag1/uwb/tdoa", int(found[1]))


def rates_in(text):
    return [float(rate) for rate in re.findall(r"average rate: ([\d.]+) ", text)]


def test_any_message_is_yaml():
    plain = runpy.run_path(str(SCRIPT))["_plain"]
    residual = plain(TdoaResidual(verdict=3, weight=0.5))
    assert (
        residual["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        and residual["verdict"] == 3
    )


HOSTILE = "x\x1b]52;c;ZXZpbA==\x07\u202e\nforged"


@pytest.mark.parametrize(
    "command",
    ["param get", "param describe", "param list", "node list", "topic list -t", "topic info -v t"],
)
def test_a_terminal_obeys_nothing_that_others_have_written(monkeypatch, capsys, command):
    """`param get` of a text with escape sequences wrote to the clipboard."""
    script = runpy.run_path(str(SCRIPT))
    function = script[command.replace(" -t", "").replace(" -v t", "").replace(" ", "_")]
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=HOSTILE)
    bounds = [FloatingPointRange(from_value=0.0, to_value=1.0)]
    described = ParameterDescriptor(
        name=HOSTILE,
        type=4,
        description=HOSTILE,
        additional_constraints=HOSTILE,
        floating_point_range=bounds,
    )
    end = SimpleNamespace(
        node_namespace=HOSTILE,
        node_name=HOSTILE,
        topic_type=HOSTILE,
        qos_profile=SimpleNamespace(
            reliability=ReliabilityPolicy.RELIABLE, durability=ReliabilityPolicy.RELIABLE
        ),
    )
    node = SimpleNamespace(
        get_topic_names_and_types=lambda: [(HOSTILE, [HOSTILE])],
        get_publishers_info_by_topic=lambda _: [end],
        get_subscriptions_info_by_topic=lambda _: [end],
        count_publishers=lambda _: 1,
        count_subscribers=lambda _: 1,
    )
    answers = {
        "param get": SimpleNamespace(values=[value]),
        "param describe": SimpleNamespace(descriptors=[described]),
        "param list": SimpleNamespace(result=SimpleNamespace(names=[HOSTILE])),
    }
    fakes = {
        "_answer": lambda *_: answers[command],
        "_client": lambda *_, **__: Any_(),
        "_nodes": lambda *_: [HOSTILE],
        "_settled": lambda look, *_: look(),
        "_topic": lambda *_, **__: HOSTILE,
    }
    function.__globals__.update(fakes)
    for of in [HOSTILE, None] if command == "param list" else [HOSTILE]:
        function(
            node,
            [],
            argparse.Namespace(node=of, name="n", topic=HOSTILE, show_types=True, verbose=True),
        )
    said = capsys.readouterr().out
    assert (
        r"\x1b]52" in said
        and r"\nforged" in said
        and all(line.isprintable() for line in said.split("\n"))
    )


class Any_:
    """Has every method. All methods do nothing."""

    def __getattr__(self, name):
        return lambda *_, **__: None


def test_its_examples_are_command_lines():
    parser = runpy.run_path(str(SCRIPT))["parser"]()
    examples = parser.epilog.splitlines()[1:]
    assert len(examples) > 5
    for example in examples:
        dev, name, *words = example.split()
        assert (dev, name) == ("./dev", "ros2") and isinstance(
            parser.parse_args(words), argparse.Namespace
        )
