# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""calibration_node as a process: what it finds is what the stream of a recording gives."""

from contextlib import suppress
from dataclasses import replace
import os
from pathlib import Path
import re
import signal
import subprocess
import threading
import time

from known_effects import sparse_flight
import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from programs import start  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.common.survey import read_survey  # noqa: E402
from uwb_tdoa_bias.effects import EffectSet  # noqa: E402
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, calibration_to_message  # noqa: E402
from uwb_tdoa_ekf.launching import NODES  # noqa: E402
from uwb_tdoa_msgs.msg import Calibration, Tdoa  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_bag, write_bag  # noqa: E402
from uwb_tdoa_tools.calibrating import in_pieces  # noqa: E402
from uwb_tdoa_tools.calibration_node import PARAMETERS, CalibrationNode  # noqa: E402
from uwb_tdoa_tools.diagnosis.self_calibration import Tape  # noqa: E402
from uwb_tdoa_tools.surveying.pieces import Message, Piece, keep, last_kept  # noqa: E402
from uwb_tdoa_tools.surveying.stream import PIECE, StreamCalibration  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "calibration_node.yaml"
TAPE = 0.1  # m
PATIENCE = 900.0  # s, limit of each wait: beside busy processes the lowest priority gets little
RATE = 5.0  # times as fast as recorded
RELIABLE = [
    word
    for topic in ("uwb/tdoa", "imu/data")
    for word in ("-p", f"qos_overrides./{topic}.subscription.reliability:=reliable")
]


def test_every_parameter_is_in_the_parameter_file_with_its_default():
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values())
    assert written == {name: parameter.default for name, parameter in PARAMETERS.items()}
    assert NODES["calibration_node"][1] == {*PARAMETERS, "use_sim_time"}


@pytest.mark.parametrize(
    "given, why",
    [
        ("tape_std:=9.0", "tape_std: 9.0 must be from 0.001 to 5."),
        ("effects_file:=nowhere.yaml", "nowhere.yaml: cannot be read"),
        ("anchor_file:=a.yaml", "anchor_file: calibration_node has no such parameter; write"),
    ],
)
def test_what_cannot_be_meant_is_refused(given, why):
    rclpy.init(args=["--ros-args", "-p", given])
    try:
        with pytest.raises(InputError, match=re.escape(why)):
            CalibrationNode()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize(
    "given, why",
    [
        ("trusted:=['77']", "there is no anchor '77'"),
        (
            "calibration_folder:={}",
            "is of anchors 0, 1, 2 in frame 'map', the survey of 0, 1, 2, 3",
        ),
    ],
)
def test_anchors_that_cannot_be_calibrated_are_an_error_and_end_nothing(tmp_path, given, why):
    few, all_of = (Anchors.from_positions(np.eye(4, 3)[:count]) for count in (3, 4))
    keep(tmp_path, 1, few, EffectSet())
    rclpy.init(args=["--ros-args", "-p", given.format(tmp_path)])
    node = CalibrationNode()
    try:
        node._anchors.anchors = all_of
        node._on_anchors(all_of)
        level, text, _ = node._report()
        assert level == DiagnosticStatus.ERROR and why in text
        assert not node._target.number and list(node._target.ids) == [0, 1, 2, 3]
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_the_reader_gets_each_transform_though_others_are_repeated(tmp_path):
    rclpy.init()
    node = CalibrationNode()
    try:
        for child, x in (("mast", 0.1), *[("camera", 0.2)] * 200):
            place = TransformStamped(child_frame_id=child)
            place.header.frame_id = "base_link"
            place.transform.translation.x = x
            message = TFMessage(transforms=[place])
            node._on_frames((serialize_message(message), message))
        messages = []
        for k in range(20):
            tdoa = Tdoa(anchor_a=0, anchor_b=1, distance_difference=0.1)
            tdoa.header.frame_id = "mast"
            tdoa.header.stamp.sec, tdoa.header.stamp.nanosec = 1_700_000_000, 10_000_000 * k
            stamp = 1.7e9 + 0.01 * k
            messages.append(Message("uwb/tdoa", stamp, round(1e9 * stamp), serialize_message(tdoa)))
        Piece(0, 1.7e9, messages, [*node._frames.values()]).write(tmp_path / "piece")
        flight = read_bag(tmp_path / "piece", anchors=Anchors.from_positions(np.eye(4, 3)))
        assert len(flight.tdoa) == 20 and flight.meta["antenna"] == pytest.approx([0.1, 0.0, 0.0])
    finally:
        node.destroy_node()
        rclpy.shutdown()


