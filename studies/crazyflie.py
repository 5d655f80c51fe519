# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""crazyflie: send measured TDoA2 logs through the radio link of a Crazyflie, and compare the estimates.

The link is simulated: messages are sampled, rounded, repeated, lost and late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import choices, cli
from uwb_tdoa_tools.crazyflie import FORCES, GRAVITY, PERIOD, RATES, LogBlock, VehicleClock
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate

from . import table

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.flight import Flight

PAIRS = [f"tdoa2.d{k}-{(k + 1) % 8}" for k in (7, 0, 1, 2, 3, 4, 5, 6)]
BLOCKS = PAIRS[:6], PAIRS[6:], [*RATES, *FORCES]  # 26 bytes each at most
BOOTED = 12.3  # s on our clock at which the vehicle was switched on


@dataclass(frozen=True)
class Link:
    """half : TDOAs as half floats; lost : share of messages; latency : s, least of a message;
    jitter : s, mean additional latency.
    """

    half: bool = False
    lost: float = 0.0
    latency: float = 0.004
    jitter: float = 0.004


def messages(
    flight: Flight, link: Link, rng: np.random.Generator
) -> list[tuple[float, int, float, np.ndarray]]:
    """[(arrival s, block, timestamp ms, values)] of a TDoA2 Flight, as they arrive. block : place
    in BLOCKS.
    """
    tdoa, imu = flight.tdoa, flight.imu
    assert imu is not None, "its inertial samples are sent too"
    sent: list[tuple[float, int, float, np.ndarray]] = []
    begin, end = max(tdoa.t[0], imu.t[0]), min(tdoa.t[-1], imu.t[-1])
    for number, variables in enumerate(BLOCKS):
        t = np.arange(begin + rng.uniform(0.0, PERIOD), end, PERIOD)
        rows = []
        for name in variables:
            if name.startswith("tdoa2"):
                a, b = int(name[7]), int(name[9])
                mine = np.flatnonzero((tdoa.a == a) & (tdoa.b == b))
                held = np.r_[0.0, tdoa.d[mine]][np.searchsorted(tdoa.t[mine], t, side="right")]
                rows.append(held.astype(np.float16) if link.half else held)
            else:
                stream = np.rad2deg(imu.gyro) if name in RATES else imu.accel / GRAVITY
                at = np.searchsorted(imu.t, t, side="right") - 1
                rows.append(stream[np.maximum(at, 0), "xyz".index(name[-1])])
        values = np.array(rows, dtype=np.float32).T
        arrival = np.maximum.accumulate(t + link.latency + rng.exponential(link.jitter, len(t)))
        stamps = np.floor(1e3 * (t - BOOTED + 100.0)).astype(int)
        kept = rng.random(len(t)) >= link.lost
        sent += [(arrival[k], number, stamps[k], values[k]) for k in np.flatnonzero(kept)]
    return sorted(sent, key=lambda message: message[0])


def streamed(flight: Flight, link: Link, seed: int = 0) -> Flight:
    """The Flight that `LogBlock` and `VehicleClock` reconstruct from the messages of a flight."""
    blocks, clock, tdoas, samples = (
        [LogBlock(variables) for variables in BLOCKS],
        VehicleClock(),
        [],
        [],
    )
    for arrival, number, timestamp, values in messages(flight, link, np.random.default_rng(seed)):
        pairs, sample = blocks[number].take(timestamp, values)
        tdoas += [(clock.stamp(t, arrival), a, b, d) for t, a, b, d in pairs]
        if sample is not None:
            samples.append((clock.stamp(sample[0], arrival), sample[1], sample[2]))
    return _flight(flight, tdoas, samples)


def as_received(flight: Flight, link: Link, seed: int = 0) -> Flight:
    """The Flight of a driver that publishes every value of every message, stamped when it arrived."""
    tdoas, samples = [], []
    for arrival, number, _, values in messages(flight, link, np.random.default_rng(seed)):
        for name, value in zip(BLOCKS[number], values):
            if name.startswith("tdoa2"):
                tdoas.append((arrival, int(name[7]), int(name[9]), float(value)))
        if number == 2:
            samples.append((arrival, np.deg2rad(values[:3]), GRAVITY * values[3:]))
    return _flight(flight, tdoas, samples)


def _flight(
    flight: Flight,
    tdoas: list[tuple[float, int, int, float]],
    samples: list[tuple[float, np.ndarray, np.ndarray]],
) -> Flight:
    """The Flight with other streams, in order of their stamps."""
    t, a, b, d = (np.array(column) for column in zip(*sorted(tdoas, key=lambda row: row[0])))
    samples.sort(key=lambda row: row[0])
    imu = Imu(*(np.array(column, dtype=float) for column in zip(*samples)))
    return replace(flight, tdoa=Tdoas(t, a, b, d), imu=imu)


def _thinned(flight):
    """One inertial sample in each period of a log block."""
    t = np.arange(flight.imu.t[0], flight.imu.t[-1], PERIOD)
    rows = np.searchsorted(flight.imu.t, t)
    return replace(
        flight, imu=Imu(flight.imu.t[rows], flight.imu.gyro[rows], flight.imu.accel[rows])
    )


WAYS = {
    "log as it is, 1 kHz IMU": lambda flight: flight,
    "all TDOAs, IMU at 100 Hz": _thinned,
    "link, converted": lambda flight: streamed(flight, Link()),
    "link, half floats": lambda flight: streamed(flight, Link(half=True)),
    "link, 5 % lost": lambda flight: streamed(flight, Link(lost=0.05)),
    "link, every value published on arrival": lambda flight: as_received(flight, Link()),
}


def add_options(add):
    """add : add_argument of a parser."""
    words = "logs of TDoA2 flights with IMU and ground truth"
    add("flights", nargs="+", metavar="FLIGHT", help=words)
    add("--survey", required=True, metavar="S", help=choices.SURVEY)
    table.add_options(add)


def run(args):
    """Print the table: each way, TDOAs and samples a second, mean and largest 3D RMSE."""
    reading = inputs.Reading(args.survey)
    recordings = reading.find(args.flights)
    found = table.results(partial(_of_recording, reading), recordings, args, unit="flight")
    judged = [one for one in found if one]
    numbers = "TDOAs/s", "IMU, Hz", "mean 3D RMSE, m", "largest, m"
    cli.show(table.head(f"what the filter gets, {len(judged)} flights", *numbers))
    for name in WAYS:
        tdoas, samples, errors = np.array([one[name] for one in judged]).T
        cells = f"{tdoas.mean():.0f}", f"{samples.mean():.0f}", f"{errors.mean():.3f}"
        cli.show(table.line([name, *cells, f"{errors.max():.3f}"]))


def _of_recording(reading, recording):
    """`judge` of a recording (path, survey); {} if it is no TDoA2 or has no IMU."""
    flight = reading.read(recording)
    fits = flight.meta["protocol"] == "tdoa2" and flight.imu is not None
    return judge(flight) if fits else {}


def judge(flight):
    """{way: (TDOAs/s, IMU in Hz, 3D RMSE m)} of a Flight."""
    out, flight = {}, flight.without("height", "pressure", "velocity")
    for name, way in WAYS.items():
        made = way(flight)
        rates = [len(stream) / np.ptp(stream.t) for stream in (made.tdoa, made.imu)]
        out[name] = *rates, evaluate(made, FilterConfig())[0].row()["rmse_3d"]
    return out
