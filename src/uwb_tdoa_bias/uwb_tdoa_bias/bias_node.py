# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""bias_node: raw TDOAs in, corrected TDOAs out.

uwb/tdoa (Tdoa), odometry (nav_msgs/Odometry), uwb/anchors (AnchorArray), /tf_static; on request
/uwb/calibration (Calibration)
  -> uwb/tdoa_corrected (TdoaCorrected: one for each Tdoa), /diagnostics
  (diagnostic_msgs/DiagnosticArray).
Every parameter is documented in config/bias_node.yaml.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
import math
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
import numpy as np

from uwb_tdoa_msgs.msg import Calibration, Tdoa, TdoaCorrected

from .common.anchors import Anchors
from .common.errors import InputError
from .common.stamps import LARGEST_STEP_BACK, PoseQueue, StampGate
from .correction.corrector import (
    Correction,
    Corrector,
    Poses,
    orientation_remarks,
    parts_of,
    warm_up,
)
from .correction.model import EFFECTS, FADED, NETWORK, PASSED, load_network
from .effects import EffectSet, LabelEffect
from .effects.base import relabelled
from .effects.tag import TagLeverArm
from .ros.anchors import (
    ANCHORS_FILE,
    ANCHORS_QOS,
    CALIBRATION,
    MOST_FRAMES,
    AnchorsInput,
    FramesInput,
    of_calibration,
    unknown_frame,
)
from .ros.cdr import CdrCodec, CdrTemplate
from .ros.node import (
    FROZEN,
    Diagnostics,
    Parameter,
    Rate,
    Report,
    StreamNode,
    StreamPoller,
    declare_all,
    refuse_unknown,
    run,
)
from .ros.topics import Epoch, Input, StreamOutput, Streams, several_publishers

PARAMETERS = {  # in the order of config/bias_node.yaml
    "anchors_file": ANCHORS_FILE,
    "effects_file": Parameter(
        "",
        (
            'path of an effects.yaml: which systematic effects to remove, with which values; "" '
            "for none"
        ),
    ),
    "model_file": Parameter(
        "",
        'path of an ONNX bias model, as `train` or `export` writes it; "" for none',
    ),
    "pose_lag": Parameter(
        0.05,
        (
            "s; a TDOA is corrected at the newest pose at least this much older than the TDOA "
            "before it"
        ),
        0.001,
        10.0,
    ),
    "hold": Parameter(
        0.225,
        "s of stamps; longest wait for that pose: above ekf_node's lag - pose_lag, below its lag",
        0.001,
        100.0,
    ),
    "calibrated": Parameter(
        False,
        (
            "take positions and delays of anchors from /uwb/calibration, which calibration_node "
            "finds, instead of those in effects_file"
        ),
    ),
    "body_frame": Parameter(
        "base_link",
        (
            "frame of the odometry's body; TDOAs in another frame are of an antenna that "
            "/tf_static places in it"
        ),
    ),
    "frozen": FROZEN,
}
POSE = "pose", "twist"  # fields read of an Odometry: numbers
MEASURED = "anchor_a", "anchor_b", "distance_difference", "variance"  # fields read of a Tdoa
CORRECTED = (  # fields written of a TdoaCorrected
    "anchor_a",
    "anchor_b",
    "raw",
    "variance",
    "bias",
    "bias_std",
    "corrected",
    "status",
    "bias_slope",
    "bias_state",
)
EARLY = 2000  # TDOAs kept until anchors arrive
Item = tuple[Any, ...]  # one TDOA: frame, sec, nanosec, and MEASURED
FRAME, ANCHOR_A, ANCHOR_B, DIFFERENCE = 0, 3, 4, 5  # places in an Item
STATUS = {PASSED: "passed", EFFECTS: "effects", NETWORK: "network", FADED: "faded"}


@dataclass
class Antenna:
    """Corrections for the TDOAs of one frame.

    Attributes
    ----------
    effects : EffectSet, including the antenna's place on the body
    name_of_status : {status of a correction: name of the bias model in messages}
    trouble : why the place of the antenna is unknown, or None
    corrector : Corrector, once there are anchors
    heard : number of TDOAs since the last report
    """

    effects: EffectSet
    name_of_status: dict[int, str]
    trouble: str | None = None
    corrector: Corrector | None = None
    heard: int = 0


