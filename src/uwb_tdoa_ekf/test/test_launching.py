# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Processes that the launch files start; test_launch_files.py runs them."""

import json
import os
from pathlib import Path
import re

import pytest
import yaml

pytest.importorskip("uwb_tdoa_msgs.msg")

from nav_msgs.msg import Odometry  # noqa: E402

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_ekf.launching import (
    LAUNCH_FILES,
    NODES,
    RANGE,
    Lives,
    discovery,
    network,
    pooled,
    start,
    tag,
    tags,
    typed,
)  # noqa: E402
from uwb_tdoa_msgs.msg import TdoaResidual  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = {
    name: ROOT.parent / package / "config" / f"{name}.yaml" for name, (package, _) in NODES.items()
}


@pytest.mark.parametrize("name", NODES)
def test_the_parameters_of_a_node_are_those_of_its_file(name):
    (content,) = yaml.safe_load(CONFIGS[name].read_text()).values()
    assert NODES[name][1] == content["ros__parameters"].keys() | {"use_sim_time"}


def test_a_value_goes_to_the_nodes_that_have_it_and_overrides_their_file():
    bias, ekf = tag(
        "tag1",
        {"anchors_file": "a.yaml", "tdoa_std": 0.3, "hold": 0.1},
        {"ekf_node": ["mine.yaml"]},
        "debug",
    )
    assert (bias.executable, bias.namespace, bias.parameters) == (
        "bias_node",
        "tag1",
        [{"anchors_file": "a.yaml", "hold": 0.1}],
    )
    assert (
        ekf.parameters == ["mine.yaml", {"anchors_file": "a.yaml", "tdoa_std": 0.3}]
        and ekf.log_level == "debug"
    )
    assert [node.executable for node in tag("", {"map": "map.npz"})] == [
        "bias_node",
        "ekf_node",
        "debias_node",
    ]
    assert start("ekf_node", "", {"map": "map.npz"}).parameters == []
    with pytest.raises(InputError, match="tdoa_sdt: is no parameter of .*; write tdoa_std"):
        tag("", {"tdoa_sdt": 1.0})


def test_what_a_node_is_told_are_arguments_which_later_ones_override():
    told = start(
        "ekf_node",
        "",
        {"world_frame": 'hall: 1 # "ä"', "tdoa_std": 0.3, "use_sim_time": True},
        ["mine.yaml"],
        "debug",
    )
    assert told.words == [
        "--log-level",
        "debug",
        "--params-file",
        "mine.yaml",
        "-p",
        'world_frame:="hall: 1 # \\"ä\\""',
        "-p",
        "tdoa_std:=0.3",
        "-p",
        "use_sim_time:=true",
    ]


def test_a_node_that_crashes_is_started_again_each_time_later():
    lives = Lives("tag1/ekf_node", True, "shutdown")
    assert [lives.ended(-9, 1.0).again for _ in range(7)] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert lives.ended(1, 61.0).again == 1.0  # after a long life
    # Not its first start: a file may have been incomplete, so the node is started again.
    again = lives.ended(2, 1.0)
    assert (again.again, again.everything) == (2.0, False)
    assert again.text == "tag1/ekf_node has ended with exit code 2: it is started again in 2 s"


@pytest.mark.parametrize("code", [0, -2, -15, 130, 143])
def test_a_node_that_was_asked_to_end_is_left_alone(code):
    ended = Lives("ekf_node", True, "shutdown").ended(code, 1.0)
    assert (ended.again, ended.text, ended.everything) == (None, None, False)


@pytest.mark.parametrize(("on_exit", "everything"), [("shutdown", True), ("stay", False)])
def test_what_ends_for_good_ends_all_if_it_is_to(on_exit, everything):
    refused, crashed = (
        Lives("ekf_node", True, on_exit).ended(2, 1.0),
        Lives("ekf_node", False, on_exit).ended(-11, 1.0),
    )
    assert (
        refused.again is crashed.again is None
        and refused.everything is crashed.everything is everything
    )
    assert "refuses what it is given" in refused.text and "ended with exit code -11" in crashed.text


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {},
            (
                "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET, ROS_DOMAIN_ID=0: heard by nodes on every "
                "machine that multicast reaches, any of which"
            ),
        ),
        (
            {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
            "LOCALHOST, ROS_DOMAIN_ID=7: heard by nodes on this machine, and",
        ),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "robot"},
            "this machine and of ROS_STATIC_PEERS=robot, and",
        ),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "robot"},
            "OFF, ROS_DOMAIN_ID=0: heard by nobody",
        ),
        (
            {"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": "robot"},
            "LOCALHOST, ROS_DOMAIN_ID=0: heard by nodes on this machine, and",
        ),
    ],
)
def test_who_hears_the_nodes_is_said(given, said):
    assert said in network(given)


