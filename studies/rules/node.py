# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What `ekf_node` says on `status` and `/diagnostics`, row by row, without the node.

An `Estimator` and a `StreamWatch` take the streams of a flight, by a clock of the study. This is
done once: no constant of `status` or `health` changes it. What they are at each look is kept. A
variant then judges these looks, as the node does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
import math
from types import SimpleNamespace
from typing import Any
from unittest import mock

import faults
from faults import ARRIVAL, T, put
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.ros.diagnostics import LOOKS, NUMBER, REPORT_PERIOD
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.monitoring.finding import Finding, most_severe_first
from uwb_tdoa_ekf.monitoring.health import Health
from uwb_tdoa_ekf.monitoring.status import FAULT, Use, status_of, with_fault_covariance
from uwb_tdoa_ekf.monitoring.stream_rules import FEW_ANCHORS, StreamWatch
from uwb_tdoa_ekf.results import Odometry, rotation_std, rows_of

from .rows import Inputs

LAG = 0.25  # s
TURN, JITTER = 0.05, 0.02  # s: streams are read so often; a look comes so much later at most
SECONDS = 50.0  # of a flight with a fault
BEGIN = 22.0  # s since the first TDOA, in the air: a fault begins
LATENCY = 0.004  # s, of a sensor
STATUS = "waiting", "starting", "running", "lost", "fault"
HONEST = 3.0  # deviations within which an error is honest
FLIGHT = "0425-traj13"  # with all sensors
Columns = tuple[np.ndarray, ...]


@dataclass
class Streams:
    """Of a tag, as they arrive.

    imu, tdoa : columns as in `faults`
    sensors : {name: (stream, arrivals s)}
    config : of the filter
    clock : s by which the clock of the node is ahead of the stamps
    """

    flight: Flight
    anchors: Anchors
    imu: Columns
    tdoa: Columns
    sensors: dict[str, tuple[Any, np.ndarray]]
    config: FilterConfig = FilterConfig()
    clock: float = 0.0


@dataclass(frozen=True)
class Look:
    """What the node has at one look.

    now : s of its clock
    estimator : what `status` and `health` ask of an Estimator
    received, counts : messages by stream; totals by verdict
    yaw_std, heard, behind : rad; s of the clock, newest odometry; s from its stamp until now
    findings : of the last report
    error, variance : of the velocity, m/s and (m/s)^2, NaN without odometry
    """

    now: float
    estimator: SimpleNamespace
    received: Counter[str]
    counts: dict[str, int]
    yaw_std: float
    heard: float | None
    behind: float | None
    findings: list[Finding]
    error: np.ndarray
    odometry: Odometry | None


def rows(inputs: Inputs) -> Iterator[tuple[str, Callable[[], dict]]]:
    """(name, sentences) of all rows: sound flights first."""
    for name in inputs.measured():
        yield f"{name} is sound, status", partial(_row, inputs, name, "")
    for fault in CHANGES:
        yield f"{fault}, status", partial(_row, inputs, FLIGHT, fault)


def _row(inputs: Inputs, name: str, fault: str) -> dict:
    looks = inputs.kept(f"node {name} {fault}", lambda: _looks(_streams(inputs, name, fault)))
    return said(looks)


def _streams(inputs: Inputs, name: str, fault: str) -> Streams:
    flight = inputs.recording(name).flight
    rng = np.random.default_rng([1, *fault.encode()])
    imu = flight.imu.t, _arriving(flight.imu.t, rng), flight.imu.gyro, flight.imu.accel
    tdoa = flight.tdoa
    columns = tdoa.t, _arriving(tdoa.t, rng), tdoa.a, tdoa.b, tdoa.d
    sensors = {}
    for sensor in SENSOR_NAMES:
        stream = getattr(flight, sensor)
        if stream is not None:
            sensors[sensor] = stream, stream.t + LATENCY
    made = Streams(flight, flight.anchors, imu, columns, sensors)
    if not fault:
        return made
    until = tdoa.t[0] + SECONDS
    made = replace(
        made,
        imu=_rows(imu, imu[T] < until),
        tdoa=_rows(columns, columns[T] < until),
        sensors={
            sensor: (rows_of(stream, stream.t < until), arrival[stream.t < until])
            for sensor, (stream, arrival) in sensors.items()
        },
    )
    return CHANGES[fault](made, float(tdoa.t[0]) + BEGIN, rng)


