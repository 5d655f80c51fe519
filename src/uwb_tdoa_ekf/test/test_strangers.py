# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Attacks that any program on the network can make on the nodes."""

import math

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from flights import corners  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically  # noqa: E402
from rig import make_shared_rig, recording  # noqa: E402, F401
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.common.anchors import MOST, Anchors  # noqa: E402
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, TF_STATIC_QOS, anchors_to_message  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

LATCHED = {"/tf_static": TF_STATIC_QOS, "uwb/anchors": ANCHORS_QOS}
NAN, INF = math.nan, math.inf


class Stranger:
    """Publish on the topics of a Rig and call services of its nodes."""

    def __init__(self, rig):
        self._rig, self._publishers = rig, {}

    def publish(self, topic, *messages):
        """Publish messages as soon as a subscriber is there."""
        if topic not in self._publishers:
            publisher = self._publishers[topic] = self._rig.node.create_publisher(
                type(messages[0]), topic, LATCHED.get(topic, 100)
            )
            self._rig.wait(publisher.get_subscription_count, f"{topic} to be heard")
        for message in messages:
            self._publishers[topic].publish(message)

    def call(self, kind, service, **request):
        """Return the response of a service of a node."""
        client = self._rig.node.create_client(kind, f"/{self._rig.namespace}/{service}")
        self._rig.wait(client.service_is_ready, f"{service} to be offered")
        return self._rig.answer(lambda: client.call_async(kind.Request(**request)), service)

    def set(self, node, name, **value):
        """Set a parameter and return its SetParametersResult.

        value : fields of the ParameterValue.
        """
        parameter = Parameter(name=name, value=ParameterValue(**value))
        return self.call(SetParameters, f"{node}/set_parameters", parameters=[parameter]).results[0]

    def alive(self, *nodes):
        """Return whether the nodes still answer."""
        return all(
            self.call(GetParameters, f"{node}/get_parameters", names=["use_sim_time"]).values
            for node in nodes
        )


def transform(q, p=(0.0, 0.0, 0.0), child="sensor"):
    out = TransformStamped(child_frame_id=child)
    out.header.frame_id = "base_link"
    (
        out.transform.rotation.x,
        out.transform.rotation.y,
        out.transform.rotation.z,
        out.transform.rotation.w,
    ) = q
    out.transform.translation.x, out.transform.translation.y, out.transform.translation.z = p
    return TFMessage(transforms=[out])


def pose(covariance, second=0):
    out = PoseWithCovarianceStamped()
    out.header.frame_id, out.header.stamp.sec, out.pose.pose.orientation.w = "map", second, 1.0
    out.pose.covariance = np.ravel(covariance).astype(float)
    return out


@pytest.fixture(scope="module")
def attacked(make_shared_rig, tmp_path_factory):  # noqa: F811
    """Return (Rig, Stranger, Process of bias_node, Process of ekf_node); the nodes have anchors."""
    file = tmp_path_factory.mktemp("attacked") / "effects.yaml"
    file.write_text("effects: {anchor_delay: {values: {10: 0.1}}}")
    rig = make_shared_rig()
    processes = rig.start("bias_node", "ekf_node", bias_node=["-p", f"effects_file:={file}"])
    rig.send_anchors(corners())
    rig.counts("ekf_node", state="starting")
    return rig, Stranger(rig), *processes


@pytest.fixture(scope="module")
def frozen(make_shared_rig):  # noqa: F811
    """Return (Rig, Stranger, Process of ekf_node).

    The nodes are frozen, with anchors and a transform.
    """
    rig = make_shared_rig()
    arguments = ["-p", "frozen:=true"]
    _, ekf = rig.start("bias_node", "ekf_node", bias_node=arguments, ekf_node=arguments)
    stranger = Stranger(rig)
    stranger.publish("/tf_static", FIRST)
    rig.send_anchors(corners())
    rig.counts("ekf_node", state="starting")
    return rig, stranger, ekf


