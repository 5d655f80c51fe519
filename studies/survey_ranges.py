# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""survey-ranges: simulate range errors that anchor positions cannot explain, and test whether
`survey` improves another flight. The rule of `survey` was tuned on these flights.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.scoring.metrics import position_at

from .ranges import NONE, flown, rmse

if TYPE_CHECKING:
    from collections.abc import Callable

    from uwb_tdoa_bias.common.flight import Flight

FIRST = 200  # seed of the first flight
STD = 0.1  # m, of the anchors, as of a tape
WAVES, LENGTH = 30, 1.5  # of a random function of the place; m
BEHIND = 0.5  # cosine beyond which the body of a walking person is between tag and anchor


def add_options(add) -> None:
    """add : add_argument of a parser."""
    add("--flights", type=int, default=5, metavar="N", help="pairs of flights (default 5)")
    add("--first", type=int, default=FIRST, metavar="SEED", help=f"first seed (default {FIRST})")
    add("--jobs", type=int, metavar="N", help="processes (default: one for each core)")


def of_place(size: float, late: bool = False) -> Callable[[Flight, int], Flight]:
    """An error of each anchor that is a function of the place; late : never too short."""

    def put(flight: Flight, seed: int) -> Flight:
        ranges, d = flight.range, flight.range.d.copy()
        p = position_at(ranges.t, flight.truth)
        for row, anchor in enumerate(flight.anchors.ids):
            rng = np.random.default_rng([seed, row])
            waves = rng.standard_normal((3, WAVES)) / LENGTH
            phases = rng.uniform(0.0, 2.0 * np.pi, WAVES)
            sizes = rng.standard_normal(WAVES) * np.sqrt(2.0 / WAVES)
            error = size * (np.cos(p @ waves + phases) @ sizes)
            own = ranges.anchor == anchor
            d[own] += (np.maximum(error, 0.0) if late else error)[own]
        return flight.replaced(range=replace(ranges, d=d))

    return put


def of_body(size: float) -> Callable[[Flight, int], Flight]:
    """Anchors behind the direction of motion are late by up to `size`, m."""

    def put(flight: Flight, seed: int) -> Flight:
        ranges, truth = flight.range, flight.truth
        ahead = np.gradient(truth.p[:, :2], truth.t, axis=0)
        ahead = np.stack([np.interp(ranges.t, truth.t, column) for column in ahead.T], axis=1)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-6)[:, None]
        to = flight.anchors.positions[flight.anchors.index(ranges.anchor)]
        to = to - position_at(ranges.t, truth)
        along = np.sum(to[:, :2] * ahead, axis=1) / np.linalg.norm(to, axis=1)
        late = size * np.maximum(-along - BEHIND, 0.0) / (1.0 - BEHIND)
        return flight.replaced(range=replace(ranges, d=ranges.d + late))

    return put


def of_anchors(flight: Flight, seed: int) -> Flight:
    """Anchors that are STD off the survey, on each axis."""
    off = STD * np.random.default_rng([seed, 99]).standard_normal((len(flight.anchors), 3))
    keys = [f"{anchor}.{axis}" for anchor in flight.anchors.ids for axis in "xyz"]
    return EFFECTS["anchor_position"](dict(zip(keys, off.ravel().tolist()))).inject(flight)


ERRORS: dict[str, tuple[Callable[[Flight, int], Flight], ...]] = {
    "nothing": (),
    "of the place, 0.05 m": (of_place(0.05),),
    "of the place, 0.1 m": (of_place(0.1),),
    "of the place, up to 0.15 m, late": (of_place(0.15, late=True),),
    "the body, up to 0.4 m late": (of_body(0.4),),
    "anchors 0.1 m off": (of_anchors,),
    "anchors 0.1 m off, and of the place, 0.1 m": (of_anchors, of_place(0.1)),
    "anchors 0.1 m off, and the body": (of_anchors, of_body(0.4)),
}


def run(args) -> None:
    """Print the table: the 3D RMSE of another flight without and with the survey, m."""
    print("| error | draw | slow before | left | ratio | applied | 3D RMSE before | after |")
    print("|---|---:|---:|---:|---:|---|---:|---:|")
    items = [(words, args.first + 2 * k) for words in ERRORS for k in range(args.flights)]
    rows = parallel.over(one, items, args.jobs)
    for words in ERRORS:
        for draw, row in enumerate(islice(rows, args.flights)):
            before, left, applied, without, after = row
            slow = f"{100 * before:.1f} cm | {100 * left:.1f} cm | {before / left:.2f}"
            cells = f"{slow} | {'yes' if applied else 'no'} | {without:.3f} | {after:.3f}"
            print(f"| {words} | {draw} | {cells} |", flush=True)


def one(item: tuple[str, int]) -> tuple[float, float, bool, float, float]:
    """(slow innovations before and left, m; whether the survey is applied; 3D RMSE of another
    flight without it and with it, m).
    """
    words, seed = item
    flights = [replace(flown(seed + k), tdoa=NONE) for k in range(2)]
    for put in ERRORS[words]:
        flights = [put(flight, seed) for flight in flights]
    found = self_calibrate(flights[:1], Tape(STD))
    applied = found.why_not is None
    # whether it is applied or not
    surveyed = replace(found, marks=(1.0, 0.0, 1.0))
    other = replace(flights[1], anchors=surveyed.anchors)
    return (
        found.before,
        found.left,
        applied,
        rmse(flights[1], None),
        rmse(other, surveyed.effects),
    )
