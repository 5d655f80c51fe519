# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""SROS2 allows each node exactly what it does: sros2/policy.xml against the ROS graph."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from cflib_objects import cflib  # noqa: E402, F401

from uwb_tdoa_bias.anchors_node import AnchorsNode  # noqa: E402
from uwb_tdoa_bias.bias_node import BiasNode  # noqa: E402
from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.common.sensors import SENSORS  # noqa: E402
from uwb_tdoa_ekf.debias import BiasMap  # noqa: E402
from uwb_tdoa_ekf.debias_node import DebiasNode  # noqa: E402
from uwb_tdoa_ekf.ekf_node import EkfNode  # noqa: E402
from uwb_tdoa_ekf.localization_node import LocalizationNode  # noqa: E402
from uwb_tdoa_tools.autopilot_node import AutopilotNode  # noqa: E402
from uwb_tdoa_tools.calibration_node import CalibrationNode  # noqa: E402
from uwb_tdoa_tools.vehicle_node import VehicleNode  # noqa: E402

FILE = Path(__file__).resolve().parents[2] / "uwb_tdoa_ekf" / "sros2" / "policy.xml"
ROLES = ("topic", "publish"), ("topic", "subscribe"), ("service", "reply"), ("service", "request")
NODES = BiasNode, EkfNode, LocalizationNode, AnchorsNode, DebiasNode
NODES += AutopilotNode, CalibrationNode, VehicleNode
KINDS = {kind.NAME: kind for kind in NODES}
OTHERS = {"robot", "operator"}  # enclaves of other nodes


def allowed():
    """Return {enclave: {node: {role: full names}}} of the policy."""
    out = {}
    for enclave in ElementTree.parse(FILE).iter("enclave"):
        of_nodes = out[Path(enclave.get("path")).name] = {}
        for profile in enclave.iter("profile"):
            node, roles = f"/{profile.get('node')}", {role: set() for _, role in ROLES}
            for kind, role in ROLES:
                for entries in profile.findall(f"{kind}s[@{role}='ALLOW']"):
                    names = [entry.text.replace("~", node) for entry in entries.findall(kind)]
                    roles[role] |= {name if name.startswith("/") else f"/{name}" for name in names}
            of_nodes[node] = roles
    return out


@pytest.fixture
def arguments(tmp_path):
    """Return arguments with which each node uses all its topics and services."""
    Anchors.from_positions(np.eye(3)).to_yaml(tmp_path / "anchors.yaml")
    cell = np.stack(np.meshgrid(*[np.arange(3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    BiasMap(0.5 * cell, np.zeros((9, 2)), 0.01 * np.eye(2), 0.5).save(tmp_path / "map.npz")
    own = {
        "anchors_node": ["-p", f"anchors_file:={tmp_path / 'anchors.yaml'}"],
        "autopilot_node": [
            "-p",
            "protocol:=crazyflie",
            "-p",
            "connection:=radio://0/80/2M/E7E7E7E7E7",
            "-p",
            "log:=[tdoa, imu, height, pressure]",
        ],
        "bias_node": ["-p", "calibrated:=true"],
        "debias_node": ["-p", f"map:={tmp_path / 'map.npz'}"],
        "ekf_node": ["-p", "publish_tf:=odom"],
        "localization_node": ["-p", "publish_tf:=odom", "-p", "calibrated:=true"],
        "vehicle_node": [
            "-p",
            "simulated_time:=true",
            "-p",
            f"sensors:=[{', '.join(SENSORS)}]",
        ],
    }
    return {name: ["--ros-args", "-p", "use_sim_time:=true", *own.get(name, ())] for name in KINDS}


def of_graph(observer, node):
    """Return {role: full names} of a node, as another node sees it."""
    asked = [node.get_name(), node.get_namespace()]
    found = {
        "publish": observer.get_publisher_names_and_types_by_node(*asked),
        "subscribe": observer.get_subscriber_names_and_types_by_node(*asked),
        "reply": observer.get_service_names_and_types_by_node(*asked),
        "request": observer.get_client_names_and_types_by_node(*asked),
    }
    return {role: {name for name, _ in names} for role, names in found.items()}


@pytest.mark.parametrize("name", KINDS)
def test_a_node_may_do_what_it_does_and_nothing_else(name, arguments, cflib):  # noqa: F811
    rclpy.init(args=arguments[name])
    given = [arguments[name]] if name == "localization_node" else []
    node = KINDS[name](*given)
    nodes, observer = [node, *node.members], rclpy.create_node("observer")
    try:
        used = {each.get_fully_qualified_name(): of_graph(observer, each) for each in nodes}
        assert allowed()[name] == used, f"mend the enclave {name} of {FILE.name}"
    finally:
        for each in (*nodes, observer):
            each.destroy_node()  # or the next test sees it
        rclpy.shutdown()


def test_nobody_else_may_take_over():
    policy = allowed()
    assert policy.keys() == KINDS.keys() | OTHERS
    (robot,), (operator,) = policy["robot"].values(), policy["operator"].values()
    ours = {"/uwb/anchors", "/initialpose", "/odometry", "/uwb/tdoa_corrected", "/clock"}
    assert not robot["publish"] & ours and not robot["request"]
    measured = {f"/{topic}" for each in SENSORS.values() for topic, _ in each.topics}
    assert measured <= robot["publish"] and "/ekf_node/reset" in operator["request"]
