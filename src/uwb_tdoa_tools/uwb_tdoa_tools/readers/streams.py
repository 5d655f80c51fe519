"""What the readers of recordings share: putting streams in order, making one IMU stream of two, naming the protocol."""

from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight, Height, Imu, Pressure, Tdoas, Truth
from uwb_tdoa_bias.foundation.pressure import pressure_at

GRAVITY = 9.81  # m/s^2 in one g of the Crazyflie's accelerometer, as in its firmware and in the UTIL scripts
NO_TARGET = 32.0  # m; the range finder writes 32.767 or more where it sees nothing, and sees 4 m at most


def read_bytes(path):
    """The content of a file; raises InputError if it cannot be read or is empty."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the path of a recording.") from error
    if not content:
        raise InputError(f"{path}: is empty (0 bytes); copy the recording again.")
    return content


def make_flight(name, anchors, streams, meta):
    """Flight of the streams of a Crazyflie recording: units to SI, stamps in order, empty streams left out.

    streams : dict of stream name to dict of column name to (n,) array; "t" in s, the rest in the units of the file.
        "tdoa": a, b, d (m); "gyro": x, y, z (deg/s); "acc": x, y, z (g); "pose": x, y, z (m), qx, qy, qz, qw.
        "tof": tof (mm); "baro": baro (m above the sea, from the pressure of the standard atmosphere).
        Every other name goes to `Flight.extra` as it is.
    meta : dict, completed here with "protocol" and, where there is something to tell, "reordered" (how often the stamps
        of each stream fell before they were sorted) and "imu_accel_interpolated".
    """
    streams = {key: columns for key, columns in streams.items() if len(columns["t"])}
    meta = dict(meta)
    reordered = {}
    for key, columns in streams.items():
        falls = int((np.diff(columns["t"]) < 0).sum())
        if falls:
            order = np.argsort(columns["t"], kind="stable")
            streams[key] = {column: values[order] for column, values in columns.items()}
            reordered[key] = falls
    if reordered:
        meta["reordered"] = reordered
    tdoa = streams.pop("tdoa", None)
    if tdoa is None:
        raise InputError(f"{meta['source']}: holds no TDOA measurement; record the tag's TDOAs with the flight.")
    tdoas = Tdoas(tdoa["t"], tdoa["a"], tdoa["b"], tdoa["d"])
    meta["protocol"] = protocol(tdoas)
    imu = None
    if "gyro" in streams and "acc" in streams:
        imu = _imu(streams.pop("gyro"), streams.pop("acc"), meta)
    truth = None
    if "pose" in streams:
        pose = streams.pop("pose")
        truth = Truth(pose["t"], _stack(pose, "x", "y", "z"), _stack(pose, "qx", "qy", "qz", "qw"))
    height = pressure = None
    if "tof" in streams:
        tof = streams.pop("tof")
        ranges = np.float32(1e-3 * np.asarray(tof["tof"], dtype=float)).astype(float)  # as a sensor_msgs/Range holds it
        height = Height(tof["t"], np.where(ranges < NO_TARGET, ranges, np.inf))
    if "baro" in streams:
        baro = _readings(streams.pop("baro"), "baro")
        pressure = Pressure(baro["t"], pressure_at(baro["baro"]))
    return Flight(name, anchors, tdoas, imu, truth, streams, meta, height, pressure)


def _readings(columns, name):
    """The rows of a sensor that is logged more often than it measures: where its value differs from the one before."""
    values = np.asarray(columns[name], dtype=float)
    new = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    return {"t": columns["t"][new], name: values[new]}


def protocol(tdoas):
    """ "tdoa2" if most measurements are between neighbours a, a + 1 in the ring of the ids that occur, else "tdoa3".

    TDoA2 anchors send in turn in fixed slots and the tag takes the difference of two that follow each other, further
    apart only where it missed one; in TDoA3 any pair occurs (Bitcraze documentation). Measured, of eight anchors: at
    least 93 % neighbours with the one, at most 20 % with the other.
    """
    ids = np.unique(np.concatenate([tdoas.a, tdoas.b]))
    step = (np.searchsorted(ids, tdoas.b) - np.searchsorted(ids, tdoas.a)) % len(ids)
    return "tdoa2" if (step == 1).mean() > 0.5 else "tdoa3"


def _imu(gyro, acc, meta):
    """One stream of both sensors at the gyroscope's stamps.

    The firmware reads both at one instant and logs one after the other, some 20 us apart: sample n goes with sample n
    as long as all stamps agree to half a period. Where they do not (an event was lost), the accelerometer is
    interpolated linearly between its own samples, and gyroscope samples outside of its time are left out.
    """
    t, rate, force = gyro["t"], _stack(gyro, "x", "y", "z"), _stack(acc, "x", "y", "z")
    half_period = 0.5 * np.median(np.diff(t)) if len(t) > 1 else 0.0
    if len(t) != len(acc["t"]) or (np.abs(t - acc["t"]) > half_period).any():
        meta["imu_accel_interpolated"] = True
        inside = (t >= acc["t"][0]) & (t <= acc["t"][-1])
        t, rate = t[inside], rate[inside]
        if not len(t):
            raise InputError(
                f"{meta['source']}: gyroscope ({gyro['t'][0]:.3f} ... {gyro['t'][-1]:.3f} s) and accelerometer "
                f"({acc['t'][0]:.3f} ... {acc['t'][-1]:.3f} s) never overlap in time; they must be of one recording."
            )
        force = np.stack([np.interp(t, acc["t"], column) for column in force.T], axis=1)
    return Imu(t, np.deg2rad(rate), force * GRAVITY)


def _stack(columns, *names):
    return np.stack([np.asarray(columns[name], dtype=float) for name in names], axis=1)
