# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the readers share: order streams, join both inertial sensors, name the protocol."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import Height, Pressure, Velocity
from uwb_tdoa_bias.common.sensors.pressure import pressure_at
from uwb_tdoa_bias.common.sensors.ranges import Ranges
from uwb_tdoa_bias.common.sensors.sensor import LARGEST_NUMBER

from ..clock import is_grouped, sentences, straightened

Columns = dict[str, np.ndarray]  # of a stream, each (n,)
Streams = dict[str, Columns]

# m/s^2 in one g of the Crazyflie's accelerometer, as in its firmware and in the UTIL scripts
GRAVITY = 9.81
NO_TARGET = 32.0  # m; the range finder writes 32.767 or more without a target, and sees 4 m at most
# mm, and m: the formula of the standard atmosphere ends at 44 km
LARGEST = {"tof": 1e9, "baro": 4e4}
# Hz; tags measure 1 to 2000 TDOAs a second, and the slowest in public sets one in 10 s
POSSIBLE_RATES = 0.02, 2e4
TIME_STEP, ALIKE, MANY = 1000.0, 0.2, 100  # ratio of two units; its tolerance; records of a stream
DAY = 86400.0  # s
# smallest reported ratio of two rates, and share of dropped samples
UNEQUAL_RATES, DROPPED_SHARE = (1.1, 0.02)
REFERENCE_SHARE = 0.95  # share of the TDOAs of a common reference anchor
# of one reading for 1 rad/s, median over 0425/TDOA2; 30 to 35 pixels in 41 degrees, given in
# tenths: 4.2 to 4.9
FLOW_COUNTS = 4.7
FLOW_READING_TIME = 0.01  # s that one reading counts over
FLOW_WILD = 40.0  # counts, beyond which a reading is clipped
FLOW_RATE = 25.0  # Hz of the velocities, each of the mean of some readings
FLOW_STD = 0.1  # m/s; measured over 0.25 s: 0.05 to 0.11
FLOW_NEAREST_RANGE = 0.2  # s to the next range, beyond which the height is not known
FLOW_TURN_TIME = 0.02  # s before and after, over which the gyroscope is averaged


def make_flight(
    name: str,
    anchors: Anchors,
    streams: Streams,
    extra: Streams,
    meta: dict[str, Any],
    salvage: bool = False,
    truth: bool = True,
) -> Flight:
    """Build a Flight from the streams of a recording: SI units, ordered stamps, no empty streams.

    Rows are in the order of the file. Inertial samples are in the body frame (x forward, y left, z up),
    quaternions turn the body to the world.

    Parameters
    ----------
    streams : {stream: {column: (n,) array}}; "t" in s, other columns in the units of the file.
        "tdoa": a, b, d (m), std (m, optional). "range": anchor, d (m), std (m, optional). "gyro":
        x, y, z (deg/s). "acc": x, y, z (g). "pose": x, y, z (m), and qx, qy, qz, qw (optional). "tof": tof (mm).
        "baro": baro (m above the sea in the standard atmosphere). "flow": x, y (pixel counts),
        which become a velocity if "tof" and IMU exist.
    extra : further streams for `Flight.extra`, not checked.
    meta : dict with "source". Added are "protocol", "clock" ([Jump] and {stream: outliers}, see
        `clock.straightened`), "reordered" ({stream: number of falling stamps}),
        "imu_accel_interpolated", "losses" ([(cause, evidence, remedy)] of unused data) and
        "remarks" (sentences).
    salvage : skip records that are not finite, or whose stamps differ by a day, with a remark.
    truth : use "pose" as ground truth; otherwise it is ignored.

    Raises InputError; without `salvage` for invalid records too.
    """
    meta = {"remarks": [], **meta}
    wanted = {
        key: columns
        for key, columns in streams.items()
        if len(columns["t"]) and (truth or key != "pose")
    }
    if "pose" in wanted and "qx" not in wanted["pose"]:
        unknown = np.full(len(wanted["pose"]["t"]), np.nan)
        wanted["pose"] = {**wanted["pose"], **dict.fromkeys(("qx", "qy", "qz", "qw"), unknown)}
    _refuse_other_unit_of_time(
        meta["source"], {key: np.asarray(columns["t"], float) for key, columns in wanted.items()}
    )
    for key in {"tdoa", "range"} & wanted.keys():
        columns = wanted[key]
        if is_grouped(
            columns["t"], *(columns[name] for name in ("a", "b", "anchor") if name in columns)
        ):
            wanted[key] = by_time(columns)
            meta["remarks"].append(
                f"{key}: the rows are grouped by anchor: read in the order of time."
            )
    clock = straightened({key: columns["t"] for key, columns in (extra | wanted).items()})
    wanted, extra = (
        {key: clock.columns(key, columns) for key, columns in group.items()}
        for group in (wanted, extra)
    )
    meta["remarks"] += sentences(clock)
    if clock.jumps or clock.kept:
        meta["clock"] = clock.jumps, clock.outliers
    streams = {key: _valid_rows(key, columns, meta, salvage) for key, columns in wanted.items()}
    reordered: dict[str, int] = {}
    streams, extra = (_in_order(group, reordered) for group in (streams, extra))
    if reordered:
        meta["reordered"] = reordered
    if not streams.keys() & {"tdoa", "range"}:
        raise InputError(
            f"{meta['source']}: holds no TDOA measurement; record the tag's TDOAs with the flight."
        )
    tdoas, poses = Tdoas(*np.empty((4, 0))), None
    if "tdoa" in streams:
        tdoas = Tdoas(*_measured(streams["tdoa"], "a", "b"))
        meta["protocol"] = protocol(tdoas)
    if "pose" in streams:
        pose = streams["pose"]
        poses = Truth(pose["t"], _stack(pose, "x", "y", "z"), _stack(pose, "qx", "qy", "qz", "qw"))
    imu = _inertial(streams, meta)
    if not meta["remarks"]:
        del meta["remarks"]
    return Flight(
        name, anchors, tdoas, imu, poses, extra, meta, clock.restarts, **_sensors(streams, imu)
    )


