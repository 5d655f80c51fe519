# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/rover.md: its file of tags, its tables and its commands."""

import re
import shlex

from documented import ROOT
import pytest
from walking import blocks, section
import yaml

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.ekf_parameters import names_of_parameters
from uwb_tdoa_tools.commands import calibrate, check, diagnose, evaluate, simulate

launching = pytest.importorskip("uwb_tdoa_ekf.launching", reason="needs rclpy")
FILE = ROOT / "docs/connect/rover.yaml"


def test_the_file_of_tags_starts_nodes_with_its_names():
    ekf = next(node for node in launching.tags(str(FILE), {}) if node.executable == "ekf_node")
    values = ekf.parameters[-1]
    assert (
        values["publish_tf"] == "odom"
        and values["odom_frame"] == "rover1/odom"
        and values["body_frame"] == "rover1/base_link"
    )
    assert ekf.remaps["velocity/odometry"] == "odom"
    known = {topic for sensor in SENSORS.values() for topic, _ in sensor.topics} | {"imu/data"}
    assert set(ekf.remaps) <= known
    config = FilterConfig(
        **{name: value for name, value in values.items() if name in vars(FilterConfig())}
    )
    assert config.planar and config.fixed_height == 0.0 and config.non_holonomic_std == 0.05


def test_parameters_of_the_page_are_there():
    rows = re.findall(r"^\| (`.*?`) \| .* \| .* \|$", section("rover.md", "Start"), re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert {"planar", "fixed_height", "use_imu"} <= named <= set(names_of_parameters())


def test_yaml_of_the_page_can_be_read():
    recipes = [
        yaml.safe_load(text)
        for heading in ("Nav2", "robot_localization")
        for text in blocks(section("rover.md", heading), "yaml")
    ]
    nav2, robot_localization = recipes
    assert nav2["global_costmap"]["global_costmap"]["ros__parameters"]["global_frame"] == "map"
    ours = robot_localization["ekf_map"]["ros__parameters"]
    assert all(len(ours[name]) == 15 for name in ("odom0_config", "odom1_config"))


def test_commands_of_the_page_are_command_lines():
    parsers = {
        "simulate": simulate.parser,
        "calibrate": calibrate.parser,
        "check": check.parser,
        "evaluate": evaluate.parser,
        "diagnose": diagnose.parser,
    }
    lines = [
        shlex.split(line)
        for text in blocks(section("rover.md", "Check, diagnose, evaluate"))
        for line in text.splitlines()
    ]
    assert {words[3] for words in lines} == set(parsers)
    for _, _, _, name, *words in lines:
        parsers[name]().parse_args(words)


@pytest.mark.slow
def test_a_simulated_rover_is_evaluated_and_checked(tmp_path, capsys):
    bag = str(tmp_path / "rover.bag")
    assert simulate.main(["--vehicle", "rover", "--duration", "30", "--no-bias", "--out", bag]) == 0
    assert evaluate.main([bag, "--no-bias", "-p", "planar:=true"]) == 0
    assert check.main([bag]) == 0
    assert "is it a flight" not in capsys.readouterr().out
