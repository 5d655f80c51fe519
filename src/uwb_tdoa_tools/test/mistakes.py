# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mistakes of drivers, surveys and clocks, to put into recordings.

Each states its effect on the streams and the rules of `check` that must name it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_tools.checking.recording import IMU, TDOA

MISTAKES = {}
# Delay of a message, s: minimum, and mean of the additional random delay
LATENCY, JITTER = (2e-3, 1e-3)


@dataclass(frozen=True)
class Mistake:
    """A mistake to put into a recording.

    text : for the table
    named : rules of `check` that name it
    make : callable(Recording, Generator, other Recording of the same room or None) -> Recording
    needs : "imu", "tdoa3", "rooms" (other surveys) or ""
    alone : no other survey may be tried
    """

    text: str
    named: tuple
    make: object
    needs: str = ""
    alone: bool = False


def mistake(text, *named, needs="", alone=False):
    """Return a decorator that adds a function to MISTAKES.

    The function takes (Recording, Generator, other Recording).
    """

    def enter(make):
        MISTAKES[make.__name__] = Mistake(text, named, make, needs, alone)
        return make

    return enter


def arriving(recording, seed):
    """Return the Recording with arrival times.

    Each message arrives a few milliseconds after its stamp. The order of the messages stays.
    """
    rng = np.random.default_rng([seed, 1])
    out = {"tdoa_arrival": _arrival(recording.tdoa.t, rng)}
    if recording.imu is not None:
        out["imu_arrival"] = _arrival(recording.imu.t, rng)
    return replace(recording, **out)


def _arrival(t, rng):
    return np.maximum.accumulate(t + LATENCY + rng.exponential(JITTER, len(t)))


def _tdoa(recording, rows=slice(None), **columns):
    """Replace columns of the TDOAs, then keep some rows."""
    tdoa = replace(recording.tdoa, **columns)
    tdoa = Tdoas(*(column[rows] for column in vars(tdoa).values()))
    return replace(recording, tdoa=tdoa, tdoa_arrival=recording.tdoa_arrival[rows])


def _imu(recording, rows=slice(None), **columns):
    """Do the same to the inertial samples."""
    imu = replace(recording.imu, **columns)
    return replace(
        recording,
        imu=Imu(imu.t[rows], imu.gyro[rows], imu.accel[rows]),
        imu_arrival=recording.imu_arrival[rows],
    )


def _moved(recording, positions, rows=slice(None)):
    anchors = recording.anchors
    return replace(
        recording, anchors=Anchors(anchors.ids[rows], positions[rows], anchors.orientations[rows])
    )


# The values of the TDOAs


@mistake("sign of all TDOAs", "tdoa_sign")
def sign(recording, rng, other):
    return _tdoa(recording, d=-recording.tdoa.d)


@mistake("TDOAs in millimetres", "tdoa_unit")
def millimetres(recording, rng, other):
    return _tdoa(recording, d=np.round(1000.0 * recording.tdoa.d))


@mistake("TDOAs in ticks of the DW1000", "tdoa_unit")
def ticks(recording, rng, other):
    return _tdoa(recording, d=np.round(recording.tdoa.d / 0.0046917639))


@mistake("TDOAs in nanoseconds", "tdoa_unit")
def nanoseconds(recording, rng, other):
    return _tdoa(recording, d=recording.tdoa.d / 0.299792458)


@mistake("TDOAs in seconds", "tdoa_unit")
def seconds(recording, rng, other):
    return _tdoa(recording, d=recording.tdoa.d / 299792458.0)


@mistake("sign does not follow the order of the ids", "tdoa_one_sign", needs="tdoa3")
def order(recording, rng, other):
    backward = recording.tdoa.a > recording.tdoa.b
    return _tdoa(recording, d=np.where(backward, -recording.tdoa.d, recording.tdoa.d))


@mistake("sign of one pair", "pair_sign", needs="tdoa2")
def pair(recording, rng, other):
    tdoa = recording.tdoa
    pairs, counts = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0, return_counts=True)
    a, b = pairs[np.argsort(counts)[-rng.integers(1, 9)]]
    return _tdoa(recording, d=np.where((tdoa.a == a) & (tdoa.b == b), -tdoa.d, tdoa.d))


@mistake("TDOAs rounded to 0.1 m", "tdoa_rounded")
def rounded(recording, rng, other):
    return _tdoa(recording, d=np.round(recording.tdoa.d, 1))


