# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge a recording by what its messages state: frames, topics, anchors, clocks, publishers.

A rule takes a Recording and yields Findings.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.monitoring.finding import ERROR, NOTE, WARNING, Finding

from ..bags.messages import BODY_FRAME, is_body
from ..clock import SET, SILENCE, WORDS, WRAP, apart, in_words
from .recording import IMU, Recording
from .tdoa_rules import largest_displacement, same_place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.common.transforms import Place

    from ..live.session import End


WHEELS = "velocity/odometry"
TURNED, SHIFTED = np.deg2rad(2.0), 0.02  # rad and m that a frame may be off the body frame


def sensor_mistakes(recording: Recording) -> Iterator[Finding]:
    """Yield findings about the Streams of the SENSORS, by their own rules."""
    for name, stream in recording.sensors.items():
        for rule in SENSORS[name].rules:
            found = rule(stream, recording.anchors)
            if found is not None:
                yield Finding(*found)


def frames(recording: Recording) -> Iterator[Finding]:
    """Yield frames other than the body's: /tf_static places them on the body, or nothing does."""
    for topic, counts in recording.frames.items():
        for frame in sorted(counts):
            if not is_body(frame):
                yield from _frame(topic, frame, recording.places.get(frame))


def _frame(topic: str, frame: str, place: Place | None) -> Iterator[Finding]:
    if place is None:
        yield Finding(
            "frame_unknown",
            WARNING,
            cause=(
                f"{topic} is in the frame {frame}, and nothing says how that sits on {BODY_FRAME}"
            ),
            evidence=f"no transform to {frame} in /tf_static",
            remedy=(
                f"publish on /tf_static how {frame} sits on {BODY_FRAME}, or have the driver write "
                f"frame_id {BODY_FRAME}"
            ),
            value=np.nan,
        )
        return
    turn, arm = place
    if turn.magnitude() < TURNED and np.linalg.norm(arm) < SHIFTED:
        return
    roll, pitch, yaw = turn.as_euler("xyz", degrees=True)
    evidence = f"roll {roll:.0f}, pitch {pitch:.0f}, yaw {yaw:.0f} degrees and "
    evidence += f"({arm[0]:.2f}, {arm[1]:.2f}, {arm[2]:.2f}) m on {BODY_FRAME}"
    yield Finding(
        "frame_turned",
        NOTE,
        cause=(
            f"{topic} is in the frame {frame}, which /tf_static places on {BODY_FRAME}; its "
            "samples "
            "are taken there"
        ),
        evidence=evidence,
        remedy="ros2 topic echo /tf_static  # nothing to do if that is how it is mounted",
        value=turn.magnitude(),
    )


def senders(recording: Recording) -> Iterator[Finding]:
    """Yield topics with two frames: two tags, or two sensors."""
    for topic, counts in recording.frames.items():
        if len(counts) > 1:
            names = ", ".join(
                f"{frame or '(none)'}: {count}" for frame, count in sorted(counts.items())
            )
            yield Finding(
                "senders",
                ERROR,
                cause=f"{topic} comes from several senders",
                evidence=f"messages by frame_id: {names}",
                remedy=(
                    "give each tag a namespace of its own: start its driver with --ros-args -r "
                    "__ns:=/tag2"
                ),
                value=float(len(counts)),
            )


def no_imu(recording: Recording) -> Iterator[Finding]:
    """Yield a finding if there are no inertial samples, or under another name."""
    if recording.imu is not None:
        return
    of_type = [topic for topic, kind in recording.topics.items() if kind == "sensor_msgs/msg/Imu"]
    there = sorted({*of_type} - recording.read)
    if of_type and not there:
        yield Finding(
            "imu_empty",
            WARNING,
            cause=f"no inertial samples on {IMU}",
            evidence=f"the topic {of_type[0]} is there, without a message that has both sensors",
            remedy=f"ros2 topic echo {of_type[0]}  # a covariance of -1 means unmeasured (REP 145)",
            value=0.0,
        )
    elif there:
        yield Finding(
            "imu_elsewhere",
            WARNING,
            cause=f"no inertial samples on {IMU}",
            evidence=f"but on {', '.join(there)}",
            remedy=(
                f"give --topic {IMU}={there[0]} to tools that read the bag, and -r "
                f"{IMU}:={there[0]} "
                "to ekf_node"
            ),
            value=0.0,
        )
    elif recording.topics:
        yield Finding(
            "imu_missing",
            WARNING,
            cause=f"no inertial samples on {IMU}",
            evidence="no topic of the type sensor_msgs/Imu",
            remedy="-p use_imu:=false  # of ekf_node, if there is no IMU",
            value=0.0,
        )


