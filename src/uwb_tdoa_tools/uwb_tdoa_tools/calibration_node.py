# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""calibration_node: calibrates the anchors while a tag moves.

uwb/tdoa (Tdoa), imu/data (sensor_msgs/Imu), uwb/anchors (AnchorArray), /tf_static; if they are there:
SENSORS
  -> /uwb/calibration (Calibration, for bias_nodes with `calibrated`), /diagnostics
  (diagnostic_msgs/DiagnosticArray).
Service ~/use (std_srvs/SetBool): false goes back to the anchors as given, true on to the calibration.
A process of its own at the lowest priority calibrates, as `calibrate --stream` does.
Every parameter is documented in config/calibration_node.yaml.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
import os
from pathlib import Path
import sys

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.common import sensors
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.ros.anchors import (
    ANCHORS_FILE,
    ANCHORS_QOS,
    CALIBRATION,
    MOST_FRAMES,
    TF_STATIC_QOS,
    AnchorsInput,
    calibration_to_message,
)
from uwb_tdoa_bias.ros.cdr import decode, message_class
from uwb_tdoa_bias.ros.node import (
    Diagnostics,
    Parameter,
    Report,
    StreamNode,
    declare_all,
    refuse_unknown,
    run,
)
from uwb_tdoa_bias.ros.topics import Input, StreamInput
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_msgs.msg import Calibration

from .choices import TAPE_STD, TRUSTED_STD
from .diagnosis.self_calibration import Tape
from .surveying.pieces import TDOAS, TOPICS, Piece, PieceCutter, Taken, Worker, keep, last_kept
from .surveying.stream import StreamCalibration

PARAMETERS = {  # in the order of config/calibration_node.yaml
    "anchors_file": ANCHORS_FILE,
    "effects_file": Parameter("", 'effects.yaml of bias_node and ekf_node; "" for none'),
    "ekf_params": Parameter("", 'parameter file of ekf_node; "" for its defaults'),
    "tape_std": Parameter(
        TAPE_STD, "m; standard deviation of each coordinate of the survey", 0.001, 5.0
    ),
    "trusted": Parameter(
        [""],
        (
            f"anchors (3) or coordinates (3.z) that are surveyed to {100 * TRUSTED_STD:g} cm; "
            '[""] for none'
        ),
    ),
    "calibration_folder": Parameter(
        "",
        (
            "folder in which the last calibrations are kept, and from which the newest is taken at the "
            'start; "" for none'
        ),
    ),
}
HAND_OVER, STEP = 5.0, 0.25  # s, of a new calibration, and between the messages of it
NICE = 5  # of its process: the odometry comes first, see docs/notebook/calibration.md
REST = 0.05  # s between two turns: nobody waits for this node
MOST_PIECES = 2  # pieces that wait for the process


def _with_bytes(content: bytes) -> tuple[bytes, TFMessage]:
    return content, decode(content, TFMessage)