def test_only_this_machine_discovers_the_nodes_unless_the_user_says_otherwise():
    assert discovery({}) == discovery({RANGE: ""}) == {RANGE: "LOCALHOST"}
    assert discovery({RANGE: "SUBNET"}) == discovery({RANGE: "OFF"}, "SUBNET") == {RANGE: "SUBNET"}


def test_texts_become_values():
    assert typed({"use_sim_time": "true", "body_frame": "", "world_frame": "map"}) == {
        "use_sim_time": True,
        "world_frame": "map",
    }


def test_tags_of_a_file(tmp_path):
    file = tmp_path / "tags.yaml"
    file.write_text(
        "anchors_file: a.yaml\ntdoa_std: 0.3\ntags: {tag1: , tag2: {body_frame: base2, "
        "tdoa_std: 0.5}}"
    )
    nodes = tags(file, {"use_sim_time": True})
    assert [(node.executable, node.namespace) for node in nodes] == [
        ("bias_node", "tag1"),
        ("ekf_node", "tag1"),
        ("bias_node", "tag2"),
        ("ekf_node", "tag2"),
        ("anchors_node", ""),
    ]
    (first,), (second,), (anchors,) = (nodes[k].parameters for k in (1, 3, 4))
    shared = {"anchors_file": str(tmp_path / "a.yaml"), "use_sim_time": True}
    assert first == {"body_frame": "tag1/base_link", "tdoa_std": 0.3} | shared
    assert second == {"body_frame": "base2", "tdoa_std": 0.5} | shared
    assert anchors == shared


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{}", "expected a mapping 'tags'"),
        ("tags: {a: 1}", "a: 1 must be a mapping"),
        ("tags: {a: {gaet: 1}}", "gaet: .* write gate"),
        ("tags: {a: {gate: }}", "gate: None is no value"),
        ("tags: {a: {gate: {b: 1}}}", "gate: .* is no value"),
        ("tags: {a: {remaps: odom}}", "remaps: 'odom' must be"),
        ("remaps: {velocity: 3}\ntags: {a: }", "remaps: .* must be"),
        ("anchors_file: []\ntags: {a: {}}", ".. is no path"),
        ("tags: {a: {params_file: 3}}", "3 is no path"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, named):
    file = tmp_path / "tags.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=f"{file}: .*{named}"):
        tags(file, {})


def test_topics_of_tags_have_other_names(tmp_path):
    file = tmp_path / "tags.yaml"
    file.write_text(
        "remaps: {velocity/odometry: odom}\ntags: {tag1: , tag2: {remaps: {imu/data: /imu2, "
        "velocity/odometry: wheels}}}"
    )
    first, second = (node for node in tags(file, {}) if node.executable == "ekf_node")
    assert first.words[2:4] == ["-r", "velocity/odometry:=odom"]
    assert second.words[2:6] == ["-r", "velocity/odometry:=wheels", "-r", "imu/data:=/imu2"]
    with pytest.raises(InputError, match="remaps: do not go with processes"):
        tags(file, {}, processes="1")


def test_one_tag_calibrates_the_anchors_of_all(tmp_path):
    file = tmp_path / "tags.yaml"
    file.write_text("calibrated: true\ncalibration_folder: kept\ntags: {a: {}, b: {}}")
    (one,) = (node for node in tags(file, {}) if node.executable == "calibration_node")
    assert one.namespace == "a" and one.parameters[-1] == {
        "calibration_folder": str(tmp_path / "kept")
    }
    told = [node.parameters[-1] for node in tags(file, {}) if node.executable == "bias_node"]
    assert [one["calibrated"] for one in told] == [True, True]


