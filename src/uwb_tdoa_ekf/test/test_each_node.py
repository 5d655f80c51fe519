"""Each node alone, as a process, over topics."""

import re
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from dataclasses import replace  # noqa: E402

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from flights import corners, position_at, with_aids  # noqa: E402
from rig import MODULES, make_rig, recording, seconds_of, stamp  # noqa: E402, F401
from sensor_msgs.msg import Imu  # noqa: E402
import test_installed  # noqa: E402

from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_bias.foundation.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.foundation.flyable import FlyableVolume  # noqa: E402
from uwb_tdoa_bias.foundation.ros_anchors import anchors_to_message  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_msgs.msg import TdoaCorrected, TdoaResidual  # noqa: E402

ANCHORS = corners()  # ids 10 ... 17
DELAYS = "effects: {anchor_delay: {values: {10: 0.1, 14: -0.05}}}"


@pytest.fixture
def delays(tmp_path):
    """Arguments for a bias_node that knows two delays."""
    file = tmp_path / "effects.yaml"
    file.write_text(DELAYS)
    return ["-p", f"effects_file:={file}"]


def test_without_a_model_everything_is_passed_on_at_once(make_rig):
    rig = make_rig()
    rig.start("bias_node")
    sent = [(0.123456789, 10, 14, 1.5), (0.2, 99, 99, float("inf")), (0.1, 14, 10, -0.25)]
    for row in sent:
        rig.send_tdoa(*row)
    rig.wait(lambda: len(rig.corrected) == 3, "three measurements, without anchors or odometry")
    for (t, a, b, d), message in zip(sent, rig.corrected):
        assert message.header.stamp == stamp(t) and message.header.frame_id == "base_link"
        assert (message.anchor_a, message.anchor_b, message.raw, message.corrected) == (a, b, d, d)
        assert (message.bias, message.bias_std, message.model) == (0.0, 0.0, "none")
        assert message.status == TdoaCorrected.STATUS_PASSED
    counts = rig.counts("bias_node", received=3)
    assert (
        counts["published"] == counts["passed"] == 3 and counts["waiting"] == counts["dropped"] == 0
    )


def test_a_measurement_waits_for_its_pose(make_rig, delays):
    rig = make_rig()
    rig.start("bias_node", bias_node=delays)
    rig.send_tdoa(0.1, 10, 14, 1.0)
    assert rig.counts("bias_node", received=1)["waiting"] == 1  # for the anchors
    rig.send_anchors(ANCHORS)
    rig.wait(lambda: len(rig.corrected) == 1, "no waiting for poses while there are none at all")
    assert (
        rig.corrected[0].status == TdoaCorrected.STATUS_EFFECTS
        and rig.corrected[0].model == "anchor_delay"
    )
    assert rig.corrected[0].bias == pytest.approx(-0.15) and rig.corrected[
        0
    ].corrected == pytest.approx(1.15)

    rig.send_pose(0.2)  # the first: nothing is corrected in the next 0.2 s
    rig.send_pose(0.5)
    rig.counts("bias_node", poses=2)
    for t in (0.56, 0.6, 0.64, 0.68):
        rig.send_tdoa(t, 14, 10, 1.0)
    counts = rig.counts("bias_node", received=5)
    # The filter can have no later pose than that of 0.1 before it gets 0.56. What precedes 0.6 is
    # 60 ms after the pose.
    assert (counts["published"], counts["waiting"]) == (2, 3)
    rig.send_pose(0.57)
    rig.wait(lambda: len(rig.corrected) == 4, "0.6 and 0.64, which follow 0.56 and 0.6")
    rig.send_pose(0.6)
    rig.wait(lambda: len(rig.corrected) == 5, "0.68, which follows 0.64")
    assert [round(seconds_of(m.header.stamp), 2) for m in rig.corrected] == [
        0.1,
        0.56,
        0.6,
        0.64,
        0.68,
    ]
    assert rig.counts("bias_node", published=5)["released before their pose"] == 0


