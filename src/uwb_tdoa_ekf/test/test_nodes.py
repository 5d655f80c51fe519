# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes, over topics: both, each alone, and with what a robot does to them."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
import re

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus
from flights import corners, kept, with_sensors
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import known_answer
import numpy as np
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rig import (  # noqa: F401
    MODULES,
    OUTPUTS,
    PATIENCE,
    STREAMS,
    make_rig,
    positions,
    recording,
    seconds_of,
    stamp,
    vector,
)
from rovers import HEIGHT, drive
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.common.anchors import FlyableVolume
from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD, Corrector
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.sensor import AccelBias
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_bias.ros.anchors import TF_QOS, TF_STATIC_QOS, anchors_to_message
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import poses_of, rows_of, to_odometry
from uwb_tdoa_msgs.msg import AnchorArray, TdoaCorrected, TdoaResidual

# --- nodes ---


pytestmark = pytest.mark.slow  # starts nodes

SOURCES = Path(__file__).resolve().parents[2]
EFFECTS = (
    "effects: {anchor_delay: {values: {10: 0.1, 14: -0.05}}, tag_lever_arm: {values: {x: 0.05, z: "
    "0.1}}}"
)


def quaternion(q):
    return q.x, q.y, q.z, q.w


@pytest.mark.parametrize(
    ("what", "processes"),
    [("effects", 2), ("network", 1)],
)
def test_odometry_is_that_of_the_offline_engine(make_rig, tmp_path, what, processes):
    flight = recording()
    heard = np.abs(flight.tdoa.t - 2.0) > 0.06  # no TDOAs, for longer than a pose lag
    doubt = np.where(np.arange(len(flight.tdoa)) % 5, 0.0, 0.5)  # m^2, variance that the tag states
    flight = replace(flight, tdoa=kept(replace(flight.tdoa, variance=doubt), heard))
    model = known_answer.write(tmp_path)
    effects = tmp_path / "effects.yaml"
    effects.write_text(EFFECTS)
    parameters, corrector = {
        "effects": (
            ["-p", f"effects_file:={effects}"],
            Corrector(flight.anchors, EffectSet.from_yaml(effects)),
        ),
        "network": (
            [
                "--params-file",
                f"{SOURCES}/uwb_tdoa_bias/config/bias_node.yaml",
                "-p",
                f"model_file:={model}",
            ],
            Corrector(flight.anchors, model=Network(model)),
        ),
    }[what]
    config, told = FilterConfig(), ["--params-file", f"{SOURCES}/uwb_tdoa_ekf/config/ekf_node.yaml"]
    rig = make_rig()
    if processes == 2:
        rig.start("bias_node", "ekf_node", bias_node=parameters, ekf_node=told)
    else:
        rig.start("localization_node", localization_node=[*told, *parameters])
    rig.send_anchors(flight.anchors)
    rig.play(flight)
    ekf = rig.counts(
        "ekf_node", IMU_samples_received=len(flight.imu), TDOAs_received=len(flight.tdoa)
    )
    bias = rig.counts("bias_node", received=len(flight.tdoa))
    expected = run_offline(flight, config, corrector)

    # Nothing is lost, nothing is late, and the accounts add up.
    assert ekf["used"] + ekf["rejected"] + ekf["startup"] + ekf["waiting"] == len(flight.tdoa)
    assert (
        ekf["late"]
        == ekf["invalid"]
        == ekf["imu_late"]
        == ekf["imu_invalid"]
        == ekf["restarts"]
        == 0
    )
    assert ekf["imu_used"] + ekf["imu_waiting"] == len(flight.imu)
    assert bias["published"] == bias["received"] == len(rig.corrected) == len(flight.tdoa)
    assert bias["waiting"] == bias["dropped"] == bias["released before their pose"] == 0

    # The corrections are the same.
    np.testing.assert_allclose([m.bias for m in rig.corrected], expected.bias, atol=1e-6)
    assert [m.raw for m in rig.corrected] == flight.tdoa.d.tolist()
    assert [m.variance for m in rig.corrected] == flight.tdoa.variance.tolist()
    assert [m.raw - m.bias for m in rig.corrected] == [m.corrected for m in rig.corrected]
    models = {"effects": {"anchor_delay+tag_lever_arm"}, "network": {"none", "known_answer"}}
    assert {m.model for m in rig.corrected} == models[what]
    assert np.ptp(expected.bias) > 0.05

    # The odometry is the same, except for the part that still waits.
    odometry = expected.odometry
    n = len(rig.odometry)
    assert len(odometry) - 3 <= n <= len(odometry) and n > 500
    np.testing.assert_array_equal(
        [seconds_of(m.header.stamp) for m in rig.odometry], odometry.t[:n]
    )
    poses, twists = [m.pose.pose for m in rig.odometry], [m.twist.twist for m in rig.odometry]
    velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
    np.testing.assert_allclose(positions(rig.odometry), odometry.p[:n], atol=1e-6)
    np.testing.assert_allclose(
        [quaternion(p.orientation) for p in poses], odometry.q[:n], atol=1e-6
    )
    np.testing.assert_allclose([vector(t.linear) for t in twists], velocity[:n], atol=1e-6)
    gyro = (
        flight.imu.gyro[np.searchsorted(flight.imu.t, odometry.t, side="right") - 1]
        - odometry.gyro_bias
    )
    np.testing.assert_allclose([vector(t.angular) for t in twists], gyro[:n], atol=1e-6)
    pose, twist = (
        np.array([getattr(m, name).covariance for m in rig.odometry]).reshape(n, 6, 6)
        for name in ("pose", "twist")
    )
    np.testing.assert_allclose(pose, covariance[:n, :6, :6], atol=1e-6)
    np.testing.assert_allclose(twist[:, :3, :3], covariance[:n, 6:, 6:], atol=1e-6)
    assert {(m.header.frame_id, m.child_frame_id) for m in rig.odometry} == {("map", "base_link")}

    # This flight is too short to show the yaw: there is no transform. Residuals agree as well.
    assert (poses_of(odometry)[-1] > LARGEST_YAW_STD).all() and not rig.received["/tf"]
    outcome = {t: i for i, t in enumerate(expected.residuals.t)}
    for residual in rig.residuals:
        i = outcome[seconds_of(residual.header.stamp)]
        assert (residual.anchor_a, residual.anchor_b) == (
            expected.residuals.a[i],
            expected.residuals.b[i],
        )
        assert residual.verdict == expected.residuals.verdict[i]
        np.testing.assert_allclose(residual.innovation, expected.residuals.innovation[i], atol=1e-6)
        np.testing.assert_allclose(residual.weight, expected.residuals.weight[i], atol=1e-6)
    assert len(rig.residuals) + ekf["waiting"] == len(flight.tdoa)

    if what == "effects":
        return
    # A recording that starts again gives the same results again.
    rig.play(flight)
    again = rig.counts(
        "ekf_node", IMU_samples_received=2 * len(flight.imu), TDOAs_received=2 * len(flight.tdoa)
    )
    # The TDOAs that still waited are late.
    assert (again["restarts"], again["late"]) == (1, ekf["waiting"])
    first, second = rig.odometry[:n], rig.odometry[n:]
    assert [m.header.stamp for m in first] == [m.header.stamp for m in second]
    assert [m.pose.pose for m in first] == [m.pose.pose for m in second]


