# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All measurements of a first map as arrays: Flights in time bins, distances and coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu
from uwb_tdoa_bias.common.survey import read_named_anchors

from ..surveying.report import read_coordinates, read_distances

MOST = 64  # anchors of a map
STEP = 0.2  # s, length of a time bin; the tag has one position in it
LONGEST = 150.0  # s of all flights that are used; more costs time and hardly adds information
SAMPLE = 0.02  # s, step of the attitude integration
G = 9.81  # m/s^2
# 1/s, gain by which the specific force corrects the attitude, with and without a rest before take-off.
# A small one needs the bias of the gyroscope, which the rest gives.
LEVELLING = 0.03, 0.1
SMOOTHED = 0.5  # s, over which rest is judged
AT_REST = 0.15, 0.03  # m/s^2 and rad/s, largest deviation at rest
BIN_STD, ONE_STD = 0.07, 0.15  # m, of the median of a bin: a part that remains, and of one value
FEWEST_BINS = 25  # bins of a recording
# Signs of the gyroscope that contradict the right ones. (1, 1, -1) does not while the yaw stays, and
# (-1, 1, -1) is a mirror image of the world.
SIGNS = (1, -1, 1), (1, -1, -1), (-1, 1, 1), (-1, -1, 1), (-1, -1, -1)
RANGE = -1  # `a` of a range


@dataclass(frozen=True, eq=False)
class Observations:
    """Measurements that determine anchors.

    Attributes
    ----------
    ids : (N,) anchor ids
    flight : (J,) number of the flight of each time bin
    t : (J,) s since the begin of its flight
    bin : (n,) row of the time bin of each TDOA or range, rising
    a, b : (n,) rows of anchors; a is RANGE for a range to b
    d, std : (n,) m, d_ab = |p - b| - |p - a|, or the range
    accel : (J, 3) m/s^2 without gravity, z up, yaw unknown; NaN without inertial samples
    height : (J,) m above z = 0; NaN where unknown
    flipped : (s, J, 3) m/s^2, as `accel`, with other signs of the axes of the gyroscope: SIGNS
    distances : (k, 4) rows a and b, distance m, std m
    coordinates : (k, 4) row, axis, value m, std m
    delay_std : m, of the part of an anchor in the error of all of its distances
    """

    ids: np.ndarray
    flight: np.ndarray
    t: np.ndarray
    bin: np.ndarray
    a: np.ndarray
    b: np.ndarray
    d: np.ndarray
    std: np.ndarray
    accel: np.ndarray
    height: np.ndarray
    flipped: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    distances: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    coordinates: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    delay_std: float = 0.0

    @property
    def middle(self) -> np.ndarray:
        """Return the rows of bins with a bin before and after them in the same flight."""
        return np.flatnonzero(self.flight[:-2] == self.flight[2:]) + 1

    @property
    def flights(self) -> int:
        """Return the number of flights."""
        return int(self.flight.max(initial=-1)) + 1

    @property
    def two(self) -> np.ndarray:
        """Return which of the n measurements are TDOAs."""
        return self.a != RANGE


def given(
    flights: Sequence[Flight],
    survey: str | Path,
    files: tuple[str | None, str | None],
    deviations: tuple[float, float],
) -> tuple[Observations, str]:
    """Return the Observations, and the name of their frame.

    survey : file of the anchors that are known
    files : coordinates, or None; distances, or None
    deviations : m, of the coordinates in the survey, and of the delay of an anchor in distances

    Raises InputError.
    """
    if Path(survey).is_dir():
        raise InputError(f"{survey}: is a folder; give the file of the anchors that are known.")
    known = read_named_anchors(survey).anchors
    distances = [] if files[1] is None else read_distances(files[1])
    between = [i for one in distances for i in (one.a, one.b)]
    ids = np.union1d(heard(flights), np.array(between, np.int64))
    lacking = np.setdiff1d(known.ids, ids)
    if len(lacking):
        raise InputError(
            f"{survey}: no measurement is of anchor {lacking[0]}; the data hold anchors "
            f"{', '.join(map(str, ids[:10]))}: name some of these."
        )
    if len(known) == len(ids):
        raise InputError(
            f"{survey}: holds all {len(ids)} anchors; leave out those that are unknown, or use survey."
        )
    if len(ids) > MOST:
        raise InputError(
            f"{len(ids)} anchors are too many for one map; give data of {MOST} at most."
        )
    rows = [
        (np.searchsorted(ids, i), axis, value, deviations[0])
        for i, position in zip(known.ids, known.positions)
        for axis, value in enumerate(position)
    ]
    for anchor, axis, value, std in [] if files[0] is None else read_coordinates(files[0]):
        if anchor not in ids:
            raise InputError(
                f"{files[0]}: no measurement is of anchor {anchor}; leave its lines out."
            )
        rows.append((np.searchsorted(ids, anchor), axis, value, std))
    table = [
        (np.searchsorted(ids, one.a), np.searchsorted(ids, one.b), one.distance, one.std)
        for one in distances
    ]
    seen = replace(
        observe(flights, ids),
        coordinates=np.array(rows, float),
        distances=np.array(table, float).reshape(-1, 4),
        delay_std=deviations[1],
    )
    return seen, known.frame