def test_the_calibration_takes_the_parameters_of_the_filter(tmp_path):
    launch = LAUNCH_FILES["tdoa.launch.py"]
    given = {name: default or "" for name, (default, *_) in launch.arguments.items()}
    names = [node.executable for node in launch.starts(given)]
    assert "calibration_node" not in names
    given |= {"calibrated": "true", "ekf_params": "ekf.yaml", "calibration_params": "own.yaml"}
    (node,) = (one for one in launch.starts(given) if one.executable == "calibration_node")
    assert node.parameters == ["own.yaml", {"ekf_params": "ekf.yaml"}]


def test_as_many_processes_as_cores(tmp_path):
    file = tmp_path / "tags.yaml"
    file.write_text(f"tags: {{{', '.join(f't{k}: {{}}' for k in range(300))}}}")
    nodes = tags(file, {}, processes="auto")
    assert len(nodes) == min(300, len(os.sched_getaffinity(0)))
    assert sorted(tag for node in nodes for tag in node.parameters[1]["tags"]) == sorted(
        f"t{k}" for k in range(300)
    )


def test_several_tags_in_a_pool_of_processes(tmp_path):
    file = tmp_path / "tags.yaml"
    file.write_text("anchors_file: a.yaml\ntags: {a: {}, b: {tdoa_std: 0.3}, c: {map: map.npz}}")
    assert [
        node.parameters[1].get("frozen") for node in pooled(tags(file, {"frozen": True}), 1)[2:]
    ] == [True]
    nodes = pooled(tags(file, {}), "2")
    assert [node.executable for node in nodes] == [
        "debias_node",
        "anchors_node",
        "localization_node",
        "localization_node",
    ]
    one, other = nodes[2:]
    assert (one.name, other.name, one.namespace) == (
        "localization_node_1",
        "localization_node_2",
        "",
    )
    assert [node.parameters[1] for node in (one, other)] == [{"tags": ["a", "c"]}, {"tags": ["b"]}]
    told = yaml.safe_load(Path(one.parameters[0]).read_text())
    assert told.keys() == {f"/**/{tag}/{node}_node" for tag in "abc" for node in ("bias", "ekf")}
    shared = {"anchors_file": str(tmp_path / "a.yaml")}
    assert told["/**/b/ekf_node"] == {
        "ros__parameters": {"body_frame": "b/base_link", "tdoa_std": 0.3} | shared
    }
    with pytest.raises(InputError, match="params_file: does not go with processes"):
        pooled([start("ekf_node", "a", {}, ["mine.yaml"])], 2)
    with pytest.raises(InputError, match="processes: 'two' must be a whole number"):
        pooled(tags(file, {}), "two")


def test_the_layout_of_rviz_is_yaml():
    content = yaml.safe_load((ROOT / "rviz" / "tdoa.rviz").read_text())
    assert {each["Name"] for each in content["Visualization Manager"]["Displays"]} >= {
        "Odometry",
        "Ground truth",
        "Anchors",
        "TF",
    }


def test_the_layout_of_foxglove_shows_what_the_nodes_publish():
    content = json.loads((ROOT / "foxglove" / "tdoa.json").read_text())
    kinds = {
        "/odometry": Odometry,
        "/uwb/residual": TdoaResidual,
        "/uwb/anchors/markers": None,
        "/ground_truth/pose": None,
        "/diagnostics": None,
    }
    panels = content["configById"]
    assert (
        panels["3D!room"]["topics"].keys() | {panels["DiagnosticSummary!all"]["topicToRender"]}
        <= kinds.keys()
    )
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    for path in paths:
        topic, filters, fields, index = re.fullmatch(
            r"([/\w]+)((?:\{\w+==\d+\})*)\.([.\w]+)(\[\d+\])?", path
        ).groups()
        message = kinds[topic]()
        for name in [*re.findall(r"\{(\w+)==", filters), *fields.split(".")]:
            value = getattr(message, name)
            message = value if hasattr(value, "get_fields_and_field_types") else message
        assert not index or len(value) > int(index[1:-1])
    assert len(paths) == len(set(paths)) == 13
    shown = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(content["layout"]))
    assert sorted(shown) == sorted(panels)
