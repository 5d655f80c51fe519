# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Our columns of foreign recordings, and their units.

columns = parse_columns("time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff_mm:mm")
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK

from .streams import GRAVITY

Columns = dict[str, tuple[str, float]]  # {our column: (their column or field, factor)}

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "ticks": TICK,
    "ns": SPEED_OF_LIGHT / 1e9,
}
# As `make_flight` takes them, from a Crazyflie: deg/s and g.
RATE = {"rad/s": 180.0 / np.pi, "deg/s": 1.0}
FORCE = {"m/s^2": 1.0 / GRAVITY, "g": 1.0}
NUMBER = {"": 1.0}
HEIGHT = {unit: 1e3 * factor for unit, factor in LENGTH.items() if unit in ("m", "cm", "mm")}
# stream: {our column: (column of the stream, {unit: factor}, the first is the default)}
STREAMS = {
    "tdoa": {
        "anchor_a": ("a", NUMBER),
        "anchor_b": ("b", NUMBER),
        "tdoa": ("d", LENGTH),
        "tdoa_std": ("std", LENGTH),
    },
    "range": {"anchor": ("anchor", NUMBER), "range": ("d", LENGTH), "range_std": ("std", LENGTH)},
    "gyro": {f"gyro_{axis}": (axis, RATE) for axis in "xyz"},
    "acc": {f"accel_{axis}": (axis, FORCE) for axis in "xyz"},
    "pose": {f"pose_{axis}": (axis, LENGTH) for axis in "xyz"}
    | {f"pose_q{k}": (f"q{k}", NUMBER) for k in "xyzw"},
    "tof": {"height": ("tof", HEIGHT)},  # in mm, as a Crazyflie has it
    "baro": {"altitude": ("baro", {"m": 1.0})},
    "flow": {f"flow_{axis}": (axis, NUMBER) for axis in "xy"},
    "anchors": {"anchor_id": ("id", NUMBER)} | {f"anchor_{axis}": (axis, LENGTH) for axis in "xyz"},
}
TIMES = {  # of each stream: the first that is given, else "time"
    "tdoa": ("tdoa_time",),
    "range": ("range_time",),
    "gyro": ("gyro_time", "imu_time"),
    "acc": ("accel_time", "imu_time"),
    "pose": ("pose_time",),
    "tof": ("height_time",),
    "baro": ("altitude_time",),
    "flow": ("flow_time",),
    "anchors": (),
}
RADIO = "tdoa", "range"  # one of them is required
ANCHORS = "anchor_a", "anchor_b", "anchor", "anchor_id"  # columns that name anchors
# cells of tools without a value
EMPTY = {"", "-", "--", "n/a", "na", "nan", "none", "null"}
MOST_SKIPPED = 0.25  # largest share of invalid records in a stream
ATTITUDE = {f"pose_q{k}" for k in "xyzw"}
OPTIONAL = {*ATTITUDE, "tdoa_std", "range_std"}
UNITS = {name: units for columns in STREAMS.values() for name, (_, units) in columns.items()}
UNITS |= {
    name: TIME for name in ("time", *sorted({name for names in TIMES.values() for name in names}))
}


def parse_columns(text: str) -> Columns:
    """Return {our column: (their column, factor)} of "OURS=THEIRS[:UNIT],...".

    A value times its factor is in m, s, degrees/s or g, as `make_flight` takes them. Raises
    InputError.
    """
    columns: Columns = {}
    for entry in text.split(","):
        ours, equals, theirs = (part.strip() for part in entry.partition("="))
        if not equals or ours not in UNITS or not theirs or ours in columns:
            raise _unknown("--columns", entry)
        columns[ours] = parse_column("--columns", ours, theirs)
    check_columns("--columns", columns)
    return columns


def parse_column(where: str, ours: str, theirs: str) -> tuple[str, float]:
    """Return (their column, factor) of one of our columns and "[-]THEIRS[:UNIT]".

    Without UNIT it is in the first of UNITS. A name that holds a colon needs its unit. A minus
    changes the sign. `where` begins error messages. Raises InputError.
    """
    entry = f"{ours}={theirs}"
    if ours not in UNITS:
        raise _unknown(where, entry)
    name, colon, unit = (part.strip() for part in theirs.rpartition(":"))
    units = UNITS[ours]
    if not colon:
        name, unit = theirs.strip(), next(iter(units))
    sign = -1.0 if name.startswith("-") else 1.0
    name = name.removeprefix("-").strip()
    if not name:
        raise _unknown(where, entry)
    if unit not in units:
        usual = " or ".join(filter(None, units)) or "none"
        raise InputError(f"{where}: {entry!r}: {unit!r} is no unit of {ours}; use {usual}.")
    return name, sign * units[unit]


def _unknown(where: str, entry: str) -> InputError:
    return InputError(
        f"{where}: {entry!r} is not OURS=THEIRS, where OURS, once, is one of {', '.join(UNITS)}."
    )


def check_columns(where: str, columns: Columns, time: bool = True) -> None:
    """Raise InputError for columns that are incomplete.

    time : whether each stream needs a column with the time. Otherwise messages have it.
    """
    used = [stream for stream, names in STREAMS.items() if names.keys() & columns.keys()]
    # without a column of a radio, the error names those of TDOAs
    for stream in used if {*RADIO} & {*used} or not time else ["tdoa", *used]:
        needed = [*(name for name in STREAMS[stream] if name not in OPTIONAL)]
        if missing := [name for name in needed if name not in columns]:
            raise InputError(
                f"{where}: {missing[0]} is missing; {', '.join(needed)} belong together."
            )
        if time and stream != "anchors" and not {*TIMES[stream], "time"} & columns.keys():
            raise InputError(
                f"{where}: {TIMES[stream][-1]}, or time, is missing; name the column with the time."
            )
    if len(ATTITUDE & columns.keys()) not in (0, 4):
        raise InputError(f"{where}: {', '.join(sorted(ATTITUDE))} belong together.")


def time_column(stream: str, columns: Columns) -> tuple[str, float] | None:
    """Return the column with the time of a stream, or None."""
    return next((columns[name] for name in (*TIMES[stream], "time") if name in columns), None)
