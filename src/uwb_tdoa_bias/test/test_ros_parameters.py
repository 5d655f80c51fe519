# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: E402
from rclpy.impl.rcutils_logger import RcutilsLogger  # noqa: E402
from rclpy.parameter import Parameter as Value  # noqa: E402

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.ros.node import (  # noqa: E402
    Parameter,
    ParameterNode,
    declare_all,
    files_of,
    refuse_unknown,
    say_unused,
)

PARAMETERS = {
    "gate": Parameter(3.0, "standard deviations", 0.0, 10.0, settable=True),
    "count": Parameter(2, "of them", 1, 5),
    "mode": Parameter("base", "what to do", choices=("none", "base")),
    "use_it": Parameter(True, "or not"),
    "speeds": Parameter([1.0, 2.0], "m/s", constraint="two numbers above 0"),
}


@pytest.fixture
def node_with():
    """Return node_with(*arguments), which starts a node with these ROS arguments."""
    nodes = []

    def make(*arguments):
        rclpy.init(args=["--ros-args", *arguments])
        nodes.append(ParameterNode("some_node", namespace="tag1"))
        nodes[-1].NAME = "some_node"
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def said(monkeypatch):
    lines = []
    monkeypatch.setattr(RcutilsLogger, "warning", lambda self, text, **_: lines.append(text))
    return lines


def test_values_and_descriptors(node_with):
    node = node_with("-p", "gate:=4.5", "-p", "mode:=none")
    assert declare_all(node, PARAMETERS) == {
        "gate": 4.5,
        "count": 2,
        "mode": "none",
        "use_it": True,
        "speeds": [1.0, 2.0],
    }
    gate, count, mode, speeds = (
        node.describe_parameter(name) for name in ("gate", "count", "mode", "speeds")
    )
    assert (gate.description, gate.read_only, count.read_only) == (
        "standard deviations",
        False,
        True,
    )
    assert (gate.floating_point_range[0].from_value, gate.floating_point_range[0].to_value) == (
        0.0,
        10.0,
    )
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 5)
    assert mode.additional_constraints == "one of none, base"
    assert speeds.additional_constraints == "two numbers above 0"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ("gate:=11.0", "gate: 11.0 must be from 0 to 10."),
        ("gate:=fast", "gate: .*; give a number with a decimal point, e.g. 1.0."),
        ("count:=0", "count: 0 must be from 1 to 5."),
        ("count:=1.5", "count: .*; give a whole number."),
        ("mode:=odom", "mode: 'odom' is not one of none, base."),
        ("mode:=true", "mode: .*; give one of none, base."),
        ("use_it:=1", "use_it: .*; give true or false."),
    ],
)
def test_a_bad_value_is_refused_in_a_sentence(node_with, given, sentence):
    with pytest.raises(InputError, match=sentence):
        declare_all(node_with("-p", given), PARAMETERS)


def test_an_unknown_name_is_refused_with_the_nearest_one(node_with):
    node = node_with("-p", "gaet:=1.0", "-p", "use_sim_time:=true", "-p", "old:=1")
    declare_all(node, PARAMETERS)
    with pytest.raises(InputError, match="gaet: some_node has no such parameter; write gate "):
        refuse_unknown(node, ["old"])


def test_what_changes_nothing_is_said(node_with, said, tmp_path):
    for name, key in (("mine", "/**"), ("other", "/**/other_node"), ("empty", None)):
        (tmp_path / name).write_text(
            f"{key}: {{ros__parameters: {{gate: 5.0, a: {{b: 1}}}}}}" if key else "{}"
        )
    files = [str(tmp_path / name) for name in ("other", "empty")]
    node = node_with("--params-file", files[0], "-p", "qos_overrides./x.publisher.depth:=3")
    assert declare_all(node, PARAMETERS)["gate"] == 3.0
    say_unused([node], files)
    assert len(said) == 2
    assert said[0].startswith(f"{files[0]}: none of its parameters is for /tag1/some_node")
    assert said[1].startswith("qos_overrides./x.publisher.depth: changes nothing")


def test_a_file_that_counts_is_not_said(node_with, said, tmp_path):
    file = tmp_path / "mine"
    file.write_text("/**: {ros__parameters: {gate: 5.0}}")
    arguments = ["--params-file", str(file)]
    node = node_with(*arguments)
    assert declare_all(node, PARAMETERS)["gate"] == 5.0
    assert files_of(["node", "--ros-args", *arguments]) == [str(file)]
    say_unused([node], files_of(arguments))
    assert not said


# Contents of a parameter file. rcl accepts some and refuses the others.
ODD = [
    # launch_ros writes every list in this way
    "/**: {ros__parameters: {speeds: !!python/tuple [1.0, 2.0]}}",
    "/**: {ros__parameters: {mode: !!str none}}",
    "/**: {ros__parameters: {mode: !ours none}}",
    "/**: {ros__parameters: {mode: none, mode: base}}",
    "/**: {ros__parameters: {gate: .inf}}",
    "/**: {ros__parameters: {mode: 010}}",
    "/**: {ros__parameters: {gate: 1e400}}",
    "/**: {ros__parameters: {count: 99999999999999999999}}",
    "/**: {ros__parameters: {mode: &a none, other: *a}}",
    "/**: {ros__parameters: {mode: none}}\n---\n/**: {ros__parameters: {mode: base}}",
    "/**: {ros__parameters: {mode: }}",
    "/**: {ros__parameters: {speeds: []}}",
    "/**: {ros__parameters: {? [a] : 1}}",
    "/**: [1, 2]",
    "just a text",
    "",
    "\xff",
]


@pytest.mark.parametrize("text", ODD)
def test_a_parameter_file_is_judged_by_rcl_alone(node_with, said, tmp_path, text):
    file = tmp_path / "odd.yaml"
    file.write_bytes(text.encode("latin-1"))
    try:
        node = node_with("--params-file", str(file))
    except rclpy_implementation.RCLError:
        # rcl refuses a file before the node exists.
        rclpy.init()
        return
    say_unused([node], [str(file)])
    given = any(name in node._parameter_overrides for name in PARAMETERS)
    assert given or "!!python/tuple" not in text
    assert not (given and said)


def test_a_read_only_parameter_may_be_set_to_what_it_is(node_with):
    node = node_with("-p", "count:=3", "-p", "speeds:=[1.5, 2.5]")
    declare_all(node, PARAMETERS)
    so = [
        Value("count", value=3),
        Value("speeds", value=[1.5, 2.5]),
        Value("mode", value="base"),
        Value("use_it", value=True),
    ]
    for parameters in ([one] for one in so):
        assert node.set_parameters_atomically(parameters).successful
    assert (
        node.set_parameters_atomically([*so, Value("gate", value=5.0)]).successful
        and node.get_parameter("gate").value == 5.0
    )
    for other in (
        Value("count", value=4),
        Value("count", value=3.0),
        Value("speeds", value=[1.5]),
        Value("mode", value="none"),
    ):
        result = node.set_parameters_atomically([so[0], Value("gate", value=6.0), other])
        assert not result.successful and "read-only" in result.reason
    assert node.get_parameter("gate").value == 5.0


@pytest.mark.parametrize(
    "name, said", [("gaet", "no parameter 'gaet'; set gate"), ("else", "no parameter 'else'; see")]
)
def test_a_misspelt_parameter_is_refused_by_name(node_with, name, said):
    node = node_with()
    declare_all(node, PARAMETERS)
    result = node.set_parameters_atomically([Value(name, value=1.0)])
    assert not result.successful and said in result.reason