def _arriving(t: np.ndarray, rng: Any) -> np.ndarray:
    return np.maximum.accumulate(t + 0.002 + rng.exponential(0.001, len(t)))


def _rows(columns: Columns, kept: np.ndarray) -> Columns:
    return tuple(column[kept] for column in columns)


def _looks(streams: Streams) -> list[Look]:
    """Let an Estimator and a StreamWatch live through the streams."""
    anchors, rng, out = streams.anchors, np.random.default_rng(2), []
    estimator = Estimator(anchors, streams.config, lag=LAG)
    ignored = [FEW_ANCHORS] if streams.config.fixed_height_std > 0.0 else []
    watch, use, received = StreamWatch(anchors, LAG, ignored), Use(LAG), Counter()
    found: list[Finding] = []
    newest: Odometry | None = None
    heard: float | None = None
    restarts = 0
    arrivals = [streams.imu[ARRIVAL], streams.tdoa[ARRIVAL]]
    arrivals += [arrival for _, arrival in streams.sensors.values()]
    begin = min(float(one[0]) for one in arrivals if len(one))
    end = max(float(one[-1]) for one in arrivals if len(one))
    turns_of_look = round(REPORT_PERIOD / LOOKS / TURN)
    for turn in range(1, int((end - begin) / TURN) + 1):
        now = begin + turn * TURN
        for name, rows in _new(streams, now - TURN, now):
            received[name] += len(rows[1]) if name in ("imu", "tdoa") else len(rows.t)
            if name == "imu":
                watch.add_imu(*rows)
                estimator.add_imu(rows[T], *rows[2:])
            elif name == "tdoa":
                watch.add_tdoa(*rows)
                estimator.add_tdoa(rows[T], *rows[2:])
            else:
                estimator.add(name, rows)
        odometry, _ = estimator.advance()
        if len(odometry.t):
            newest, heard = rows_of(odometry, slice(-1, None)), now
        if turn % turns_of_look:
            continue
        if len(out) % LOOKS == LOOKS - 1:
            before, restarts = restarts, estimator.counts["restarts"]
            if restarts != before:
                watch.restart()
            found = watch.findings(estimator.sign_turns, use.contradicted)
            found = most_severe_first([*found, *estimator.findings])
        now += JITTER * float(rng.random())
        use.update(now, received, estimator.counts, estimator.running)
        out.append(_look(streams, estimator, now, received, newest, heard, found))
    return out


def _new(streams: Streams, since: float, until: float) -> Iterator[tuple[str, Any]]:
    """(stream, rows) that arrive in a turn."""
    for name, columns in (("imu", streams.imu), ("tdoa", streams.tdoa)):
        kept = _between(columns[ARRIVAL], since, until)
        if kept.stop > kept.start:
            yield name, tuple(column[kept] for column in columns)
    for name, (stream, arrival) in streams.sensors.items():
        kept = _between(arrival, since, until)
        if kept.stop > kept.start:
            yield name, rows_of(stream, kept)


def _between(arrival: np.ndarray, since: float, until: float) -> slice:
    return slice(*np.searchsorted(arrival, [since, until], side="right").tolist())


def _look(
    streams: Streams,
    estimator: Estimator,
    now: float,
    received: Counter[str],
    newest: Odometry | None,
    heard: float | None,
    found: list[Finding],
) -> Look:
    asked = "running", "lost", "restarted", "side_unknown", "without_imu", "unsure", "yaw_doubts"
    state = SimpleNamespace(**{name: getattr(estimator, name) for name in asked})
    state.workspace = estimator.workspace.copy()
    yaw_std, behind, error = math.nan, None, np.full(3, math.nan)
    if newest is not None:
        truth = streams.flight.truth
        moved = [
            np.interp(newest.t[0] + half, truth.t, truth.p[:, k])
            for half in (-0.1, 0.1)
            for k in range(3)
        ]
        error = newest.v[0] - np.subtract(moved[3:], moved[:3]) / 0.2
        behind = now - float(newest.t[0]) + streams.clock
        if estimator.running:
            yaw_std = float(rotation_std(newest.q, newest.covariance)[0, 2])
    counts = dict(estimator.counts)
    return Look(
        now, state, Counter(received), counts, yaw_std, heard, behind, list(found), error, newest
    )


