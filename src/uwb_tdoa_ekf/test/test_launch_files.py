# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The launch files with the real launch and launch_ros, and the nodes that they start."""

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import threading
import time

from programs import run
import pytest
import yaml

pytest.importorskip("uwb_tdoa_msgs.msg")

from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.parameter import parameter_value_to_python  # noqa: E402
from rclpy.parameter_client import AsyncParameterClient  # noqa: E402
from real_launch import PATIENCE, WHY_NOT, Launch, ros2  # noqa: E402
from rig import make_rig, recording, stamp  # noqa: E402, F401
from rosgraph_msgs.msg import Clock  # noqa: E402

from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))]
READY = "ekf_node]: ready"
INTEGRATOR = """
from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node, PushRosNamespace


def generate_launch_description():
    told = {"tags": ["one", "two"], "body_frame": "drone", "model_file": ""}
    node = Node(package="uwb_tdoa_ekf", executable="localization_node", namespace="robot", parameters=[told], output="screen")
    ours = IncludeLaunchDescription(PythonLaunchDescriptionSource(r"TAGS"), launch_arguments={"tags": r"FILE", "processes": "1"}.items())
    return LaunchDescription([node, GroupAction([PushRosNamespace("hall"), ours])])
"""


STOCK = """
from launch import LaunchDescription
from launch.actions import ExecuteProcess
from uwb_tdoa_ekf.launching_actions import actions

def generate_launch_description():
    code = "import rclpy; rclpy.init(); rclpy.create_node('stock'); rclpy.shutdown()"
    return LaunchDescription([*actions([], "false", "shutdown", "LOCALHOST", "false"), ExecuteProcess(cmd=["python3", "-c", code])])
"""
PROFILES = """<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <log><use_default>FALSE</use_default><consumer><class>FileConsumer</class>
    <property><name>filename</name><value>{}</value></property><property><name>append</name><value>FALSE</value></property>
  </consumer></log>
</dds>"""


@pytest.fixture
def launch(tmp_path):
    """Return launch(*words, rig=None, path=()), which starts a Launch. It ends with the test.

    rig : a Rig that waits for nodes of this launch.
    """
    started = []

    def make(*words, rig=None, **options):
        folder = tmp_path / f"launch{len(started)}"
        folder.mkdir()
        started.append(Launch(folder, *map(str, words), **options))
        if rig:
            rig.watch(started[-1])
        return started[-1]

    yield make
    for each in started:
        each.close()


def left_behind(launched):
    """Return the names of all files in its folder for temporary files."""
    return sorted(path.name for path in launched.temporary.iterdir())


@contextmanager
def ticking(publisher, epoch):
    """Publish /clock from an epoch on."""
    over = threading.Event()

    def tick():
        t = 0.0
        while not over.wait(0.05):
            t += 0.05
            publisher.publish(Clock(clock=stamp(t, epoch)))

    thread = threading.Thread(target=tick)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def ends_well(launched):
    """Check that Ctrl-C ends all nodes cleanly and no temporary files remain."""
    launched.interrupt()
    assert "has died" not in launched.said, launched.said
    assert left_behind(launched) == []


def values_of(rig, node, *names):
    """Return the values of parameters of a node, given its absolute name."""
    client = AsyncParameterClient(rig.node, node)
    rig.wait(client.services_are_ready, f"the services of {node}")
    values = rig.answer(lambda: client.get_parameters(names), node).values
    return [parameter_value_to_python(value) for value in values]


def reliable(file, namespace):
    """Write a parameter file with reliable streams for both nodes."""
    ends = (
        "uwb/tdoa.subscription",
        "imu/data.subscription",
        "odometry.subscription",
        "uwb/tdoa_corrected.subscription",
    )
    told = {
        f"/{namespace}/{name}": {kind: {"reliability": "reliable"}}
        for name, kind in (end.rsplit(".", 1) for end in ends)
    }
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"qos_overrides": told}}}))
    return file


def file_of(flight, folder):
    flight.anchors.to_yaml(folder / "anchors.yaml")
    return folder / "anchors.yaml"


def tags_file(folder, text):
    (folder / "tags.yaml").write_text(text)
    return folder / "tags.yaml"