def odometry_unread(recording: Recording) -> Iterator[Finding]:
    """Yield odometry, as from wheels, on a topic that nothing reads.

    The odometry of our filter, for any tag, does not count.
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
        yield Finding(
            "odometry_unread",
            WARNING,
            cause=f"the odometry on {', '.join(there)} is not used",
            evidence=f"velocities are read from velocity and {WHEELS}",
            remedy=(
                f"if it is of wheels or a camera: --topic {WHEELS}={there[0]} for tools, and -r "
                f"{WHEELS}:={there[0]} for ekf_node"
            ),
            value=float(len(there)),
        )


def other_anchors(recording: Recording) -> Iterator[Finding]:
    """Yield a finding if the anchors in the bag, which the nodes use, differ from the survey."""
    if recording.recorded is None or same_place(recording.anchors, recording.recorded):
        return
    off = largest_displacement(recording.anchors, recording.recorded)
    evidence = (
        f"the same ids are up to {off:.2f} m apart" if np.isfinite(off) else "no id in common"
    )
    yield Finding(
        "survey_differs",
        NOTE,
        cause=(
            "the bag holds other anchors than the survey, which counts here; nodes without an "
            "anchors_file take those of the bag"
        ),
        evidence=evidence,
        remedy=(
            "give both nodes the survey as anchors_file, or replay a bag that `convert --survey` "
            "has "
            "made of this bag"
        ),
        value=off,
    )


def falling_stamps(recording: Recording) -> Iterator[Finding]:
    """Yield a finding if the stamps in the file fall. The reader has sorted them."""
    if recording.falls:
        yield Finding(
            "stamps_fall",
            WARNING,
            cause="messages in the file are out of order",
            evidence=f"the stamps fall {recording.falls} times",
            remedy="-p reorder:=0.02 -p lag:=0.3  # of ekf_node, for the same driver live",
            value=float(recording.falls),
        )


# {kind of a jump of the clock: (rule, severity, remedy)}, and of a restart
OF_CLOCK = {
    SILENCE: (
        "clock_silence",
        WARNING,
        "record with ros2 bag record, whose arrival times tell one from the other",
    ),
    WRAP: (
        "clock_wrap",
        ERROR,
        "count the wraps in the driver: live, ekf_node starts anew at each of them",
    ),
    SET: (
        "clock_set",
        ERROR,
        "set the clock before the recording begins (chronyc waitsync), or stamp with a clock that "
        "nobody sets",
    ),
}
RESTARTED = (
    "clock_restart",
    ERROR,
    "record each start of the tag by itself; live, ekf_node starts anew there",
)


def clock_jumps(recording: Recording) -> Iterator[Finding]:
    """Yield restarts, wraps and settings of the clock, and single wrong stamps."""
    for jump in recording.jumps:
        (rule, severity, remedy), words = OF_CLOCK.get(jump.kind, RESTARTED), in_words(jump)
        yield Finding(rule, severity, *words, remedy, jump.by)
    for name, count in recording.outliers.items():
        yield Finding(
            "stamps_wild",
            WARNING,
            cause=(
                f"{count} messages of {WORDS.get(name, name)} have stamps far from those of their "
                "neighbours"
            ),
            evidence="they are left out here, and by the nodes",
            remedy=(
                "stamp when the sample is measured; look for a field that is not initialised, or a "
                "transfer that is not checked"
            ),
            value=float(count),
        )


def sensors_apart(recording: Recording) -> Iterator[Finding]:
    """Yield sensors without a message in the time of the TDOAs.

    The rules of streams judge the IMU, unless it is alone.
    """
    for name, ahead, count in apart(
        {"tdoa": recording.tdoa.t, **{name: of.t for name, of in recording.sensors.items()}}
    ):
        topic = WORDS.get(name, name)
        yield Finding(
            "sensor_apart",
            ERROR,
            cause=(
                f"the stamps of {topic} are {abs(ahead):.3f} s "
                f"{'ahead of' if ahead > 0.0 else 'behind'} those of uwb/tdoa"
            ),
            evidence=(
                f"none of its {count} messages is stamped within the time of the TDOAs: none can "
                "be "
                "used"
            ),
            remedy="stamp all sensors with the clock of one machine",
            value=ahead,
        )


def unused_data(recording: Recording) -> Iterator[Finding]:
    """Yield data that the reader of the recording did not use."""
    for cause, evidence, remedy in recording.losses:
        yield Finding(
            "imu_lost", WARNING, cause=cause, evidence=evidence, remedy=remedy, value=np.nan
        )


def _by_topic(recording: Recording) -> Iterator[tuple[str, list[End], list[End]]]:
    """Yield (topic, publishers, subscriptions) of each live topic."""
    for topic in sorted({end.topic for end in recording.ends}):
        ends = [end for end in recording.ends if end.topic == topic]
        yield (
            topic,
            [end for end in ends if end.publishes],
            [end for end in ends if not end.publishes],
        )


def different_types(recording: Recording) -> Iterator[Finding]:
    """Yield topics with several types: such publishers and subscriptions never match."""
    for topic, publishers, subscriptions in _by_topic(recording):
        found = {end.kind for end in (*publishers, *subscriptions)}
        if len(found) > 1:
            evidence = ", ".join(
                sorted(f"{end.node}: {end.kind}" for end in (*publishers, *subscriptions))
            )
            yield Finding(
                "type_other",
                ERROR,
                cause=f"{topic} has several types",
                evidence=evidence,
                remedy=(
                    f"start the driver of the other type with --ros-args -r {topic}:={topic}_other"
                ),
                value=float(len(found)),
            )


def incompatible_qos(recording: Recording) -> Iterator[Finding]:
    """Yield subscriptions that request more than a publisher offers, and so receive nothing from it."""
    for topic, publishers, subscriptions in _by_topic(recording):
        deaf = {
            (publisher.node, end.node): (publisher, end)
            for publisher, end in product(publishers, subscriptions)
            if not any(other.gets(publisher) for other in subscriptions if other.node == end.node)
        }
        for publisher, end in deaf.values():
            yield Finding(
                "qos_unmatched",
                ERROR,
                cause=(
                    f"{end.node} hears nothing of what {publisher.node} publishes on {topic}: it "
                    "asks "
                    "for more than is offered"
                ),
                evidence=f"published {publisher.qos}; asked for: {end.qos}",
                remedy=_stronger(publisher, end),
                value=np.nan,
            )


def _stronger(publisher: End, end: End) -> str:
    """Return the QoS to write in the node that publishes."""
    policies = ["reliability=ReliabilityPolicy.RELIABLE"] * end.reliable + [
        "durability=DurabilityPolicy.TRANSIENT_LOCAL"
    ] * end.latched
    return (
        f"qos = QoSProfile(depth=100, {', '.join(policies)})  # in {publisher.node}, or ask for "
        f"less in {end.node}"
    )


def several_publishers(recording: Recording) -> Iterator[Finding]:
    """Yield live topics with several publishers. Many nodes may publish /tf and /tf_static."""
    for topic, publishers, _ in _by_topic(recording):
        if len(publishers) > 1 and topic.rpartition("/")[2] not in ("tf", "tf_static"):
            names = ", ".join(sorted(end.node for end in publishers))
            yield Finding(
                "publishers_several",
                ERROR,
                cause=f"{len(publishers)} publish on {topic}",
                evidence=names,
                remedy=(
                    "give each tag a namespace of its own: start its driver with --ros-args -r "
                    "__ns:=/tag2, or stop all but one"
                ),
                value=float(len(publishers)),
            )


def volatile_anchors(recording: Recording) -> Iterator[Finding]:
    """Yield anchors that late subscriptions do not get, unless they are repeated."""
    for topic, publishers, _ in _by_topic(recording):
        for publisher in publishers:
            if topic.endswith("uwb/anchors") and not publisher.latched:
                yield Finding(
                    "anchors_volatile",
                    WARNING,
                    cause="nodes that start later get no anchors, unless they are repeated",
                    evidence=f"{publisher.node} publishes {topic} {publisher.qos}",
                    remedy=(
                        "qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  "
                        "# or anchors_file of both nodes"
                    ),
                    value=np.nan,
                )


RULES = (
    sensor_mistakes,
    frames,
    senders,
    no_imu,
    odometry_unread,
    other_anchors,
    falling_stamps,
    clock_jumps,
    sensors_apart,
    unused_data,
    different_types,
    incompatible_qos,
    several_publishers,
    volatile_anchors,
)