def test_a_rover_over_topics_is_that_of_the_offline_engine_to_the_bit(make_rig):
    """The rover is a planar vehicle with wheels as nav_msgs/Odometry, TDOAs and an IMU."""
    flight = drive(1, 8.0, begin=0.0)
    for name in ("imu", "tdoa", "velocity"):
        part = getattr(flight, name)
        as_read = np.array([seconds_of(stamp(t)) for t in part.t])
        flight = replace(flight, **{name: replace(part, t=as_read)})
    config = FilterConfig(planar=True, fixed_height=HEIGHT)
    told = {"planar": "true", "fixed_height": HEIGHT}
    rig = make_rig()
    rig.start(
        "bias_node",
        "ekf_node",
        ekf_node=[word for name, value in told.items() for word in ("-p", f"{name}:={value}")],
    )
    rig.add_publisher("velocity/odometry")
    rig.send_anchors(flight.anchors)
    rig.play(flight, sensors=["velocity/odometry"])
    ekf = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    assert ekf["velocity_used"] > 0.8 * len(flight.velocity) and ekf["velocity_late"] == 0
    # the driver of the wheels states no variance
    assert rig.values("ekf_node")["velocity deviations of"] == "velocity_std, yaw_rate_std"
    assert ekf["late"] == ekf["invalid"] == ekf["restarts"] == 0

    odometry = run_offline(flight, config).odometry
    n = len(rig.odometry)
    assert len(odometry) - 10 <= n <= len(odometry) and n > 500
    odometry = rows_of(odometry, slice(0, n))
    stamps = [seconds_of(m.header.stamp) for m in rig.odometry]
    np.testing.assert_array_equal(stamps, odometry.t)
    poses, twists = [m.pose.pose for m in rig.odometry], [m.twist.twist for m in rig.odometry]
    velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
    np.testing.assert_array_equal(positions(rig.odometry), odometry.p)
    np.testing.assert_array_equal([quaternion(p.orientation) for p in poses], odometry.q)
    np.testing.assert_array_equal([vector(t.linear) for t in twists], velocity)
    stated = np.array([m.pose.covariance for m in rig.odometry]).reshape(n, 6, 6)
    np.testing.assert_array_equal(stated, covariance[:, :6, :6])
    # Transforms begin when the wheels have shown the yaw.
    steady = np.flatnonzero(poses_of(odometry)[-1] <= LARGEST_YAW_STD).tolist()
    assert 100 < len(steady) < n - 100
    rig.wait(lambda: len(rig.received["/tf"]) == len(steady), "all transforms")
    transforms = {seconds_of(t.header.stamp): t for m in rig.received["/tf"] for t in m.transforms}
    for message in (rig.odometry[k] for k in steady):
        transform = transforms[seconds_of(message.header.stamp)].transform
        assert vector(transform.translation) == vector(message.pose.pose.position)
        assert transform.rotation == message.pose.pose.orientation
    # The yaw rate comes from the gyroscope or the wheels.
    assert np.ptp([t.angular.z for t in twists]) > 0.1


