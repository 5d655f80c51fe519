# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read the streams of a recording as `check` judges them: in the order of arrival."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.common.survey import as_named

from ..bags import is_bag
from ..bags.bag import (
    TF_STATIC,
    TopicMessages,
    imu_in_body,
    place_in_body,
    read_stream,
    read_streams,
    recorded_anchors,
    sensor_place,
    surveyed,
)
from ..bags.files import open_bag, remarks_of
from ..bags.messages import STREAMS, Names, tdoas_of
from ..command_lines import suggest_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from uwb_tdoa_bias.common.sensors.sensor import Stream
    from uwb_tdoa_bias.common.transforms import Place

    from ..clock import Jump
    from ..live.session import End
    from ..readers.inputs import Reading

IMU, TDOA = "imu/data", "uwb/tdoa"
OF_SENSORS = tuple(topic for sensor in SENSORS.values() for topic, _ in sensor.topics)
HEARD = (TDOA, IMU, "uwb/anchors", *OF_SENSORS, "uwb/tdoa_corrected", "odometry", "uwb/residual")


@dataclass(frozen=True)
class Recording:
    """Streams of a recording, not sorted.

    Stamps are on one continuous time (see `clock.straightened`).

    Attributes
    ----------
    name : str
        Short name.
    anchors : Anchors
        Survey to check against.
    tdoa : Tdoas
        TDOAs.
    imu : Imu or None
        Inertial samples, as of an IMU in the origin of the body.
    tdoa_arrival, imu_arrival : (n,) array
        When the recorder received them, s, NaN where unknown.
    frames : dict
        {topic: {frame_id: messages}}.
    places : dict
        {frame_id: (Rotation, arm (3,) m)} of frames that /tf_static connects with the body.
    topics : dict
        {topic: type} of a bag, or of all live topics.
    recorded : Anchors or None
        Anchors that the bag holds.
    read : frozenset of str
        Names of the topics that were read, or are our own.
    falls : int
        How often the stamps fell in a file whose reader has sorted them.
    remarks : tuple of str
        Sentences about damaged parts.
    ends : tuple of End
        Publishers and subscriptions of live topics.
    sensors : dict
        {name: Stream} of the SENSORS.
    truth : Truth or None
        Ground truth; only rules that name it use it.
    jumps : tuple of Jump
        Jumps of the clock, which are corrected.
    outliers : dict
        {stream: messages left out because of their stamps}.
    losses : tuple of (cause, evidence, remedy)
        Data that a reader did not use.
    """

    name: str
    anchors: Anchors
    tdoa: Tdoas
    imu: Imu | None
    tdoa_arrival: np.ndarray
    imu_arrival: np.ndarray
    frames: dict[str, dict[str, int]] = field(default_factory=dict)
    places: dict[str, Place] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)
    recorded: Anchors | None = None
    read: frozenset[str] = frozenset()
    falls: int = 0
    remarks: tuple[str, ...] = ()
    ends: tuple[End, ...] = ()
    sensors: dict[str, Stream] = field(default_factory=dict)
    truth: Truth | None = None
    jumps: tuple[Jump, ...] = ()
    outliers: dict[str, int] = field(default_factory=dict)
    losses: tuple[tuple[str, str, str], ...] = ()


def read_recording(
    reading: Reading, path: str | Path, survey: str | Path | None = None
) -> Recording:
    """Read a log, a CSV file or a bag. survey : path of a survey, or None. Raises InputError."""
    if is_bag(path) and not reading.profile:
        return _read_bag(reading, Path(path), survey)
    return of_flight(reading.read((Path(path), survey)))


def read_live(
    reading: Reading,
    seconds: float,
    survey: str | Path | None = None,
    say: Callable[[str], object] = print,
) -> Recording:
    """Record live topics for some seconds, and return the Recording.

    Parameters
    ----------
    reading : Reading
        Names of the topics.
    seconds : float
        Duration, s.
    survey : path or None
        Survey to check against.
    say : callable
        Called with sentences about the progress.

    Raises
    ------
    InputError
        If no TDOA arrives.
    """
    from ..live.session import listen

    name_of = Names(reading.namespace, reading.topics)
    with temporary_folder() as folder:
        bag = folder / "live"
        heard = dict.fromkeys([*map(name_of, (*HEARD, "tf_static")), TF_STATIC])
        topics, ends = listen([*heard], bag, seconds, say)
        try:
            recording = _read_bag(reading, bag, survey)
        except InputError as error:
            raise InputError(str(error).replace(str(bag), "live topics")) from error
    recording = replace(recording, topics=topics, ends=tuple(ends))
    if "/clock" in topics:  # simulated time, which arrivals do not follow
        tdoa, imu = (
            np.full_like(arrival, np.nan)
            for arrival in (recording.tdoa_arrival, recording.imu_arrival)
        )
        recording = replace(recording, tdoa_arrival=tdoa, imu_arrival=imu)
    return recording