def test_late_stamps_are_moved(make_rig, tmp_path):
    (tmp_path / "effects.yaml").write_text("effects: {tdoa_time_offset: {values: {offset: 0.03}}}")
    rig = make_rig()
    rig.start("bias_node", bias_node=["-p", f"effects_file:={tmp_path / 'effects.yaml'}"])
    rig.send_anchors(ANCHORS)
    rig.send_tdoa(1.25, 10, 14, 1.0)
    rig.wait(lambda: len(rig.corrected) == 1, "no waiting for poses while there are none at all")
    assert rig.corrected[0].header.stamp == stamp(1.22) and rig.corrected[0].corrected == 1.0


def test_wrong_ids_and_signs_are_put_right(make_rig, tmp_path):
    text = (
        "effects: {anchor_ids: {values: {99: 10}}, pair_sign: {values: {10-14: -1}}, "
        "anchor_delay: {values: {10: 0.1}}}"
    )
    (tmp_path / "effects.yaml").write_text(text)
    rig = make_rig()
    rig.start("bias_node", bias_node=["-p", f"effects_file:={tmp_path / 'effects.yaml'}"])
    rig.send_anchors(ANCHORS)
    rig.send_tdoa(0.1, 99, 14, 1.5)
    rig.send_tdoa(0.2, 14, 99, 1.5)
    rig.wait(lambda: len(rig.corrected) == 2, "no waiting for poses while there are none at all")
    assert [(m.anchor_a, m.anchor_b, m.raw) for m in rig.corrected] == [
        (10, 14, -1.5),
        (14, 10, 1.5),
    ]
    assert [m.corrected for m in rig.corrected] == pytest.approx([-1.4, 1.4])


def test_a_measurement_does_not_wait_for_ever(make_rig, delays):
    rig = make_rig()
    rig.start("bias_node", bias_node=delays)
    rig.send_pose(0.5)
    rig.counts("bias_node", poses=1)
    rig.send_anchors(ANCHORS)  # after the pose, which is kept
    for t in (1.0, 1.1, 1.2):
        rig.send_tdoa(t, 14, 10, 1.0)
    assert rig.counts("bias_node", received=3)["waiting"] == 3
    rig.send_tdoa(1.24, 14, 10, 1.0)  # more than 0.225 s after the first
    rig.wait(lambda: rig.corrected, "the first to leave")
    counts = rig.counts("bias_node", received=4, published=1)
    assert (counts["waiting"], counts["released before their pose"]) == (3, 1)
    # A recording that starts again: what waits belongs to the old one, and its poses are forgotten.
    rig.send_tdoa(0.1, 14, 10, 2.0)
    rig.send_tdoa(0.15, 14, 10, 3.0)  # one stamp could have been wrong
    rig.wait(lambda: len(rig.corrected) == 3, "no waiting for poses of the past")
    assert [message.raw for message in rig.corrected[1:]] == [2.0, 3.0]
    counts = rig.counts("bias_node", received=6)
    assert (counts["published"], counts["waiting"], counts["dropped"]) == (3, 0, 3)


def test_what_cannot_be_corrected_is_passed_on_and_counted(make_rig, delays):
    rig = make_rig()
    rig.start("bias_node", bias_node=delays)
    rig.send_anchors(ANCHORS)
    pairs = [
        (10, 99, 1.0),
        (99, 10, 1.0),
        (10, 10, 1.0),
        (10, 14, float("nan")),
        (10, 14, float("inf")),
        (10, 14, 1.0),
    ]
    for i, row in enumerate(pairs):
        rig.send_tdoa(0.1 + 0.01 * i, *row)
    rig.wait(lambda: len(rig.corrected) == 6, "all of them")
    assert [m.status for m in rig.corrected] == [TdoaCorrected.STATUS_PASSED] * 5 + [
        TdoaCorrected.STATUS_EFFECTS
    ]
    assert [(m.bias, m.model) for m in rig.corrected[:5]] == [(0.0, "none")] * 5
    counts = rig.counts("bias_node", received=6)
    assert (counts["published"], counts["invalid"], counts["passed"], counts["effects"]) == (
        6,
        5,
        5,
        1,
    )
    rig.send_tdoa(500.0, 10, 14, 2.0)
    assert rig.counts("bias_node", received=7)["waiting"] == 1
    rig.send_tdoa(0.2, 10, 14, 3.0)
    rig.wait(lambda: len(rig.corrected) == 8, "the wrong stamp, and what came after it")
    assert [(m.raw, m.status) for m in rig.corrected[6:]] == [
        (2.0, TdoaCorrected.STATUS_PASSED),
        (3.0, TdoaCorrected.STATUS_EFFECTS),
    ]
    assert rig.counts("bias_node", received=8)["dropped"] == 0