@mistake("TDOAs clipped at 1.5 m", "tdoa_clipped")
def clipped(recording, rng, other):
    return _tdoa(recording, d=np.clip(recording.tdoa.d, -1.5, 1.5))


@mistake("every tenth TDOA is not a number", "tdoa_invalid")
def not_finite(recording, rng, other):
    return _tdoa(
        recording, d=np.where(np.arange(len(recording.tdoa)) % 10 == 0, np.nan, recording.tdoa.d)
    )


@mistake("published twice", "tdoa_twice")
def twice(recording, rng, other):
    return _tdoa(recording, rows=np.repeat(np.arange(len(recording.tdoa)), 2))


@mistake("last value of each pair published by a timer, at 1 kHz", "tdoa_repeated")
def by_timer(recording, rng, other):
    tdoa = recording.tdoa
    pairs, inverse = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0, return_inverse=True)
    common = np.flatnonzero(np.bincount(inverse.reshape(-1)) > len(tdoa) / 100)
    t = np.arange(tdoa.t[0] + 1.0, tdoa.t[-1], 1e-3)
    turn = common[np.arange(len(t)) % len(common)]
    d = np.zeros(len(t))
    for k in common:
        mine, due = np.flatnonzero(inverse.reshape(-1) == k), turn == k
        d[due] = tdoa.d[
            mine[np.maximum(np.searchsorted(tdoa.t[mine], t[due], side="right") - 1, 0)]
        ]
    made = replace(
        recording,
        tdoa=Tdoas(t, pairs[turn, 0], pairs[turn, 1], d),
        tdoa_arrival=np.full(len(t), np.nan),
    )
    return arriving(made, 3) if np.isfinite(recording.tdoa_arrival).any() else made


@mistake("a second tag on the topic, half a flight behind", "two_tags", needs="other")
def second_tag(recording, rng, other):
    one, two = recording.tdoa, other.tdoa
    length = one.t[-1] - one.t[0]
    later = one.t[0] + (two.t - two.t[0] + 0.5 * length) % length
    later[two.t - two.t[0] > length] = np.inf
    t = np.r_[one.t, later]
    rows = np.argsort(t, kind="stable")[: np.isfinite(t).sum()]
    columns = (np.r_[x, y][rows] for x, y in ((one.a, two.a), (one.b, two.b), (one.d, two.d)))
    return replace(recording, tdoa=Tdoas(t[rows], *columns), tdoa_arrival=t[rows] + 0.003)


# Ids and surveys


@mistake("ids of two anchors swapped", "ids_exchanged")
def swapped(recording, rng, other):
    one, two = rng.choice(recording.anchors.ids, 2, replace=False)
    return _renamed(recording, {one: two, two: one})


@mistake("ids counted from 1, survey from 0", "ids_renumbered")
def from_one(recording, rng, other):
    return _tdoa(recording, a=recording.tdoa.a + 1, b=recording.tdoa.b + 1)


@mistake("an anchor missing from the survey", "ids_unknown", alone=True)
def unsurveyed(recording, rng, other):
    rows = np.arange(len(recording.anchors)) != rng.integers(len(recording.anchors))
    return _moved(recording, recording.anchors.positions, rows)


@mistake("an anchor switched off", "anchor_missing")
def switched_off(recording, rng, other):
    off = rng.choice(recording.anchors.ids)
    return _tdoa(recording, rows=(recording.tdoa.a != off) & (recording.tdoa.b != off))


@mistake("an anchor loses power on the way", "anchor_silent")
def power_lost(recording, rng, other):
    tdoa, off = recording.tdoa, rng.choice(recording.anchors.ids)
    before = tdoa.t < 0.6 * tdoa.t[0] + 0.4 * tdoa.t[-1]
    return _tdoa(recording, rows=before | ((tdoa.a != off) & (tdoa.b != off)))


@mistake("only three anchors heard", "few_anchors")
def three_anchors(recording, rng, other):
    ids = recording.anchors.ids[:3]
    return _tdoa(recording, rows=np.isin(recording.tdoa.a, ids) & np.isin(recording.tdoa.b, ids))


@mistake("survey of another room, the right one among those given", "survey_other", needs="rooms")
def another_room(recording, rng, other):
    return replace(recording, anchors=other)


