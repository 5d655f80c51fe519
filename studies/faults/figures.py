# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Play a flight with faults to real nodes over topics. Measure their errors, their reports, and
whether they recover.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
import re
import tempfile
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from .. import table
from . import judge
from .catalogue import FAULTS
from .events import Scene, events_of, part_of, turned

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from uwb_tdoa_bias.common.flight import Flight

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FLIGHT = "flights/0426/0426-traj5"


def add_options(add: Callable[..., object]) -> None:
    """add : add_argument of a parser."""
    data = "measured flights; without them a flight is simulated (default: %(default)s)"
    add("--data", metavar="DIR", type=Path, default=DATA, help=data)
    add(
        "--only",
        metavar="PATTERN",
        default="",
        help="faults whose names this regular expression finds",
    )
    add("--list", action="store_true", help="print the faults and end")
    table.add_options(add, jobs=1)  # each fault in a ROS domain of its own


def run(args: argparse.Namespace) -> None:
    """Print the table."""
    names = [name for name in FAULTS if re.search(args.only, name)]
    if not names:
        raise InputError(f"--only: no fault is called like {args.only!r}; --list prints them all.")
    if args.list:
        cli.show(*(f"{name:32} {FAULTS[name].text}" for name in names))
        return
    cli.show(table.head(*judge.HEAD, texts=len(judge.HEAD)))
    well = 0
    for row in table.results(partial(row_of, data=args.data), names, args, unit="fault"):
        well += row["verdict"].startswith("ok")
        cli.show(judge.line(row))
    cli.show("", f"{well} of {len(names)} ok")


def row_of(name: str, data: Path) -> dict[str, Any]:
    """The figures of one fault, see `judge.judged`. data : folder of measured flights."""
    from .play import played

    fault = FAULTS[name]
    part = part_of(flight_of(data), fault.seconds)
    scene = Scene(fault.begin, fault.end, part.truth)
    events = fault.change(events_of(part, ("imu", "tdoa", *fault.plays)), scene)
    judged_by = replace(scene, truth=turned(scene.truth, fault.turned))
    with tempfile.TemporaryDirectory() as folder:
        return judge.judged(
            name, fault, played(events, fault.seconds, fault.parameters, folder), judged_by
        )


@lru_cache(maxsize=1)
def flight_of(data: Path) -> Flight:
    """A measured flight out of the folder, or a simulated one."""
    if (data / FLIGHT).exists():
        return inputs.Reading(data / "surveys").one(data / FLIGHT)
    return simulate(SimulationConfig(seed=1, protocol="tdoa3"))
