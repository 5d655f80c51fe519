# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the rules over streams and residuals, and the findings in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
import math
import re
from typing import Any

import faults
from faults import ACCEL, ARRIVAL, GYRO, D, T, put
import halls
from mistakes import MISTAKES, arriving
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.common.geometry import ranges
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK
from uwb_tdoa_bias.common.survey import UNITS
from uwb_tdoa_bias.effects import Covariance
from uwb_tdoa_ekf.evidence import keys_of
from uwb_tdoa_ekf.monitoring.finding import Finding
from uwb_tdoa_ekf.monitoring.monitor import Monitor
from uwb_tdoa_ekf.monitoring.signs import SignWatch
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules, StreamWatch
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.readers.streams import protocol

from . import node, pace
from .rows import FIRST_SEED, HALL, VALUES, Inputs

# {rule, severity and anchors: [first, last s, value of the last finding]}
Said = dict[str, list[float]]
HEALTHY = "0426-traj5", "0422-log02", "0425-traj13", "0426-traj1"
SPOILT = HEALTHY[0]  # measured flight into which mistakes are put
SETTLES = "const4-trial3-tdoa2-traj2"  # a false alarm comes earlier without the first s of motion
WEIGHTLESS = "no_gravity"  # of MISTAKES
EVERY = 1.0  # s between two looks
UNTIL = 45.0  # s of a measured flight
RATE = 50.0  # Hz, estimates of a run that are kept
LAG = 0.25  # s
CHECKED = ", checked"  # of a finding over the whole recording
A, B = 2, 3  # columns of the TDOAs, behind T and ARRIVAL
TICKS = 2.0**32 * TICK  # m, range of 32 bits of the clock of a DW1000
Columns = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Watched:
    """A row: said() : Said. of : kind of the rules that it shows."""

    name: str
    of: str
    said: Callable[[], Said]


@dataclass(frozen=True)
class Seen:
    """Streams, counted in windows. looks : (s, new windows of the IMU, of the TDOAs, unknown ids so
    far); rest : windows that end with the recording.
    """

    anchors: Anchors
    looks: list[tuple[float, list, list, Counter]]
    rest: tuple[list, list]


def rows(inputs: Inputs) -> list[Watched]:
    """All rows, the cheapest first."""
    parts = (_of_streams, _of_scale, _of_sign, _of_anchors)
    made = [row for part in parts for row in part(inputs)]
    for kind, told in (("node", node.rows(inputs)), ("pace", pace.rows(inputs))):
        made += [Watched(name, kind, said) for name, said in told]
    return made


# Streams


def _imu(change: Callable[[Columns, Any], Columns]) -> Callable:
    return lambda imu, tdoa, rng: (change(imu, rng), tdoa)


def _tdoa(change: Callable[[Columns, Any], Columns]) -> Callable:
    return lambda imu, tdoa, rng: (imu, change(tdoa, rng))


def _both(change: Callable[[Columns], Columns]) -> Callable:
    return lambda imu, tdoa, rng: (change(imu), change(tdoa))


def _rarely(share: float, rng: Any, columns: Columns, value: Any, place: int) -> Columns:
    hit = rng.random(len(columns[T])) < share
    return put(columns, place, np.where(hit, value, columns[place]))


def _wrapped(columns: Columns, step: float, share: float, rng: Any) -> Columns:
    hit = rng.random(len(columns[T])) < share
    return put(columns, D, columns[D] + np.where(hit, step, 0.0))


def _between(columns: Columns, begin: float, end: float) -> Columns:
    t = columns[T] - columns[T][0]
    return tuple(column[(t < begin) | (t > end)] for column in columns)


def _fast(columns: Columns) -> Columns:
    arrival = columns[ARRIVAL]
    return put(columns, ARRIVAL, arrival[0] + (arrival - arrival[0]) / 4.0)