def test_one_tag_on_simulated_time_from_start_over_a_crash_to_ctrl_c(make_rig, launch, tmp_path):
    # The epoch makes these diagnostics newer than all earlier ones.
    flight, rig, epoch = (recording(2.0), make_rig(latched=False), int(time.time()) + 10**6)
    file = reliable(tmp_path / "reliable.yaml", rig.namespace)
    clock = rig.node.create_publisher(Clock, "/clock", 10)
    launched = launch(
        "uwb_tdoa_ekf",
        "tdoa.launch.py",
        f"namespace:={rig.namespace}",
        f"anchors_file:={file_of(flight, tmp_path)}",
        f"bias_params:={file}",
        f"ekf_params:={file}",
        "publish_tf:=odom",
        "use_sim_time:=true",
        "world_frame:=hall: 1 # 'ä'",
        rig=rig,
    )
    launched.wait(
        "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, "
        f"ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']}: heard by nodes on this machine"
    )
    with ticking(clock, epoch):
        rig.meet("bias_node", "ekf_node")
        rig.play(flight, epoch)
        assert values_of(
            rig, f"/{rig.namespace}/ekf_node", "publish_tf", "use_sim_time", "world_frame"
        ) == ["odom", True, "hall: 1 # 'ä'"]
        assert rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))["used"] > 0
        # A node that crashes is started again, with its parameters.
        os.kill(launched.pid_of("ekf_node"), signal.SIGKILL)
        launched.wait("ekf_node has ended with exit code -9: it is started again in 1 s")
        launched.wait(READY, 2)
        assert values_of(rig, f"/{rig.namespace}/ekf_node", "publish_tf") == ["odom"]
    assert {message.header.frame_id for message in rig.odometry} == {"hall: 1 # 'ä'"} and len(
        rig.odometry
    ) > 200
    launched.interrupt()
    assert launched.said.count("has died") == 1, launched.said
    assert left_behind(launched) == []


def test_several_tags_each_with_its_own_parameters(make_rig, launch, tmp_path):
    flight, rig = recording(2.0), make_rig(latched=False)
    file_of(flight, tmp_path)
    file = tags_file(
        tmp_path,
        (
            "anchors_file: anchors.yaml\nmodel_file: ''\ntags: {tag0: {}, tag1: {tdoa_std: 0.3, "
            "body_frame: drone}}"
        ),
    )
    launched = launch("uwb_tdoa_ekf", "tags.launch.py", f"tags:={file}", rig=rig)
    rig.meet("bias_node", "ekf_node")
    rig.play(flight)
    rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    assert len(rig.odometry) > 200 and {message.child_frame_id for message in rig.odometry} == {
        "tag0/base_link"
    }
    default = FilterConfig().tdoa_std
    for tag, told in {"tag0": ["tag0/base_link", default], "tag1": ["drone", 0.3]}.items():
        assert values_of(rig, f"/{tag}/ekf_node", "body_frame", "tdoa_std") == told
        assert values_of(rig, f"/{tag}/bias_node", "anchors_file") == [
            str(tmp_path / "anchors.yaml")
        ]
    ends_well(launched)


def test_list_parameters_of_a_launch_file_of_others_and_ours_in_their_namespace(
    make_rig, launch, tmp_path
):
    rig = make_rig()
    file = tags_file(tmp_path, "model_file: ''\ntags: {tag0: {tdoa_std: 0.3}}")
    ours = Path(__file__).resolve().parents[1] / "launch" / "tags.launch.py"
    (tmp_path / "robot.launch.py").write_text(
        INTEGRATOR.replace("TAGS", str(ours)).replace("FILE", str(file))
    )
    launched = launch(tmp_path / "robot.launch.py", rig=rig)
    assert values_of(rig, "/robot/localization_node", "tags") == [["one", "two"]]
    assert values_of(rig, "/robot/two/ekf_node", "body_frame") == ["drone"]
    assert values_of(rig, "/hall/tag0/ekf_node", "tdoa_std", "body_frame") == [
        0.3,
        "tag0/base_link",
    ]
    assert "none of its parameters" not in launched.said
    launched.interrupt()
    assert "has died" not in launched.said
    # These files belong to the node of the other launch file.
    assert all(name.startswith("launch_params_") for name in left_behind(launched))


PLAYER = """#!/bin/sh
# ros2 bag play BAG --clock HZ --delay S --rate R, for those who have no ros2 bag
shift 2
exec {python} -m uwb_tdoa_tools.commands replay "$1" --clock "$3" --rate "$7" --wait-topics imu/data uwb/tdoa --wait-matched 100
"""


def test_a_bag_is_played_on_its_time_and_then_all_ends(make_rig, launch, tmp_path):
    bag = pytest.importorskip("uwb_tdoa_tools.bags.bag")
    rig, heard, player = make_rig(latched=False), [], tmp_path / "bin" / "ros2"
    player.parent.mkdir()
    player.write_text(PLAYER.format(python=os.sys.executable))
    player.chmod(0o755)
    bag.write_bag(recording(6.0), tmp_path / "flight")
    rig.node.create_subscription(Odometry, "/odometry", heard.append, 1000)
    launched = launch(
        "uwb_tdoa_ekf", "bag.launch.py", f"bag:={tmp_path / 'flight'}", path=[player.parent]
    )
    rig.wait(lambda: len(heard) > 100 or launched.over, "the odometry of the bag")
    assert len(heard) > 100, launched.said
    assert (
        launched.ended() == 0
        and "shutting down" in launched.said
        and "has died" not in launched.said
    ), launched.said
    assert left_behind(launched) == []
    launched = launch("uwb_tdoa_ekf", "bag.launch.py", "bag:=/nowhere", path=[player.parent])
    assert launched.ended() == 1 and "ros2 bag play has ended with exit code 2" in launched.said


