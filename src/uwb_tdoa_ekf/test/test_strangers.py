"""What anybody on the network can do to the nodes: each test is an attack."""

import math

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from flights import corners  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically  # noqa: E402
from rig import make_rig, recording  # noqa: E402, F401
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.foundation.anchors import MOST, Anchors  # noqa: E402
from uwb_tdoa_bias.foundation.ros_anchors import ANCHORS_QOS, anchors_to_message  # noqa: E402
from uwb_tdoa_bias.foundation.ros_frames import TF_STATIC_QOS  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa  # noqa: E402

LATCHED = {"/tf_static": TF_STATIC_QOS, "uwb/anchors": ANCHORS_QOS}
NAN, INF = math.nan, math.inf


class Stranger:
    """Publishes on the topics of a Rig, and calls services of its nodes."""

    def __init__(self, rig):
        self._rig, self._publishers = rig, {}

    def publish(self, topic, *messages):
        """Publish, once somebody listens."""
        if topic not in self._publishers:
            publisher = self._publishers[topic] = self._rig.node.create_publisher(
                type(messages[0]), topic, LATCHED.get(topic, 100)
            )
            self._rig.wait(publisher.get_subscription_count, f"{topic} to be heard")
        for message in messages:
            self._publishers[topic].publish(message)

    def call(self, kind, service, **request):
        """The response of a service of a node, which it must give."""
        client = self._rig.node.create_client(kind, f"/{self._rig.namespace}/{service}")
        self._rig.wait(client.service_is_ready, f"{service} to be offered")
        return self._rig.answer(lambda: client.call_async(kind.Request(**request)), service)

    def set(self, node, name, **value):
        """SetParametersResult of a parameter, whose value has these fields."""
        parameter = Parameter(name=name, value=ParameterValue(**value))
        return self.call(SetParameters, f"{node}/set_parameters", parameters=[parameter]).results[0]

    def alive(self, *nodes):
        """Whether nodes still answer."""
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


@pytest.mark.parametrize("node", ["ekf_node", "bias_node"])
def test_no_transform_ends_a_node(make_rig, tmp_path, node):
    (tmp_path / "effects.yaml").write_text("effects: {anchor_delay: {values: {10: 0.1}}}")
    rig = make_rig()
    (process,) = rig.start(node, bias_node=["-p", f"effects_file:={tmp_path / 'effects.yaml'}"])
    stranger = Stranger(rig)
    rig.send_anchors(corners())
    odd = [
        (0.0,) * 4,
        (NAN,) * 4,
        (1e308, 1e308, 0.0, 0.0),
        (1e-320, 0.0, 0.0, 0.0),
        (INF, 0.0, 0.0, 1.0),
    ]
    for k, q in enumerate(odd):
        stranger.publish("/tf_static", transform(q, child=f"sensor{k}"))
    for k, p in enumerate((1e308, -1e200, INF), len(odd)):
        stranger.publish("/tf_static", transform((0.0, 0.0, 0.0, 1.0), (p, 0.0, 0.0), f"sensor{k}"))
    for k in range(len(odd) + 3):
        message = Imu() if node == "ekf_node" else Tdoa(anchor_a=10, anchor_b=11)
        rig.send(
            "imu/data" if node == "ekf_node" else "uwb/tdoa", message, 0.01 * k, frame=f"sensor{k}"
        )
    counted = {"IMU_samples_received" if node == "ekf_node" else "received": len(odd) + 3}
    rig.counts(node, **counted)
    assert stranger.alive(node) and not any("Traceback" in line for line in process.lines)


def test_no_pose_and_no_parameter_ends_a_node_and_no_flood_of_poses_fills_it(make_rig):
    rig = make_rig()
    (process,) = rig.start("ekf_node")
    stranger = Stranger(rig)
    rig.send_anchors(corners())
    rig.counts("ekf_node", state="starting")
    poses = rig.pose_publisher(process)

    def refused(text, *told):
        """Whether the node has said so; else these poses are published: few at a time, because its
        queue holds no more.
        """
        for message in told:
            poses.publish(message)
        assert stranger.alive("ekf_node")
        return any(text in line for line in process.lines)

    odd = pose(1e308 * np.eye(6)), pose(np.full((6, 6), 1e300)), pose(np.full((6, 6), 1e20))
    rig.wait(
        lambda: refused("initialpose: not taken: it holds numbers", *odd), "odd poses to be refused"
    )
    rig.wait(
        lambda: refused("100 wait for their time already", *[pose(np.eye(6), 2_000_000_000)] * 5),
        "too many poses to be refused",
    )
    for kind in (SetParameters, SetParametersAtomically):
        service = "set_parameters" if kind is SetParameters else "set_parameters_atomically"
        stranger.call(
            kind,
            f"ekf_node/{service}",
            parameters=[Parameter(name="tdoa_std", value=ParameterValue(type=200))],
        )
    rig.wait(
        lambda: any("set_parameters: a request cannot be read" in line for line in process.lines),
        "a request to be refused",
    )
    many = stranger.call(
        SetParameters, "ekf_node/set_parameters", parameters=[Parameter(name="nothing")] * 1000
    )
    assert not many.results
    listed = stranger.call(ListParameters, "ekf_node/list_parameters", prefixes=["t"] * 1000)
    assert (
        not listed.result.names
        and stranger.call(
            ListParameters, "ekf_node/list_parameters", prefixes=["qos_overrides"]
        ).result.names
    )
    text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 10_000_000)
    stranger.call(
        SetParameters,
        "ekf_node/set_parameters",
        parameters=[Parameter(name="tdoa_std", value=text)],
    )
    assert stranger.alive("ekf_node") and not any("Traceback" in line for line in process.lines)


