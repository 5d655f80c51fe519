# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Driver faults in a simulated flight, as columns of the sent messages and their arrival.

Without ROS.
"""

from dataclasses import replace

from flights import fly
import numpy as np

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.geometry import tdoa

IMU_RATE, TDOA_RATE = 100.0, 100.0  # Hz
T, ARRIVAL, GYRO, ACCEL = range(4)
D = 4
LATENCY = 0.002  # s


def put(columns, place, value):
    """Return the columns with one replaced."""
    return (*columns[:place], value, *columns[place + 1 :])


def of_imu(change):
    return lambda imu, tdoa, rng: (change(imu, rng), tdoa)


def of_tdoa(change):
    return lambda imu, tdoa, rng: (imu, change(tdoa, rng))


def second_tag(columns, rng):
    """Add the TDOA of another tag after every TDOA. It differs by 2 m."""
    other = put(columns, D, columns[D] + 2.0 * np.sign(rng.normal(size=len(columns[D]))))
    return merged(columns, put(other, T, other[T] + 0.003))


def repeated(columns, rng):
    """Repeat every inertial sample ten times, a millisecond apart."""
    parts = (
        put(put(columns, T, columns[T] + 0.001 * k), ARRIVAL, columns[ARRIVAL] + 0.001 * k)
        for k in range(10)
    )
    return merged(*parts)


def merged(*parts):
    columns = [np.concatenate(column) for column in zip(*parts)]
    order = np.argsort(columns[ARRIVAL], kind="stable")
    return tuple(column[order] for column in columns)


# name: (function of the columns of a flight, text of the finding)
FAULTS = {
    "IMU in g": (of_imu(lambda c, rng: put(c, ACCEL, c[ACCEL] / 9.81)), "accelerometer is in g"),
    "gyroscope in degrees/s": (
        of_imu(lambda c, rng: put(c, GYRO, np.rad2deg(c[GYRO]))),
        "gyroscope is in degrees/s",
    ),
    "IMU 0.5 s ahead": (of_imu(lambda c, rng: put(c, T, c[T] + 0.5)), "imu/data are 0.50. s ahead"),
    "IMU 0.5 s behind": (
        of_imu(lambda c, rng: put(c, T, c[T] - 0.5)),
        "imu/data are 0.50. s behind|0.4.. s behind",
    ),
    "TDOAs stamped 0": (of_tdoa(lambda c, rng: put(c, T, 0.0 * c[T])), "uwb/tdoa is not stamped"),
    "TDOAs in blocks of 1 s": (
        of_tdoa(lambda c, rng: put(c, ARRIVAL, np.ceil(c[ARRIVAL]))),
        "uwb/tdoa arrive in blocks",
    ),
    "TDOAs 10 s ahead": (
        of_tdoa(lambda c, rng: put(c, T, c[T] + 10.0)),
        "imu/data are .* s behind|clock of uwb/tdoa jumps",
    ),
    "all 10 s ahead": (
        lambda imu, tdoa, rng: (put(imu, T, imu[T] + 10.0), put(tdoa, T, tdoa[T] + 10.0)),
        "ahead of the clock",
    ),
    "a second tag": (of_tdoa(second_tag), "two tags share"),
    "every TDOA twice": (of_tdoa(lambda c, rng: merged(c, c)), "published twice"),
    "TDOAs shuffled by 50 ms": (
        of_tdoa(lambda c, rng: put(c, T, c[T] - 0.05 * rng.random(len(c[T])))),
        "out of order.*reorder",
    ),
    "IMU at ten times its rate": (of_imu(repeated), "published more than once"),
    "IMU upside down": (
        of_imu(lambda c, rng: put(c, ACCEL, c[ACCEL] * [1.0, -1.0, -1.0])),
        "-z points up",
    ),
}
# A common clock error does not show in the streams.
OF_THE_CLOCK = {"all 10 s ahead"}


def _flight():
    """Return a flight that hears its anchors one after the other, as with TDOA2."""
    flight = fly(
        seed=5,
        duration=30.0,
        imu_rate=IMU_RATE,
        tdoa_rate=TDOA_RATE,
        accel_noise=0.01,
        gyro_noise=0.001,
    )
    anchors, t = flight.anchors, flight.tdoa.t
    a = np.arange(len(t)) % len(anchors)
    b = (a + 1) % len(anchors)
    p = flight.meta["wave"].motion(t)[0]
    d = tdoa(p, anchors.positions[a], anchors.positions[b]) + 0.05 * np.random.default_rng(
        1
    ).normal(size=len(t))
    return replace(flight, tdoa=Tdoas(t, anchors.ids[a], anchors.ids[b], d))


FLIGHT = _flight()


def columns_of(begin, parts):
    """Return the imu and tdoa columns of a flight.

    Parameters
    ----------
    begin : float
        Begin of the flight, in s of the clock.
    parts : list of (from, to, names of faults)
        Times in s after `begin`.
    """
    rng = np.random.default_rng(3)
    end = parts[-1][1]
    imu = _part((FLIGHT.imu.t, FLIGHT.imu.t, FLIGHT.imu.gyro, FLIGHT.imu.accel), begin, end)
    tdoa = _part(
        (FLIGHT.tdoa.t, FLIGHT.tdoa.t, FLIGHT.tdoa.a, FLIGHT.tdoa.b, FLIGHT.tdoa.d), begin, end
    )
    out = []
    for low, high, name in parts:
        pieces = [
            tuple(c[(s[T] - begin >= low) & (s[T] - begin < high)] for c in s) for s in (imu, tdoa)
        ]
        for fault in FAULTS.keys() & set(name):
            pieces = FAULTS[fault][0](*pieces, rng)
        out.append(pieces)
    return [merged(*stream) for stream in zip(*out)]


def _part(columns, begin, end):
    inside = columns[T] < end
    t, _, *values = (column[inside] for column in columns)
    return (t + begin, t + begin + LATENCY, *values)