def test_quality_of_service(make_rig):
    rig = make_rig(listen=["odometry", "uwb/tdoa_corrected", "uwb/residual"], reliable=False)
    other = f"qos_overrides./{rig.namespace}/odometry.publisher.reliability:=best_effort"
    rig.start("bias_node", "ekf_node", ekf_node=["-p", other])
    best_effort = (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
    always = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
    latched = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = {
        "uwb/tdoa_corrected": {"bias_node": always},
        "uwb/residual": {"ekf_node": always},
        "odometry": {"ekf_node": best_effort},  # set by the parameter above
        "/tf": {"ekf_node": always},
        "/diagnostics": {"bias_node": always, "ekf_node": always},
    }
    subscriptions = {
        "uwb/tdoa": {"bias_node": best_effort},
        "odometry": {"bias_node": best_effort},
        "imu/data": {"ekf_node": best_effort},
        "uwb/tdoa_corrected": {"ekf_node": best_effort},
        "uwb/anchors": {"bias_node": latched, "ekf_node": latched},
    }

    def found(endpoints, topic):
        return {
            end.node_name: (end.qos_profile.reliability, end.qos_profile.durability)
            for end in endpoints(topic if topic.startswith("/") else f"/{rig.namespace}/{topic}")
            if end.node_namespace == f"/{rig.namespace}" and end.node_name != "rig"
        }

    for expected, endpoints in (
        (publishers, rig.node.get_publishers_info_by_topic),
        (subscriptions, rig.node.get_subscriptions_info_by_topic),
    ):
        for topic, nodes in expected.items():
            rig.wait(
                lambda e=endpoints, t=topic, n=nodes: found(e, t).keys() >= n.keys(),
                f"the ends of {topic} to be known",
            )
            assert found(endpoints, topic) == nodes, topic

    def arrived():
        rig.send_tdoa(0.1, 10, 11, 0.5)  # best effort: repeat until one arrives
        return rig.corrected

    rig.wait(arrived, "a measurement to pass")


# --- each node ---


ANCHORS = corners()  # ids 10 ... 17


LATE_EFFECTS = """effects: {anchor_delay: {values: {10: 0.1, 14: -0.05}}, anchor_ids: {values: {98: 11}},
  pair_sign: {values: {11-15: -1}}, tdoa_time_offset: {values: {offset: 0.03}},
  tag_lever_arm: {values: {z: 0.0}}}"""  # a lever arm needs poses
LATE = 0.03  # s, delay of every TDOA, corrected by LATE_EFFECTS


def test_bias_node_corrects_each_tdoa_at_its_pose_and_accounts_for_it(make_rig, tmp_path):
    """Stamps in this test are those without the delay LATE; `send` adds it."""
    (tmp_path / "effects.yaml").write_text(LATE_EFFECTS)
    rig = make_rig()
    rig.start("bias_node", bias_node=["-p", f"effects_file:={tmp_path / 'effects.yaml'}"])

    def send(t, *row):
        rig.send_tdoa(t + LATE, *row)

    def corrected(count, what):
        rig.wait(lambda: len(rig.corrected) == count, what)
        return rig.corrected[count - 1]

    # It waits for anchors, and for poses if there are some.
    send(0.1, 10, 14, 1.0)
    assert rig.counts("bias_node", received=1)["waiting"] == 1
    rig.send_anchors(ANCHORS)
    first = corrected(1, "no waiting for poses while there are none at all")
    assert first.status == TdoaCorrected.STATUS_EFFECTS and "anchor_delay" in first.model
    assert (first.raw, first.header.stamp) == (1.0, stamp(0.1))
    assert (first.bias, first.corrected) == pytest.approx((-0.15, 1.15))
    rig.send_pose(0.2)  # the first pose: no corrections in the next 0.2 s
    rig.send_pose(0.5)
    rig.counts("bias_node", poses=2)
    for t in (0.56, 0.6, 0.64, 0.68):
        send(t, 14, 10, 1.0)
    counts = rig.counts("bias_node", received=5)
    # Before 0.56 the filter cannot have a pose later than 0.1. The TDOA before 0.6 is 60 ms after
    # the pose of 0.5.
    assert (counts["published"], counts["waiting"]) == (2, 3)
    rig.send_pose(0.57)
    corrected(4, "0.6 and 0.64, which follow 0.56 and 0.6")
    rig.send_pose(0.6)
    corrected(5, "0.68, which follows 0.64")
    stamps = [round(seconds_of(m.header.stamp), 2) for m in rig.corrected]
    assert stamps == [0.1, 0.56, 0.6, 0.64, 0.68]
    assert rig.counts("bias_node", published=5)["released before their pose"] == 0

    # The wait is limited.
    for t in (1.0, 1.1, 1.2):
        send(t, 14, 10, 1.0)
    assert rig.counts("bias_node", received=8)["waiting"] == 3
    send(1.24, 14, 10, 1.0)  # more than 0.225 s after the first
    corrected(6, "the first to leave")
    counts = rig.counts("bias_node", received=9, published=6)
    assert (counts["waiting"], counts["released before their pose"]) == (3, 1)

    # The recording starts again. Waiting TDOAs belong to the old run, and its poses are forgotten.
    send(0.1, 14, 10, 2.0)
    send(0.16, 14, 10, 3.0)  # A single stamp could be wrong.
    corrected(8, "no waiting for poses of the past")
    assert [message.raw for message in rig.corrected[6:]] == [2.0, 3.0]
    counts = rig.counts("bias_node", received=11)
    assert (counts["published"], counts["waiting"], counts["dropped"]) == (8, 0, 3)

    # TDOAs without a correction are passed on and counted. Wrong ids and signs are corrected.
    nan, inf = float("nan"), float("inf")
    pairs = [(10, 99, 1.0), (99, 10, 1.0), (10, 10, 1.0), (10, 14, nan), (10, 14, inf)]
    for i, row in enumerate([*pairs, (98, 15, 1.5), (15, 98, 1.5)]):
        send(0.2 + 0.01 * i, *row)
    corrected(15, "all of them")
    passed, named = rig.corrected[8:13], rig.corrected[13:]
    assert [(m.status, m.bias, m.model) for m in passed] == [
        (TdoaCorrected.STATUS_PASSED, 0.0, "none")
    ] * 5
    assert [(m.anchor_a, m.anchor_b, m.raw) for m in named] == [(11, 15, -1.5), (15, 11, 1.5)]
    counts = rig.counts("bias_node", received=18)
    assert (counts["published"], counts["invalid"]) == (15, 5)
    statuses = [message.status for message in rig.corrected]
    assert counts["passed"] == statuses.count(TdoaCorrected.STATUS_PASSED)
    assert counts["effects"] == statuses.count(TdoaCorrected.STATUS_EFFECTS)
    send(500.0, 10, 14, 2.0)
    assert rig.counts("bias_node", received=19)["waiting"] == 1
    send(0.3, 10, 14, 3.0)
    corrected(17, "the wrong stamp, and what came after it")
    assert [(m.raw, m.status) for m in rig.corrected[15:]] == [
        (2.0, TdoaCorrected.STATUS_PASSED),
        (3.0, TdoaCorrected.STATUS_EFFECTS),
    ]
    assert rig.counts("bias_node", received=20)["dropped"] == 3


def test_ekf_node_accounts_for_every_measurement_from_bad_anchors_to_others(make_rig, tmp_path):
    rig, flight = make_rig(), recording(2.0)
    cells = np.zeros((1, 1, 1), bool), np.full((1, 1, 1), 0.1)
    nowhere = FlyableVolume(
        [-50] * 3, [100] * 3, *cells, flight.anchors.ids, flight.anchors.positions
    )
    nowhere.save(tmp_path / "flyable.npz")
    (process,) = rig.start(
        "ekf_node", ekf_node=["-p", f"flyable_volume:={tmp_path / 'flyable.npz'}"]
    )
    a, b = flight.tdoa.a[0], flight.tdoa.b[0]
    bad = anchors_to_message(flight.anchors)
    bad.anchors[2].pose.position.z = float("nan")
    rig.send_anchors(bad)
    named = f"anchor {flight.anchors.ids[2]} "
    rig.wait(lambda: named in rig.fresh_status("ekf_node").message, "the reason")
    for t in (0.001, 0.002):
        rig.send_corrected(t, a, b, 0.0)
    assert rig.counts("ekf_node", TDOAs_received=2)["waiting"] == 2
    assert rig.fresh_status("ekf_node").level == DiagnosticStatus.ERROR
    rig.send_anchors(flight.anchors)  # late anchors: the filter now uses the buffered TDOAs
    rig.play(flight, send_tdoa=rig.send_corrected)

    now = max(flight.tdoa.t[-1], flight.imu.t[-1])
    nan, inf = float("nan"), float("inf")
    invalid = [(a, a, 0.0), (a, 99, 0.0), (99, b, 0.0), (a, b, nan), (a, b, inf), (a, b, 500.0)]
    before = len(rig.residuals)
    for row in invalid:
        rig.send_corrected(now + 0.001, *row)
    late = now - 0.5
    rig.send_corrected(late, a, b, 0.0)
    # Out of order by less than `reorder`, so they are used in the order of their stamps.
    rig.send_corrected(now + 0.013, a, b, 0.0)
    rig.send_corrected(now + 0.011, b, a, 0.0)
    rig.send_imu(now + 0.1)
    rig.send_corrected(now + 0.1, a, b, 0.0)
    # Residuals of all TDOAs except the very last. This includes the last of the flight, which
    # waited.
    told = len(flight.tdoa) + 2 + len(invalid) + 1 + 2
    rig.wait(lambda: len(rig.residuals) == told, "all residuals")
    said = {}
    for message in rig.residuals[before:]:
        said.setdefault(message.verdict, []).append(message)
    assert [(m.anchor_a, m.anchor_b) for m in said[TdoaResidual.VERDICT_INVALID]] == [
        row[:2] for row in invalid
    ]
    (one,) = said[TdoaResidual.VERDICT_LATE]
    assert seconds_of(one.header.stamp) == pytest.approx(late, abs=1e-9)
    filtered = (TdoaResidual.VERDICT_USED, TdoaResidual.VERDICT_REJECTED)
    stamps = [seconds_of(m.header.stamp) for m in rig.residuals[before:] if m.verdict in filtered]
    assert stamps == sorted(stamps)
    assert stamps[-2:] == pytest.approx([now + 0.011, now + 0.013], abs=1e-9)
    assert {m.header.frame_id for m in rig.residuals} == {"map"}
    counts = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa) + 2 + len(invalid) + 4)
    verdicts = ("used", "rejected", "late", "invalid", "startup")
    assert sum(counts[name] for name in verdicts) == len(rig.residuals)
    assert len(rig.residuals) + counts["waiting"] == counts["TDOAs received"]
    assert (counts["invalid"], counts["late"], counts["waiting"]) == (len(invalid), 1, 1)
    imu = sum(counts[f"imu_{name}"] for name in ("used", "late", "invalid", "waiting"))
    assert imu == counts["IMU samples received"] == len(flight.imu) + 1
    values = rig.values("ekf_node")
    assert (values["state"], values["flyable"]) == ("running", "no")
    assert float(values["efficiency"]) > 0.0

    # An IMU without accelerometer, or without gyroscope, is refused.
    for k, covariance in enumerate(["linear_acceleration"] * 3 + ["angular_velocity"]):
        message = Imu()
        getattr(message, f"{covariance}_covariance")[0] = -1.0
        rig.send("imu/data", message, now + 0.11 + 0.01 * k)
    assert rig.counts("ekf_node", IMU_samples_received=len(flight.imu) + 5)["imu_invalid"] == 4

    def warnings():
        said = "covariance of -1", "set use_imu to false"
        return [line for line in process.lines if all(words in line for words in said)]

    rig.wait(warnings, "a warning")
    assert len(warnings()) == 1

    # Equal anchors change nothing. Other anchors restart the filter.
    rig.send_anchors(flight.anchors)
    assert rig.counts("ekf_node")["restarts"] == 0
    moved = flight.anchors.at(flight.anchors.positions + 0.5)
    rig.send_anchors(moved)
    counts = rig.counts("ekf_node", restarts=1, state="starting")
    # All residuals are there, with the old anchors.
    assert counts["waiting"] == 0 and len(rig.residuals) == told + 1