@mistake(
    "survey of another room, no other at hand",
    "survey_misfit",
    "anchor_moved",
    needs="rooms",
    alone=True,
)
def another_room_alone(recording, rng, other):
    return replace(recording, anchors=other)


@mistake("one coordinate of one anchor wrong by 2 m", "anchor_moved", "survey_misfit", alone=True)
def typing_error(recording, rng, other):
    positions = recording.anchors.positions.copy()
    positions[rng.integers(len(positions)), rng.integers(2)] += rng.choice([-2.0, 2.0])
    return _moved(recording, positions)


@mistake("three anchors late by 1 m", "anchors_late", "survey_misfit", alone=True)
def late_anchors(recording, rng, other):
    tdoa, late = recording.tdoa, rng.choice(recording.anchors.ids, 3, replace=False)
    return _tdoa(recording, d=tdoa.d + np.isin(tdoa.b, late) - np.isin(tdoa.a, late))


@mistake("x and y of the survey exchanged", "survey_mirrored", "imu_axes", needs="imu", alone=True)
def mirrored_survey(recording, rng, other):
    return _moved(recording, recording.anchors.positions[:, [1, 0, 2]])


@mistake("survey upside down", "survey_upside_down", needs="imu", alone=True)
def upside_down_survey(recording, rng, other):
    return _moved(recording, recording.anchors.positions * [1.0, -1.0, -1.0])


@mistake("survey with y up", "survey_upside_down", needs="imu", alone=True)
def y_up_survey(recording, rng, other):
    x, y, z = recording.anchors.positions.T
    return _moved(recording, np.column_stack([x, z, -y]))


# The inertial sensor


@mistake("accelerometer in g", "imu_force_unit", needs="imu")
def in_g(recording, rng, other):
    return _imu(recording, accel=recording.imu.accel / 9.81)


@mistake("gyroscope in degrees/s", "imu_rate_unit", needs="imu")
def in_degrees(recording, rng, other):
    return _imu(recording, gyro=np.rad2deg(recording.imu.gyro))


@mistake("gravity taken out", "imu_no_gravity", needs="imu")
def no_gravity(recording, rng, other):
    return _imu(recording, accel=recording.imu.accel - [0.0, 0.0, 9.81])


@mistake("IMU in forward, right, down", "imu_turned", needs="imu")
def front_right_down(recording, rng, other):
    return _turned(recording, np.diag([1.0, -1.0, -1.0]))


@mistake("IMU on its side (y up)", "imu_turned", needs="imu")
def on_its_side(recording, rng, other):
    return _turned(recording, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))


@mistake("accelerometer with the other sign (-9.81 upwards)", "imu_turned", "imu_axes", needs="imu")
def minus_gravity(recording, rng, other):
    return _imu(recording, accel=-recording.imu.accel)


@mistake("sign of gyroscope x", "imu_axes", needs="imu")
def gyro_sign(recording, rng, other):
    return _imu(recording, gyro=recording.imu.gyro * [-1.0, 1.0, 1.0])


@mistake("y of both sensors with the other sign (left-handed)", "imu_axes", needs="imu")
def left_handed(recording, rng, other):
    return _imu(
        recording,
        gyro=recording.imu.gyro * [1.0, -1.0, 1.0],
        accel=recording.imu.accel * [1.0, -1.0, 1.0],
    )


@mistake("x and y of the gyroscope exchanged", "imu_axes", needs="imu")
def gyro_exchanged(recording, rng, other):
    return _imu(recording, gyro=recording.imu.gyro[:, [1, 0, 2]])


@mistake("IMU silent: all zeros", "imu_silent", needs="imu")
def silent(recording, rng, other):
    return _imu(recording, gyro=0.0 * recording.imu.gyro, accel=0.0 * recording.imu.accel)


@mistake("IMU read at 100 Hz, published at 1 kHz", "imu_repeated", needs="imu")
def held(recording, rng, other):
    rows = np.arange(len(recording.imu)) // 10 * 10
    return _imu(recording, gyro=recording.imu.gyro[rows], accel=recording.imu.accel[rows])


@mistake("one axis of the accelerometer dead", "imu_axis_dead", needs="imu")
def dead_axis(recording, rng, other):
    return _imu(recording, accel=recording.imu.accel * [1.0, 0.0, 1.0])


