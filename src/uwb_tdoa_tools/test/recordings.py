# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small synthetic recordings for the tests of all readers and writers."""

import struct
import zlib

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth

ANCHORS = Anchors(
    [0, 1, 5],
    [[0.1, 0.2, 0.3], [4.0, 0.0, 3.0], [4.0, 5.0, 0.2]],
    [[0.0, 0.0, 0.0, 1.0], [0.6, 0.0, 0.8, 0.0], [np.nan] * 4],
)
SURVEY = "id,x,y,z\n0,0.1,0.2,0.3\n1,4,0,3\n5,4,5,0.2\n"
XYZ = ("x", "y", "z")
EVENTS = {  # name: (id, [(variable, struct code)])
    "estTDOA": (3, [("idA", "B"), ("idB", "B"), ("distanceDiff", "f")]),
    "estGyroscope": (7, [(f"gyro.{axis}", "f") for axis in XYZ]),
    "estAcceleration": (8, [(f"acc.{axis}", "f") for axis in XYZ]),
    "estPose": (300, [(f"locSrv.{axis}", "f") for axis in (*XYZ, "qx", "qy", "qz", "qw")]),
    "estBarometer": (9, [("baro.asl", "f")]),
    "estTemperature": (11, [("baro.temp", "f")]),
    "estTOF": (12, [("range.zrange", "H")]),
    "estFlow": (10, [("motion.deltaX", "h"), ("motion.deltaY", "h")]),
}
ROWS = [  # (name, ticks, values); estBarometer and estTemperature are not in order of time
    ("estGyroscope", 1_000_000, (180.0, 0.0, -90.0)),
    ("estAcceleration", 1_000_020, (0.0, 0.5, 1.0)),
    ("estTDOA", 1_000_500, (0, 1, 1.25)),
    ("estPose", 1_000_700, (1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0)),
    ("estBarometer", 1_001_500, (101.5,)),
    ("estGyroscope", 1_001_000, (0.0, 90.0, 0.0)),
    ("estAcceleration", 1_001_020, (0.0, 0.0, 2.0)),
    ("estTDOA", 1_002_500, (1, 5, -0.5)),
    ("estBarometer", 1_001_400, (0.0,)),
    ("estBarometer", 1_001_520, (101.5,)),
    ("estTemperature", 1_001_500, (21.5,)),
    ("estTemperature", 1_001_400, (20.5,)),
    ("estTOF", 1_001_200, (1250,)),
    ("estTOF", 1_001_300, (32767,)),
    ("estGyroscope", 1_002_000, (0.0, 0.0, 45.0)),
    ("estAcceleration", 1_002_020, (1.0, 0.0, 1.0)),
]


def log_bytes(rows=ROWS, version=2, events=EVENTS):
    """Return a micro-SD event log.

    Ticks are microseconds in version 2, milliseconds in version 1.
    """
    out = bytearray(struct.pack("<BHH", 0xBC, version, len(events)))
    for name, (number, variables) in events.items():
        out += struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        for variable, code in variables:
            out += f"{variable}({code})".encode() + b"\0"
    for name, ticks, values in rows:
        number, variables = events[name]
        out += struct.pack("<HQ" if version == 2 else "<HI", number, ticks)
        out += struct.pack("<" + "".join(code for _, code in variables), *values)
    return bytes(out) + struct.pack("<I", zlib.crc32(out))


FULL_HEADER = (
    "t_tdoa,idA,idB,tdoa_meas,t_acc,acc_x,acc_y,acc_z,t_gyro,gyro_x,gyro_y,gyro_z,t_tof,tof,t_flow,deltaX,deltaY,"
    "t_baro,baro,t_pose,pose_x,pose_y,pose_z,pose_qx,pose_qy,pose_qz,pose_qw"
)
# three TDOAs, four IMU samples, one tof, two flow, one baro, two poses: in the same rows, but at
# different times
FULL_ROWS = [
    "0.010,0,1,0.25,0.001,0,0,1,0.001,180,0,0,0.02,31,0.03,1,-2,0.04,99.5,0.005,1,2,3,0,0,0,1",
    "0.012,1.0,5.0,-0.50,0.002,0,0,1,0.002,0,90,0,,,0.05,3,4,,,0.009,1,2,3.5,0,0,0.6,0.8",
    "0.014,5,0,0.75,0.003,0,0,2,0.003,0,0,45,,,,,,,,,,,,,,,",
    ",,,,0.004,1,0,1,0.004,0,0,0,,,,,,,,,,,,,,,",
]


def csv_text(header=FULL_HEADER, rows=FULL_ROWS):
    return "\n".join([header, *rows]) + "\n"


def small_flight(seconds=2.0, rate=1000, name="small"):
    """Return a Flight with different stamps in each stream.

    Some orientations of anchors and ground truth are unknown.
    """
    rng = np.random.default_rng(7)
    # us, as in a log
    ticks = 10_000_000 + np.arange(round(seconds * rate)) * 1_000_000 // rate
    n, k, m = len(ticks), len(ticks) // 2, len(ticks) // 4
    quaternions = rng.normal(size=(m, 4))
    quaternions[0] = np.nan
    return Flight(
        name,
        ANCHORS,
        Tdoas(
            (ticks[::2][:k] + 300) / 1e6, rng.integers(0, 2, k), np.full(k, 5), rng.normal(size=k)
        ),
        Imu(ticks / 1e6, rng.normal(size=(n, 3)), rng.normal(size=(n, 3))),
        Truth((ticks[::4][:m] + 100) / 1e6, rng.normal(size=(m, 3)), quaternions),
        {},
        {"protocol": "tdoa3", "source": "nowhere"},
    )


def differences(one, other):
    """Return the names of the arrays that are not exactly equal in two flights."""
    found = []
    for part in ("anchors", "tdoa", "imu", "truth", "height", "pressure", "velocity"):
        first, second = getattr(one, part), getattr(other, part)
        if (first is None) != (second is None):
            found.append(part)
        for name in vars(first) if first is not None and second is not None else ():
            a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
            if a.shape != b.shape or not (
                np.array_equal(a, b, equal_nan=True) if a.dtype.kind == "f" else (a == b).all()
            ):
                found.append(f"{part}.{name}")
    return found