MOUNTED = """effects: {height_offset: {values: {offset: 0.1}}, height_scale: {values: {scale: 0.02}}, velocity_scale:
  {values: {scale: 0.1}}, velocity_misalignment: {values: {yaw: 1.5}}, velocity_delay: {values: {offset: 0.02}}}"""


def test_height_pressure_and_velocity_are_used_where_they_are_there(make_rig, tmp_path):
    rig, file = make_rig(), tmp_path / "effects.yaml"
    file.write_text(MOUNTED)
    rig.start("ekf_node", ekf_node=["-p", f"effects_file:={file}"])
    effects, flight = EffectSet.from_yaml(file), with_sensors(recording(3.0), rate=50.0)
    for effect in effects.effects:
        flight = effect.inject(flight)
    # sensor_msgs/Range has single precision
    flight.height.range[:] = np.float32(flight.height.range)
    flight.height.range[20] = np.inf
    topics = ["height", "pressure", "velocity"]
    for each in topics:
        rig.add_publisher(each)
    rig.send_anchors(flight.anchors)
    rig.play(flight, send_tdoa=rig.send_corrected, ahead=0.1, sensors=topics)
    counts = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    verdicts = ("used", "rejected", "late", "invalid", "startup", "waiting")
    for sensor in ("height", "pressure", "velocity"):
        assert (
            sum(counts[f"{sensor}_{verdict}"] for verdict in verdicts)
            == counts[f"{sensor}_received"]
            > 100
        )
        assert counts[f"{sensor}_used"] > 50
    assert counts["height_invalid"] == 1
    assert rig.values("ekf_node")["velocity deviations of"] == "the messages"
    expected = run_offline(flight, None, Corrector(flight.anchors, effects)).odometry
    place = np.searchsorted(expected.t, [seconds_of(m.header.stamp) for m in rig.odometry])
    np.testing.assert_allclose(positions(rig.odometry), expected.p[place], atol=1e-3)