def test_more_anchors_than_a_message_may_hold_are_refused(make_rig):
    rig = make_rig()
    rig.start("ekf_node")
    stranger, rng = Stranger(rig), np.random.default_rng(1)
    rig.send_anchors(Anchors.from_positions(rng.uniform(0.0, 50.0, (MOST, 3))))
    rig.counts("ekf_node", state="starting")
    message = anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.anchors = [type(message.anchors[0])(id=k) for k in range(MOST + 1)]
    rig.send_anchors(message)
    rig.wait(
        lambda: rig.values("ekf_node").get("unreadable on uwb/anchors", "0")[0] == "1",
        "them to be refused",
    )
    assert stranger.alive("ekf_node")


def test_a_frozen_node_takes_no_other_parameter_anchors_transform_or_pose(make_rig):
    rig, flight = make_rig(), recording(2.0)
    (process,) = rig.start("ekf_node", ekf_node=["-p", "frozen:=true"])
    stranger = Stranger(rig)
    first, other = transform((0.0, 0.0, 0.0, 1.0)), transform((1.0, 0.0, 0.0, 0.0))
    stranger.publish("/tf_static", first)
    rig.send_anchors(flight.anchors)
    rig.counts("ekf_node", state="starting")
    poses = rig.pose_publisher(
        process
    )  # before the start a pose may be told: these are refused for their frame only
    rig.play(flight, send_tdoa=rig.send_corrected)
    rig.wait(lambda: rig.odometry, "odometry")
    rig.counts("ekf_node", TDOAs_received=len(flight.tdoa), refused_because_frozen=0)

    moved = Anchors(flight.anchors.ids, flight.anchors.positions + 0.5, flight.anchors.orientations)
    double = {"type": ParameterType.PARAMETER_DOUBLE}
    for name, value in (
        ("tdoa_std", {**double, "double_value": 100.0}),
        ("use_sim_time", {"type": 1, "bool_value": True}),
        ("frozen", {"type": 1, "bool_value": False}),
        ("unknown", {"type": 1}),
    ):
        result = stranger.set("ekf_node", name, **value)
        assert (
            not result.successful
            and f"parameter '{name}': refused, because this node is frozen" in result.reason
        )
    assert stranger.set(
        "ekf_node", "tdoa_std", **double, double_value=0.25
    ).successful  # what it is
    reset = stranger.call(Trigger, "ekf_node/reset")
    assert not reset.success and "a reset: refused, because this node is frozen" in reset.message
    assert rig.counts("ekf_node", refused_because_frozen=5)["restarts"] == 0
    rig.send_anchors(flight.anchors)  # the same
    rig.send_anchors(moved)
    rig.counts("ekf_node", refused_because_frozen=6)
    stranger.publish("/tf_static", first, other)
    rig.counts("ekf_node", refused_because_frozen=7)
    poses.publish(pose(np.eye(6)))
    counts = rig.counts("ekf_node", refused_because_frozen=8)
    assert (
        counts["restarts"] == 0
        and rig.values("ekf_node")["state"] == "running"
        and rig.values("ekf_node")["frozen"] == "yes"
    )


def test_what_a_frozen_node_refuses_is_a_warning_once(make_rig, tmp_path):
    rig = make_rig()
    (process,) = rig.start("bias_node", bias_node=["-p", "frozen:=true"])
    stranger = Stranger(rig)
    rig.send_anchors(corners())
    assert not stranger.set("bias_node", "use_sim_time", type=1, bool_value=True).successful
    rig.send_tdoa(0.1, 10, 14, 1.0)
    rig.wait(
        lambda: rig.values("bias_node").get("refused because frozen") == "1", "it to be counted"
    )
    rig.wait(
        lambda: any("refused, because this node is frozen" in line for line in process.lines),
        "a warning",
    )
    rig.send_tdoa(0.2, 10, 14, 1.0)
    rig.wait(
        lambda: rig.fresh_status("bias_node").level == DiagnosticStatus.OK, "the warning to be over"
    )


@pytest.mark.parametrize("frozen", [False, True])
def test_no_peer_fills_the_log(make_rig, frozen):
    """IMU messages, each in a frame with another name of 4 kB, made 298 MB of log in 10 s."""
    rig = make_rig()
    (process,) = rig.start("ekf_node", ekf_node=["-p", f"frozen:={str(frozen).lower()}"])
    stranger = Stranger(rig)
    rig.send_anchors(corners())
    count = 3000
    for k in range(count):
        message = Imu()
        message.header.frame_id, message.header.stamp.sec = f"{k}{'x' * 4000}", 1_700_000_000
        message.header.stamp.nanosec = 1_000_000 * (k % 1000)
        stranger.publish("imu/data", message)
        if k % 100 == 0:
            assert stranger.alive("ekf_node")
    rig.wait(
        lambda: rig.values("ekf_node").get("IMU samples received", "0") != "0", "them to be heard"
    )
    assert stranger.alive("ekf_node")
    lines = list(process.lines)
    assert sum(map(len, lines)) < 1_000_000 and max(map(len, lines)) < 3000
