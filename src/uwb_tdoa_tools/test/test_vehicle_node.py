# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""vehicle_node: its parameters, and a flight with the real nodes on a busy computer.

The test commands the flight by services.
"""

from dataclasses import replace
from pathlib import Path
import re

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point
import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.srv", reason="needs the built workspace: ./dev build")

from live_flights import hall  # noqa: E402
from test_lockstep import load  # noqa: E402, F401

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.common.sensors import SENSORS  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_msgs.srv import GoTo, Land, Takeoff  # noqa: E402
from uwb_tdoa_tools.flying import rover  # noqa: E402
from uwb_tdoa_tools.flying.mission import SPEED, Waypoints  # noqa: E402
from uwb_tdoa_tools.flying.simulator import DT  # noqa: E402
from uwb_tdoa_tools.flying.trial import Task  # noqa: E402
from uwb_tdoa_tools.flying.vehicle import WORLDS
from uwb_tdoa_tools.flying.verdict import verdict_of  # noqa: E402
from uwb_tdoa_tools.vehicle_node import PARAMETERS, VehicleNode  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "vehicle_node.yaml"
SERVICES = Path(__file__).resolve().parents[2] / "uwb_tdoa_msgs" / "srv"
OF_CRAZYSWARM2 = {  # requests of crazyflie_interfaces 1.0
    "Takeoff": "uint8 group_mask, float32 height, builtin_interfaces/Duration duration",
    "GoTo": (
        "uint8 group_mask, bool relative, geometry_msgs/Point goal, float32 yaw, "
        "builtin_interfaces/Duration duration"
    ),
    "Land": "uint8 group_mask, float32 height, builtin_interfaces/Duration duration",
}


def test_every_parameter_is_in_the_parameter_file_with_its_default():
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values())
    assert written == {name: parameter.default for name, parameter in PARAMETERS.items()}


@pytest.mark.parametrize("name", OF_CRAZYSWARM2)
def test_requests_are_those_that_users_of_crazyswarm2_know(name):
    request = (SERVICES / f"{name}.srv").read_text().partition("---")[0]
    assert re.findall(r"^(\w[\w/]* \w+)", request, re.MULTILINE) == OF_CRAZYSWARM2[name].split(", ")


@pytest.mark.parametrize(
    "given, why",
    [
        ("sensors:=[sonar]", f"sensors: 'sonar' is not one of {', '.join(SENSORS)}."),
        (
            "vehicle:=rover",
            "vehicle: a rover takes no commands and no sensors; set mission to true.",
        ),
        ("world:=moon", "world: 'moon' is not one of hall,"),
    ],
)
def test_what_it_does_not_know_is_refused(given, why):
    rclpy.init(args=["--ros-args", "-p", given])
    try:
        with pytest.raises(InputError, match=re.escape(why)):
            VehicleNode()
    finally:
        rclpy.shutdown()


@pytest.mark.slow
def test_it_flies_by_services_beside_two_busy_processes(tmp_path, load):  # noqa: F811
    with hall(tmp_path, "seed:=3", "sensors:=[height]") as flown:
        refused = flown.ask(GoTo, "go_to", goal=Point(z=1.0), duration=Duration(sec=5))
        assert not refused.success and refused.message == "it does not fly; take off first."
        flown.wait(lambda: flown.odometry, "odometry")
        load(2)
        flown.wait(
            lambda: (
                flown.ask(
                    Takeoff, "takeoff", height=1.0, duration=Duration(sec=2, nanosec=500_000_000)
                ).success
            ),
            "it to arm",
        )
        flown.wait(lambda: flown.odometry.pose.pose.position.z > 0.8, "it to be up")
        beside = flown.ask(
            GoTo, "go_to", relative=True, goal=Point(x=0.3), duration=Duration(sec=2)
        )
        assert beside.success and beside.message == ""
        assert flown.ask(Land, "land", duration=Duration(sec=2)).success
        flown.wait(lambda: flown.verdicts, "the verdict")
    (verdict,) = flown.verdicts
    assert verdict["landed"], verdict["why"]
    assert verdict["reported_lost"] is None and verdict["phases"]["air"]["rmse"] < 0.3


@pytest.mark.slow
def test_a_rover_drives_by_the_nodes_as_it_does_in_lockstep(tmp_path):
    own, told = ("seed:=3", "mission:=true", "vehicle:=rover"), []
    for name, value in rover.FILTER.items():
        told.append(f"{name}:={str(value).lower()}")
    with hall(tmp_path, *own, ekf=told) as driven:
        driven.wait(lambda: driven.verdicts, "the verdict")
    (verdict,) = driven.verdicts
    assert verdict["arrived"], verdict["why"]
    world = replace(WORLDS["hall"], sensors=rover.SENSOR_NAMES)
    task = Task(world, 3, "place", config=FilterConfig(**rover.FILTER), path=Waypoints())
    lockstep = verdict_of(rover.drive(task))
    one_turn = SPEED * DT  # m, error of odometry that comes one turn later
    for name in ("tracking", "farthest", "place"):
        assert verdict[name] == pytest.approx(lockstep[name], abs=one_turn)