# node, arguments, pattern of the error message
BAD = [
    ("bias_node", ["-p", "model_file:=nowhere.onnx"], "nowhere.onnx does not exist"),
    ("bias_node", ["-p", "hold:=1"], "hold: .* 1.0"),
    ("ekf_node", ["-p", "robust:=maybe"], "robust: 'maybe' is not one of"),
    ("ekf_node", ["-p", "lag:=0.001"], "reorder, lag"),
    ("ekf_node", ["-p"], "ros-args"),
    ("debias_node", [], "map: is empty"),
    ("debias_node", ["-p", "map:=nowhere.npz"], "nowhere.npz: is no position bias map"),
    ("localization_node", ["-p", "tags:=[a, a]"], "tags: .* different"),
    ("localization_node", ["-p", "lagg:=0.2"], "lagg: .* has no such parameter; write lag"),
]


@pytest.mark.parametrize("node, arguments, named", BAD)
def test_bad_parameters_are_refused_in_one_sentence(node, arguments, named, capsys):
    """In a process with several nodes, the first may have printed that it is ready."""
    assert import_module(MODULES[node]).main(["--ros-args", *arguments]) == 2
    said = capsys.readouterr().err
    last = said.splitlines()[-1]
    assert last.startswith(f"{node}: error: ") and re.search(named, said), said


# --- node frames ---


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
    imu = flight.imu
    seen = {name: turned.apply(getattr(imu, name)) for name in ("gyro", "accel")}
    mounted = replace(flight, imu=replace(imu, **seen))

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