def _refuse_other_unit_of_time(source: str, stamps: dict[str, np.ndarray]) -> None:
    """Raise InputError if a stream is 1000 times as long as another, or has an impossible rate."""
    spans = {
        key: span
        for key, t in stamps.items()
        if len(t) >= MANY and 0.0 < (span := float(np.ptp(t))) < np.inf
    }
    remedy = "give the unit of the time (s, ms, us or ns), or the column that holds it."
    for key in sorted({"tdoa", "range"} & spans.keys()):
        rate = (len(stamps[key]) - 1) / spans[key]
        if not POSSIBLE_RATES[0] <= rate <= POSSIBLE_RATES[1]:
            raise InputError(f"{source}: {rate:.3g} records of {key} a second cannot be; {remedy}")
    if not spans:
        return
    longest, shortest = max(spans, key=spans.__getitem__), min(spans, key=spans.__getitem__)
    ratio = spans[longest] / spans[shortest]
    unit = TIME_STEP ** round(np.log(ratio) / np.log(TIME_STEP))
    if unit > 1.0 and abs(ratio / unit - 1.0) < ALIKE:
        raise InputError(
            f"{source}: {longest} spans {spans[longest]:.4g} s, {shortest} {spans[shortest]:.4g} s, "
            f"about {unit:.0f} times as long: one is in another unit; {remedy}"
        )


def _in_order(streams: Streams, reordered: dict[str, int]) -> Streams:
    """Return the streams that are not empty, sorted by stamp; count falling stamps."""
    out = {}
    for key, columns in streams.items():
        if not len(columns["t"]):
            continue
        falls = int((np.diff(columns["t"]) < 0).sum())
        if falls:
            columns, reordered[key] = by_time(columns), falls
        out[key] = columns
    return out


def by_time(columns: Columns) -> Columns:
    """Return the columns of a stream in the order of time."""
    order = np.argsort(columns["t"], kind="stable")
    return {name: values[order] for name, values in columns.items()}


def _inertial(streams: Streams, meta: dict[str, Any]) -> Imu | None:
    """Return the IMU stream; a single inertial sensor is a loss in `meta`."""
    if "gyro" in streams and "acc" in streams:
        return _imu(streams["gyro"], streams["acc"], meta)
    alone = streams.keys() & {"gyro", "acc"}
    if alone:
        name, missing = (
            ("gyroscope", "accelerometer") if alone == {"gyro"} else ("accelerometer", "gyroscope")
        )
        cause = f"the {name} is not used: the filter needs both inertial sensors"
        meta["losses"] = [(cause, f"there is no {missing}", f"record the {missing} too")]
    return None


def _sensors(streams: Streams, imu: Imu | None) -> dict[str, Any]:
    """Return the streams of other sensors, by their names in a Flight."""
    out: dict[str, Any] = {}
    if "range" in streams:
        out["range"] = Ranges(*_measured(streams["range"], "anchor"))
    if "tof" in streams:
        tof = streams["tof"]
        # the precision of a sensor_msgs/Range
        ranges = np.float32(1e-3 * np.asarray(tof["tof"], dtype=float)).astype(float)
        out["height"] = Height(tof["t"], np.where(ranges < NO_TARGET, ranges, np.inf))
    if "baro" in streams:
        baro = _readings(streams["baro"], "baro")
        out["pressure"] = Pressure(baro["t"], pressure_at(baro["baro"]))
    height = out.get("height")
    if (
        "flow" in streams
        and imu is not None
        and height is not None
        and min(len(imu.t), np.isfinite(height.range).sum()) > 1
    ):
        t, x, y = (np.asarray(streams["flow"][name], dtype=float) for name in "txy")
        velocity = flow_velocity(t, x, y, height, imu)
        if len(velocity.t):
            out["velocity"] = velocity
    return out