def test_every_measurement_is_accounted_for(make_rig):
    rig = make_rig()
    rig.start("ekf_node")
    flight = recording(2.0)
    a, b = flight.tdoa.a[0], flight.tdoa.b[0]
    for t in (0.001, 0.002):
        rig.send_corrected(t, a, b, 0.0)
    assert rig.counts("ekf_node", TDOAs_received=2)["waiting"] == 2
    assert rig.fresh_status("ekf_node").level == DiagnosticStatus.ERROR
    rig.send_anchors(flight.anchors)  # late: what came before is used now
    rig.play(flight, send_tdoa=rig.send_corrected)

    now = max(flight.tdoa.t[-1], flight.imu.t[-1])
    invalid = [
        (a, a, 0.0),
        (a, 99, 0.0),
        (99, b, 0.0),
        (a, b, float("nan")),
        (a, b, float("inf")),
        (a, b, 500.0),
    ]
    before = len(rig.residuals)
    for row in invalid:
        rig.send_corrected(now + 0.001, *row)
    late = now - 0.5
    rig.send_corrected(late, a, b, 0.0)
    # Out of order, but within `reorder`: used in the order of their stamps.
    rig.send_corrected(now + 0.013, a, b, 0.0)
    rig.send_corrected(now + 0.011, b, a, 0.0)
    rig.send_imu(now + 0.1)
    rig.send_corrected(now + 0.1, a, b, 0.0)
    # All but the very last, and the last one of the flight that had been waiting.
    rig.wait(
        lambda: len(rig.residuals) == len(flight.tdoa) + 2 + len(invalid) + 1 + 2, "all residuals"
    )
    said = {}
    for message in rig.residuals[before:]:
        said.setdefault(message.verdict, []).append(message)
    assert [(m.anchor_a, m.anchor_b) for m in said[TdoaResidual.VERDICT_INVALID]] == [
        row[:2] for row in invalid
    ]
    assert [seconds_of(m.header.stamp) for m in said[TdoaResidual.VERDICT_LATE]] == pytest.approx(
        [late], abs=1e-9
    )
    filtered = (TdoaResidual.VERDICT_USED, TdoaResidual.VERDICT_REJECTED)
    stamps = [seconds_of(m.header.stamp) for m in rig.residuals[before:] if m.verdict in filtered]
    assert stamps == sorted(stamps) and stamps[-2:] == pytest.approx(
        [now + 0.011, now + 0.013], abs=1e-9
    )
    assert {m.header.frame_id for m in rig.residuals} == {"map"}
    counts = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa) + 2 + len(invalid) + 4)
    verdicts = ("used", "rejected", "late", "invalid", "startup")
    assert sum(counts[name] for name in verdicts) + counts["waiting"] == counts["TDOAs received"]
    assert (counts["invalid"], counts["late"], counts["waiting"]) == (len(invalid), 1, 1)
    assert sum(counts[name] for name in verdicts) == len(rig.residuals)
    imu = sum(counts[f"imu_{name}"] for name in ("used", "late", "invalid", "waiting"))
    assert imu == counts["IMU samples received"] == len(flight.imu) + 1


MOUNTED = """effects: {height_offset: {values: {offset: 0.1}}, height_scale: {values: {scale: 0.02}}, velocity_scale:
  {values: {scale: 0.1}}, velocity_misalignment: {values: {yaw: 1.5}}, velocity_delay: {values: {offset: 0.02}}}"""


