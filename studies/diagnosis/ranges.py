# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""diagnose-ranges: put errors into simulated distances to anchors, and diagnose them.

The distances are used alone and together with TDOAs. Another flight judges the diagnosis.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.diagnosis.diagnose import diagnose
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing

from ..ranges import NONE, flown, rmse

FIRST = 100  # seed of the first flight: nothing was chosen on those from there on
# words: (the effect put in, its name where it is found, its value, how near counts as found)
ERRORS = {
    "a delay of one anchor, 0.3 m": ("anchor_delay", {"3": 0.3}, 0.1),
    "an anchor 0.3 m off": ("anchor_position", {"5.x": 0.2, "5.y": -0.2, "5.z": 0.1}, 0.1),
    "stamps of ranges 50 ms late": ("range_delay", {"offset": 0.05}, 0.01),
    "3 % too long": ("range_scale", {"scale": 0.03}, 0.01),
    "delays of ranges alone, each anchor its own": (
        "range_offset",
        {str(i): 0.1 + 0.05 * i for i in range(8)},
        0.1,
    ),
    "nothing": (None, {}, 0.0),
}
SETS = {"ranges": lambda flight: replace(flight, tdoa=NONE), "both": lambda flight: flight}


def add_options(add) -> None:
    """add : add_argument of a parser."""
    add(
        "--flights",
        type=int,
        default=5,
        metavar="N",
        help="pairs of flights of each error (default 5)",
    )
    add(
        "--first",
        type=int,
        default=FIRST,
        metavar="SEED",
        help=f"seed of the first flight (default {FIRST})",
    )
    add("--only", nargs="+", metavar="TEXT", help="errors whose words hold one of these")
    add("--no-truth", action="store_true", help="diagnose without ground truth, which judges alone")
    add("--jobs", type=int, metavar="N", help="processes (default: one for each core)")


def run(args) -> None:
    """Print the table."""
    print(
        "| measured | put in | found | largest error of a value | 3D RMSE before | after | "
        "without the error | flights made worse |"
    )
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    errors = [
        words for words in ERRORS if not args.only or any(text in words for text in args.only)
    ]
    items = [
        (words, what, args.first + 2 * k, args.no_truth)
        for what in SETS
        for words in errors
        for k in range(args.flights)
    ]
    rows = parallel.over(one, items, args.jobs)
    for what in SETS:
        for words in errors:
            mine = list(islice(rows, args.flights))
            found, off, before, after, clean = (
                np.array(column, dtype=float) for column in zip(*mine)
            )
            cells = (
                f"{before.mean():.3f} m | {after.mean():.3f} m | {clean.mean():.3f} m | "
                f"{np.sum(after > 1.01 * before)}"
            )
            told = (
                f"{int(found.sum())} of {len(mine)} | "
                f"{np.max(off, initial=0.0) if ERRORS[words][0] else np.nan:.3f}"
            )
            print(f"| {what} | {words} | {told} | {cells} |", flush=True)


def one(item: tuple[str, str, int, bool]) -> tuple[float, float, float, float, float]:
    """(whether it was found and added; largest error of its values; 3D RMSE of another flight
    before, after, and without the error, m).
    """
    words, what, seed, blind = item
    name, values, near = ERRORS[words]
    clean = [SETS[what](flown(seed + k)) for k in range(2)]
    flights = clean if name is None else [EFFECTS[name](values).inject(flight) for flight in clean]
    result = diagnose(flights[:1], flights[1:], reference=Nothing() if blind else GroundTruth())
    before, after = (rmse(flights[1], effects) for effects in (None, result.effects))
    if name is None:
        return float(len(result.effects) > 0), np.nan, before, after, before
    # With ranges alone, a delay of the ranges is the same as a delay of the anchor.
    name = "anchor_delay" if name == "range_offset" and what == "ranges" else name
    added = {effect.name: effect.values for effect in result.effects}.get(name, {})
    off = max(abs(added.get(key, 0.0) - values.get(key, 0.0)) for key in {**values, **added})
    return float(off < near), off, before, after, rmse(clean[1])