def test_a_node_that_refuses_what_it_is_given_is_not_started_again(launch):
    launched = launch("uwb_tdoa_ekf", "tdoa.launch.py", "effects_file:=/nowhere.yaml")
    # Either node may print it: with shutdown, the first to end stops the other.
    launched.wait("_node: error: /nowhere.yaml")
    launched.wait(
        "_node refuses what it is given (see its message above), and is not started again"
    )
    assert launched.ended() == 1 and left_behind(launched) == []


def test_arguments_are_listed_and_what_is_wrong_with_one_is_said(launch):
    wrong = {
        "tags:=/nowhere.yaml": "/nowhere.yaml: cannot be read as YAML",
        "respawn:=maybe": "respawn",
    }
    files = "tdoa.launch.py", "tags.launch.py", "bag.launch.py"
    refused = [
        launch("uwb_tdoa_ekf", "tags.launch.py" if "tags" in word else "tdoa.launch.py", word)
        for word in wrong
    ]
    listed = [launch("uwb_tdoa_ekf", file, "--show-args") for file in files]
    for launched, said in zip(refused, wrong.values()):
        assert launched.ended() == 1 and said in launched.said and left_behind(launched) == []
    for launched in listed:
        assert launched.ended() == 0 and "respawn" in launched.said and "on_exit" in launched.said


def param(rig, *words):
    """Run `ros2 param ...` until it finds the node; return its CompletedProcess."""
    made = []

    def found():
        command = [*ros2(), "param", *words[:1], "--no-daemon", "--spin-time", "1", *words[1:]]
        made.append(run(*command, timeout=PATIENCE))
        return "Node not found" not in made[-1].stdout + made[-1].stderr

    rig.wait(found, f"ros2 param to find {words[1]}")
    return made[-1]


def test_a_dump_of_parameters_goes_back_into_the_node_and_into_its_launch_file(
    make_rig, launch, tmp_path
):
    rig, dumps = make_rig(), []
    nodes = {node: f"/{rig.namespace}/{node}_node" for node in ("bias", "ekf")}
    words = "uwb_tdoa_ekf", "tdoa.launch.py", f"namespace:={rig.namespace}"
    launched = launch(*words, "publish_tf:=none", rig=rig)
    for back in (False, True):
        if back:
            ends_well(launched)
            launched = launch(
                *words, *(f"{node}_params:={tmp_path / node}.yaml" for node in nodes), rig=rig
            )
        for node, name in nodes.items():
            values_of(rig, name, "use_sim_time")  # the node is there
            dump = param(rig, "dump", name)
            dumps.append(yaml.safe_load(dump.stdout))
            assert len(dumps[-1][name]["ros__parameters"]) > 5, dump.stderr
            (tmp_path / f"{node}.yaml").write_text(dump.stdout)
            if not back:
                loaded = param(rig, "load", name, tmp_path / f"{node}.yaml")
                assert loaded.returncode == 0 and loaded.stderr == ""
                assert loaded.stdout.count("successful") == len(values_below(dumps[-1]))
    assert (
        dumps[:2] == dumps[2:] and dumps[1][nodes["ekf"]]["ros__parameters"]["publish_tf"] == "none"
    )
    ends_well(launched)


def values_below(part):
    """Return all values in nested mappings."""
    return [
        value
        for each in part.values()
        for value in (values_below(each) if isinstance(each, dict) else [each])
    ]


def test_what_is_launched_obeys_no_profiles_of_the_present_folder(launch, tmp_path, monkeypatch):
    """This includes programs of other packages, such as rviz2.

    With the profile in this folder, Fast DDS would use the file as its log and empty it.
    """
    (tmp_path / "bashrc").write_text("precious\n")
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").write_text(PROFILES.format(tmp_path / "bashrc"))
    (tmp_path / "stock.launch.py").write_text(STOCK)
    monkeypatch.delenv("SKIP_DEFAULT_XML_FILE", raising=False)
    monkeypatch.chdir(tmp_path)
    launched = launch(tmp_path / "stock.launch.py")
    assert launched.ended() == 0 and "process has finished cleanly" in launched.said, launched.said
    assert (tmp_path / "bashrc").read_text() == "precious\n"