FIRST, OTHER = transform((0.0, 0.0, 0.0, 1.0)), transform((1.0, 0.0, 0.0, 0.0))


def said(process, text):
    return any(text in line for line in process.lines)


def test_no_pose_and_no_parameter_ends_a_node_and_no_flood_of_poses_fills_it(attacked):
    # Before its first measurement, the node accepts poses of any stamp.
    rig, stranger, _, ekf = attacked
    poses = rig.pose_publisher(ekf)

    def refused(text, *told):
        """Publish poses and return whether the node has printed the text.

        The queue of the node holds few messages, so the caller passes few poses.
        """
        for message in told:
            poses.publish(message)
        assert stranger.alive("ekf_node")
        return said(ekf, text)

    odd = pose(1e308 * np.eye(6)), pose(np.full((6, 6), 1e300)), pose(np.full((6, 6), 1e20))
    rig.wait(
        lambda: refused("initialpose: not taken: it holds numbers", *odd), "odd poses to be refused"
    )
    rig.wait(
        lambda: refused("100 wait for their time already", *[pose(np.eye(6), 2_000_000_000)] * 5),
        "too many poses to be refused",
    )
    odd = [Parameter(name="tdoa_std", value=ParameterValue(type=200))]
    for kind, service in (
        (SetParameters, "set_parameters"),
        (SetParametersAtomically, "set_parameters_atomically"),
    ):
        stranger.call(kind, f"ekf_node/{service}", parameters=odd)
    rig.wait(
        lambda: said(ekf, "set_parameters: a request is not, or only partly"),
        "a request to be refused",
    )

    def listed(*prefixes):
        service = "ekf_node/list_parameters"
        return stranger.call(ListParameters, service, prefixes=prefixes).result.names

    many = [Parameter(name="nothing")] * 1000
    assert not stranger.call(SetParameters, "ekf_node/set_parameters", parameters=many).results
    assert not listed(*["t"] * 1000) and listed("qos_overrides")
    stranger.set(
        "ekf_node",
        "tdoa_std",
        type=ParameterType.PARAMETER_STRING,
        string_value="x" * 10_000_000,
    )
    assert stranger.alive("ekf_node") and not said(ekf, "Traceback")


def test_no_transform_ends_a_node(attacked):
    rig, stranger, *processes = attacked
    odd = [
        (0.0,) * 4,
        (NAN,) * 4,
        (1e308, 1e308, 0.0, 0.0),
        (1e-320, 0.0, 0.0, 0.0),
        (INF, 0.0, 0.0, 1.0),
    ]
    sent = [transform(q, child=f"sensor{k}") for k, q in enumerate(odd)]
    for k, p in enumerate((1e308, -1e200, INF, NAN), len(odd)):
        sent.append(transform((0.0, 0.0, 0.0, 1.0), (p, 0.0, 0.0), f"sensor{k}"))
    for message in sent:
        stranger.publish("/tf_static", message)
    for process in processes:
        rig.wait(lambda process=process: said(process, "is no rotation"), "a refusal")
    for k in range(len(sent)):
        rig.send("imu/data", Imu(), 0.01 * k, frame=f"sensor{k}")
        rig.send("uwb/tdoa", Tdoa(anchor_a=10, anchor_b=11), 0.01 * k, frame=f"sensor{k}")
    rig.counts("ekf_node", IMU_samples_received=len(sent))
    rig.counts("bias_node", received=len(sent))
    assert stranger.alive("ekf_node", "bias_node")
    assert not any(said(process, "Traceback") for process in processes)


def test_more_anchors_than_a_message_may_hold_are_refused(attacked):
    rig, stranger, *_ = attacked
    places = np.random.default_rng(1).uniform(0.0, 50.0, (MOST, 3))
    rig.send_anchors(Anchors.from_positions(places))
    rig.counts("ekf_node", state="starting")
    message = anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.anchors = [type(message.anchors[0])(id=k) for k in range(MOST + 1)]
    rig.send_anchors(message)
    refused = "unreadable on uwb/anchors"
    rig.wait(lambda: rig.values("ekf_node").get(refused, "0")[0] == "1", "them to be refused")
    assert stranger.alive("ekf_node", "bias_node")