def heard(flights: Sequence[Flight]) -> np.ndarray:
    """Return the ids of all anchors in the TDOAs and ranges of Flights, rising."""
    parts = [np.zeros(0, np.int64)]
    for flight in flights:
        parts += [flight.tdoa.a, flight.tdoa.b]
        parts += [] if flight.range is None else [flight.range.anchor]
    return np.unique(np.concatenate(parts))


def observe(flights: Sequence[Flight], ids: np.ndarray) -> Observations:
    """Return the Observations of Flights of anchors with these ids, (N,) rising.

    Bins at rest before take-off and after landing are left out: radio near the floor errs by metres.
    Raises InputError for a flight that is too short.
    """
    parts = [_of_flight(flight, ids, LONGEST / len(flights)) for flight in flights]
    if not parts:
        empty = np.zeros(0)
        whole = np.zeros(0, np.int64)
        return Observations(
            ids, whole, empty, whole, whole, whole, empty, empty, np.zeros((0, 3)), empty
        )
    t, accels, height, rows = zip(*parts)
    accel = np.concatenate(accels, axis=1)
    lengths = [len(each) for each in t]
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int)
    for part, begin in zip(rows, begins):
        part[:, 0] += begin
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    bins, a, b = table[:, :3].T.astype(int)
    flight_of = np.repeat(np.arange(len(parts)), lengths)
    return Observations(
        ids,
        flight_of,
        np.concatenate(t),
        bins,
        a,
        b,
        table[:, 3],
        table[:, 4],
        accel[0],
        np.concatenate(height),
        accel[1:],
    )


