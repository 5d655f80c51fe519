# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each node alone, as a process, over topics."""

from importlib import import_module
import re

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")


from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from flights import corners, with_sensors  # noqa: E402
from rig import MODULES, PATIENCE, make_rig, positions, recording, seconds_of, stamp  # noqa: E402, F401
from sensor_msgs.msg import Imu  # noqa: E402

from uwb_tdoa_bias.common.flyable import FlyableVolume  # noqa: E402
from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_bias.ros.anchors import anchors_to_message  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_msgs.msg import TdoaCorrected, TdoaResidual  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

ANCHORS = corners()  # ids 10 ... 17


EFFECTS = """effects: {anchor_delay: {values: {10: 0.1, 14: -0.05}}, anchor_ids: {values: {98: 11}},
  pair_sign: {values: {11-15: -1}}, tdoa_time_offset: {values: {offset: 0.03}},
  tag_lever_arm: {values: {z: 0.0}}}"""  # a lever arm needs poses
LATE = 0.03  # s, delay of every TDOA, corrected by EFFECTS


def test_bias_node_corrects_each_tdoa_at_its_pose_and_accounts_for_it(make_rig, tmp_path):
    """Stamps in this test are those without the delay LATE; `send` adds it."""
    (tmp_path / "effects.yaml").write_text(EFFECTS)
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