@pytest.mark.parametrize(
    "topic, effects", [("velocity", MOUNTED), ("velocity/odometry", "effects: {}")]
)
def test_height_pressure_and_velocity_are_used_where_they_are_there(
    make_rig, tmp_path, topic, effects
):
    rig, file = make_rig(), tmp_path / "effects.yaml"
    file.write_text(effects)
    rig.start("ekf_node", ekf_node=["-p", f"effects_file:={file}"])
    effects, flight = EffectSet.from_yaml(file), with_aids(recording(3.0), rate=50.0)
    for effect in effects.effects:
        flight = effect.inject(flight)
    if topic == "velocity/odometry":  # wheels whose driver states no variance
        n, gyro = (
            len(flight.velocity),
            np.interp(flight.velocity.t, flight.imu.t, flight.imu.gyro[:, 2]),
        )
        wheels = replace(
            flight.velocity, std=np.zeros((n, 3)), yaw_rate=gyro, yaw_rate_std=np.zeros(n)
        )
        flight = replace(flight, velocity=wheels)
    flight.height.range[:] = np.float32(
        flight.height.range
    )  # a sensor_msgs/Range is not more precise
    flight.height.range[20] = np.inf
    topics = ["height", "pressure", topic]
    for each in topics:
        rig.add_publisher(each)
    rig.send_anchors(flight.anchors)
    rig.play(flight, send_tdoa=rig.send_corrected, ahead=0.1, aids=topics)
    counts = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    verdicts = ("used", "rejected", "late", "invalid", "startup", "waiting")
    for aid in ("height", "pressure", "velocity"):
        assert (
            sum(counts[f"{aid}_{verdict}"] for verdict in verdicts)
            == counts[f"{aid}_received"]
            > 100
        )
        assert counts[f"{aid}_used"] > 50
    assert counts["height_invalid"] == 1
    values = {entry.key: entry.value for entry in rig.fresh_status("ekf_node").values}
    said = {"velocity": "the messages", "velocity/odometry": "velocity_std, yaw_rate_std"}
    assert values["velocity deviations of"] == said[topic]
    expected = run_offline(flight, None, Corrector(flight.anchors, effects)).odometry
    place = np.searchsorted(expected.t, [seconds_of(m.header.stamp) for m in rig.odometry])
    p = [
        (m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z)
        for m in rig.odometry
    ]
    np.testing.assert_allclose(p, expected.p[place], atol=1e-3)


def test_an_imu_without_accelerometer_is_not_believed(make_rig):
    rig = make_rig()
    (process,) = rig.start("ekf_node")
    rig.send_anchors(ANCHORS)
    rig.wait(
        lambda: "no TDOAs" in rig.fresh_status("ekf_node").message, "the anchors to have arrived"
    )
    for i in range(3):
        message = Imu()
        message.linear_acceleration_covariance[0] = -1.0
        rig.send("imu/data", message, 0.01 * i)
    message = Imu()
    message.angular_velocity_covariance[0] = -1.0
    rig.send("imu/data", message, 0.03)
    rig.send_imu(0.04)
    counts = rig.counts("ekf_node", IMU_samples_received=5)
    assert (counts["imu_invalid"], counts["imu_waiting"] + counts["imu_used"]) == (4, 1)

    def warnings():
        return [
            line
            for line in process.lines
            if "set use_imu to false" in line and "covariance of -1" in line
        ]

    rig.wait(warnings, "a warning")
    assert len(warnings()) == 1