class BiasNode(StreamNode):
    """Node around a Corrector: converts messages and counts them.

    Every TDOA is counted: received = published + waiting + dropped.
    """

    NAME = "bias_node"

    def __init__(self, member: Collection[str] | None = None, **options: Any) -> None:
        """Start the node.

        Parameters
        ----------
        member : None for a separate node. In a localization_node: names of parameters of its other nodes;
            it calls the turns of this node and hands over the odometry.
        options : of Node
        """
        super().__init__(self.NAME, **options)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self, member or ())
        effects_file, model_file = own["effects_file"], own["model_file"]
        self._lag, self._limit, self._body = own["pose_lag"], own["hold"], own["body_frame"]
        effects = EffectSet.from_yaml(effects_file) if effects_file else EffectSet()
        self._calibrations: Input | None = None
        self._calibration = 0  # number of the one in use
        if own["calibrated"]:
            if own["frozen"]:
                raise InputError(
                    "calibrated: changes the correction while the node runs, and frozen forbids that; "
                    "leave one of them out."
                )
            effects = effects.with_anchors()  # they are compiled now
            self._calibrations = Input(
                self, Calibration, CALIBRATION, self._on_calibration, ANCHORS_QOS
            )
        self._effects = effects
        self._late = self._effects.stamp_offset("tdoa")  # s
        self._labels = [one for one in self._effects if isinstance(one, LabelEffect)]
        self._model = load_network(model_file)
        self._known_poses = Poses()  # of all correctors
        self._antennas: dict[str, Antenna] = {}  # by frame of the TDOAs
        self._body_antenna = Antenna(self._effects, self._compiled_names(self._effects))
        self._epoch, self._rate = Epoch(), Rate()
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()  # at the last report
        self._hold = PoseQueue(self._limit)
        self._tdoas, self._poses = StampGate(), StampGate()
        self._codec = CdrCodec(TdoaCorrected, *CORRECTED)
        self._template = lru_cache(MOST_FRAMES)(self._new_template)
        self.output = StreamOutput(self, TdoaCorrected, "uwb/tdoa_corrected")
        self._frames = FramesInput(self, self._epoch.seconds, self._on_frames)
        self._anchors = AnchorsInput(self, self._on_anchors, own["anchors_file"])
        self.streams = Streams(self, self._epoch, self._release)
        self.streams.add(
            CdrCodec(Odometry, *POSE), "odometry", self._on_odometry, handed=member is not None
        )
        self.streams.add(CdrCodec(Tdoa, *MEASURED), "uwb/tdoa", self._on_tdoa)
        self._diagnostics = Diagnostics(self, self._report)
        self._anchors.start()
        if member is None:
            self.turns = StreamPoller([self.streams.take])
        self.ready = f"ready; correcting with: {self._model_name}"

    @property
    def holds(self) -> int:
        """Number of TDOAs that wait for their pose."""
        return len(self._hold)

    @property
    def _all_antennas(self) -> list[Antenna]:
        """All antennas, that of the body first."""
        return [self._body_antenna, *self._antennas.values()]

    @property
    def _model_name(self) -> str:
        """Name of the bias model that corrects the TDOAs."""
        placed = [*self._antennas.values(), self._body_antenna]
        return placed[0].name_of_status[NETWORK]

    @property
    def _idle(self) -> bool:
        return all(antenna.name_of_status[NETWORK] == "none" for antenna in self._all_antennas)

    def _compiled_names(self, effects: EffectSet) -> dict[int, str]:
        """Compile the functions of an EffectSet, and return `name_of_status` for an Antenna."""
        return warm_up(effects, self._model, self._lag).name_of_status

    def _start_over(self) -> None:
        """Delete the poses and all TDOAs that wait for one."""
        self._counts["dropped"] += len(self._hold)
        self._hold = PoseQueue(self._limit)
        self._known_poses.clear()
        for antenna in self._all_antennas:
            if antenna.corrector is not None:
                antenna.corrector.reset()

    def _give_corrector(self, antenna: Antenna) -> None:
        """Give an Antenna its Corrector, once there are anchors."""
        anchors = self._anchors.anchors
        if anchors is not None:
            antenna.corrector = Corrector(
                anchors, antenna.effects, self._model, self._lag, self._known_poses
            )

    def _on_anchors(self, anchors: Anchors) -> None:
        known = self._body_antenna.corrector
        if known is not None and known.anchors.frame != anchors.frame:
            self._start_over()
        for antenna in self._all_antennas:
            if antenna.corrector is None:
                self._give_corrector(antenna)
            else:
                antenna.corrector.change_anchors(anchors)
        self._release()

    def _on_calibration(self, message: Calibration) -> None:
        """Replace positions and delays of the anchors in the effects of all antennas."""
        anchors = self._anchors.anchors
        try:
            found = of_calibration(message)
            if anchors is not None and message.header.frame_id != anchors.frame:
                raise InputError(
                    f"it is in frame '{message.header.frame_id}', the anchors in '{anchors.frame}'."
                )
        except InputError as error:
            self.warn_at_times(CALIBRATION, f"{CALIBRATION}: not taken: {error}")
            return
        self._calibration, self._effects = message.number, self._effects.with_anchors(found)
        for antenna in self._all_antennas:
            antenna.effects = antenna.effects.with_anchors(found)
            if antenna.corrector is not None:
                antenna.corrector.change_effects(antenna.effects)

    def _on_frames(self) -> None:
        """Update all antennas after a new or changed constant transform."""
        for frame in [*self._antennas]:
            self._place_antenna(frame)

    def _antenna(self, frame: str) -> Antenna:
        """Return the Antenna of TDOAs of a frame."""
        if frame in self._antennas:
            return self._antennas[frame]
        if frame in ("", self._body) or len(self._antennas) >= MOST_FRAMES:
            return self._body_antenna
        self._place_antenna(frame)
        return self._antennas[frame]

    def _place_antenna(self, frame: str) -> None:
        """Find the place of an antenna on the body, and set its effects.

        frame : of its TDOAs, not the body frame
        """
        trouble, effects, known = None, self._effects, self._antennas.get(frame)
        between = self._frames.frames.between(self._body, frame)
        held = self._model.holds if self._model else ()
        if TagLeverArm.name in (*held, *(effect.name for effect in effects.effects)):
            source = "model_file" if TagLeverArm.name in held else "effects_file"
            self.get_logger().info(
                f"{TagLeverArm.name} of {source} counts, not the transform of '{frame}'"
            )
        elif between is None:
            trouble = unknown_frame("uwb/tdoa", frame, self._body)
        elif between[1].any():
            try:
                effects = EffectSet(
                    (*effects.effects, TagLeverArm(values=dict(zip("xyz", between[1].tolist()))))
                )
            except InputError as error:
                trouble = (
                    f"uwb/tdoa: the place of '{frame}' on '{self._body}' in /tf_static is not "
                    f"taken: {error}"
                )
        if trouble:
            self.warn_at_times(f"antenna {frame}", trouble)
        if known is not None and effects.effects == known.effects.effects:
            known.trouble = trouble
            return
        elsewhere = effects.effects != self._effects.effects
        names = self._body_antenna.name_of_status
        if elsewhere:
            names = self._compiled_names(effects)
        antenna = self._antennas[frame] = Antenna(effects, names, trouble)
        self._give_corrector(antenna)
        if elsewhere:
            self.get_logger().info(
                f"'{frame}' is placed by /tf_static; correcting with: {names[NETWORK]}"
            )

    def _on_odometry(
        self, frame: str, t: np.ndarray, rows: np.ndarray, arrival: np.ndarray
    ) -> None:
        self._counts["poses"] += len(t)
        if self._idle:
            return
        anchors = self._anchors.anchors
        if anchors is not None and frame != anchors.frame:
            self.warn_at_times(
                "frame of odometry",
                f"odometry is in frame '{frame}', the anchors in '{anchors.frame}': taken as the "
                "same frame",
            )
        if self._poses.take_all(t.tolist()):
            self._add_poses(t, rows)
        else:
            for k, stamp in enumerate(t.tolist()):
                self._take_pose(stamp, rows[k : k + 1])

    def _take_pose(self, t: float, row: np.ndarray) -> None:
        """Take one pose, after the gate has judged its stamp; t : s; row : (1,)."""
        accepted, _, jumped_back = self._poses.take(t, row, [self._tdoas.newest, self._tdoas.held])
        if jumped_back:
            self._start_over()
            held, self._tdoas = self._tdoas.finish(), StampGate()
            for stamp, item in held:
                if item is not None:  # else it is already published
                    self._take([stamp], [item])
        for stamp, row in accepted:
            self._add_poses(np.array([stamp]), row)

    def _add_poses(self, t: np.ndarray, rows: np.ndarray) -> None:
        self._known_poses.add(t, *parts_of(*(np.array(rows[name]) for name in POSE)))

    def _on_tdoa(self, frame: str, t: np.ndarray, rows: np.ndarray, arrival: np.ndarray) -> None:
        self._counts["received"] += len(t)
        antenna = self._antenna(frame)
        antenna.heard += len(t)
        if self._labels:
            rows = self._relabelled(rows)
        items = [(frame, *row) for row in rows.tolist()]
        if self._idle:
            self._publish(items, Correction.none(rows["distance_difference"]))
        else:
            self._take(t.tolist(), items)

    def _relabelled(self, rows: np.ndarray) -> np.ndarray:
        """Return rows of TDOAs with corrected ids and signs."""
        rows, names = rows.copy(), MEASURED[:3]
        a, b, d = (rows[name] for name in names)
        for name, column in zip(names, relabelled(self._labels, a, b, d)):
            rows[name] = column
        return rows

    def _take(self, stamps: Sequence[float], items: Iterable[Item | None]) -> None:
        """Queue TDOAs for their poses.

        stamps : s, as received; items : (frame, sec, nanosec, a, b, d, variance)
        """
        stamps = [t - self._late for t in stamps]
        if stamps and self._tdoas.take_all(stamps):
            for t, item in zip(stamps, items):
                self._hold.add(t, item)
            return
        for t, item in zip(stamps, items):
            if (
                t < self._tdoas.newest - LARGEST_STEP_BACK
            ):  # published at once; ekf_node decides whether time restarts
                self._pass(item)
                item = None
            accepted, outliers, jumped_back = self._tdoas.take(t, item, [self._poses.newest])
            for _, outlier in outliers:  # ekf_node reports its wrong stamp
                self._pass(outlier)
            if jumped_back:
                self.get_logger().info("time has gone back: starting over")
                self._start_over()
                held, self._poses = self._poses.finish(), StampGate()
                for stamp, row in held:
                    self._take_pose(stamp, row)
            for stamp, kept in accepted:
                if kept is not None:
                    self._hold.add(stamp, kept)

    def _pass(self, item: Item | None) -> None:
        """Publish a TDOA uncorrected, unless it is already published."""
        if item is not None:
            self._publish([item], Correction.none(np.array([item[DIFFERENCE]])))

    def _release(self) -> None:
        """Publish all TDOAs that need not wait longer."""
        correctors = [one.corrector for one in self._all_antennas if one.corrector is not None]
        if not correctors:
            self._counts["dropped"] += self._hold.shorten(EARLY)
            return
        # all have the same poses; one whose effects need none is always ready
        waiting = next((one for one in correctors if one.uses_pose), correctors[0])
        has_poses = self._poses.newest > -math.inf
        released = self._hold.take(lambda preceding: not has_poses or waiting.ready(preceding))
        for _, of_frame in groupby(released, lambda one: one[1][FRAME]):
            self._correct_and_publish(*zip(*of_frame))

    def _correct_and_publish(
        self, stamps: Sequence[float], items: Sequence[Item], ready: Sequence[bool]
    ) -> None:
        """Correct and publish TDOAs of one frame.

        stamps : s; items : as in `_take`; ready : whether the pose of each is known
        """
        corrector: Any = self._antenna(items[0][FRAME]).corrector  # exists once anchors arrived
        t, d = np.array(stamps), np.array([item[DIFFERENCE] for item in items])
        a = corrector.anchors.index([item[ANCHOR_A] for item in items])
        b = corrector.anchors.index([item[ANCHOR_B] for item in items])
        valid = (a >= 0) & (b >= 0) & (a != b) & np.isfinite(d)
        correction = corrector.correct(t[valid], a[valid], b[valid], d[valid])
        if not valid.all():  # the others pass uncorrected
            of_valid, correction = correction, Correction.none(d)
            for name, values in vars(of_valid).items():
                getattr(correction, name)[valid] = values
        self._counts["invalid"] += len(t) - int(valid.sum())
        self._counts["unready"] += len(t) - sum(ready)
        self._publish(items, correction, self._epoch.parts(t) if self._late else None)

    def _publish(
        self,
        items: Sequence[Item],
        correction: Correction,
        stamps: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Publish corrected TDOAs.

        items : as in `_take`; correction : of these
        stamps : seconds and nanoseconds, (n,) each, that replace their own
        """
        frames, *columns = zip(*items)
        measured = columns if stamps is None else (*stamps, *columns[2:])  # up to the variance
        values = [np.array(column) for column in (*measured, *vars(correction).values())]
        status = correction.status.tolist()
        names = [self._antenna(frame).name_of_status[one] for frame, one in zip(frames, status)]
        first = 0
        for (frame, model), same in groupby(zip(frames, names)):
            end = first + len(list(same))
            template = self._template(frame, model)
            rows = template.rows(end - first)
            for name, column in zip(("sec", "nanosec", *CORRECTED), values):
                rows[name] = column[first:end]
            self.output.publish(frame, template, rows)
            first = end
        self._counts["published"] += len(items)
        self._counts.update(STATUS[one] for one in status)

    def _new_template(self, frame: str, model: str) -> CdrTemplate:
        message = TdoaCorrected(model=model)
        message.header.frame_id = frame
        return self._codec.template(message)

    def _report(self) -> Report:
        counts, inputs = self._counts, self.streams.inputs
        rate = self._rate.of(counts["received"])
        new = counts - self._reported
        self._reported = counts.copy()
        recent = {"uwb/tdoa": new["received"], "odometry": new["poses"]}
        others = [*self._anchors.refusals, *self._frames.refusals]
        others += [self._calibrations.refusals] if self._calibrations else []
        wiring = [
            *(end.trouble(recent[name]) for name, end in inputs.items()),
            several_publishers(self, "uwb/tdoa_corrected"),
            *(refusals.trouble() for refusals in others),
            self._frames.trouble,
        ]
        correctors = [antenna.corrector for antenna in self._all_antennas]
        outside = [phrase for one in correctors if one is not None for phrase in one.outside]
        values = {
            "model": self._model_name,
            "calibration": self._calibration,
            "received": counts["received"],
            "published": counts["published"],
            "waiting": len(self._hold) + len(self._tdoas),
            "dropped": counts["dropped"],
            **{name: counts[name] for name in STATUS.values()},
            "released before their pose": counts["unready"],
            "invalid": counts["invalid"],
            "beyond where effects were seen": "; ".join(outside) or "nothing",
            "poses": counts["poses"],
            "TDOA rate": f"{rate:.1f} Hz",
            **{f"publishers of {name}": end.get_publisher_count() for name, end in inputs.items()},
            "subscribers of uwb/tdoa_corrected": self.output.publisher.get_subscription_count(),
            **{f"lost on {name}": end.lost for name, end in inputs.items()},
            **{
                f"unreadable on {end.topic}": end.count for end in (*self.streams.refusals, *others)
            },
        }
        level, text = self._health(rate, new)
        if level != DiagnosticStatus.ERROR and any(wiring):
            level, text = DiagnosticStatus.WARN, next(filter(None, wiring))
        return level, text, values

    def _health(self, rate: float, new: Counter[str]) -> tuple[bytes, str]:
        """Return (level, text); rate : Hz, of TDOAs; new : counts since the last report."""
        for antenna in self._antennas.values():
            heard, antenna.heard = antenna.heard, 0
            if antenna.trouble and heard:
                return DiagnosticStatus.WARN, antenna.trouble
        if self._idle:
            return (
                DiagnosticStatus.OK,
                "passing TDOAs on: neither effects_file nor model_file is set",
            )
        if self._anchors.refused:
            return DiagnosticStatus.ERROR, self._anchors.refused
        if self._anchors.anchors is None:
            return (
                DiagnosticStatus.ERROR,
                "no anchors yet: publish them on uwb/anchors, reliable and transient local",
            )
        if not rate:
            return (
                DiagnosticStatus.WARN,
                "no TDOAs on uwb/tdoa: check that the tag's driver runs in this namespace",
            )
        trouble = self._model and self._model.trouble(self._anchors.anchors)
        if trouble:
            return DiagnosticStatus.WARN, f"model_file {trouble}"
        if self._poses.newest == -math.inf:
            runs = self.streams.inputs["odometry"].get_publisher_count()
            remedy = "see the status of ekf_node, which runs" if runs else "start ekf_node"
            return (
                DiagnosticStatus.WARN,
                f"no poses on odometry yet: what needs one is not corrected; {remedy}",
            )
        if new["unready"]:
            return (
                DiagnosticStatus.WARN,
                "odometry is late: TDOAs leave before their pose; check the load of ekf_node",
            )
        model, judged = self._model, new["published"] - new["invalid"]
        if model and judged > 0 and not any(new[STATUS[one]] for one in model.statuses):
            return (
                DiagnosticStatus.WARN,
                "model_file gives no possible bias for any TDOA, and none is corrected by it: train "
                "or export it again",
            )
        for remark in orientation_remarks(self._anchors.anchors, self._effects, self._model):
            return DiagnosticStatus.WARN, remark
        return DiagnosticStatus.OK, f"correcting with {self._model_name}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node, and return the exit code."""
    return run(BiasNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
