# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Both nodes, as processes, over topics."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from flights import kept  # noqa: E402
import known_answer  # noqa: E402
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy  # noqa: E402
from rig import OUTPUTS, make_rig, positions, recording, seconds_of, stamp, vector  # noqa: E402, F401
from rovers import HEIGHT, drive  # noqa: E402

from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD, Corrector  # noqa: E402
from uwb_tdoa_bias.correction.network import Network  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_ekf.results import poses_of, rows_of, to_odometry  # noqa: E402

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
