# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The faults: one row each. To add a fault, add a line to `FAULTS`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np

from .changes import (
    Change,
    chain,
    delayed,
    done,
    during,
    first,
    for_good,
    framed,
    frozen,
    in_bursts,
    jittered_frames,
    late_anchor,
    lost,
    moved,
    nothing,
    only_from,
    placed,
    pose_given,
    relabelled,
    repeated,
    republished,
    restamped,
    scaled,
    second_sender,
    valued,
)
from .events import PLAYED

# s: from the first message to a fault, how long it lasts, and what follows
BEGIN, LASTS, AFTER = (14.0, 6.0, 7.0)
EARLY, LONG = 5.0, 22.0  # s: begin and length of one whose effect needs long
FEET, LIGHT = 3.280839895, 0.299792458  # in a metre; m in a nanosecond
NORMAL = 9.80665  # m/s^2 in g
STREAMS = ("tdoa", "imu", *PLAYED)
ALL = " ".join(STREAMS)


@dataclass(frozen=True)
class Fault:
    """A fault of the messages, and the time in which it acts.

    text : description
    change : of the events
    plays : sensors in addition to TDOAs and the IMU
    begin, lasts, after : s, see `BEGIN`
    parameters : {node: {name: value}}
    anew : the filter restarts by request
    turned : degrees by which the world is turned about z. No measurement shows this, so the
        estimate is right if it is turned, too.
    """

    text: str
    change: Change = nothing
    plays: tuple[str, ...] = ()
    begin: float = BEGIN
    lasts: float = LASTS
    after: float = AFTER
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    anew: bool = False
    turned: float = 0.0

    @property
    def end(self) -> float:
        """s, when it is over."""
        return self.begin + self.lasts

    @property
    def seconds(self) -> float:
        """Length of the flight, s."""
        return self.end + self.after

    @property
    def ends(self) -> bool:
        """Whether the flight continues after the fault."""
        return self.after > 0.0


def standing(text: str, change: Change = nothing, **rest: Any) -> Fault:
    """A Fault of the whole flight."""
    return Fault(text, change, begin=0.0, lasts=BEGIN + LASTS + AFTER, after=0.0, **rest)


def long(text: str, change: Change, **rest: Any) -> Fault:
    """A Fault that begins early and lasts long."""
    return Fault(text, change, begin=EARLY, lasts=LONG, **rest)


def lasting(text: str, change: Change, **rest: Any) -> Fault:
    """A Fault that begins in the air and does not end."""
    return Fault(text, change, lasts=LASTS + AFTER, after=0.0, **rest)


def jump(text: str, change: Change, **rest: Any) -> Fault:
    """A Fault of one instant."""
    return Fault(text, change, lasts=0.5, after=LASTS + AFTER, **rest)


def ekf(**parameters: Any) -> dict[str, dict[str, Any]]:
    """Parameters of ekf_node."""
    return {"ekf_node": parameters}


def of_stream(name: str) -> dict[str, Fault]:
    """What can be wrong with the time or the sequence of any stream."""
    plays = (name,) if name in PLAYED else ()
    rows = {
        "ahead 0.3 s": Fault("stamps are 0.3 s ahead", during(name, restamped(0.3))),
        "ahead 5 s": Fault("stamps are 5 s ahead", during(name, restamped(5.0))),
        "ahead 60 s": long("stamps are 60 s ahead", during(name, restamped(60.0))),
        "ahead 3600 s": long("stamps are an hour ahead", during(name, restamped(3600.0))),
        "behind 0.3 s": Fault("stamps are 0.3 s behind", during(name, restamped(-0.3))),
        "behind 5 s": Fault("stamps are 5 s behind", during(name, restamped(-5.0))),
        "behind 60 s": Fault("stamps are 60 s behind", during(name, restamped(-60.0))),
        "drift": long("the clock drifts by 5 ms in a second", during(name, restamped(0.0, 5e-3))),
        "one ahead 5 s": jump("one stamp is 5 s ahead", first(1, name, restamped(5.0))),
        "one behind 5 s": jump("one stamp is 5 s behind", first(1, name, restamped(-5.0))),
        "two behind 5 s": jump("two stamps are 5 s behind", first(2, name, restamped(-5.0))),
        "jump +5 s": lasting(
            "the clock jumps by 5 s ahead and stays there", during(name, restamped(5.0))
        ),
        "jump -5 s": lasting(
            "the clock jumps by 5 s back and stays there", during(name, restamped(-5.0))
        ),
        "bursts": Fault("messages come together, each half a second", during(name, in_bursts(0.5))),
        "silent 1 s": Fault("no message for 1 s", during(name, lost), lasts=1.0, after=AFTER + 5.0),
        "silent 5 s": Fault("no message for 5 s", during(name, lost), lasts=5.0, after=AFTER + 1.0),
        "flood": Fault("each message comes ten times", during(name, repeated(10))),
        "duplicates": Fault("each message comes twice", during(name, repeated(2))),
        "NaN": Fault("values are NaN", during(name, scaled(math.nan))),
        "stands still": Fault("stamps stay the same", _stopped(name)),
    }
    return {f"{name}: {key}": replace(row, plays=plays) for key, row in rows.items()}