def test_a_frozen_node_takes_no_other_parameter_anchors_transform_or_pose(frozen):
    (rig, stranger, process), flight = frozen, recording(2.0)
    # The node accepts poses before its start. It refuses these for their frame only.
    poses = rig.pose_publisher(process)
    rig.play(flight)
    rig.wait(lambda: rig.odometry, "odometry")
    rig.counts("ekf_node", TDOAs_received=len(flight.tdoa), refused_because_frozen=0)

    double = {"type": ParameterType.PARAMETER_DOUBLE}
    for name, value in (
        ("tdoa_std", {**double, "double_value": 100.0}),
        ("use_sim_time", {"type": 1, "bool_value": True}),
        ("frozen", {"type": 1, "bool_value": False}),
        ("unknown", {"type": 1}),
    ):
        result = stranger.set("ekf_node", name, **value)
        assert not result.successful
        assert f"parameter '{name}': refused, because this node is frozen" in result.reason
    same = stranger.set("ekf_node", "tdoa_std", **double, double_value=0.25)
    assert same.successful  # the value is unchanged
    reset = stranger.call(Trigger, "ekf_node/reset")
    assert not reset.success and "a reset: refused, because this node is frozen" in reset.message
    assert rig.counts("ekf_node", refused_because_frozen=5)["restarts"] == 0
    rig.send_anchors(flight.anchors)  # the same anchors
    rig.send_anchors(flight.anchors.at(flight.anchors.positions + 0.5))
    rig.counts("ekf_node", refused_because_frozen=6)
    stranger.publish("/tf_static", FIRST, OTHER)
    rig.counts("ekf_node", refused_because_frozen=7)
    poses.publish(pose(np.eye(6)))
    assert rig.counts("ekf_node", refused_because_frozen=8)["restarts"] == 0
    values = rig.values("ekf_node")
    assert (values["state"], values["frozen"]) == ("running", "yes")


def test_what_a_frozen_node_refuses_is_a_warning_once(frozen):
    rig, stranger, _ = frozen
    before = rig.counts("bias_node")["refused because frozen"]
    assert not stranger.set("bias_node", "use_sim_time", type=1, bool_value=True).successful
    rig.counts("bias_node", refused_because_frozen=before + 1)
    (bias,) = (process for name, process in rig._processes.items() if name == "bias_node")
    rig.wait(lambda: said(bias, "refused, because this node is frozen"), "a warning")
    rig.send_tdoa(3.0, 10, 14, 1.0)
    rig.wait(
        lambda: "frozen" not in rig.fresh_status("bias_node").message, "the warning to be over"
    )


@pytest.mark.parametrize("nodes", ["attacked", "frozen"])
def test_no_peer_fills_the_log(request, nodes):
    """IMU messages in ever new frames with names of 4 kB once made 298 MB of log in 10 s."""
    rig, stranger, *_, process = request.getfixturevalue(nodes)
    before, heard = len(process.lines), rig.counts("ekf_node")["IMU samples received"]
    for k in range(3000):
        message = Imu()
        message.header.frame_id, message.header.stamp.sec = f"{k}{'x' * 4000}", 1_700_000_000
        message.header.stamp.nanosec = 1_000_000 * (k % 1000)
        stranger.publish("imu/data", message)
        if k % 100 == 0:
            assert stranger.alive("ekf_node")

    def arrived():
        return int(rig.values("ekf_node").get("IMU samples received", "0")) > heard

    rig.wait(arrived, "them to be heard")
    assert stranger.alive("ekf_node")
    lines = process.lines[before:]
    assert sum(map(len, lines)) < 1_000_000 and max(map(len, lines), default=0) < 3000
