# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from collections import Counter
import math
from pathlib import Path
import time

from node_parameters import written_and_declared
import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.impl.rcutils_logger import RcutilsLogger  # noqa: E402

from uwb_tdoa_bias.bias_node import MEASURED, BiasNode  # noqa: E402
from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.correction.model import NETWORK, Model  # noqa: E402
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, EffectSet  # noqa: E402
from uwb_tdoa_bias.effects.anchor import AnchorPosition  # noqa: E402
from uwb_tdoa_bias.effects.tag import TagLeverArm  # noqa: E402
from uwb_tdoa_bias.ros.anchors import calibration_to_message  # noqa: E402
from uwb_tdoa_bias.ros.cdr import CdrCodec  # noqa: E402
from uwb_tdoa_bias.ros.node import BURST  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "bias_node.yaml"


@pytest.fixture
def node():
    rclpy.init()
    node = BiasNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_every_parameter_is_in_the_parameter_file_with_its_default(node):
    parameters, declared = written_and_declared(node, CONFIG)
    assert parameters == declared


def test_an_ekf_node_that_runs_is_not_to_be_started(node, monkeypatch):
    monkeypatch.setattr(BiasNode, "_idle", False)
    node._anchors.anchors = Anchors.from_positions(np.eye(3))
    text = node._health(1.0, Counter())[1]
    assert text.startswith("no poses on odometry yet") and text.endswith("start ekf_node")
    odometry = node.create_publisher(Odometry, "odometry", 10)
    until = time.monotonic() + 60.0
    while not odometry.get_subscription_count() or "runs" not in node._health(1.0, Counter())[1]:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_an_antenna_that_would_be_too_far_from_the_body_is_said_and_taken_as_the_body(node):
    assert not node._report()[1].startswith("uwb/tdoa:")
    node._frames.frames.set("base_link", "mast", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 3.0))
    node._antenna("mast").heard = 1
    _, text, values = node._report()
    assert (
        text.startswith("uwb/tdoa: the place of 'mast' on 'base_link' in /tf_static is not taken: ")
        and "z is 3" in text
    )
    assert "lever_arm" not in values["model"]


def test_tdoas_of_two_antennas_are_corrected_each_by_its_own_place_and_none_is_dropped(node):
    """The antennas alternate. Their lever arms are 0.3 m and -0.3 m along x."""
    for frame, x in (("left", 0.3), ("right", -0.3)):
        node._frames.frames.set("base_link", frame, (0.0, 0.0, 0.0, 1.0), (x, 0.0, 0.0))
    node._anchors.anchors = Anchors.from_positions([[-9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    node._on_anchors(node._anchors.anchors)
    sent = []
    node._publish = lambda items, correction, stamps=None: sent.extend(
        zip((item[0] for item in items), correction.bias.tolist())
    )
    codec = CdrCodec(Tdoa, *MEASURED)
    for k in range(200):
        t, frame = 0.01 * k, ("left", "right")[k % 2]
        node._known_poses.add(t, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), 0.0)
        node._poses.take_all([t])
        rows = codec.template(Tdoa(anchor_a=0, anchor_b=1)).rows(1)
        rows["nanosec"] = 10_000_000 * k
        node._on_tdoa(frame, np.array([t]), rows, np.zeros(1))
        node._release()
    assert node._counts["dropped"] == 0 and len(sent) > 190
    assert {(frame, round(bias, 6)) for frame, bias in sent[100:]} == {
        ("left", -0.6),
        ("right", 0.6),
    }
    assert [frame for frame, _ in sent] == [("left", "right")[k % 2] for k in range(len(sent))]


@pytest.fixture
def calibrated(tmp_path):
    """A BiasNode that takes calibrations, with a delay of anchor 1 in its effects_file."""
    known = EffectSet((AnchorDelay(values={"1": 0.5}), TagLeverArm(values={"x": 0.1})))
    known.to_yaml(tmp_path / "effects.yaml")
    given = ["calibrated:=true", f"effects_file:={tmp_path / 'effects.yaml'}"]
    rclpy.init(args=["--ros-args", *(word for each in given for word in ("-p", each))])
    node = BiasNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def bias_of(node, k=0, frame="base_link"):
    """Return the bias of a TDOA of anchors 0 and 1 at the origin, at 0.01 k s."""
    t = 0.01 * k
    node._known_poses.add(t, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), 0.0)
    stamps, rows = np.array([t]), np.array([0])
    return node._antenna(frame).corrector.correct(stamps, rows, rows + 1, np.zeros(1)).bias[0]


def test_a_calibration_replaces_what_the_file_says_of_anchors_and_keeps_the_poses(calibrated):
    frames, anchors = calibrated._frames.frames, Anchors.from_positions([[-9.0, 0, 0], [9.0, 0, 0]])
    calibrated._anchors.anchors = anchors
    calibrated._on_anchors(anchors)
    for k in range(100):
        before = bias_of(calibrated, k)
    assert before == pytest.approx(0.5 - 0.2)
    found = AnchorPosition(values={"0.x": -0.2}), AnchorDelay(values={"0": 0.1, "1": 0.3})
    message = calibration_to_message(EffectSet(found), anchors)
    message.number = 7
    calibrated._on_calibration(message)
    # |p - b| - |p - a| falls by the 0.2 m that anchor 0 is farther away
    assert bias_of(calibrated, 101) == pytest.approx(0.3 - 0.1 - 0.2 - 0.2)
    assert calibrated._report()[2]["calibration"] == 7
    frames.set("base_link", "mast", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.1))
    assert bias_of(calibrated, 102, "mast") == pytest.approx(bias_of(calibrated, 102))