class CalibrationNode(StreamNode):
    """Cut what it hears into pieces, and publish what a Worker finds from them."""

    NAME = "calibration_node"
    PERIOD = REST

    def __init__(self) -> None:
        """Declare parameters, and connect all topics."""
        os.setpriority(os.PRIO_PROCESS, 0, max(NICE, os.getpriority(os.PRIO_PROCESS, 0)))
        super().__init__(self.NAME)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self)
        effects, config = own["effects_file"], own["ekf_params"]
        self._base = EffectSet.from_yaml(effects) if effects else EffectSet()
        self._config = FilterConfig.from_yaml(config) if config else None
        self._tape = Tape(own["tape_std"], trusted=tuple(filter(None, own["trusted"])))
        folder = own["calibration_folder"]
        self._folder = Path(folder) if folder else None
        self._cutter, self._frames = PieceCutter(), dict[tuple[str, ...], bytes]()
        self._pieces: list[Piece] = []  # that wait
        self._worker: Worker | None = None
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()  # at the last report
        self._text, self._trouble = "no piece is complete yet", ""
        self._refused = ""  # why these anchors are not calibrated
        self._cost = 0.0  # s of processor time of the last piece
        self._found = self._base  # calibration in use, of this number
        self._number, self._last, self._in_use = 0, 0.0, True
        self._shown = self._target = Calibration()  # published last, and after a hand-over
        self._share = 1.0  # of a hand-over
        self._publisher = self.create_publisher(Calibration, CALIBRATION, ANCHORS_QOS)
        self._inputs = {
            topic: StreamInput(self, message_class(kind), topic) for topic, kind in TOPICS.items()
        }
        Input(self, TFMessage, "/tf_static", self._on_frames, TF_STATIC_QOS, read=_with_bytes)
        self._anchors = AnchorsInput(self, self._on_anchors, own["anchors_file"])
        self.create_service(SetBool, "~/use", self._on_use)
        self.create_timer(STEP, self._hand_over, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._diagnostics = Diagnostics(self, self._report)
        self._anchors.start()
        self.turns = self
        self.ready = "ready; calibrating while the tag moves"

    def _on_frames(self, received: tuple[bytes, TFMessage]) -> None:
        """Keep the last message on the same frames; publishers may repeat theirs."""
        content, message = received
        children = tuple(each.child_frame_id for each in message.transforms)
        if children in self._frames or len(self._frames) < MOST_FRAMES:
            self._frames[children] = content

    def _on_anchors(self, anchors: Anchors) -> None:
        """Start with Anchors, from the last calibration of them that was kept."""
        self._end_worker()
        self._cutter, self._pieces, self._refused = PieceCutter(), [], ""
        self._number, self._found, age = 0, self._base, 0.0
        try:
            self._tape.position_std(anchors)  # refuses unknown ids in `trusted`
            if self._folder is not None:
                self._number, self._found, age = last_kept(self._folder, anchors, self._base)
        except InputError as error:
            self._refused = f"not calibrating: {error}"
            self.get_logger().error(self._refused)
        if self._number:
            self._text = f"calibration {self._number} is in use, kept {age / 3600.0:.1f} h ago"
            self.get_logger().info(self._text)
        self._aim()
        self._share = 1.0
        self._publish(self._target)

    def _aim(self) -> None:
        """Start a hand-over to what is to be in use."""
        anchors = self._anchors.anchors
        assert anchors is not None
        effects = self._found if self._in_use else self._base
        self._target, self._share = calibration_to_message(effects, anchors), 0.0
        self._target.number = self._number if self._in_use else 0
        second, nanosecond = divmod(round(1e9 * self._last), 10**9)
        self._target.header.stamp = Time(sec=second, nanosec=nanosecond)

    def _hand_over(self) -> None:
        """Publish the next step of a hand-over."""
        if self._share >= 1.0:
            return
        left, self._share = 1.0 - self._share, min(1.0, self._share + STEP / HAND_OVER)
        message, part = copy(self._target), (1.0 - self._share) / left
        for name in ("shifts", "delays"):
            shown, target = (np.array(getattr(one, name)) for one in (self._shown, self._target))
            setattr(message, name, (target + part * (shown - target)).tolist())
        self._publish(message)

    def _publish(self, message: Calibration) -> None:
        self._shown = message
        self._publisher.publish(message)

    def _on_use(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._anchors.anchors is None:
            response.message = "no anchors yet"
            return response
        self._in_use = request.data
        self._aim()
        response.success = True
        response.message = (
            f"calibration {self._number} is in use in {HAND_OVER:g} s"
            if self._target.number
            else f"the anchors as given are in use in {HAND_OVER:g} s"
        )
        self.get_logger().info(response.message)
        return response

    def take(self) -> float | None:
        """Collect what has arrived, and return the rest after it, s; None if nothing has."""
        arrived = False
        for topic, end in self._inputs.items():
            messages, stamps = end.fetch_serialized()
            arrived = arrived or bool(messages)
            self._counts[topic] += len(messages)
            for content, stamp in zip(messages, stamps):
                self._cutter.add(topic, stamp, content)
        self._pieces += self._cutter.pieces()
        left_out, self._pieces = self._pieces[:-MOST_PIECES], self._pieces[-MOST_PIECES:]
        self._counts["left out"] += len(left_out)
        anchors = self._anchors.anchors
        if anchors is not None and not self._refused:
            self._serve(anchors)
        return REST if arrived else None

    def _serve(self, anchors: Anchors) -> None:
        """Give the next piece to the Worker, and use what it has found."""
        try:
            taken = self._worker and self._worker.result()
            if taken:
                self._use(taken, anchors)
            if self._pieces and (self._worker is None or not self._worker.busy):
                self._worker = self._worker or self._new_worker(anchors)
                piece = self._pieces.pop(0)
                self._worker.give(
                    Piece(piece.number, piece.first, piece.messages, [*self._frames.values()])
                )
        except (EOFError, OSError):
            self._counts["crashes"] += 1
            self._trouble = "the process that calibrates has ended: the next piece starts another; check the memory"
            self._end_worker()

    def _new_worker(self, anchors: Anchors) -> Worker:
        calibration = StreamCalibration(anchors, self._tape, self._found, self._config)
        calibration.number = self._number
        return Worker(calibration)

    def _use(self, taken: Taken, anchors: Anchors) -> None:
        """Use what came of a piece."""
        self._text, self._trouble, self._cost = taken.text, "", taken.cost
        self._counts["pieces"] += 1
        if not taken.taken:
            return
        self._number, self._found, self._last = taken.number, taken.effects, taken.last
        if self._in_use:
            self._aim()
        if self._folder is not None:
            try:
                keep(self._folder, self._number, anchors, self._found)
            except (OSError, InputError) as error:
                self._trouble = (
                    f"calibration_folder: calibration {self._number} is not kept: {error}"
                )

    def _report(self) -> Report:
        new = self._counts - self._reported
        self._reported = self._counts.copy()
        values = {
            "calibration": self._target.number,
            "last piece": self._text,
            "pieces taken": self._counts["pieces"],
            "pieces left out": self._counts["left out"],
            "processor time of the last piece": f"{self._cost:.1f} s",
            "messages that wait for the end of a piece": len(self._cutter),
            "messages left out": self._cutter.left_out,
            "crashes": self._counts["crashes"],
            **{f"received on {topic}": self._counts[topic] for topic in TOPICS},
            **{f"lost on {topic}": end.lost for topic, end in self._inputs.items()},
            f"subscribers of {CALIBRATION}": (takers := self._publisher.get_subscription_count()),
        }
        wiring = [end.trouble(new[topic]) for topic, end in self._inputs.items()]
        trouble = self._anchors.refused or self._trouble or next(filter(None, wiring), None)
        if self._anchors.anchors is None:
            trouble = trouble or "no anchors yet: publish them on uwb/anchors, or set anchors_file"
        elif not new[TDOAS]:
            trouble = trouble or "no TDOAs on uwb/tdoa: check that the tag's driver runs"
        elif not takers:
            trouble = (
                trouble or "no bias_node takes the calibration: start it with calibrated:=true"
            )
        if self._refused:
            return DiagnosticStatus.ERROR, self._refused, values
        if trouble:
            return DiagnosticStatus.WARN, trouble, values
        return DiagnosticStatus.OK, self._text, values

    def _end_worker(self) -> None:
        if self._worker is not None:
            self._worker.close()
        self._worker = None

    def destroy_node(self) -> None:
        """End the process and the node."""
        self._end_worker()
        super().destroy_node()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node, and return the exit code."""
    return run(CalibrationNode, __doc__.replace("SENSORS", sensors.in_words()), argv)


if __name__ == "__main__":
    sys.exit(main())