def test_other_anchors_start_the_filter_anew_and_the_same_do_not(make_rig, tmp_path):
    rig, flight = make_rig(), recording(1.5)
    nowhere = (
        np.zeros((1, 1, 1), bool),
        np.full((1, 1, 1), 0.1),
        flight.anchors.ids,
        flight.anchors.positions,
    )
    FlyableVolume([-50, -50, -50], [100, 100, 100], *nowhere).save(tmp_path / "flyable.npz")
    rig.start("ekf_node", ekf_node=["-p", f"flyable_volume:={tmp_path / 'flyable.npz'}"])
    rig.send_anchors(flight.anchors)
    rig.play(flight, send_tdoa=rig.send_corrected)
    rig.send_anchors(flight.anchors)
    assert rig.counts("ekf_node")["restarts"] == 0 and rig.values("ekf_node")["state"] == "running"
    assert (
        rig.values("ekf_node")["flyable"] == "no"
        and float(rig.values("ekf_node")["efficiency"]) > 0.0
    )
    moved = Anchors(flight.anchors.ids, flight.anchors.positions + 0.5, flight.anchors.orientations)
    rig.send_anchors(moved)
    counts = rig.counts("ekf_node", restarts=1, state="starting")
    assert counts["waiting"] == 0 and len(rig.residuals) == len(
        flight.tdoa
    )  # with the old anchors, to the last one
    assert counts["used"] + counts["rejected"] + counts["startup"] == len(flight.tdoa)


def test_an_anchor_that_goes_one_that_moves_and_one_that_comes_do_not_stop_the_nodes(make_rig):
    rig, flight = make_rig(), test_installed.flight_through()
    processes = rig.start("bias_node", "ekf_node")
    rig.send_anchors(test_installed.BOX)
    rig.play(test_installed.cut(flight, -np.inf, test_installed.CHANGE))
    before = rig.counts("ekf_node", state="running")
    rig.send_anchors(test_installed.after())
    rig.wait(
        lambda: all(
            any("the anchors have changed" in line for line in process.lines)
            for process in processes
        ),
        "the change to arrive",
    )
    rig.play(test_installed.cut(flight, test_installed.CHANGE, np.inf))
    counts = rig.counts("ekf_node", TDOAs_received=len(flight.tdoa.t))
    assert counts["restarts"] == counts["recoveries"] == 0 and counts["used"] > before["used"] + 500
    t, p = (
        np.array([pick(m) for m in rig.odometry])
        for pick in (
            lambda m: seconds_of(m.header.stamp),
            lambda m: [getattr(m.pose.pose.position, k) for k in "xyz"],
        )
    )
    assert np.diff(t).max() < 0.1  # it never stopped
    late = t > test_installed.CHANGE
    assert np.linalg.norm(p[late] - position_at(flight, t[late]), axis=1).max() < 0.3


def test_bad_anchors_are_told(make_rig):
    rig = make_rig()
    rig.start("ekf_node")
    message = anchors_to_message(ANCHORS)
    message.anchors[2].pose.position.z = float("nan")
    rig.send_anchors(message)
    rig.wait(
        lambda: f"anchor {ANCHORS.ids[2]} " in rig.fresh_status("ekf_node").message, "the reason"
    )
    assert rig.fresh_status("ekf_node").level == DiagnosticStatus.ERROR


@pytest.mark.parametrize(
    ("node", "arguments", "named"),
    [
        ("bias_node", ["-p", "model_file:=nowhere.onnx"], "nowhere.onnx does not exist"),
        ("bias_node", ["-p", "effects_file:=nowhere.yaml"], "nowhere.yaml"),
        ("bias_node", ["-p", "hold:=1"], "hold: .* 1.0"),
        ("bias_node", ["-p", "pose_lag:=-1.0"], "pose_lag"),
        ("ekf_node", ["-p", "robust:=maybe"], "robust: 'maybe' is not one of"),
        ("ekf_node", ["-p", "iterations:=2.5"], "iterations: .* a whole number"),
        ("ekf_node", ["-p", "lag:=0.001"], "reorder, lag"),
        ("ekf_node", ["-p"], "ros-args"),
    ],
)
def test_bad_parameters_are_refused_in_one_sentence(node, arguments, named):
    result = subprocess.run(
        [sys.executable, "-m", MODULES[node], "--ros-args", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1].startswith(f"{node}: error: ")
    assert "Traceback" not in result.stderr
    assert re.search(named, result.stderr)
