# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How a simulated vehicle keeps pace with a filter over topics, by a clock of the study.

The streams of a flight go to an `Estimator` turn by turn. What odometry a turn sets free depends on
stamps only, and is kept. A row delays it as a computer would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.flying import over_topics
from uwb_tdoa_tools.flying.simulator import DT

from .rows import FIRST_SEED, Inputs

MODULE = over_topics.__name__
CONSTANTS = (
    "LARGEST_CATCH_UP",
    "LONGEST_GAP",
    "UNTRUSTED",
    "PATIENCE",
    "IMPATIENCE",
    "REMEMBERED",
)
SWITCHES = {  # rules that are off
    "a long delay shifts all later turns": ("LARGEST_CATCH_UP", math.inf),
    "the filter goes on without a stream": ("LONGEST_GAP", math.inf),
    "the filter waits for order at first": ("UNTRUSTED", 0.0),
    "a missing odometry ends the patience": ("IMPATIENCE", over_topics.PATIENCE),
    "the usual period of odometry": ("REMEMBERED", 1),
}
SECONDS = 25.0  # of a flight
TICK = 0.005  # s of the wall clock between two looks without news
Turns = list[tuple[float, SimpleNamespace, SimpleNamespace, np.ndarray]]


def rows(inputs: Inputs) -> Iterator[tuple[str, Callable[[], dict]]]:
    """(name, sentences) of all rows."""
    for name, (change, config, delay) in WAYS.items():
        yield f"pace, {name}", partial(_row, inputs, name, change, config, delay)
    for name, hangs in HANGS.items():
        yield f"pace, {name}", partial(_in_real_time, hangs)


def _row(
    inputs: Inputs, name: str, change: Callable, config: dict[str, Any], delay: Callable
) -> dict:
    def make() -> Turns:
        return _turns(change(inputs.flight_of("hall", FIRST_SEED)), FilterConfig(**config))

    return _flown(inputs.kept(f"pace {name}", make), delay)


def _turns(flight: Flight, config: FilterConfig) -> Turns:
    """[(s of stamps, samples of the IMU, TDOAs, stamps of the odometry that they set free)]."""
    estimator, out = Estimator(flight.anchors, config), []
    begin, imu, tdoa = 0.0, flight.imu, flight.tdoa
    for turn in range(1, int(SECONDS / DT) + 1):
        now = begin + turn * DT
        some = [rows_of(one, (one.t > now - DT) & (one.t <= now)) for one in (imu, tdoa)]
        if len(some[0].t):
            estimator.add_imu(some[0].t, some[0].gyro, some[0].accel)
        if len(some[1].t):
            estimator.add_tdoa(some[1].t, some[1].a, some[1].b, some[1].d)
        odometry, _ = estimator.advance()
        out.append((now, *(SimpleNamespace(t=one.t) for one in some), odometry.t.copy()))
    return out


def _flown(turns: Turns, delay: Callable[[float, Any], float]) -> dict[str, list[float]]:
    """{figure: [0, 0, value]}: s of the wall clock per flight, longest turn, and turns that began
    without odometry that was due. delay(s of stamps, rng) : s until odometry has come.
    """
    clock, rng = SimpleNamespace(now=100.0), np.random.default_rng(4)
    pace = over_topics.Lockstep(lambda: clock.now)
    coming: list[tuple[float, float]] = []  # s of the wall clock, stamp
    early, longest = 0, 0.0
    for now, imu, tdoa, odometry in turns:
        pace.sent(now, {"imu": imu, "tdoa": tdoa})
        wait = delay(now, rng)
        begin = clock.now
        if math.isfinite(wait):
            coming += [(clock.now + wait, float(t)) for t in odometry]
        while True:
            for _, t in [one for one in coming if one[0] <= clock.now]:
                pace.heard(t)
            coming = [one for one in coming if one[0] > clock.now]
            if pace.may_go_on():
                break
            clock.now = min([clock.now + TICK, *(at for at, _ in coming)])
        early += bool(coming)
        longest = max(longest, clock.now - begin)
    return {
        "s of the clock": [0.0, 0.0, clock.now - 100.0],
        "s of the longest turn": [0.0, 0.0, longest],
        "turns before their odometry": [0.0, 0.0, float(early)],
    }


def _in_real_time(hangs: dict[float, float]) -> dict[str, list[float]]:
    """The same of RealTime: s of the clock, and most turns at one moment. hangs : {s: s}."""
    clock, left = SimpleNamespace(now=0.0), dict(hangs)
    pace, most = over_topics.RealTime(lambda: clock.now), 0
    turn, at_once = 0, 0
    while turn * DT < SECONDS:
        if pace.may_go_on():
            turn, at_once = turn + 1, at_once + 1
            pace.sent(turn * DT, {})
            most = max(most, at_once)
            continue
        hang = next((left.pop(at) for at in list(left) if at <= clock.now), TICK)
        clock.now, at_once = clock.now + hang, 0
    return {
        "s of the clock": [0.0, 0.0, clock.now],
        "most turns at once": [0.0, 0.0, float(most)],
    }


def _as_it_is(flight: Flight) -> Flight:
    return flight


def _silent(stream: str, begin: float, end: float) -> Callable[[Flight], Flight]:
    def change(flight: Flight) -> Flight:
        part = getattr(flight, stream)
        return replace(flight, **{stream: rows_of(part, (part.t < begin) | (part.t > end))})

    return change


def _quick(now: float, rng: Any) -> float:
    return 0.003


def _loaded(now: float, rng: Any) -> float:
    return float(rng.exponential(0.03))


def _hangs(seconds: float) -> Callable[[float, Any], float]:
    return lambda now, rng: seconds if 10.0 <= now < 10.0 + DT else 0.003


def _dies(now: float, rng: Any) -> float:
    return 0.003 if now < 15.0 else math.inf


def _loses(now: float, rng: Any) -> float:
    return math.inf if rng.random() < 0.002 else 0.003


# {row: (change of the flight, parameters of the filter, delay)}
WAYS: dict[str, tuple[Callable, dict[str, Any], Callable]] = {
    "a quick computer": (_as_it_is, {}, _quick),
    "a loaded computer": (_as_it_is, {}, _loaded),
    "the filter hangs for 2 s": (_as_it_is, {}, _hangs(2.0)),
    "the filter hangs for 4 s": (_as_it_is, {}, _hangs(4.0)),
    "the filter hangs for 8 s": (_as_it_is, {}, _hangs(8.0)),
    "the filter dies": (_as_it_is, {}, _dies),
    "odometry is lost at times": (_as_it_is, {}, _loses),
    "odometry at 50 Hz": (_as_it_is, {"odometry_rate": 50.0}, _loaded),
    "no TDOAs in the first 3 s": (_silent("tdoa", 0.0, 3.0), {}, _loaded),
    "TDOAs silent for 2 s": (_silent("tdoa", 12.0, 14.0), {}, _loaded),
    "TDOAs silent for 0.2 s": (_silent("tdoa", 12.0, 12.2), {}, _loaded),
    "IMU silent for 2 s": (_silent("imu", 12.0, 14.0), {}, _loaded),
}
# {row: {s of the clock: s for which the node hangs}}
HANGS = {
    "in real time": {},
    "in real time, a delay of 0.06 s": {5.0: 0.06},
    "in real time, a delay of 0.15 s": {5.0: 0.15},
    "in real time, a delay of 3 s": {5.0: 3.0},
}