def said(looks: list[Look]) -> dict[str, list[float]]:
    """{text: [s of the first look, s of the last, number of looks or reports]}.

    The share of velocities that are worse than stated while a fault holds has a line too.
    """
    out: dict[str, list[float]] = {}
    begin, worse, faulty = looks[0].now, 0, 0
    clock = SimpleNamespace(now=begin)
    with mock.patch("time.monotonic", lambda: clock.now):
        health = Health(FilterConfig(), LAG)
        for k, look in enumerate(looks, 1):
            clock.now = look.now
            health.received, health.last_odometry = Counter(look.received), look.heard
            health.behind = look.behind
            if k % LOOKS == 0:
                level, text, _ = health.report(None, look.estimator, look.counts, (), look.findings)
                for sentence in text.split(" | "):
                    _count(out, f"diagnostics {level[0]}: {sentence}", look.now - begin)
            health.look(look.estimator, look.counts)
            age = math.inf if look.heard is None else look.now - look.heard
            status = status_of(look.estimator, look.yaw_std, age, health.use, look.findings)
            known = ", yaw known" if status.yaw_known else ""
            _count(out, f"{STATUS[status.status]}{known}: {status.why}", look.now - begin)
            if status.status == FAULT and look.odometry is not None:
                wide = with_fault_covariance(look.odometry, look.estimator.workspace)
                std = np.sqrt(np.diagonal(wide.covariance[0, 3:6, 3:6]))
                faulty += 1
                worse += bool((np.abs(look.error) > HONEST * std).any())
    if faulty:
        out["velocities worse than stated in a fault"] = [0.0, 0.0, worse / faulty]
    return out


def _count(out: dict[str, list[float]], text: str, at: float) -> None:
    key = NUMBER.sub("#", text)[:100]
    first, _, count = out.get(key, [at, at, 0.0])
    out[key] = [first, at, count + 1.0]


# Faults


def _stream(name: str, change: Callable[[Columns, float, Any], Columns]) -> Callable:
    return lambda of, begin, rng: replace(of, **{name: change(getattr(of, name), begin, rng)})


def _both(change: Callable[[Columns, float, Any], Columns]) -> Callable:
    return lambda of, begin, rng: replace(
        of, imu=change(of.imu, begin, rng), tdoa=change(of.tdoa, begin, rng)
    )


def _silent(seconds: float) -> Callable:
    return lambda c, begin, rng: _rows(c, (c[T] < begin) | (c[T] > begin + seconds))


def _late(by: float, seconds: float, share: float = 1.0) -> Callable:
    def change(c: Columns, begin: float, rng: Any) -> Columns:
        hit = (c[T] > begin) & (c[T] < begin + seconds) & (rng.random(len(c[T])) < share)
        late = put(c, ARRIVAL, c[ARRIVAL] + np.where(hit, by, 0.0))
        order = np.argsort(late[ARRIVAL], kind="stable")
        return _rows(late, order)

    return change


def _of_values(place: int, value: Callable, seconds: float, share: float) -> Callable:
    """value(column, rng) in a share of the rows, for some seconds."""

    def change(c: Columns, begin: float, rng: Any) -> Columns:
        hit = (c[T] > begin) & (c[T] < begin + seconds) & (rng.random(len(c[T])) < share)
        return put(c, place, np.where(hit, value(c[place], rng), c[place]))

    return change


def _thinned(rate: float) -> Callable:
    def change(c: Columns, begin: float, rng: Any) -> Columns:
        step = max(1, round(len(c[T]) / (c[T][-1] - c[T][0]) / rate))
        return _rows(c, np.arange(len(c[T])) % step == 0)

    return change


def _falling(every: float, by: float) -> Callable:
    """Stamps and arrivals of all streams stay, but the clock of one falls back now and then."""
    return lambda c, begin, rng: put(c, T, c[T] - by * np.floor((c[T] - c[T][0]) / every))