@mistake("accelerometer clipped at 10.5 m/s^2", "imu_clipped", needs="imu")
def clipped_accel(recording, rng, other):
    return _imu(recording, accel=np.clip(recording.imu.accel, -10.5, 10.5))


@mistake("accelerometer shaking, 4 m/s^2 rms at 90 Hz", "imu_shaking", needs="imu")
def shaking(recording, rng, other):
    shake = 4.0 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 90.0 * recording.imu.t)
    return _imu(recording, accel=recording.imu.accel + shake[:, None] * [1.0, 0.0, 0.0])


@mistake("IMU in the frame imu_link, no transform", "frame_unknown", needs="imu")
def unknown_frame(recording, rng, other):
    return replace(
        recording,
        frames={TDOA: {"base_link": len(recording.tdoa)}, IMU: {"imu_link": len(recording.imu)}},
    )


@mistake("IMU turned by 90 degrees about z, as /tf_static says", "frame_turned", needs="imu")
def turned_frame(recording, rng, other):
    quarter = Rotation.from_euler("z", 90.0, degrees=True)
    return replace(
        unknown_frame(recording, rng, other), places={"imu_link": (quarter, np.zeros(3))}
    )


# Stamps


@mistake("stamps of all TDOAs 0", "stamps_zero")
def stamp_zero(recording, rng, other):
    return _tdoa(recording, t=0.0 * recording.tdoa.t)


@mistake("stamps of the IMU in milliseconds", "stamps_unit", needs="imu")
def stamp_unit(recording, rng, other):
    return _imu(recording, t=1000.0 * recording.imu.t)


@mistake("stamps of the IMU in steps of 20 ms", "stamps_coarse", needs="imu")
def stamp_coarse(recording, rng, other):
    return _imu(recording, t=np.floor(recording.imu.t / 0.02) * 0.02)


@mistake("IMU 0.5 s ahead", "stamps_apart", needs="imu")
def imu_ahead(recording, rng, other):
    return _imu(recording, t=recording.imu.t + 0.5)


@mistake("IMU 0.3 s behind", "stamps_apart", needs="imu")
def imu_behind(recording, rng, other):
    return _imu(recording, t=recording.imu.t - 0.3)


@mistake("TDOAs 10 s ahead", "stamps_apart", needs="imu")
def tdoa_ahead(recording, rng, other):
    return _tdoa(recording, t=recording.tdoa.t + 10.0)


@mistake("clock of the IMU fast by 2 ms/s", "clock_drift", needs="imu live")
def drift(recording, rng, other):
    t = recording.imu.t
    return _imu(recording, t=t + 2e-3 * (t - t[0]))


@mistake("clock of the TDOAs set back by 5 s on the way", "stamps_jump")
def jump(recording, rng, other):
    t = recording.tdoa.t
    return _tdoa(recording, t=np.where(t > 0.5 * (t[0] + t[-1]), t - 5.0, t))


@mistake("TDOAs arrive in blocks of a second", "blocks", needs="live")
def in_blocks(recording, rng, other):
    return replace(recording, tdoa_arrival=np.ceil(recording.tdoa_arrival))


@mistake("packets shuffled by up to 50 ms", "stamps_fall", needs="live")
def shuffled(recording, rng, other):
    arrival = recording.tdoa_arrival + rng.uniform(0.0, 0.05, len(recording.tdoa))
    rows = np.argsort(arrival, kind="stable")
    return replace(_tdoa(recording, rows=rows), tdoa_arrival=arrival[rows])


@mistake("IMU at 25 Hz", "rate", needs="imu")
def slow_imu(recording, rng, other):
    return _imu(recording, rows=slice(None, None, 40))


@mistake("the IMU falls silent for 2 s", "gap", needs="imu")
def imu_gap(recording, rng, other):
    t = recording.imu.t
    middle = 0.5 * (t[0] + t[-1])
    return _imu(recording, rows=(t < middle) | (t > middle + 2.0))


def _renamed(recording, table):
    columns = {}
    for name in ("a", "b"):
        ids = getattr(recording.tdoa, name)
        columns[name] = ids.copy()
        for one, two in table.items():
            columns[name][ids == one] = two
    return _tdoa(recording, **columns)


def _turned(recording, matrix):
    return _imu(recording, gyro=recording.imu.gyro @ matrix.T, accel=recording.imu.accel @ matrix.T)