def _of_flight(
    flight: Flight, ids: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps (J,), accelerations, heights (J,) and rows (bin, a, b, d, std).

    Accelerations, (1 + s, J, 3), are those of the samples and those of SIGNS.
    """
    begin, end = flight.start, flight.end
    level = None
    if flight.imu is not None and len(flight.imu) > 1:
        level = _Level.of(flight.imu)
        begin, end = max(begin, level.begin), min(end, level.end)
    end = min(end, begin + longest)
    count = int((end - begin) / STEP)
    if count < FEWEST_BINS:
        raise InputError(
            f"{flight.name}: holds {max(end - begin, 0.0):.1f} s of motion with TDOAs or ranges; "
            f"a map needs {FEWEST_BINS * STEP:g} s at least, and a minute to be good."
        )
    t = begin + STEP * (np.arange(count) + 0.5)
    accel = np.full((1 + len(SIGNS), count, 3), np.nan)
    if level is not None and flight.imu is not None:
        accel[0] = level.accelerations(t)
        for row, signs in enumerate(SIGNS, start=1):
            turned = replace(flight.imu, gyro=flight.imu.gyro * np.array(signs, float))
            accel[row] = _Level.of(turned).accelerations(t)
    tdoa = flight.tdoa
    a, b = np.searchsorted(ids, tdoa.a), np.searchsorted(ids, tdoa.b)
    swapped = a > b
    rows = [
        _medians(
            ((tdoa.t - begin) / STEP, count),
            np.where(swapped, b, a),
            np.where(swapped, a, b),
            np.where(swapped, -tdoa.d, tdoa.d),
        )
    ]
    if flight.range is not None:
        to = np.searchsorted(ids, flight.range.anchor)
        of = np.full(len(to), RANGE)
        rows.append(_medians(((flight.range.t - begin) / STEP, count), of, to, flight.range.d))
    height = np.full(count, np.nan)
    if flight.height is not None:
        measured = np.isfinite(flight.height.range)
        at, along = flight.height.t[measured], flight.height.range[measured]
        if level is not None:
            along = along * level.upright(at)
        for row in np.unique(((at - begin) / STEP).astype(int)):
            if 0 <= row < count:
                height[row] = np.median(along[((at - begin) / STEP).astype(int) == row])
    return t - begin, accel, height, np.concatenate(rows)


def _medians(
    place: tuple[np.ndarray, int], a: np.ndarray, b: np.ndarray, d: np.ndarray
) -> np.ndarray:
    """Return rows (bin, a, b, median d, std) of each bin and pair, (n, 5).

    place : stamps in bins, (m,), and the number of bins
    """
    stamp, count = place
    inside = (stamp >= 0.0) & (stamp < count) & np.isfinite(d)
    bins, a, b, d = stamp[inside].astype(int), a[inside], b[inside], d[inside]
    order = np.lexsort((d, b, a, bins))
    table = np.column_stack([bins, a, b])[order]
    d = d[order]
    first = np.flatnonzero(np.r_[True, (table[1:] != table[:-1]).any(axis=1)][: len(d)])
    many = np.diff(np.r_[first, len(d)])
    middle = 0.5 * (d[first + (many - 1) // 2] + d[first + many // 2])
    std = np.sqrt(BIN_STD**2 + ONE_STD**2 / many)
    return np.column_stack([table[first], middle, std])


@dataclass(frozen=True, eq=False)
class _Level:
    """A levelled inertial sensor.

    t : (m,) s, equally spaced; accel : (m, 3) m/s^2 without gravity, z up, yaw from 0
    up : (m,) cosine of the tilt; begin, end : s, of the motion
    """

    t: np.ndarray
    accel: np.ndarray
    up: np.ndarray
    begin: float
    end: float

    @classmethod
    def of(cls, imu: Imu) -> _Level:
        """Integrate the gyroscope; the specific force corrects roll and pitch slowly."""
        t = np.arange(imu.t[0], imu.t[-1], SAMPLE) + 0.5 * SAMPLE
        gyro, force = (_averaged(imu.t, values, t) for values in (imu.gyro, imu.accel))
        window = np.ones(int(SMOOTHED / SAMPLE))
        slow_gyro, slow_force = (_smoothed(values, window) for values in (gyro, force))
        off = np.abs(np.linalg.norm(slow_force, axis=1) - G)
        turning = np.linalg.norm(slow_gyro - slow_gyro[0], axis=1)
        moving = np.flatnonzero((off > AT_REST[0]) | (turning > AT_REST[1]))
        first, last = (moving[0], moving[-1]) if len(moving) else (0, len(t) - 1)
        rested = first > len(window)
        bias = gyro[:first].mean(axis=0) if rested else np.zeros(3)
        gain = LEVELLING[0 if rested else 1] * SAMPLE
        mean = force[: 2 * len(window)].mean(axis=0)
        turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [mean])[0].as_matrix()
        steps = Rotation.from_rotvec((gyro - bias) * SAMPLE).as_matrix()
        accel, up = np.empty((len(t), 3)), np.empty(len(t))
        for row, step in enumerate(steps):
            specific = turn @ force[row]
            accel[row] = specific - [0.0, 0.0, G]
            up[row] = turn[2, 2]
            x, y, _ = gain * specific / max(np.linalg.norm(specific), 1e-9)
            # a small rotation about (y, -x, 0) turns the specific force upwards
            turn = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [x, y, 1.0]]) @ turn @ step
            if row % 50 == 0:
                left, _, right = np.linalg.svd(turn)
                turn = left @ right
        return cls(t, accel, up, float(t[first]), float(t[last]))

    def accelerations(self, t: np.ndarray) -> np.ndarray:
        """Return accelerations at stamps t, (J, 3) m/s^2, NaN outside of the samples.

        The weights are a triangle of STEP on both sides. Its mean is the second difference of positions
        over STEP^2, exactly.
        """
        half = round(STEP / SAMPLE)
        weights = 1.0 - np.abs(np.arange(-half, half + 1)) / half
        smooth = _smoothed(self.accel, weights)
        out = np.column_stack([np.interp(t, self.t, column) for column in smooth.T])
        out[(t < self.t[0] + STEP) | (t > self.t[-1] - STEP)] = np.nan
        return out

    def upright(self, t: np.ndarray) -> np.ndarray:
        """Return the cosine of the tilt at stamps t, (n,)."""
        return np.interp(t, self.t, self.up)


def _smoothed(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return weighted means of values (m, 3); at the ends of the weights that are inside."""
    whole = np.convolve(np.ones(len(values)), weights, "same")
    return np.column_stack([np.convolve(column, weights, "same") / whole for column in values.T])


def _averaged(t: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return means of samples over the cells of an equally spaced grid of middles, (m, 3)."""
    cell = np.clip(((t - grid[0]) / SAMPLE + 0.5).astype(int), 0, len(grid) - 1)
    many = np.bincount(cell, minlength=len(grid))
    full = many > 0
    columns = []
    for column in values.T:
        sums = np.bincount(cell, column, len(grid))[full]
        columns.append(np.interp(grid, grid[full], sums / many[full]))
    return np.column_stack(columns)
