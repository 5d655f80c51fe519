# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""parameters: halve and double each parameter of the filter, and measure the effect on measured
flights.
"""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig

from .noise import figures
from .surveying import measured_flights

FACTORS = (0.5, 2.0)


def add_options(add):
    """add : add_argument of a parser."""
    add("--data", type=Path, required=True, metavar="DATA", help="folder of measured flights")
    add(
        "--flights",
        nargs="+",
        default=["flights/0425", "flights/0426"],
        metavar="PATH",
        help="flights or folders of flights below DATA",
    )
    add("--sensors", nargs="*", default=[], metavar="SENSOR", help="auxiliary sensors to use")


def run(args):
    """Print a table, a row for each parameter, the most important first."""
    flights = measured_flights(args.data, args.flights, args.sensors)
    usual = FilterConfig()
    before = outcome(flights, usual)
    rows = []
    for parameter, factor, config in varied(usual):
        nees, error = outcome(flights, config)
        rows.append((parameter, factor, error / before[1] - 1.0, nees / before[0] - 1.0))
    print(f"as they are: 3D RMSE {before[1]:.3f} m, NEES {before[0]:.2f}, {len(flights)} flights\n")
    print("| parameter | 3D RMSE, halved | doubled | NEES, halved | doubled |\n|---|" + 4 * "---:|")
    by_name = {}
    for parameter, factor, error, nees in rows:
        by_name.setdefault(parameter, {})[factor] = (error, nees)
    for name, sides in sorted(by_name.items(), key=worth, reverse=True):
        cells = [
            f"{sides[factor][k]:+.1%}" if factor in sides else ""
            for k in (0, 1)
            for factor in FACTORS
        ]
        print(f"| `{name}` | {' | '.join(cells)} |")


def varied(usual):
    """Yield (parameter, factor, FilterConfig) for each number that is not 0 and stays in bounds."""
    for each in fields(FilterConfig):
        value = getattr(usual, each.name)
        if each.type not in (int, float) or value == 0.0:
            continue
        for factor in FACTORS:
            try:
                yield each.name, factor, replace(usual, **{each.name: each.type(factor * value)})
            except InputError:
                continue


def outcome(flights, config):
    """(mean NEES, mean 3D RMSE in m) of Flights."""
    nees, error = figures(flights, config, None)
    return float(np.mean(nees)), float(error)


def worth(row):
    """The largest change of the error of a row of the table."""
    return max(abs(error) for error, _ in row[1].values())
