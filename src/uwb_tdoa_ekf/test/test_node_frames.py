# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ekf_node and bias_node with the frames, parameters and services of a robot.

Each test starts the nodes once and checks many properties.
"""

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from dataclasses import replace  # noqa: E402

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.duration import Duration  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from rig import STREAMS, make_rig, positions, recording, seconds_of, stamp  # noqa: E402, F401
from scipy.spatial.transform import Rotation  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.common.flight import Imu  # noqa: E402
from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm  # noqa: E402
from uwb_tdoa_bias.effects.sensor import AccelBias  # noqa: E402
from uwb_tdoa_bias.effects.tag import TagLeverArm  # noqa: E402
from uwb_tdoa_bias.ros.frames import TF_QOS, TF_STATIC_QOS  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

# attitude of the IMU on the body: upside down
TURN = Rotation.from_euler("ZYX", [90.0, 0.0, 180.0], degrees=True)
ARM = [0.05, 0.0, 0.1]  # m, position of the antenna on the body


def transform(parent, child, p=(0.0, 0.0, 0.0), q=(0.0, 0.0, 0.0, 1.0), t=None):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    if t is not None:
        message.header.stamp = stamp(t)
    v, r = message.transform.translation, message.transform.rotation
    (v.x, v.y, v.z), (r.x, r.y, r.z, r.w) = map(float, p), map(float, q)
    return message


def call(rig, kind, service, request):
    client = rig.node.create_client(kind, service)
    rig.wait(client.service_is_ready, f"{service} to be there")
    return rig.answer(lambda: client.call_async(request), service)


def test_sensors_in_frames_of_their_own_among_frames_that_move(make_rig, tmp_path):
    """The results agree with the offline engine.

    The IMU is turned, the antenna is on an arm, and another node publishes odom -> base_link.
    Anchors and effects come from files.
    """
    flight = recording(3.0)
    flight.anchors.to_yaml(tmp_path / "anchors.yaml")
    straight = {
        "shape": "line",
        "covariate": "height",
        "knots": (0.0, 3.0),
        "values": {"c0": 0.1, "c1": 0.4},
    }
    known = (
        AccelBias({"x": 0.4}),
        SmoothTerm(channel="accel.y", **straight),
        SmoothTerm(form="common", **straight),
    )
    EffectSet(known).to_yaml(tmp_path / "effects.yaml")
    file = [
        "-p",
        f"anchors_file:={tmp_path / 'anchors.yaml'}",
        "-p",
        f"effects_file:={tmp_path / 'effects.yaml'}",
    ]
    rig = make_rig()
    static = rig.node.create_publisher(TFMessage, "/tf_static", TF_STATIC_QOS)
    moving = rig.node.create_publisher(TFMessage, "/tf", TF_QOS)
    arms = [
        transform("base_link", "imu_link", q=TURN.as_quat()),
        transform("base_link", "uwb", ARM),
    ]
    static.publish(TFMessage(transforms=arms))
    config = FilterConfig(initial_yaw=0.2, initial_yaw_std=0.3)  # a known yaw, for transforms
    told = "publish_tf:=odom", "initial_yaw:=0.2", "initial_yaw_std:=0.3"
    of_ekf = [*file, *(word for value in told for word in ("-p", value))]
    rig.start("bias_node", "ekf_node", bias_node=file, ekf_node=of_ekf)
    rig.wait(
        lambda: static.get_subscription_count() == 2 and moving.get_subscription_count() >= 1,
        "TF to be heard",
    )
    # A matched subscription gets latched messages a little later.
    assert static.wait_for_all_acked(Duration(seconds=60.0))
    effects = EffectSet((*known, TagLeverArm(values=dict(zip("xyz", ARM)))))
    flight = effects.effects[-1].inject(flight)
    turned = TURN.inv()
    mounted = replace(
        flight, imu=Imu(flight.imu.t, turned.apply(flight.imu.gyro), turned.apply(flight.imu.accel))
    )

    send, course = rig.send, []

    def in_frames(topic, message, t, frame="base_link", **epoch):
        # odom drifts away from the map.
        if topic == "imu/data" and round(t * 200.0) % 10 == 0:
            course.append(t)
            q = Rotation.from_euler("z", 0.1 * t).as_quat()
            moving.publish(
                TFMessage(transforms=[transform("odom", "base_link", (t, 0.5 * t, 0.0), q, t)])
            )
        send(topic, message, t, {"imu/data": "imu_link", "uwb/tdoa": "uwb"}[topic], **epoch)

    rig.send = in_frames
    rig.play(mounted)
    ekf = rig.counts(
        "ekf_node", IMU_samples_received=len(flight.imu), TDOAs_received=len(flight.tdoa)
    )
    assert ekf["late"] == ekf["imu_late"] == 0
    assert {entry.key: entry.value for entry in rig.fresh_status("bias_node").values}[
        "model"
    ] == effects.name
    expected = run_offline(flight, config, Corrector(flight.anchors, effects)).odometry
    place = np.searchsorted(expected.t, [seconds_of(m.header.stamp) for m in rig.odometry])
    apart = np.linalg.norm(positions(rig.odometry) - expected.p[place], axis=1)
    assert len(apart) > 300 and apart.max() < 0.01

    # map -> odom and odom -> base_link together give the odometry of the same stamp.
    poses = {
        (m.header.stamp.sec, m.header.stamp.nanosec): m.pose.pose.position for m in rig.odometry
    }
    leading = [t for m in rig.received["/tf"] for t in m.transforms if t.child_frame_id == "odom"]
    assert len(leading) > 300 and {t.header.frame_id for t in leading} == {"map"}
    for message in leading[::20]:
        t = seconds_of(message.header.stamp)
        if t > course[-1]:
            continue
        v, q = message.transform.translation, message.transform.rotation
        led = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([t, 0.5 * t, 0.0]) + [v.x, v.y, v.z]
        p = poses[message.header.stamp.sec, message.header.stamp.nanosec]
        # odom -> base_link comes only every 50 ms, so it may be missing at this stamp.
        np.testing.assert_allclose(led, [p.x, p.y, p.z], atol=0.02)


def test_what_a_robot_does_to_a_running_filter(make_rig):
    """The test covers volatile anchors, both kinds of subscribers and an unknown frame.

    Parameters, initialpose and reset follow in flight.
    """
    flight = recording(2.0)
    rig = make_rig(reliable=False, latched=False)
    counts = {}
    (process,) = rig.start("ekf_node")
    for policy in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        for topic in ("odometry", "uwb/residual"):
            take = lambda _, key=(topic, policy): counts.update({key: counts.get(key, 0) + 1})  # noqa: E731
            rig.node.create_subscription(
                STREAMS[topic], topic, take, QoSProfile(depth=1000, reliability=policy)
            )
    volatile = rig.node.create_publisher(AnchorArray, "uwb/anchors", 1)
    rig.wait(
        lambda: "no anchors" in rig.fresh_status("ekf_node").message, "the node to miss the anchors"
    )

    def repeat_anchors():
        rig.send_anchors(flight.anchors, volatile)
        return "no anchors" not in rig.fresh_status("ekf_node").message

    rig.wait(repeat_anchors, "repeated anchors to be taken")
    rig.play(flight, send_tdoa=rig.send_corrected)
    ekf = rig.counts("ekf_node")
    assert ekf["used"] > 50
    rig.wait(lambda: len(counts) == 4, "all four to have received something")
    for topic in ("odometry", "uwb/residual"):
        assert (
            counts[topic, ReliabilityPolicy.RELIABLE]
            >= counts[topic, ReliabilityPolicy.BEST_EFFORT]
            > 50
        )

    # parameters
    def set_parameter(name, value):
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        return call(rig, SetParameters, "ekf_node/set_parameters", request).results[0]

    number = ParameterValue(type=3, double_value=9.0)
    assert set_parameter("tdoa_std", number).successful
    assert not set_parameter("tdoa_std", ParameterValue(type=3, double_value=-1.0)).successful
    assert "read-only" in set_parameter("workspace_margin", number).reason
    refused = set_parameter("loss", ParameterValue(type=4, string_value="square"))
    assert not refused.successful and "is not one of" in refused.reason
    t = flight.imu.t[-1]
    for k in range(1, 40):
        rig.send_imu(t + 0.005 * k)
        rig.send_corrected(
            t + 0.005 * k,
            *(column[k].item() for column in (flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)),
        )
    rig.wait(lambda: rig.residuals[-1].innovation_variance > 80.0, "the new tdoa_std to count")

    # a pose
    poses = rig.pose_publisher(process)
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = "map", stamp(t + 0.25)
    message.pose.pose.position.x, message.pose.pose.position.y = 1.0, 2.0
    message.pose.covariance = np.diag([0.01, 0.01, 0.0, 0.0, 0.0, 0.01]).ravel()
    poses.publish(message)
    message.header.frame_id = "odom"  # is refused
    poses.publish(message)
    rig.wait(
        lambda: any(
            "initialpose: not taken: its frame is 'odom'" in line for line in process.lines
        ),
        "a refusal",
    )
    for k in range(45, 60):
        rig.send_imu(t + 0.005 * k)
        rig.send_corrected(t + 0.005 * k, 99, 98, 0.0)
    rig.wait(
        lambda: seconds_of(rig.odometry[-1].header.stamp) > t + 0.26, "odometry after the pose"
    )
    np.testing.assert_allclose(positions(rig.odometry[-1:])[0, :2], [1.0, 2.0], atol=0.2)

    # an IMU in an unknown frame
    rig.send("imu/data", rig.imu_message(), t + 0.31, "imu_link")
    unknown = "imu/data is in frame 'imu_link', which /tf_static does not connect with 'base_link'"
    rig.wait(lambda: any(unknown in line for line in process.lines), "it to be named")

    # reset
    answer = call(rig, Trigger, "ekf_node/reset", Trigger.Request())
    assert answer.success
    status = rig.fresh_status("ekf_node")
    values = {entry.key: entry.value for entry in status.values}
    assert (values["restarts"], values["state"]) == ("1", "starting")
    assert status.level != DiagnosticStatus.OK
