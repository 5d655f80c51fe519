"""What the messages of a bag say about themselves: frames, topics, anchors. A rule takes a
Recording and yields Findings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.streams import ERROR, NOTE, WARNING, Finding

from ..bags.messages import BODY_FRAME
from ..bags.placing import is_body
from ..clock import SET, SILENCE, WORDS, WRAP, apart, in_words
from .recording import IMU
from .tdoa_rules import furthest, same_place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..bags.placing import Place
    from .recording import Recording

WHEELS = "velocity/odometry"
TURNED, SHIFTED = np.deg2rad(2.0), 0.02  # rad and m that a frame may be off the body frame


def frames(recording: Recording) -> Iterator[Finding]:
    """A frame that is not the body's: placed by /tf_static, as the nodes and the tools take it, or
    by nobody.
    """
    for topic, counts in recording.frames.items():
        for frame in sorted(counts):
            if not is_body(frame):
                yield from _frame(topic, frame, recording.places.get(frame))


def _frame(topic: str, frame: str, place: Place | None) -> Iterator[Finding]:
    if place is None:
        cause = f"{topic} is in the frame {frame}, and nothing says how that sits on {BODY_FRAME}"
        line = (
            f"publish on /tf_static how {frame} sits on {BODY_FRAME}, or have the driver write "
            f"frame_id {BODY_FRAME}"
        )
        yield Finding(
            "frame_unknown", WARNING, cause, f"no transform to {frame} in /tf_static", line, np.nan
        )
        return
    turn, arm = place
    if turn.magnitude() < TURNED and np.linalg.norm(arm) < SHIFTED:
        return
    roll, pitch, yaw = turn.as_euler("xyz", degrees=True)
    evidence = f"roll {roll:.0f}, pitch {pitch:.0f}, yaw {yaw:.0f} degrees and "
    evidence += f"({arm[0]:.2f}, {arm[1]:.2f}, {arm[2]:.2f}) m on {BODY_FRAME}"
    cause = (
        f"{topic} is in the frame {frame}, which /tf_static places on {BODY_FRAME}; its samples "
        "are taken there"
    )
    line = "ros2 topic echo /tf_static  # nothing to do if that is how it is mounted"
    yield Finding("frame_turned", NOTE, cause, evidence, line, turn.magnitude())


def senders(recording: Recording) -> Iterator[Finding]:
    """Two frames on one topic: two tags, or two sensors."""
    for topic, counts in recording.frames.items():
        if len(counts) > 1:
            names = ", ".join(
                f"{frame or '(none)'}: {count}" for frame, count in sorted(counts.items())
            )
            line = (
                "give each tag a namespace of its own: start its driver with --ros-args -r "
                "__ns:=/tag2"
            )
            yield Finding(
                "senders",
                ERROR,
                f"{topic} comes from several senders",
                f"messages by frame_id: {names}",
                line,
                float(len(counts)),
            )


def no_imu(recording: Recording) -> Iterator[Finding]:
    """No inertial samples, or under another name."""
    if recording.imu is not None:
        return
    there = sorted(
        topic for topic, kind in recording.topics.items() if kind == "sensor_msgs/msg/Imu"
    )
    if there:
        line = (
            f"give --topic {IMU}={there[0]} to tools that read the bag, and -r {IMU}:={there[0]} "
            "to ekf_node"
        )
        yield Finding(
            "imu_elsewhere",
            WARNING,
            f"no inertial samples on {IMU}",
            f"but on {', '.join(there)}",
            line,
            0.0,
        )
    elif recording.topics:
        yield Finding(
            "imu_missing",
            WARNING,
            f"no inertial samples on {IMU}",
            "no topic of the type sensor_msgs/Imu",
            "-p use_imu:=false  # of ekf_node, if there is no IMU",
            0.0,
        )


def odometry_unread(recording: Recording) -> Iterator[Finding]:
    """Odometry, as of wheels, under a name that nothing reads.

    What a filter of ours gave, for whatever tag, is none.
    """
    tags = [
        topic.removesuffix("uwb/tdoa") for topic in recording.topics if topic.endswith("/uwb/tdoa")
    ]
    known = {
        *recording.read,
        *(f"{tag}{ours}" for tag in tags for ours in ("odometry", "odometry/debiased")),
    }
    there = sorted(
        topic
        for topic, kind in recording.topics.items()
        if kind == "nav_msgs/msg/Odometry" and topic not in known
    )
    if there and "velocity" not in recording.sensors:
        line = (
            f"if it is of wheels or a camera: --topic {WHEELS}={there[0]} for tools, and -r "
            f"{WHEELS}:={there[0]} for ekf_node"
        )
        cause, evidence = (
            f"the odometry on {', '.join(there)} is not used",
            f"velocities are read from velocity and {WHEELS}",
        )
        yield Finding("odometry_unread", WARNING, cause, evidence, line, float(len(there)))


def anchors(recording: Recording) -> Iterator[Finding]:
    """The anchors in the bag, which the nodes use, against the survey."""
    if recording.recorded is None or same_place(recording.anchors, recording.recorded):
        return
    off = furthest(recording.anchors, recording.recorded)
    evidence = (
        f"the same ids are up to {off:.2f} m apart" if np.isfinite(off) else "no id in common"
    )
    line = (
        "give both nodes the survey as anchors_file, or replay a bag that `convert --survey` has "
        "made of this bag"
    )
    yield Finding(
        "survey_differs",
        NOTE,
        (
            "the bag holds other anchors than the survey, which counts here; nodes without an "
            "anchors_file take those of the bag"
        ),
        evidence,
        line,
        off,
    )


def sorted_file(recording: Recording) -> Iterator[Finding]:
    """A file whose stamps fall: the reader has put them in order."""
    if recording.falls:
        yield Finding(
            "stamps_fall",
            WARNING,
            "messages in the file are out of order",
            f"the stamps fall {recording.falls} times",
            "-p reorder:=0.02 -p lag:=0.3  # of ekf_node, for the same driver live",
            float(recording.falls),
        )


def clock(recording: Recording) -> Iterator[Finding]:
    """A clock that started again, wrapped or was set while it was recorded, and single stamps of no
    time at all.
    """
    for jump in recording.jumps:
        cause, done = in_words(jump)
        if jump.kind == SILENCE:
            remedy = "record with ros2 bag record, whose arrival times tell one from the other"
            yield Finding("clock_silence", WARNING, cause, done, remedy, jump.by)
        elif jump.kind == WRAP:
            remedy = "count the wraps in the driver: live, ekf_node starts anew at each of them"
            yield Finding("clock_wrap", ERROR, cause, done, remedy, jump.by)
        elif jump.kind == SET:
            remedy = (
                "set the clock before the recording begins (chronyc waitsync), or stamp with a "
                "clock that nobody sets"
            )
            yield Finding("clock_set", ERROR, cause, done, remedy, jump.by)
        else:
            remedy = "record each start of the tag by itself; live, ekf_node starts anew there"
            yield Finding("clock_restart", ERROR, cause, done, remedy, jump.by)
    for name, count in recording.outliers.items():
        cause = (
            f"{count} messages of {WORDS.get(name, name)} have stamps far from those of their "
            "neighbours"
        )
        remedy = (
            "stamp when the sample is measured; look for a field that is not initialised, or a "
            "transfer that is not checked"
        )
        yield Finding(
            "stamps_wild",
            WARNING,
            cause,
            "they are left out here, and by the nodes",
            remedy,
            float(count),
        )


def other_time(recording: Recording) -> Iterator[Finding]:
    """A sensor of which no message is stamped within the time of the TDOAs; what is about the IMU,
    stream rules say, unless it is alone.
    """
    for name, ahead, count in apart(
        {"tdoa": recording.tdoa.t, **{name: of.t for name, of in recording.sensors.items()}}
    ):
        topic = WORDS.get(name, name)
        cause = (
            f"the stamps of {topic} are {abs(ahead):.3f} s "
            f"{'ahead of' if ahead > 0.0 else 'behind'} those of uwb/tdoa"
        )
        evidence = (
            f"none of its {count} messages is stamped within the time of the TDOAs: none can be "
            "used"
        )
        yield Finding(
            "sensor_apart",
            ERROR,
            cause,
            evidence,
            "stamp all sensors with the clock of one machine",
            ahead,
        )


def losses(recording: Recording) -> Iterator[Finding]:
    """What the reader of the recording has not used."""
    for cause, evidence, remedy in recording.losses:
        yield Finding("imu_lost", WARNING, cause, evidence, remedy, np.nan)


LABEL_RULES = (frames, senders, no_imu, odometry_unread, anchors, sorted_file, clock, other_time, losses)
