"""Event logs of the Crazyflie's micro-SD card deck (uSD logger), versions 1 and 2."""

import zlib
from pathlib import Path

import numpy as np
from numba import njit

from uwb_tdoa_bias.foundation.errors import InputError

from .streams import make_flight, read_bytes

MAGIC = 0xBC
_CRC_SIZE = 4
_STAMP = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}  # version: type of the time stamp, its ticks per second
_NUMPY_OF_STRUCT = {  # codes of Python's struct module, little endian and packed
    "b": "i1", "B": "u1", "?": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "l": "<i4", "L": "<u4",
    "q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8",
}  # fmt: skip
_STREAMS = {  # event name: our stream, {column in the log: column of the stream}
    "estTDOA": ("tdoa", {"idA": "a", "idB": "b", "distanceDiff": "d"}),
    "estGyroscope": ("gyro", {"gyro.x": "x", "gyro.y": "y", "gyro.z": "z"}),
    "estAcceleration": ("acc", {"acc.x": "x", "acc.y": "y", "acc.z": "z"}),
    "estPose": ("pose", {f"locSrv.{axis}": axis for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")}),
    "estTOF": ("tof", {"range.zrange": "tof"}),
    "estBarometer": ("baro", {"baro.asl": "baro"}),
}


def read_usd_log(path, anchors):
    """Flight of a micro-SD event log.

    TDOAs come from estTDOA, the IMU from estGyroscope (deg/s to rad/s) and estAcceleration (g to m/s^2), the ground
    truth from estPose, the height from estTOF (mm to m) and the pressure from estBarometer (altitude to Pa). Other events that occur are in `Flight.extra` under the names and in the units of the log.
    Raises InputError for a file that is empty, foreign, cut or damaged (the checksum is always verified).
    Format: "uSD logger" of the Crazyflie firmware.
    """
    data = read_bytes(path)
    version, events, start = _read_header(path, data)
    stamp, ticks = _STAMP[version]
    size_of_id = np.full(65536, -1, dtype=np.int64)
    dtypes = {}
    for number, (name, fields) in events.items():
        dtypes[name] = np.dtype([("id", "<u2"), ("t", stamp), ("values", np.dtype(fields))])
        size_of_id[number] = dtypes[name].itemsize
    raw = np.frombuffer(data, dtype=np.uint8)
    offsets, ids, stopped = _scan(raw, start, len(data) - _CRC_SIZE, size_of_id)
    _check(path, data, stopped)

    streams = {}
    for number, (name, fields) in events.items():
        dtype = dtypes[name]
        at = offsets[ids == number]
        rows = raw[at[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]
        columns = {field: np.ascontiguousarray(rows["values"][field]) for field, _ in fields}
        stream, rename = _STREAMS.get(name, (name, {field: field for field in columns}))
        missing = [field for field in rename if field not in columns]
        if missing:
            raise InputError(f"{path}: event {name} has no variable {missing[0]} (it has {', '.join(columns)}).")
        streams[stream] = {rename[field]: values for field, values in columns.items() if field in rename}
        streams[stream]["t"] = rows["t"] / ticks
    streams["tdoa"] = _tdoa(streams.get("tdoa", {"t": np.empty(0)}))
    name = Path(path).name
    return make_flight(name, anchors, streams, {"source": str(path), "format": f"uSD log version {version}"})


def _tdoa(columns):
    """The integers and doubles that `Tdoas` holds (the log has bytes and floats)."""
    types = {"t": float, "a": np.int64, "b": np.int64, "d": float}
    return {column: np.asarray(values, dtype=types[column]) for column, values in columns.items()}


def _read_header(path, data):
    """Version, {id: (name, [(variable, numpy type), ...])} and where the events start."""
    if data[0] != MAGIC:
        raise InputError(
            f"{path}: byte 0 is 0x{data[0]:02X}, a micro-SD event log starts with 0xBC; give the file as it is on "
            "the card."
        )
    at = 1

    def take(size, what):
        nonlocal at
        if at + size > len(data) - _CRC_SIZE:
            raise InputError(
                f"{path}: ends after {len(data)} bytes, inside the header ({what} expected at byte {at}); the file is "
                "cut: copy it from the card again."
            )
        at += size
        return data[at - size : at]

    def number(what):
        return int.from_bytes(take(2, what), "little")

    def string(what):
        end = data.find(0, at)
        content = take((end if end >= 0 else len(data)) + 1 - at, what)[:-1]
        if not content.isascii() or not content:
            raise InputError(
                f"{path}: byte {at - len(content) - 1}: expected {what}, found {content!r}; the file is damaged."
            )
        return content.decode("ascii")

    version = number("the version")
    if version not in _STAMP:
        raise InputError(f"{path}: is an event log of version {version}; versions 1 and 2 can be read.")
    events = {}
    for _ in range(number("the number of event types")):
        where, event = at, number("the id of an event type")
        name = string("the name of an event type")
        fields = []
        for _ in range(number(f"the number of variables of {name}")):
            variable = string(f"a variable of {name}")
            field, code = variable[:-3], variable[-2:-1]
            if variable[-3:] != f"({code})" or code not in _NUMPY_OF_STRUCT or field in dict(fields):
                raise InputError(
                    f"{path}: byte {at - len(variable) - 1}: {variable!r} is not a new variable of {name} (expected "
                    f"'name(c)', c one of {' '.join(_NUMPY_OF_STRUCT)}); the file is damaged."
                )
            fields.append((field, _NUMPY_OF_STRUCT[code]))
        if event in events or name in (known for known, _ in events.values()):
            raise InputError(
                f"{path}: byte {where}: event type {event} {name!r} is defined twice; the file is damaged."
            )
        events[event] = (name, fields)
    return version, events, at


def _check(path, data, stopped):
    """Raise InputError unless the checksum is right and the events fill the file. stopped: where they do not, or -1."""
    stored, computed = int.from_bytes(data[-_CRC_SIZE:], "little"), zlib.crc32(data[:-_CRC_SIZE])
    first = f"first event that cannot be read: byte {stopped}" if stopped >= 0 else "no event is visibly broken"
    if stored != computed:
        raise InputError(
            f"{path}: the checksum in the last 4 bytes is 0x{stored:08X} but 0x{computed:08X} was expected for the "
            f"{len(data) - _CRC_SIZE} bytes before it ({first}); the file is cut or damaged: copy it from the "
            "card again."
        )
    if stopped >= 0:
        raise InputError(
            f"{path}: byte {stopped}: no event of a type that the header defines fits here, although the checksum is "
            "right; the log was written by a faulty logger."
        )


@njit(cache=True)
def _scan(raw, start, end, size_of_id):
    """Offsets and ids of the events in raw[start:end], and where the scan had to stop (-1: it ended at `end`).

    size_of_id : (65536,) bytes of a whole event (id, stamp, payload), -1 where no type has the id.
    """
    smallest = 6  # id and version 1 stamp, no payload
    room = max((end - start) // smallest, 0)
    offsets = np.empty(room, dtype=np.int64)
    ids = np.empty(room, dtype=np.uint16)
    count = 0
    at = start
    while at < end:
        if at + 2 > end:
            return offsets[:count], ids[:count], at
        number = raw[at] | (np.int64(raw[at + 1]) << 8)
        size = size_of_id[number]
        if size < 0 or at + size > end:
            return offsets[:count], ids[:count], at
        offsets[count] = at
        ids[count] = number
        count += 1
        at += size
    return offsets[:count], ids[:count], -1