class Listener:
    """A node of the test.

    messages : Calibrations in the order of arrival
    values, text : of /diagnostics of calibration_node
    corrects : values of /diagnostics of bias_node
    """

    def __init__(self):
        self.node = rclpy.create_node("listener")
        self.messages, self.values, self.text, self.corrects = [], {}, "", {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.node.create_subscription(
            Calibration, "/uwb/calibration", self.messages.append, ANCHORS_QOS
        )
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.use = self.node.create_client(SetBool, "calibration_node/use")

    def _on_diagnostics(self, message):
        for status in message.status:
            if status.name == "/calibration_node":
                self.text = status.message
                self.values = {each.key: each.value for each in status.values}
            if status.name == "/bias_node":
                self.corrects = {each.key: each.value for each in status.values}

    def wait(self, condition, what):
        until = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < until, f"waited for {what}: {self.text} {self.values}"
            self._executor.spin_once(timeout_sec=0.1)

    def ask(self, use):
        """Call the service `use`, and return the text of the answer."""
        self.wait(self.use.service_is_ready, "the service")
        future = self.use.call_async(SetBool.Request(data=use))
        self.wait(future.done, "the answer")
        return future.result().message


@pytest.fixture
def listener():
    rclpy.init()
    listener = Listener()
    yield listener
    listener.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def run():
    """Give run(module, *words), which starts a process; `lines` of it hold its output."""
    started = []

    def run(*words):
        process = start(
            "-u", "-m", *words, stderr=subprocess.STDOUT, start_new_session=True, env={**os.environ}
        )
        process.lines = []
        threading.Thread(
            target=lambda: process.lines.extend(iter(process.stdout.readline, "")), daemon=True
        ).start()
        started.append(process)
        return process

    yield run
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag of three pieces and a rest, with anchors as a tape has them, and their file."""
    folder = tmp_path_factory.mktemp("recorded")
    flight = sparse_flight(300, 3.1 * PIECE)
    off = np.random.default_rng(7).normal(0.0, TAPE, flight.anchors.positions.shape)
    flight = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    write_bag(flight, folder / "bag")
    flight.anchors.to_yaml(folder / "tape.yaml")
    return folder / "bag", folder / "tape.yaml"


def children(process):
    """Return the pids of the processes that a process has started."""
    folder = Path(f"/proc/{process.pid}/task/{process.pid}")
    return [int(pid) for pid in (folder / "children").read_text().split()]


def node_words(survey, folder):
    given = [f"anchors_file:={survey}", f"calibration_folder:={folder}"]
    return [
        "uwb_tdoa_tools.calibration_node",
        "--ros-args",
        *(word for each in given for word in ("-p", each)),
        *RELIABLE,
    ]


def replay_words(bag):
    return [
        "uwb_tdoa_tools.commands",
        "replay",
        bag,
        "--rate",
        RATE,
        "--wait-topics",
        "uwb/tdoa",
        "imu/data",
    ]


@pytest.mark.slow
def test_live_is_the_stream_of_the_recording_to_the_bit(recorded, tmp_path, listener, run):
    bag, survey = recorded
    folder = tmp_path / "kept"
    node = run(*node_words(survey, folder))
    # without TDOAs: the replay must begin with calibration_node, and not with the first of both
    given = ["-p", "calibrated:=true", "-r", "uwb/tdoa:=nowhere"]
    run("uwb_tdoa_bias.bias_node", "--ros-args", *given)
    listener.wait(lambda: listener.values and listener.corrects, "the nodes")
    assert listener.messages[-1].number == 0 and not np.any(listener.messages[-1].shifts)
    replay = run(*replay_words(bag))
    listener.wait(lambda: listener.values["pieces taken"] == "3", "three pieces")
    assert listener.values["messages left out"] == listener.values["pieces left out"] == "0"
    listener.wait(lambda: replay.poll() is not None, "the end of the replay")

    given = read_survey(survey)
    expected = StreamCalibration(given, Tape(TAPE))
    for piece in list(in_pieces(read_bag(bag, anchors=given, truth=False)))[:3]:
        expected.take(piece)
    assert expected.number > 0
    number, kept, _ = last_kept(folder, given, EffectSet())
    assert number == expected.number
    message = calibration_to_message(expected.effects, given)

    def arrived():
        last = listener.messages[-1]
        return (last.number, last.shifts, last.delays) == (number, message.shifts, message.delays)

    listener.wait(arrived, "the calibration")
    np.testing.assert_array_equal(listener.messages[-1].covariance, message.covariance)
    listener.wait(lambda: listener.corrects["calibration"] == str(number), "bias_node to take it")
    assert listener.corrects["unreadable on /uwb/calibration"] == "0"
    # a hand-over has 20 steps, some of which may be missed
    shown = np.array([one.shifts for one in listener.messages])
    assert np.abs(np.diff(shown, axis=0)).max() < 0.25 * np.abs(shown).max()

    assert "the anchors as given are in use" in listener.ask(False)
    listener.wait(lambda: not np.any(listener.messages[-1].shifts), "the way back")
    assert listener.messages[-1].number == 0
    listener.ask(True)
    listener.wait(arrived, "the calibration again")

    # what is kept is in use at the next start, even if the node is killed
    os.killpg(node.pid, signal.SIGKILL)
    node.wait()
    listener.messages.clear()
    run(*node_words(survey, folder))
    listener.wait(lambda: listener.messages, "the next start")
    assert listener.messages[0].number == number
    assert listener.messages[0].shifts == pytest.approx(message.shifts, abs=1e-9)


@pytest.mark.slow
def test_a_process_that_dies_costs_one_piece(recorded, tmp_path, listener, run):
    bag, survey = recorded
    node = run(*node_words(survey, tmp_path / "kept"))
    listener.wait(lambda: listener.values, "the node")
    run(*replay_words(bag))
    listener.wait(lambda: children(node), "the process that calibrates")
    # with "spawn" a process that looks after resources is a child, too
    for pid in children(node):
        os.kill(pid, signal.SIGKILL)
    listener.wait(lambda: listener.values["crashes"] == "1", "the crash to be noticed")
    assert "check the memory" in listener.text
    listener.wait(lambda: listener.values["pieces taken"] == "2", "the pieces after it")
    (worker,) = (
        pid for pid in children(node) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
    os.killpg(node.pid, signal.SIGINT)
    assert node.wait(timeout=PATIENCE) == 0, "".join(node.lines)
    assert not Path(f"/proc/{worker}").exists()