def _measured(columns: Columns, *ids: str) -> tuple[np.ndarray, ...]:
    """Return (stamps s, ids of each anchor, values m, variances m^2 or 0 if unknown), (n,) each."""
    variance = columns["std"] ** 2 if "std" in columns else np.zeros(len(columns["t"]))
    numbers = (np.asarray(columns[name], np.int64) for name in ids)
    return columns["t"], *numbers, np.asarray(columns["d"], float), variance


def _valid_rows(key: str, columns: Columns, meta: dict[str, Any], salvage: bool) -> Columns:
    """Return the columns of a stream without rows that are not finite."""
    columns = {name: np.asarray(values) for name, values in columns.items()}
    numbers = dict(columns)
    if key == "pose" and all(np.isnan(columns[name]).all() for name in ("qx", "qy", "qz", "qw")):
        numbers = {
            name: values for name, values in columns.items() if not name.startswith("q")
        }  # not recorded
    bad = np.zeros(len(columns["t"]), dtype=bool)
    for name, values in numbers.items():
        values, largest = values.astype(float), LARGEST.get(name, LARGEST_NUMBER)
        wrong = ~(np.abs(values) <= largest)
        if wrong.any() and not salvage:
            row = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{meta['source']}: {key}, record {row + 1} of {len(bad)} at "
                f"{columns['t'][row]:.3f} s: {name} is "
                f"{columns[name][row]}; it must be finite, within +-{largest:g}: leave such "
                "records out with --salvage."
            )
        bad |= wrong
    if salvage and not bad.all():
        middle = np.sort(columns["t"][~bad])[(np.count_nonzero(~bad) - 1) // 2]
        bad |= np.abs(columns["t"] - middle) > DAY
    if not bad.any():
        return columns
    meta["remarks"].append(
        f"{key}: {np.count_nonzero(bad)} of {len(bad)} records left out, they are no numbers."
    )
    return {name: values[~bad] for name, values in columns.items()}


def _readings(columns: Columns, name: str) -> Columns:
    """Return the rows where the value changes, for a sensor that is logged faster than it measures."""
    values = np.asarray(columns[name], dtype=float)
    new = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    return {"t": columns["t"][new], name: values[new]}


def protocol(tdoas: Tdoas) -> str:
    """Return "tdoa2", "tdoa3" or "tdoa, one reference", from the pairs of anchors.

    TDoA2 anchors send in turn in fixed slots, and the tag subtracts two consecutive arrivals. So
    the pairs are the sides of one ring, except where a packet was missed. In TDoA3 any pair occurs
    (Bitcraze documentation). If all anchors are compared with the same anchor, it is neither.

    In 37 recordings with eight anchors, TDoA2 has 95 % and more on one ring. TDoA3 has 52 % at most
    on the eight most frequent pairs. Three anchors have only three pairs: they are a ring if the
    order of the two never changes.
    """
    ids, rows = np.unique(np.concatenate([tdoas.a, tdoas.b]), return_inverse=True)
    n, (a, b) = len(ids), rows.reshape(2, -1)
    if n > 2 and np.bincount(rows.ravel()).max() > REFERENCE_SHARE * len(a):
        return "tdoa, one reference"
    # only the pairs that occur: a table of all pairs would grow with the square of n
    pair, of_pair = np.unique(np.minimum(a, b) * n + np.maximum(a, b), return_inverse=True)
    heard, rising = np.bincount(of_pair), np.bincount(of_pair, a < b)
    often = np.argsort(-heard, kind="stable")[:n]
    if n < 4:
        one_way = np.maximum(rising, heard - rising)[often].sum() == len(a)
        return "tdoa2" if one_way else "tdoa3"
    share = heard[often].sum() / len(a)
    # a ring has two sides at each anchor, and all are connected
    sides = np.stack(np.divmod(pair[often], n))
    meets = coo_array((np.ones(len(often)), tuple(sides)), (n, n))
    is_ring = (np.bincount(sides.ravel(), minlength=n) == 2).all() and connected_components(
        meets, directed=False
    )[0] == 1
    return "tdoa2" if is_ring and share > 0.5 * (1.0 + 2.0 / (n - 1)) else "tdoa3"


def _imu(gyro: Columns, acc: Columns, meta: dict[str, Any]) -> Imu:
    """Return one stream of both sensors at the stamps of the gyroscope.

    The firmware reads both at one instant and logs one after the other, 20 us apart. Sample n
    belongs to sample n if all stamps agree to half a period. Otherwise an event was lost: the
    accelerometer is interpolated, and gyroscope samples outside of its time are dropped.
    """
    t, rate, force = gyro["t"], _stack(gyro, "x", "y", "z"), _stack(acc, "x", "y", "z")
    half_period = 0.5 * np.median(np.diff(t)) if len(t) > 1 else 0.0
    if len(t) != len(acc["t"]) or (np.abs(t - acc["t"]) > half_period).any():
        meta["imu_accel_interpolated"] = True
        inside = (t >= acc["t"][0]) & (t <= acc["t"][-1])
        if losses := _imu_losses(t, acc["t"], inside):
            meta["losses"] = losses
        t, rate = t[inside], rate[inside]
        if not len(t):
            raise InputError(
                f"{meta['source']}: gyroscope ({gyro['t'][0]:.3f} ... {gyro['t'][-1]:.3f} s) "
                "and accelerometer "
                f"({acc['t'][0]:.3f} ... {acc['t'][-1]:.3f} s) never overlap in time; they "
                "must be of one recording."
            )
        force = np.stack([np.interp(t, acc["t"], column) for column in force.T], axis=1)
    return Imu(t, np.deg2rad(rate), force * GRAVITY)


def _imu_losses(
    gyro: np.ndarray, acc: np.ndarray, inside: np.ndarray
) -> list[tuple[str, str, str]]:
    """Return [(cause, evidence, remedy)] of unused samples.

    Parameters
    ----------
    gyro, acc : (n,) and (m,) s, stamps.
    inside : (n,) bool, gyroscope samples that are used.
    """
    out = []
    rates = [
        1.0 / max(float(np.median(np.diff(t))), 1e-9) if len(t) > 1 else 0.0 for t in (gyro, acc)
    ]
    evidence = f"gyroscope {rates[0]:.0f} Hz, accelerometer {rates[1]:.0f} Hz"
    if max(rates) > UNEQUAL_RATES * min(rates):
        out.append(
            (
                "gyroscope and accelerometer have different rates: only the stamps of the "
                "gyroscope are used",
                evidence,
                "log both at one rate, e.g. in one block of the log",
            )
        )
    if (lost := float(np.mean(~inside))) > DROPPED_SHARE:
        out.append(
            (
                "samples of the gyroscope are left out: the accelerometer was not recorded then",
                f"{100.0 * lost:.0f} % of them; {evidence}",
                "start and stop both together",
            )
        )
    return out


def _stack(columns: Columns, *names: str) -> np.ndarray:
    return np.stack([np.asarray(columns[name], dtype=float) for name in names], axis=1)


def flow_velocity(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, height: Height, imu: Imu
) -> Velocity:
    """Return the velocity in the body frame, x and y, from an optical flow sensor at up to 25 Hz.

    Needs a nearby range and the gyroscope. The sensor looks down and sees the ground rotate and
    move. With the range h along its axis, x = -COUNTS (v_y / h + omega_x) and y = -COUNTS (v_x / h
    - omega_y), in the axes of the Crazyflie's flow deck (flowdeck_v1v2.c of its firmware).

    Parameters
    ----------
    t : (n,) s, ascending.
    x, y : (n,) counts of single readings.
    """
    cell = np.unique((t * FLOW_RATE).astype(int), return_inverse=True)[1]
    columns = (t, *(np.clip(counts, -FLOW_WILD, FLOW_WILD) for counts in (x, y)))
    t, x, y = (np.bincount(cell, column) / np.bincount(cell) for column in columns)
    t = t - 0.5 * FLOW_READING_TIME
    seen = np.isfinite(height.range)
    stamps, h = height.t[seen], np.interp(t, height.t[seen], height.range[seen])
    near = np.abs(
        t - stamps[np.clip(np.searchsorted(stamps, t), 1, len(stamps) - 1) - [[1], [0]]]
    ).min(axis=0)
    turns = np.cumsum(imu.gyro[:, :2] * np.gradient(imu.t)[:, None], axis=0)
    ends = [
        np.stack([np.interp(t + s, imu.t, turns[:, k]) for k in range(2)], axis=1)
        for s in (-FLOW_TURN_TIME, FLOW_TURN_TIME)
    ]
    rate = (ends[1] - ends[0]) / (2.0 * FLOW_TURN_TIME)
    v = np.stack(
        [h * (rate[:, 1] - y / FLOW_COUNTS), -h * (rate[:, 0] + x / FLOW_COUNTS), np.zeros(len(t))],
        axis=1,
    )
    known = (
        (near < FLOW_NEAREST_RANGE)
        & (t > imu.t[0] + FLOW_TURN_TIME)
        & (t < imu.t[-1] - FLOW_TURN_TIME)
    )
    return Velocity(
        t[known], v[known], np.tile([FLOW_STD, FLOW_STD, np.inf], (np.count_nonzero(known), 1))
    )