def _sensor(name: str, change: Callable[[Any, np.ndarray, float], tuple]) -> Callable:
    def changed(of: Streams, begin: float, rng: Any) -> Streams:
        return replace(of, sensors=of.sensors | {name: change(*of.sensors[name], begin)})

    return changed


def _no_more(seconds: float) -> Callable:
    def change(stream: Any, arrival: np.ndarray, begin: float) -> tuple:
        kept = (stream.t < begin) | (stream.t > begin + seconds)
        return rows_of(stream, kept), arrival[kept]

    return change


def _wrong(value: Callable, seconds: float) -> Callable:
    def change(stream: Any, arrival: np.ndarray, begin: float) -> tuple:
        hit = (stream.t > begin) & (stream.t < begin + seconds)
        old = stream.values
        hit = hit.reshape(-1, *[1] * (old.ndim - 1))
        return stream.with_values(np.where(hit, value(old), old)), arrival

    return change


def _delayed(by: float, seconds: float) -> Callable:
    def change(stream: Any, arrival: np.ndarray, begin: float) -> tuple:
        hit = (stream.t > begin) & (stream.t < begin + seconds)
        return stream, np.maximum.accumulate(arrival + np.where(hit, by, 0.0))

    return change


def _of_survey(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    def changed(of: Streams, begin: float, rng: Any) -> Streams:
        old = of.anchors
        return replace(of, anchors=Anchors(old.ids, change(old.positions), old.orientations))

    return changed


def _clock(ahead: float) -> Callable:
    return lambda of, begin, rng: replace(of, clock=ahead)


def _slow(of: Streams, begin: float, rng: Any) -> Streams:
    """All messages wait, longer and longer, up to 3 s, as on a machine that is too slow."""

    def waits(arrival: np.ndarray) -> np.ndarray:
        return arrival + np.clip(0.2 * (arrival - begin), 0.0, 3.0)

    return replace(
        of,
        imu=put(of.imu, ARRIVAL, waits(of.imu[ARRIVAL])),
        tdoa=put(of.tdoa, ARRIVAL, waits(of.tdoa[ARRIVAL])),
        sensors={name: (one, waits(arrival)) for name, (one, arrival) in of.sensors.items()},
    )


def _without_imu(of: Streams, begin: float, rng: Any) -> Streams:
    return replace(of, imu=_rows(of.imu, of.imu[T] < -math.inf), sensors={})


def _three_anchors(of: Streams, begin: float, rng: Any) -> Streams:
    some = of.anchors.ids[:3]
    a, b = of.tdoa[2:4]
    return replace(of, tdoa=_rows(of.tdoa, np.isin(a, some) & np.isin(b, some)))


def _several(*changes: Callable) -> Callable:
    def changed(of: Streams, begin: float, rng: Any) -> Streams:
        for change in changes:
            of = change(of, begin, rng)
        return of

    return changed


def _no_number(values: np.ndarray, rng: Any = None) -> np.ndarray:
    return np.full_like(values, math.nan)


def _metres_off(values: np.ndarray, rng: Any) -> np.ndarray:
    return values + rng.choice([-4.0, 4.0], len(values))


def _turned(values: np.ndarray) -> np.ndarray:
    return -3.0 * values


A, D = 2, 4
CHANGES: dict[str, Callable[[Streams, float, Any], Streams]] = {
    "TDOAs silent for 0.7 s": _stream("tdoa", _silent(0.7)),
    "TDOAs silent for 1.6 s": _stream("tdoa", _silent(1.6)),
    "TDOAs silent for 4 s": _stream("tdoa", _silent(4.0)),
    "no IMU from here on": _stream("imu", _silent(math.inf)),
    "both silent for 4 s": _both(_silent(4.0)),
    "TDOAs 0.5 s late for 1 s": _stream("tdoa", _late(0.5, 1.0)),
    "TDOAs 0.5 s late for 6 s": _stream("tdoa", _late(0.5, 6.0)),
    "a third of the TDOAs 0.5 s late": _stream("tdoa", _late(0.5, math.inf, 0.35)),
    "TDOAs are no numbers for 1 s": _stream("tdoa", _of_values(D, _no_number, 1.0, 1.0)),
    "70 % of the TDOAs are no numbers": _stream("tdoa", _of_values(D, _no_number, math.inf, 0.7)),
    "40 % of the TDOAs are no numbers": _stream("tdoa", _of_values(D, _no_number, math.inf, 0.4)),
    "all TDOAs 4 m off for 3 s": _stream("tdoa", _of_values(D, _metres_off, 3.0, 1.0)),
    "70 % of the TDOAs 4 m off": _stream("tdoa", _of_values(D, _metres_off, math.inf, 0.7)),
    "40 % of the TDOAs 4 m off": _stream("tdoa", _of_values(D, _metres_off, math.inf, 0.4)),
    "8 TDOAs a second": _stream("tdoa", _thinned(8.0)),
    "8 TDOAs a second, 70 % no numbers": _stream(
        "tdoa",
        lambda c, begin, rng: _of_values(D, _no_number, math.inf, 0.7)(
            _thinned(8.0)(c, begin, rng), begin, rng
        ),
    ),
    "3 TDOAs a second": _stream("tdoa", _thinned(3.0)),
    "TDOAs fall back by 3 s every 4 s": _stream("tdoa", _falling(4.0, 3.0)),
    "TDOAs fall back by 3 s every second": _stream("tdoa", _falling(1.0, 3.0)),
    "a TDOA in 3 s": _stream("tdoa", _thinned(0.33)),
    "no TDOAs from here on": _stream("tdoa", _silent(math.inf)),
    "nothing from here on for 9 s, then all late": _several(
        _both(_silent(9.0)), _stream("tdoa", _late(0.5, math.inf))
    ),
    "survey has other ids": lambda of, begin, rng: replace(
        of, anchors=Anchors(of.anchors.ids + 40, of.anchors.positions, of.anchors.orientations)
    ),
    "all TDOAs too late from the first on": lambda of, begin, rng: replace(
        of, tdoa=_late(0.5, math.inf)(of.tdoa, -math.inf, rng)
    ),
    "TDOAs at random": _stream(
        "tdoa", lambda c, begin, rng: put(c, D, rng.uniform(-2, 2, len(c[D])))
    ),
    "only three anchors": _three_anchors,
    "without IMU": _without_imu,
    "signs wrong": _stream("tdoa", lambda c, begin, rng: put(c, D, -c[D])),
    "survey in feet": _of_survey(lambda p: p / 0.3048),
    "survey mirrored": _of_survey(lambda p: p * [-1.0, 1.0, 1.0]),
    "accelerometer in g": _stream("imu", lambda c, begin, rng: put(c, 3, c[3] / 9.81)),
    "everything wrong at once": _several(
        _stream("imu", lambda c, begin, rng: put(c, 2, np.rad2deg(c[2]))),
        _stream("imu", lambda c, begin, rng: put(c, 3, np.clip(c[3], -10.5, 10.5))),
        _stream("tdoa", lambda c, begin, rng: put(c, D, np.round(20.0 * c[D]) / 20.0)),
        _stream(
            "tdoa", lambda c, begin, rng: put(c, A, np.where(rng.random(len(c[A])) < 0.1, 99, c[A]))
        ),
        _stream("tdoa", lambda c, begin, rng: faults.merged(c, c)),
    ),
    "a slow machine": _slow,
    "clock of the node 30 s ahead": _clock(30.0),
    "clock of the node 0.7 s behind": _clock(-0.7),
    "clock of the node 5 s behind": _clock(-5.0),
    "clock of the node an hour ahead": _clock(3600.0),
    "range finder silent for 1.5 s": _sensor("height", _no_more(1.5)),
    "range finder silent for 6 s": _sensor("height", _no_more(6.0)),
    "velocity wrong for 1 s": _sensor("velocity", _wrong(_turned, 1.0)),
    "velocity wrong": _sensor("velocity", _wrong(_turned, math.inf)),
    "velocity no number": _sensor("velocity", _wrong(_no_number, math.inf)),
    "range finder 0.6 s late": _sensor("height", _delayed(0.6, 6.0)),
}