def of_flight(flight: Flight) -> Recording:
    """Return the Recording of a Flight. The arrivals of its messages are unknown."""
    tdoa, imu = (
        np.full(len(stream) if stream is not None else 0, np.nan)
        for stream in (flight.tdoa, flight.imu)
    )
    falls = sum(flight.meta.get("reordered", {}).values())
    sensors = {name: stream for name in SENSORS if (stream := getattr(flight, name)) is not None}
    jumps, outliers = flight.meta.get("clock", ((), {}))
    losses = tuple(
        (cause, evidence, remedy) for cause, evidence, remedy in flight.meta.get("losses", ())
    )
    streams = flight.tdoa, flight.imu, tdoa, imu
    return Recording(
        flight.name,
        flight.anchors,
        *streams,
        falls=falls,
        sensors=sensors,
        truth=flight.truth,
        jumps=jumps,
        outliers=outliers,
        losses=losses,
    )


def _read_bag(reading: Reading, path: Path, survey: str | Path | None) -> Recording:
    name_of = Names(reading.namespace, reading.topics)
    of_anchors = name_of("uwb/anchors")
    with open_bag(path) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
        bag = read_streams(path, reader, name_of, ("tdoa", "imu", *SENSORS))
        poses = read_stream(path, reader, "pose", name_of, bag.frames)
        recorded = recorded_anchors(path, reader, of_anchors)
        remarks = (*remarks_of(reader), *(each for of in bag.found.values() for each in of.remarks))
    tdoa, imu, clock = bag.found["tdoa"], bag.found["imu"], bag.clock
    sensors = {
        name: STREAMS[name].make(bag.found[name].stamps / 1e9, bag.found[name].rows)
        for name in SENSORS
        if len(bag.found[name].stamps)
    }
    if not len(tdoa.stamps) and not sensors.keys() & set(LOCATING):
        there = sorted(
            topic
            for topic, kind in topics.items()
            if kind == STREAMS["tdoa"].message and topic != name_of(TDOA)
        )
        places = " or ".join(f"--topic {TDOA}={topic}" for topic in there)
        hint = f"say where they are ({places})"
        if not there:
            hint = f"a recording of others needs a profile, which this line names: {suggest_line(path)}"
        raise InputError(f"{path}: has no message on {name_of(TDOA)}; {hint}.")
    given = as_named(survey)
    anchors = (given or surveyed(path, recorded, of_anchors)).anchors
    samples = STREAMS["imu"].make(imu.stamps / 1e9, imu.rows) if len(imu.stamps) else None
    if samples is not None and (place := sensor_place(bag.frames, IMU, imu.frames)[0]):
        samples = imu_in_body(samples, place)
    return Recording(
        name=path.stem.removesuffix("_bag"),
        anchors=anchors,
        tdoa=tdoas_of(tdoa.stamps / 1e9, tdoa.rows.reshape(-1, 4)),
        imu=samples,
        tdoa_arrival=bag.arrivals["tdoa"],
        imu_arrival=bag.arrivals["imu"],
        frames={
            topic: dict(stream.frames)
            for topic, stream in ((TDOA, tdoa), (IMU, imu))
            if len(stream.stamps)
        },
        places={
            frame: place
            for frame in {*tdoa.frames, *imu.frames}
            if (place := place_in_body(bag.frames, frame))
        },
        topics=topics,
        read=frozenset(map(name_of, HEARD)),
        recorded=recorded and recorded.anchors,
        remarks=remarks,
        sensors=sensors,
        truth=None if clock.jumps else _truth_of(poses),
        jumps=clock.jumps,
        outliers=clock.outliers,
    )


def _truth_of(found: TopicMessages) -> Truth | None:
    """Return the ground truth of a bag, without messages that are no numbers."""
    stamps, rows, _ = found.in_order()
    known = STREAMS["pose"].valid(rows).all(axis=1) if len(stamps) else np.zeros(0, bool)
    return STREAMS["pose"].make(stamps[known], rows[known]) if known.any() else None