def _at_rest(columns: Columns, bias: float, rng: Any) -> Columns:
    n = len(columns[T])
    still = put(columns, GYRO, [bias, 0.0, 0.1] + 0.01 * rng.normal(size=(n, 3)))
    return put(still, ACCEL, [0.1, -0.2, 9.81] + 0.03 * rng.normal(size=(n, 3)))


_TILTED = np.array([[1.0, 0.0, 0.0], [0.0, 0.7, 0.7], [0.0, -0.7, 0.7]])
# Faults of rules that neither `mistakes` nor the table of faults has
SPOILING: dict[str, Callable] = {
    "stamps of the IMU stand": _imu(lambda c, rng: put(c, T, 7.0 + 0.0 * c[T])),
    "IMU stamped by microseconds in nanosec": _imu(
        lambda c, rng: put(c, T, np.floor(c[T]) + 1e-3 * (c[T] % 1.0))
    ),
    "IMU silent for 0.4 s": _imu(lambda c, rng: _between(c, 20.0, 20.4)),
    "TDOAs silent for 0.8 s": _tdoa(lambda c, rng: _between(c, 20.0, 20.8)),
    "TDOAs at a tenth of 100 Hz": _tdoa(
        lambda c, rng: tuple(column[:: max(1, len(c[T]) // 450)] for column in c)
    ),
    "TDOAs arrive 0.6 s late": _tdoa(lambda c, rng: put(c, ARRIVAL, c[ARRIVAL] + 0.6)),
    "IMU 0.15 s behind": _imu(lambda c, rng: put(c, T, c[T] - 0.15)),
    "IMU in blocks of 0.5 s": _imu(lambda c, rng: put(c, ARRIVAL, np.ceil(2.0 * c[ARRIVAL]) / 2.0)),
    "both in blocks of 1 s": _both(lambda c: put(c, ARRIVAL, np.ceil(c[ARRIVAL]))),
    "replayed four times as fast": _both(_fast),
    "both on another clock": _both(lambda c: put(c, ARRIVAL, c[ARRIVAL] + 1e6)),
    "one stamp far ahead": _tdoa(
        lambda c, rng: put(c, T, c[T] + 1e9 * (np.arange(len(c[T])) == len(c[T]) // 2))
    ),
    "IMU tilted by 45 degrees": _imu(lambda c, rng: put(c, ACCEL, c[ACCEL] @ _TILTED)),
    "accelerometer in mg": _imu(lambda c, rng: put(c, ACCEL, 1e3 / 9.80665 * c[ACCEL])),
    "accelerometer half of what it is": _imu(lambda c, rng: put(c, ACCEL, 0.5 * c[ACCEL])),
    "a gyroscope axis dead": _imu(lambda c, rng: put(c, GYRO, c[GYRO] * [1.0, 0.0, 1.0])),
    "1 % of the samples not finite": _imu(
        lambda c, rng: put(c, GYRO, np.where(rng.random((len(c[T]), 1)) < 0.01, np.nan, c[GYRO]))
    ),
    "at rest": _imu(lambda c, rng: _at_rest(c, 0.02, rng)),
    "at rest, gyroscope 0.6 rad/s off": _imu(lambda c, rng: _at_rest(c, 0.6, rng)),
    "gyroscope clipped at 1 rad/s": _imu(lambda c, rng: put(c, GYRO, np.clip(c[GYRO], -1.0, 1.0))),
    "a tenth of the TDOAs outliers": _tdoa(
        lambda c, rng: _rarely(0.1, rng, c, rng.uniform(10.0, 30.0, len(c[T])), D)
    ),
    "a tenth of the TDOAs of one anchor": _tdoa(lambda c, rng: _rarely(0.1, rng, c, c[B], A)),
    "a step of 10 m": _tdoa(lambda c, rng: _wrapped(c, 10.0, 0.08, rng)),
    "a step of 2^32 ticks": _tdoa(lambda c, rng: _wrapped(c, TICKS, 0.2, rng)),
    "TDOAs rounded to 0.05 m": _tdoa(lambda c, rng: put(c, D, np.round(20.0 * c[D]) / 20.0)),
    "TDOAs rounded to 0.01 m": _tdoa(lambda c, rng: put(c, D, np.round(c[D], 2))),
    "TDOAs of a tag 2 m away between": _tdoa(faults.second_tag),
    "TDOAs in kilometres": _tdoa(lambda c, rng: put(c, D, c[D] / 1e3)),
    "TDOAs in seconds": _tdoa(lambda c, rng: put(c, D, c[D] / SPEED_OF_LIGHT)),
    "TDOAs at random": _tdoa(lambda c, rng: put(c, D, rng.uniform(-3.0, 3.0, len(c[D])))),
    "half of the TDOAs at random": _tdoa(
        lambda c, rng: _rarely(0.5, rng, c, rng.uniform(-3.0, 3.0, len(c[D])), D)
    ),
    "one TDOA in 40": _tdoa(lambda c, rng: tuple(column[::40] for column in c)),
}


def _of_streams(inputs: Inputs) -> Iterator[Watched]:
    make = partial(_streams, inputs)
    for name in HEALTHY:
        yield Watched(f"{name} is sound", "streams", partial(make, name))
        yield Watched(
            f"{name} is sound, without arrivals", "streams", partial(make, name, log=True)
        )
    kind = protocol(inputs.recording(SPOILT).flight.tdoa)
    for fault, mistake in MISTAKES.items():
        if {*mistake.needs.split()} <= {"imu", "live", kind}:
            change = partial(_mistaken, fault)
            yield Watched(mistake.text, "streams", partial(make, SPOILT, change))
    for fault, change in SPOILING.items():
        yield Watched(fault, "streams", partial(make, SPOILT, partial(_spoilt, change)))
    change = partial(_spoilt, _imu(lambda c, rng: put(c, T, c[T] + 0.4)))
    yield Watched("IMU 0.4 s ahead in a log", "streams", partial(make, SPOILT, change, log=True))
    for name in inputs.measured():
        change = partial(_mistaken, WEIGHTLESS)
        yield Watched(
            f"{name}, {MISTAKES[WEIGHTLESS].text}", "streams", partial(make, name, change)
        )
    for fault in sorted(faults.FAULTS.keys() - faults.OF_THE_CLOCK):
        yield Watched(f"for 6 s: {fault}", "streams", partial(_for_a_while, inputs, fault))


def _mistaken(fault: str, recording: Any) -> Any:
    rng = np.random.default_rng([0, *fault.encode()])
    return MISTAKES[fault].make(recording, rng, None)


def _spoilt(change: Callable, recording: Any) -> Any:
    imu, tdoa = change(*_columns(recording), np.random.default_rng(1))
    return recording.anchors, imu, tdoa


def _columns(recording: Any) -> tuple[Columns, Columns]:
    imu, tdoa = recording.imu, recording.tdoa
    return (
        (imu.t, recording.imu_arrival, imu.gyro, imu.accel),
        (tdoa.t, recording.tdoa_arrival, tdoa.a, tdoa.b, tdoa.d),
    )


def _streams(inputs: Inputs, name: str, change: Callable | None = None, log: bool = False) -> Said:
    said = _replayed(_seen(inputs, name, change, log))
    return {key: one for key, one in said.items() if not log or key.endswith(CHECKED)}


def _seen(inputs: Inputs, name: str, change: Callable | None, log: bool) -> Seen:
    def make() -> Seen:
        flight = inputs.recording(name).flight
        recording = arriving(of_flight(_first(flight, UNTIL)), 0)
        found = recording if change is None else change(recording)
        anchors, *both = found if isinstance(found, tuple) else (found.anchors, *_columns(found))
        if log:
            both = [put(c, ARRIVAL, np.full(len(c[T]), np.nan)) for c in both]
        return _counted(anchors, *both)

    return inputs.kept(f"seen {name} {_name(change)} {log}", make)


def _name(change: Any) -> str:
    """Name of a change, to keep what it makes under."""
    if change is None:
        return ""
    (what,) = change.args
    if isinstance(what, str):
        return what
    return next((name for name, one in SPOILING.items() if one is what), "ahead")


def _first(flight: Flight, seconds: float) -> Flight:
    end = flight.tdoa.t[0] + seconds
    tdoa, imu = (rows_of(part, part.t < end) for part in (flight.tdoa, flight.imu))
    return replace(flight.without(*SENSOR_NAMES), tdoa=tdoa, imu=imu)


def _for_a_while(inputs: Inputs, fault: str) -> Said:
    def make() -> Seen:
        parts = [(0.0, 4.0, ()), (4.0, 10.0, (fault,)), (10.0, 16.0, ())]
        return _counted(faults.FLIGHT.anchors, *faults.columns_of(1e9, parts))

    return _replayed(inputs.kept(f"seen for a while {fault}", make))


def _counted(anchors: Anchors, imu: Columns, tdoa: Columns) -> Seen:
    """Count streams in windows, look by look."""
    rules, looks = StreamRules(anchors), []
    rules._scale.add = lambda snapshot: None  # the scale has separate rows
    known = [np.where(np.isfinite(c[ARRIVAL]), c[ARRIVAL], c[T]) for c in (imu, tdoa)]
    begin = min(float(np.min(one)) for one in known)
    until = min(max(float(np.max(one)) for one in known), begin + 2.0 * UNTIL)
    for now in np.arange(begin + EVERY, until + EVERY, EVERY):
        before = len(rules.imu), len(rules.tdoa)
        for columns, arrival, feed in zip((imu, tdoa), known, (rules.feed_imu, rules.feed_tdoa)):
            inside = (arrival > now - EVERY) & (arrival <= now)
            if inside.any():
                feed(*(column[inside] for column in columns))
        new = rules.imu[before[0] :], rules.tdoa[before[1] :]
        looks.append((float(now - begin), *new, Counter(rules.unknown)))
    before = len(rules.imu), len(rules.tdoa)
    rules.finish()
    return Seen(anchors, looks, (rules.imu[before[0] :], rules.tdoa[before[1] :]))


def _replayed(seen: Seen, scale: bool = False) -> Said:
    """Findings in flight, look by look, and over the whole recording as in `check`."""
    watch, said = StreamWatch(seen.anchors, LAG), {}
    whole = StreamRules(seen.anchors)
    for now, imu, tdoa, unknown in seen.looks:
        for rules in (watch._rules, whole):
            rules.unknown = unknown
            for windows, more in ((rules.imu, imu), (rules.tdoa, tdoa)):
                for window in more:
                    rules._keep(windows, window)
            if scale:
                for window in tdoa:
                    rules._scale.add(window.latest)
        for finding in watch.findings():
            _note(said, finding, now)
    for windows, more in zip((whole.imu, whole.tdoa), seen.rest):
        windows += more
    for finding in whole.findings():
        said[f"{finding.rule} {finding.severity}{CHECKED}"] = [0.0, 0.0, finding.value]
    return said


def _note(said: Said, finding: Finding, now: float, anchors: str = "") -> None:
    key = f"{finding.rule} {finding.severity} {anchors}".strip()
    said[key] = [said.get(key, [now])[0], now, finding.value]


# Scale of the survey


def _of_scale(inputs: Inputs) -> Iterator[Watched]:
    for name in HEALTHY[:3]:
        yield Watched(f"survey of {name}", "scale", partial(_scaled, inputs, name, _as_it_is))
    for name, factor in UNITS.items():
        change = partial(_scaled, inputs, SPOILT, partial(_times, factor))
        yield Watched(f"survey in {name}", "scale", change)
    for factor in (25.0, 0.1):
        change = partial(_scaled, inputs, SPOILT, partial(_times, factor))
        yield Watched(f"survey {factor:g} times too large", "scale", change)
    for row, unit in ((1, "millimetres"), (6, "inches"), (1, "feet")):
        change = partial(_scaled, inputs, SPOILT, partial(_times_one, row, UNITS[unit]))
        yield Watched(f"anchor {row} in {unit}", "scale", change)
    for name, change in SURVEYS.items():
        yield Watched(name, "scale", partial(_scaled, inputs, SPOILT, change))
    for name in ("nanoseconds", "sign", "millimetres"):
        yield Watched(f"TDOAs: {name}", "scale", partial(_scaled, inputs, SPOILT, _as_it_is, name))
    for name in UNFIT:
        yield Watched(f"{name}, scale", "scale", partial(_scaled, inputs, SPOILT, _as_it_is, name))
        change = partial(_times, UNITS["feet"])
        words = f"{name}, survey in feet"
        yield Watched(words, "scale", partial(_scaled, inputs, SPOILT, change, name))


def _as_it_is(positions: np.ndarray) -> np.ndarray:
    return positions


def _times(factor: float, positions: np.ndarray) -> np.ndarray:
    return factor * positions


def _times_one(row: int, factor: float, positions: np.ndarray) -> np.ndarray:
    changed = positions.copy()
    changed[row] *= factor
    return changed


def _exchanged(positions: np.ndarray) -> np.ndarray:
    return positions[[0, 1, 5, 3, 4, 2, *range(6, len(positions))]]


def _taped(positions: np.ndarray) -> np.ndarray:
    return positions + 0.1 * np.random.default_rng(0).normal(size=positions.shape)


SURVEYS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "two anchors exchanged": _exchanged,
    "x of the survey mirrored": lambda positions: positions * [-1.0, 1.0, 1.0],
    "all anchors at one height": lambda positions: positions * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0],
    "survey with errors of 0.1 m": _taped,
    "survey of another room": lambda positions: (
        np.random.default_rng(3).uniform(-1.0, 1.0, positions.shape) * [3.0, 5.0, 1.5]
    ),
}


# What is wrong with TDOAs that fit no survey
UNFIT = (
    "TDOAs in kilometres",
    "TDOAs in seconds",
    "TDOAs at random",
    "half of the TDOAs at random",
    "one TDOA in 40",
)


def _scaled(inputs: Inputs, name: str, change: Callable, mistake: str = "") -> Said:
    of = partial(_mistaken, mistake) if mistake else None
    if mistake in SPOILING:
        of = partial(_spoilt, SPOILING[mistake])
    seen = _seen(inputs, name, of, False)
    anchors = seen.anchors
    moved = Anchors(anchors.ids, change(anchors.positions), anchors.orientations)
    found = _replayed(replace(seen, anchors=moved), scale=True)
    return {key: one for key, one in found.items() if "scale" in key or "tdoa_unit" in key}


# Signs


def _of_sign(inputs: Inputs) -> Iterator[Watched]:
    signs: dict[str, Callable] = {
        "sound": lambda t: 1.0 + 0.0 * t,
        "wrong": lambda t: -1.0 + 0.0 * t,
        "right from 20 s on": lambda t: np.where(t < 20.0, -1.0, 1.0),
        "wrong from 18 s on": lambda t: np.where(t < 18.0, 1.0, -1.0),
    }
    for name in [*HEALTHY, *sorted({*inputs.measured()} - {*HEALTHY})]:
        for what, sign in signs.items():
            if name in HEALTHY[:2] or what in ("sound", "wrong"):
                yield Watched(f"{name}, sign {what}", "sign", partial(_signed, inputs, name, sign))
    for name in HEALTHY:
        for what in ("sound", "wrong"):
            for every in FEW:
                run = partial(_signed, inputs, name, signs[what], every)
                yield Watched(f"{name}, one TDOA in {every}, sign {what}", "sign", run)
    flight = f"fly hall {FIRST_SEED}"
    yield Watched(f"{flight}, sign sound", "sign", partial(_signed, inputs, "", signs["sound"]))
    yield Watched(f"{flight}, sign wrong", "sign", partial(_signed, inputs, "", signs["wrong"]))


FEW = 20, 40  # so many TDOAs become one


def _signed(inputs: Inputs, name: str, sign: Callable, every: int = 1) -> Said:
    """What a SignWatch finds; the filter doubts 2 s after the signs have become wrong. every : one
    TDOA of so many is used.
    """
    flight = inputs.recording(name).flight if name else inputs.flight_of("hall", FIRST_SEED)
    tdoa = rows_of(flight.tdoa, slice(None, None, every))
    watch, said = SignWatch(flight.anchors), {}
    since = tdoa.t - tdoa.t[0]
    for k in range(int(min(since[-1], UNTIL))):
        rows = (since >= k) & (since < k + 1.0)
        if 20.0 < k and sign(np.array([17.0]))[0] > 0.0 > sign(np.array([k]))[0]:
            watch.doubt()
        watch.feed(tdoa.t[rows], tdoa.a[rows], tdoa.b[rows], sign(since[rows]) * tdoa.d[rows])
        if watch.finding is not None:
            _note(said, watch.finding, k + 1.0)
        if watch._certain:
            said.setdefault("certain", [k + 1.0, k + 1.0, 1.0])
    return said


# Residuals


def _of_anchors(inputs: Inputs) -> Iterator[Watched]:
    make = partial(_of_residuals, inputs)
    for name in [*HEALTHY, *sorted({*inputs.measured()} - {*HEALTHY})]:
        yield Watched(f"{name} is sound, residuals", "monitoring", partial(make, name))
    yield Watched(
        f"{SETTLES} is sound, residuals", "monitoring", partial(_first_of, inputs, SETTLES)
    )
    for name in HEALTHY[:3]:
        for pair in PAIRS:
            words = "anchors {} and {} exchanged from 25 s on".format(*pair)
            run = partial(make, name, words, partial(_swapped, *pair), False)
            yield Watched(f"{name}, {words}", "monitoring", run)
    for world in ("hall", "anchor-late", "anchor-silent"):
        for seed in (FIRST_SEED, FIRST_SEED + 1):
            name = f"fly {world} {seed}"
            yield Watched(f"{name}, residuals", "monitoring", partial(_flown, inputs, world, seed))
    for name in ("tdoa: sign", "tdoa: two ids exchanged", "tdoa: half are outliers"):
        yield Watched(f"{name}, residuals", "monitoring", partial(_faulty, inputs, name))
    yield Watched(HALL, "monitoring", partial(_passing, inputs))
    for name, part, axis, size in BIASES:
        words = f"{name}, {part} {'xyz'[axis]} {size:g} off from 30 s on"
        run = partial(_biased, inputs, name, part, axis, size)
        yield Watched(words, "monitoring", run)
    for name, (change, calibrated) in CHANGES.items():
        for flight in HEALTHY[1:3] if name in OFTEN else HEALTHY[1:2]:
            run = partial(make, flight, name, change, calibrated)
            yield Watched(f"{flight}, {name}", "monitoring", run)


def _one(row: int, size: Callable | float, flight: Flight, t: np.ndarray, p: np.ndarray) -> Any:
    """Delay of one anchor, m, of the others 0: (n, N)."""
    out = np.zeros((len(t), len(flight.anchors)))
    out[:, row] = size(t) if callable(size) else size
    return out


def _shifted(
    row: int, begin: float, shift: Any, flight: Flight, t: np.ndarray, p: np.ndarray
) -> Any:
    positions = flight.anchors.positions
    moved = positions.copy()
    moved[row] += shift
    away = [ranges(p[:, None], where)[0] for where in (moved, positions)]
    return np.where(t[:, None] > begin, away[0] - away[1], 0.0)


def _swapped(one: int, other: int, flight: Flight, t: np.ndarray, p: np.ndarray) -> Any:
    away = ranges(p[:, None], flight.anchors.positions)[0]
    out = np.zeros_like(away)
    out[:, one] = np.where(t > 25.0, away[:, other] - away[:, one], 0.0)
    out[:, other] = -out[:, one]
    return out


def _half(flight: Flight, t: np.ndarray, p: np.ndarray) -> Any:
    late = np.random.default_rng(0).uniform(2.5, 4.0, len(flight.anchors))
    late *= np.arange(len(flight.anchors)) % 2
    return late * (t > 30.0)[:, None]


def _after(begin: float, size: float, end: float = math.inf) -> Callable:
    return lambda t: size * ((t > begin) & (t < end))


def _two(flight: Flight, t: np.ndarray, p: np.ndarray) -> Any:
    return _one(2, _after(20.0, 0.6), flight, t, p) + _one(5, _after(32.0, 0.6), flight, t, p)


# Delays of anchors that are put into a measured flight, by s since the first TDOA; whether the
# anchors have been calibrated
CHANGES: dict[str, tuple[Callable | None, bool]] = {
    "an anchor 0.5 m late from 25 s on": (partial(_one, 2, _after(25.0, 0.5)), False),
    "an anchor 0.5 m early from 25 s on": (partial(_one, 4, _after(25.0, -0.5)), False),
    "an anchor 0.25 m late from 25 s on": (partial(_one, 2, _after(25.0, 0.25)), False),
    "an anchor late from 20 to 30 s": (partial(_one, 0, _after(20.0, 0.5, 30.0)), False),
    "a clock drifts by 0.06 m/s": (
        partial(_one, 1, lambda t: 0.06 * np.maximum(t - 18.0, 0.0)),
        False,
    ),
    "two anchors, one after the other": (_two, False),
    "half of the anchors metres late": (_half, False),
    "an anchor moved by 0.7 m before": (partial(_shifted, 3, -1.0, (0.5, -0.4, 0.3)), False),
    "an anchor moved by 0.7 m before, calibrated": (
        partial(_shifted, 3, -1.0, (0.5, -0.4, 0.3)),
        True,
    ),
    "an anchor moved by 0.7 m from 20 s on, calibrated": (
        partial(_shifted, 3, 20.0, (0.5, -0.4, 0.3)),
        True,
    ),
    "an anchor 0.35 m later than calibrated": (partial(_one, 3, 0.35), True),
    "calibrated": (None, True),
    "two anchors exchanged from 25 s on": (partial(_swapped, 1, 4), False),
}
OFTEN = {
    "an anchor 0.5 m late from 25 s on",
    "a clock drifts by 0.06 m/s",
    "an anchor moved by 0.7 m before",
    "calibrated",
    "two anchors exchanged from 25 s on",
}
# (flight, sensor of the IMU, axis, rad/s or m/s^2) of a bias that moves
BIASES = (
    (HEALTHY[1], "gyro", 2, 0.06),
    (HEALTHY[1], "accel", 2, 1.2),
    (HEALTHY[0], "gyro", 0, 0.06),
    (HEALTHY[0], "accel", 2, 2.5),
)
PAIRS = (0, 1), (0, 5), (2, 3), (2, 7), (3, 6)  # rows of anchors that are exchanged
# of calibrated anchors, m
POSITION_STD, DELAY_STD = 0.03, 0.02


def _of_residuals(
    inputs: Inputs,
    name: str,
    what: str = "",
    change: Callable | None = None,
    calibrated: bool = False,
) -> Said:
    flight = inputs.recording(name).flight.without(*SENSOR_NAMES)
    if change is not None:
        flight = inputs.kept(f"delayed {name} {what}", lambda: _delayed(flight, change))
    run = _run(inputs, f"{name} {what}", flight)
    ids = flight.anchors.ids
    stds = np.repeat([POSITION_STD, DELAY_STD], [3 * len(ids), len(ids)])
    covariance = Covariance(keys_of(ids), np.diag(stds**2)) if calibrated else None
    return _events(flight.anchors, run, covariance)


def _first_of(inputs: Inputs, name: str) -> Said:
    """Residuals of the first seconds of a recording of `util`."""
    flight = inputs.long_recording(name).flight
    return _events(flight.anchors, _run(inputs, f"first of {name}", flight))


def _delayed(flight: Flight, change: Callable) -> Flight:
    tdoa, truth = flight.tdoa, flight.truth
    p = np.stack([np.interp(tdoa.t, truth.t, truth.p[:, k]) for k in range(3)], axis=1)
    delays = change(flight, tdoa.t - tdoa.t[0], p)
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    n = np.arange(len(tdoa))
    return replace(flight, tdoa=replace(tdoa, d=tdoa.d + delays[n, b] - delays[n, a]))


def _flown(inputs: Inputs, world: str, seed: int) -> Said:
    flight = inputs.flight_of(world, seed)
    return _events(flight.anchors, _run(inputs, f"{world} {seed}", flight))


def _faulty(inputs: Inputs, fault: str) -> Said:
    flight = inputs.faulty(VALUES[fault], fault.split(":")[0]).flight
    return _events(flight.anchors, _run(inputs, fault.replace(":", ""), flight))


def _biased(inputs: Inputs, name: str, part: str, axis: int, size: float) -> Said:
    """An axis of a sensor of the IMU reads more from 30 s on: rad/s or m/s^2."""
    flight = inputs.recording(name).flight.without(*SENSOR_NAMES)
    imu = flight.imu
    values = getattr(imu, part).copy()
    values[imu.t > flight.tdoa.t[0] + 30.0, axis] += size
    flight = replace(flight, imu=replace(imu, **{part: values}))
    return _events(flight.anchors, _run(inputs, f"biased {name} {part} {axis} {size:g}", flight))


def _passing(inputs: Inputs) -> Said:
    make = partial(halls.fly, halls.hall(HALL, 1), 0, 40.0)
    flight = inputs.kept("passing", make)
    return _events(flight.anchors, _run(inputs, "passing", flight))


def _run(inputs: Inputs, key: str, flight: Flight) -> Any:
    """Odometry, thinned, and residuals."""

    def make() -> Any:
        run = run_offline(flight)
        odometry = run.odometry
        place = np.unique(np.floor(RATE * odometry.t), return_index=True)[1]
        return rows_of(odometry, place), run.residuals

    return inputs.kept(f"run {key}", make)


def _events(anchors: Anchors, run: Any, calibrated: Covariance | None = None) -> Said:
    """What a Monitor finds of anchors and of biases, and how often it saw all signs turn."""
    odometry, residuals = run
    order = np.argsort(residuals.t, kind="stable")
    residuals = rows_of(residuals, order)
    monitor, said = Monitor(anchors, calibrated), {}
    begin = math.floor(residuals.t[0])
    for low in np.arange(begin, residuals.t[-1] + 1.0, 1.0):
        some = [
            rows_of(part, (part.t >= low) & (part.t < low + 1.0)) for part in (odometry, residuals)
        ]
        monitor.add(*some)
        monitor.update(low + 1.0)
        for finding in monitor._anchor_findings().values():
            named = re.search(r"[Aa]nchors? ?(are exchanged, )?([\d ,or]*\d)", finding.cause)
            _note(said, finding, float(low + 1.0 - begin), named[2] if named else "")
        for sentence in monitor._axis_alarms():
            key = sentence.split(" by ")[0]
            since = said.get(key, [float(low + 1.0 - begin)])[0]
            said[key] = [since, float(low + 1.0 - begin), 1.0]
    said["turns"] = [0.0, 0.0, float(monitor.turns)]
    return said