def _stopped(name: str) -> Change:
    return lambda events, scene: during(name, lambda event, _: (event._replace(t=scene.begin),))(
        events, scene
    )


def _rotated(degrees: float, p: np.ndarray) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return p @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _another_room(p: np.ndarray) -> np.ndarray:
    return np.random.default_rng(3).uniform([0.0, 0.0, 0.2], [12.0, 6.0, 3.5], p.shape)


def _one_in_millimetres(p: np.ndarray) -> np.ndarray:
    p[2] *= 1000.0
    return p


def _two_at_one_place(p: np.ndarray) -> np.ndarray:
    p[1] = p[4]
    return p


UPSIDE_DOWN, LYING, MIRRORED = np.array([1.0, -1.0, -1.0]), [0, 2, 1], np.array([-1.0, 1.0, 1.0])
EXCHANGED, SHIFTED, UNKNOWN = (
    {2: 5, 5: 2},
    {k: (k + 1) % 8 for k in range(8)},
    {k: k + 100 for k in range(8)},
)

FAULTS: dict[str, Fault] = {
    "nothing": Fault("nothing"),
    "nothing, all sensors": Fault(
        "nothing; with height, pressure, velocity and ranges", plays=PLAYED
    ),
    **{key: row for name in STREAMS for key, row in of_stream(name).items()},
    # Several streams
    "all: jump +5 s": jump(
        "all clocks jump by 5 s ahead and stay there",
        for_good(during(ALL, restamped(5.0))),
        plays=PLAYED,
    ),
    "all: jump -5 s": jump(
        "all clocks jump by 5 s back and stay there",
        for_good(during(ALL, restamped(-5.0))),
        plays=PLAYED,
    ),
    "all: bursts": Fault(
        "all messages come together, each half a second",
        during(ALL, in_bursts(0.5)),
        plays=PLAYED,
    ),
    "all: silent 1 s": Fault(
        "no message at all for 1 s", during(ALL, lost), plays=PLAYED, lasts=1.0
    ),
    "all: silent 5 s": Fault(
        "no message at all for 5 s", during(ALL, lost), plays=PLAYED, lasts=5.0
    ),
    "all: flood": Fault("each message comes ten times", during(ALL, repeated(10)), plays=PLAYED),
    "tdoa and imu: silent 10 s": Fault(
        "no TDOA and no IMU sample for 10 s", during("tdoa imu", lost), lasts=10.0
    ),
    "velocity freezes, TDOAs stop": Fault(
        "the velocity freezes; 2 s later TDOAs stop",
        chain(frozen("velocity"), only_from(2.0, during("tdoa", lost))),
        plays=("velocity",),
    ),
    # TDOAs
    "tdoa: old 1.2 s": Fault(
        "TDOAs are 1.2 s old and stamped on arrival", during("tdoa", delayed(1.2, restamp=True))
    ),
    "tdoa: late 0.6 s": Fault("TDOAs come 0.6 s late, stamped right", during("tdoa", delayed(0.6))),
    "tdoa: in cm": standing("TDOAs are in centimetres", during("tdoa", scaled(100.0))),
    "tdoa: in cm, in flight": Fault(
        "TDOAs are in centimetres for 6 s", during("tdoa", scaled(100.0))
    ),
    "tdoa: in ns": standing("TDOAs are in nanoseconds", during("tdoa", scaled(1.0 / LIGHT))),
    "tdoa: in feet": standing("TDOAs are in feet", during("tdoa", scaled(FEET))),
    "tdoa: sign": standing("all TDOAs have the other sign", during("tdoa", scaled(-1.0))),
    "tdoa: sign, in flight": lasting(
        "all TDOAs have the other sign from mid-flight on", during("tdoa", scaled(-1.0))
    ),
    "tdoa: sign, for 6 s": Fault(
        "all TDOAs have the other sign for 6 s", during("tdoa", scaled(-1.0))
    ),
    "tdoa: ids exchanged": standing(
        "ids 2 and 5 are exchanged", during("tdoa", relabelled(EXCHANGED))
    ),
    "tdoa: ids exchanged, in flight": Fault(
        "ids 2 and 5 are exchanged for 6 s", during("tdoa", relabelled(EXCHANGED))
    ),
    "tdoa: ids shifted": standing(
        "each id is that of the next anchor", during("tdoa", relabelled(SHIFTED))
    ),
    "tdoa: ids unknown": Fault("ids are of no anchor", during("tdoa", relabelled(UNKNOWN))),
    "tdoa: one anchor late": Fault(
        "one anchor is late by 1 m", during("tdoa", late_anchor(2, 1.0))
    ),
    "tdoa: one anchor late, always": standing(
        "one anchor is late by 1 m", during("tdoa", late_anchor(2, 1.0))
    ),
    "tdoa: two publishers": Fault(
        "a second publisher sends the same",
        during("tdoa", second_sender(lambda event, _: (event,))),
    ),
    "tdoa: another tag": Fault(
        "a second tag publishes on the topic", during("tdoa", second_sender(scaled(-0.5)))
    ),
    "tdoa: two antenna frames": Fault(
        "messages come in two antenna frames in turn", framed("tdoa", "antenna_1", "antenna_2")
    ),
    # The IMU
    "imu: in g": standing(
        "the accelerometer is in g", during("imu", scaled(1.0 / NORMAL, "accel"))
    ),
    "imu: in g, in flight": Fault(
        "the accelerometer is in g for 6 s", during("imu", scaled(1.0 / NORMAL, "accel"))
    ),
    "imu: in degrees/s": standing(
        "the gyroscope is in degrees/s", during("imu", scaled(math.degrees(1.0), "gyro"))
    ),
    "imu: y and z exchanged": standing(
        "the axes y and z are exchanged", during("imu", valued(lambda v: v[LYING]))
    ),
    "imu: upside down": standing(
        "the IMU is upside down", during("imu", valued(lambda v: v * UPSIDE_DOWN))
    ),
    "imu: turned by 90 degrees": standing(
        "the IMU is turned by 90 degrees about z",
        during("imu", valued(lambda v: _rotated(90.0, v))),
        plays=("velocity",),
    ),
    "imu: gyroscope off": Fault(
        "the gyroscope is off by 0.5 rad/s about z for 3 s",
        during("imu", valued(lambda v: v + [0.0, 0.0, 0.5], "gyro")),
        lasts=3.0,
        after=10.0,
    ),
    "imu: frozen": Fault("the values of the IMU freeze", frozen("imu")),
    # Other sensors
    "height: in mm": Fault(
        "heights are in millimetres", during("height", scaled(1000.0)), plays=("height",)
    ),
    "height: frozen": Fault("the height freezes", frozen("height"), plays=("height",)),
    "pressure: in hPa": Fault(
        "pressures are in hPa", during("pressure", scaled(0.01)), plays=("pressure",)
    ),
    "velocity: in km/h": Fault(
        "velocities are in km/h", during("velocity", scaled(3.6)), plays=("velocity",)
    ),
    "velocity: x and y exchanged": Fault(
        "axes are exchanged",
        during("velocity", valued(lambda v: v[[1, 0, 2]])),
        plays=("velocity",),
    ),
    "velocity: sign": Fault(
        "the velocity has the other sign", during("velocity", scaled(-1.0)), plays=("velocity",)
    ),
    "velocity: two publishers": Fault(
        "a second publisher, whose clock is 1.5 s behind",
        during("velocity", second_sender(restamped(-1.5))),
        plays=("velocity",),
    ),
    "range: in cm": Fault(
        "ranges are in centimetres", during("range", scaled(100.0)), plays=("range",)
    ),
    # The survey
    "survey: in mm": standing("the survey is in millimetres", placed(lambda p: 1000.0 * p)),
    "survey: in cm": standing("the survey is in centimetres", placed(lambda p: 100.0 * p)),
    "survey: in feet": standing("the survey is in feet", placed(lambda p: FEET * p)),
    "survey: one in mm": standing("one anchor is in millimetres", placed(_one_in_millimetres)),
    "survey: zeros": standing("all positions are zero", placed(lambda p: 0.0 * p)),
    "survey: mirrored": standing("the survey is mirrored", placed(lambda p: p * MIRRORED)),
    "survey: rotated": standing(
        "the survey is turned by 90 degrees about z",
        placed(lambda p: _rotated(90.0, p)),
        turned=90.0,
    ),
    "survey: two at one place": standing("two anchors are at one place", placed(_two_at_one_place)),
    "survey: another room": standing("the survey is of another room", placed(_another_room)),
    "survey: one moved": standing("one anchor is elsewhere by 1 m", moved(2, [1.0, 0.0, 0.0])),
    "anchors: jitter": Fault(
        "anchors are published each second with 2 mm of jitter",
        republished(
            1.0,
            lambda anchors, rng: replace(
                anchors,
                positions=anchors.positions + 2e-3 * rng.standard_normal(anchors.positions.shape),
            ),
        ),
    ),
    "anchors: one removed": Fault(
        "one anchor is removed for 6 s",
        republished(LASTS, lambda anchors, _: anchors.only(np.arange(len(anchors) - 1))),
    ),
    "anchors: repeated": Fault(
        "anchors are published ten times a second", republished(0.1, lambda anchors, _: anchors)
    ),
    "tf_static: jitter": Fault(
        "/tf_static turns by 1e-6 rad each second",
        chain(framed("imu", "imu_link"), jittered_frames(1.0, 1e-6)),
    ),
    # Nodes and what they are asked
    "ekf_node restarts": Fault(
        "ekf_node is killed and started again after 1 s",
        chain(done("kill", node="ekf_node"), done("start", 1.0, node="ekf_node")),
        anew=True,
    ),
    "bias_node restarts": Fault(
        "bias_node is killed and started again after 1 s",
        chain(done("kill", node="bias_node"), done("start", 1.0, node="bias_node")),
    ),
    "reset": jump("~/reset is called in flight", done("reset"), anew=True),
    "initialpose: right": jump("the right pose on initialpose", pose_given()),
    "initialpose: 3 m off": jump("a pose on initialpose that is 3 m off", pose_given(offset=3.0)),
    "initialpose: yaw 90 degrees off": jump(
        "a yaw on initialpose that is 90 degrees off", pose_given(yaw=math.pi / 2)
    ),
    "initial_yaw: wrong": standing(
        "initial_yaw is 90 degrees off, stated 0.1 rad",
        parameters=ekf(initial_yaw=math.pi / 2, initial_yaw_std=0.1),
    ),
    "fixed_height: flying": standing(
        "fixed_height on a tag that flies", parameters=ekf(fixed_height=0.1, fixed_height_std=0.02)
    ),
    "parameter: legal": jump(
        "tdoa_std is set to 0.3 m", done("parameter", name="tdoa_std", value=0.3)
    ),
    "parameter: misspelt": jump(
        "a parameter that is misspelt is set", done("parameter", name="tdoa_stdd", value=0.3)
    ),
    "busy": Fault("two loops keep the cores busy", done("busy", seconds=LASTS)),
}
