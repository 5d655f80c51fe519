"""Sensors that are not in the frame of the body: where /tf_static of a bag places them, taken as
the nodes take it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.flight import Imu
from uwb_tdoa_bias.foundation.transforms import Frames
from uwb_tdoa_ekf.imu_mount import ImuMount

from .files import readable
from .message_types import check_type
from .messages import BODY_FRAME

if TYPE_CHECKING:
    from collections import Counter
    from pathlib import Path

    from scipy.spatial.transform import Rotation

    from .files import BagReader

    Place = tuple[Rotation, np.ndarray]  # of a sensor in the body: its turn, and its arm (3,) m

TF_STATIC = "/tf_static"


def is_body(frame: str) -> bool:
    """Whether a frame_id is that of the body, of whatever robot; an empty one is taken for it."""
    return frame.rpartition("/")[2] in (BODY_FRAME, "")


def read_frames(path: str | Path, reader: BagReader) -> Frames:
    """Frames of all messages on /tf_static of an open bag. Raises InputError."""
    frames = Frames()
    connections = [
        c
        for c in reader.connections
        if c.topic == TF_STATIC and c.msgtype == "tf2_msgs/msg/TFMessage"
    ]
    for connection in connections:
        check_type(path, connection)
    for _, _, message in readable(path, reader, connections):
        for each in message.transforms:
            q, p = each.transform.rotation, each.transform.translation
            q, p = (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)
            if any(q) and np.isfinite([*q, *p]).all():
                frames.set(each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"), q, p)
    return frames


def place_of(frames: Frames, frame: str) -> Place | None:
    """(Rotation, arm (3,) m) of a sensor's frame in the body: of the same robot, or of the only
    one; None if not known.
    """
    robot = frame.lstrip("/").rpartition("/")[0]
    for body in ([f"{robot}/{BODY_FRAME}"] if robot else []) + [BODY_FRAME]:
        if place := frames.between(body, frame.lstrip("/")):
            return place
    return None


def imu_in_body(imu: Imu, place: Place) -> Imu:
    """The Imu with the samples of one that is at a place (see `place_of`), in the origin of the
    body.
    """
    return Imu(imu.t, *ImuMount(*place).in_body(imu.t, imu.gyro, imu.accel))


def placed(frames: Frames, topic: str, counts: Counter[str]) -> tuple[Place | None, str | None]:
    """(place or None, remark or None) of the one frame that the messages of a topic have. counts :
    {frame_id: messages}. A place changes the result, so it is remarked on, too.
    """
    others = sorted(frame for frame in counts if not is_body(frame))
    if not others:
        return None, None
    if len(counts) > 1:
        return (
            None,
            (
                f"{topic} comes in several frames ({', '.join(sorted(counts))}): taken as "
                f"{BODY_FRAME}."
            ),
        )
    place = place_of(frames, others[0])
    if place is None:
        return (
            None,
            (
                f"{topic} is in frame '{others[0]}', which {TF_STATIC} does not connect with "
                f"'{BODY_FRAME}': taken as that."
            ),
        )
    at = ", ".join(f"{value:.3f}" for value in place[1])
    return (
        place,
        (
            f"{topic} is taken from frame '{others[0]}', which {TF_STATIC} places at ({at}) m in "
            f"'{BODY_FRAME}'."
        ),
    )