@pytest.mark.parametrize(
    "fault, why",
    [
        ({"shifts": [0.0]}, "1 shifts and 2 delays are no three and one for each of 2 anchors"),
        ({"delays": [0.0, math.nan]}, "nan"),
        ({"shifts": [9.0] * 6}, "9"),
        ({"ids": [0, 0]}, "twice"),
    ],
)
def test_a_faulty_calibration_changes_nothing(calibrated, monkeypatch, fault, why):
    anchors = Anchors.from_positions([[-9.0, 0, 0], [9.0, 0, 0]])
    calibrated._anchors.anchors = anchors
    calibrated._on_anchors(anchors)
    said = []
    monkeypatch.setattr(BiasNode, "warn_at_times", lambda node, kind, text: said.append(text))
    before, message = calibrated._effects, calibration_to_message(EffectSet(), anchors)
    for name, value in fault.items():
        setattr(message, name, value)
    calibrated._on_calibration(message)
    message = calibration_to_message(EffectSet(), anchors)
    message.header.frame_id = "other"
    calibrated._on_calibration(message)
    assert calibrated._effects is before
    assert why in said[0] and "frame 'other', the anchors in 'map'" in said[1]


def test_frozen_refuses_to_be_calibrated():
    rclpy.init(args=["--ros-args", "-p", "frozen:=true", "-p", "calibrated:=true"])
    try:
        with pytest.raises(InputError, match="calibrated: .* frozen forbids"):
            BiasNode()
    finally:
        rclpy.shutdown()


def test_an_effect_that_needs_orientations_of_anchors_is_named_where_there_are_none(node):
    node._anchors.anchors = Anchors.from_positions(np.eye(3))
    node._effects = EffectSet((EFFECTS["antenna_pattern"]({"anchor": 0.1}),))
    node._body_antenna.name_of_status = dict.fromkeys(range(4), "antenna_pattern")
    node._poses.take_all([0.0])
    level, text = node._health(1.0, Counter())
    assert level == DiagnosticStatus.WARN
    assert text.startswith("antenna_pattern needs orientations of anchors, and the survey has none")
    node._effects = EffectSet()
    assert node._health(1.0, Counter()) == (DiagnosticStatus.OK, "correcting with antenna_pattern")


def test_with_an_antenna_of_tf_static_alone_tdoas_wait_for_their_pose(node):
    node._frames.frames.set("base_link", "mast", (0.0, 0.0, 0.0, 1.0), (0.3, 0.0, 0.0))
    node._anchors.anchors = Anchors.from_positions([[-9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    node._on_anchors(node._anchors.anchors)
    codec = CdrCodec(Tdoa, *MEASURED)
    for stamp in (0.0, 1.0):
        node._known_poses.add(stamp, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), 0.0)
        node._poses.take_all([stamp])
    for k in (110, 115):  # the pose of the second is not there yet
        rows = codec.template(Tdoa(anchor_a=0, anchor_b=1)).rows(1)
        rows["sec"], rows["nanosec"] = 1, 10_000_000 * (k - 100)
        node._on_tdoa("mast", np.array([0.01 * k]), rows, np.zeros(1))
    node._release()
    assert node.holds == 2 and not node._counts["published"]


@pytest.mark.parametrize("number", [np.nan, 1e9])
def test_a_model_that_gives_no_possible_bias_corrects_nothing_and_is_named(node, number):
    class Broken(Model):
        name = "broken"

        def __init__(self):
            self.meta = {}

        def added(self, samples, known):
            status = np.full(len(samples), float(NETWORK))
            return known._replace(bias=np.full(len(samples), number), status=status)

    anchors = Anchors.from_positions([[-9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    effects = EffectSet((EFFECTS["anchor_delay"]({"0": 0.5}),))
    known, broken = (
        Corrector(anchors, effects, model).correct(*map(np.array, ([1.0], [0], [1], [3.0])))
        for model in (None, Broken())
    )
    for one, other in zip(vars(known).values(), vars(broken).values()):
        np.testing.assert_array_equal(one, other)
    node._model = Broken()
    node._body_antenna.name_of_status = dict.fromkeys(range(4), "broken")
    node._anchors.anchors = anchors
    node._poses.take_all([0.0])
    sound = Counter(published=9, network=9)
    assert node._health(1.0, sound)[0] == DiagnosticStatus.OK
    level, text = node._health(1.0, Counter(published=9, effects=9))
    assert level == DiagnosticStatus.WARN and text.startswith("model_file gives no possible bias")


def test_many_warnings_of_one_kind_do_not_hide_another(node, monkeypatch):
    lines = []
    monkeypatch.setattr(RcutilsLogger, "warning", lambda self, text: lines.append(text))
    for k in range(3 * BURST):
        node.warn_at_times(f"antenna {k}", "foreign")
    node.warn_at_times("frame of odometry", "another")
    assert lines.count("foreign") == BURST and "another" in lines
