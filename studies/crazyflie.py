# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Send measured TDoA2 logs through the radio link of a Crazyflie, and compare the estimates."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.crazyflie import PERIOD
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.scoring.evaluation import evaluate

from .radio_link import Link, as_received, streamed

WAYS = {
    "log as it is, 1 kHz IMU": lambda flight: flight,
    "all TDOAs, IMU at 100 Hz": lambda flight: _thinned(flight),
    "link, converted": lambda flight: streamed(flight, Link()),
    "link, half floats": lambda flight: streamed(flight, Link(half=True)),
    "link, 5 % lost": lambda flight: streamed(flight, Link(lost=0.05)),
    "link, every value published on arrival": lambda flight: as_received(flight, Link()),
}


def add_options(add):
    """add : add_argument of a parser."""
    add(
        "flights",
        nargs="+",
        metavar="FLIGHT",
        help="logs of TDoA2 flights with IMU and ground truth",
    )
    add("--survey", required=True, metavar="S", help=choices.SURVEY)


def run(args):
    """Print the table: 3D RMSE, m."""
    flights = [
        f
        for f in inputs.Reading(args.survey).flights(args.flights)
        if f.meta["protocol"] == "tdoa2"
    ]
    for line in table([f for f in flights if f.imu is not None]):
        print(line, flush=True)


def table(flights):
    """Lines of Markdown: each way, the mean and the largest error over the flights, and how many
    TDOAs a second.
    """
    yield (
        f"| what the filter gets, {len(flights)} flights | TDOAs/s | IMU, Hz | mean 3D RMSE, m | "
        "largest, m |"
    )
    yield "| --- | ---: | ---: | ---: | ---: |"
    flights = [replace(flight, height=None, pressure=None, velocity=None) for flight in flights]
    for name, way in WAYS.items():
        made = [way(flight) for flight in flights]
        errors = [evaluate(flight, FilterConfig())[0].row()["rmse_3d"] for flight in made]
        rates = [
            np.mean([len(s) / np.ptp(s.t) for s in streams])
            for streams in zip(*((f.tdoa, f.imu) for f in made))
        ]
        yield (
            f"| {name} | {rates[0]:.0f} | {rates[1]:.0f} | {np.mean(errors):.3f} | "
            f"{max(errors):.3f} |"
        )


def _thinned(flight):
    """One inertial sample in each period of a log block."""
    t = np.arange(flight.imu.t[0], flight.imu.t[-1], PERIOD)
    rows = np.searchsorted(flight.imu.t, t)
    return replace(
        flight, imu=Imu(flight.imu.t[rows], flight.imu.gyro[rows], flight.imu.accel[rows])
    )
