# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ranges: compare the error of simulated flights with distances to anchors, alone and with TDOAs,
with the bound of `plan` for one round.

A second table shows the effect of faulty ranges in addition to TDOAs.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Tdoas
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import without_offset
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.planning.installation import FixedNoise, Installation
from uwb_tdoa_tools.planning.precision import bound, information, position_error
from uwb_tdoa_tools.scoring.evaluation import evaluate, score_of
from uwb_tdoa_tools.scoring.metrics import position_at, scored_phase
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

STD = 0.1  # m, of a range and of a TDOA, white
FRESH = 300  # the first seed of flights among other anchors
OFFSET = 0.25  # m, by which all ranges are too long
PATHS = "sines", "circle", "square", "rising_circle", "sines"
# of what is simulated
KNOWN = FilterConfig(tdoa_std=STD, range_std=STD, tdoa_correlation_length=1.0, range_offset_std=0.0)
HIGH = 2.9  # m, of a ceiling
CEILING = [(x, y, HIGH) for x, y in ((-3.5, -4.0), (3.5, -4.0), (3.5, 4.0), (-3.5, 4.0))]
WALLS = {  # m, positions of few anchors, or of anchors in a plane
    "eight in the corners": None,
    "six at the ceiling": [*CEILING, (0.0, -4.0, HIGH), (0.0, 4.0, HIGH)],
    "four at the ceiling": CEILING,
    "four, high and low": [(x, y, z) for (x, y, _), z in zip(CEILING, (0.2, HIGH, 0.2, HIGH))],
}
NONE = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
SETS = {
    "ranges": lambda flight: replace(flight, tdoa=NONE),
    "TDOAs": lambda flight: flight.without("range"),
    "both": lambda flight: flight,
}


FAULTS = {  # functions that spoil Ranges; the TDOAs have persistent errors
    "sound": lambda ranges, rng: ranges,
    "3 m too long": lambda ranges, rng: replace(ranges, d=ranges.d + 3.0),
    "twice as long": lambda ranges, rng: replace(ranges, d=2.0 * ranges.d),
    "millimetres": lambda ranges, rng: replace(ranges, d=1000.0 * ranges.d),
    "anything from 0 to 10 m": lambda ranges, rng: replace(
        ranges, d=rng.uniform(0.0, 10.0, len(ranges))
    ),
    "ids shuffled": lambda ranges, rng: replace(ranges, anchor=rng.permutation(ranges.anchor)),
}


def add_options(add):
    """add : add_argument of a parser."""
    add(
        "--flights",
        type=int,
        default=5,
        metavar="N",
        help="simulated flights of each set (default 5)",
    )


def run(args):
    """Print the table."""
    print(
        "| what | filter | mean 3D RMSE | bound of one round | largest ratio | NEES "
        "|\n|---|---|---:|---:|---:|---:|"
    )
    flights = [flown(seed) for seed in range(args.flights)]
    for what, taken in SETS.items():
        for words, config in (("defaults", FilterConfig()), ("told the noise", KNOWN)):
            rows = [
                evaluate(taken(flight), config)[0].row()
                for flight in tqdm(flights, unit="flight", disable=None)
            ]
            print(line(what, words, rows, [bound_of(flight) for flight in flights]), flush=True)
    print(
        "\n| ranges, 0.25 m too long | estimate | range_offset_std | mean 3D RMSE | NEES "
        "|\n|---|---|---:|---:|---:|"
    )
    for what in ("ranges", "both"):
        longer = [without_offset(SETS[what](flight), -OFFSET) for flight in flights]
        for estimate in ("filtered", "smoothed"):
            for std in (0.0, FilterConfig().range_offset_std):
                estimator = FlightEstimator(
                    FilterConfig(range_offset_std=std), smoothed=estimate == "smoothed"
                )
                rows = [
                    score_of(flight, estimator)[0].row()
                    for flight in tqdm(longer, unit="flight", disable=None)
                ]
                errors, nees = (
                    np.mean([row[name] for row in rows]) for name in ("rmse_3d", "nees_mean")
                )
                print(
                    f"| {what} | {estimate} | {std:g} m | {errors:.3f} m | {nees:.2f} |", flush=True
                )
    print(
        "\n| anchors, ranges alone | offset | range_offset_std | mean 3D RMSE | NEES "
        "|\n|---|---:|---:|---:|---:|"
    )
    for words, positions in WALLS.items():
        flights = [
            SETS["ranges"](flown(FRESH + seed, positions=positions)) for seed in range(args.flights)
        ]
        for offset in (0.0, OFFSET):
            for std in (0.0, FilterConfig().range_offset_std):
                rows = [
                    evaluate(without_offset(one, -offset), FilterConfig(range_offset_std=std))[
                        0
                    ].row()
                    for one in flights
                ]
                errors, nees = (
                    np.mean([row[name] for row in rows]) for name in ("rmse_3d", "nees_mean")
                )
                print(
                    f"| {words} | {offset:g} m | {std:g} m | {errors:.3f} m | {nees:.2f} |",
                    flush=True,
                )
    print("\n| ranges beside TDOAs | mean 3D RMSE | largest over that without |\n|---|---:|---:|")
    flights = [flown(seed, persistent=True) for seed in range(args.flights)]
    without = np.array([rmse(flight.without("range")) for flight in flights])
    print(f"| none | {without.mean():.3f} m | 1.00 |")
    for words, fault in FAULTS.items():
        errors = np.array(
            [rmse(spoiled(flight, fault, seed)) for seed, flight in enumerate(flights)]
        )
        print(f"| {words} | {errors.mean():.3f} m | {np.max(errors / without):.2f} |", flush=True)


def rmse(flight: Flight, effects: EffectSet | None = None) -> float:
    """m, 3D, in the air, by the filter with its defaults, and with an EffectSet."""
    return evaluate(flight, effects=effects)[0].row()["rmse_3d"]


def spoiled(flight: Flight, fault, seed: int) -> Flight:
    """The Flight with a fault of FAULTS in its ranges."""
    return replace(flight, range=fault(flight.range, np.random.default_rng(seed)))


def flown(
    seed: int,
    persistent: bool = False,
    positions: Sequence[tuple[float, float, float]] | None = None,
) -> Flight:
    """A simulated flight with both. persistent : its TDOAs have errors that persist, too; positions
    : m, of anchors, or eight in corners.
    """
    noise: dict[str, Any] = dict(
        noise_std=STD, range_noise=STD, bias=persistent, multipath=persistent
    )
    if positions is not None:
        noise["anchors"] = Anchors.from_positions(np.array(positions))
    return simulate(
        SimulationConfig(
            seed=seed,
            trajectory=PATHS[seed % len(PATHS)],
            duration=40.0,
            imu_rate=500.0,
            truth_rate=100.0,
            **noise,
        )
    )


def bound_of(flight: Flight) -> float:
    """m: root mean square of the bound of `plan` for one range to each anchor, over the airborne
    part.
    """
    _, first, last = scored_phase(flight.truth)
    places = position_at(np.arange(first, last, 0.5), flight.truth)
    installation = Installation(flight.anchors, FixedNoise(STD), "every_range")
    return float(np.sqrt(np.mean(position_error(bound(information(places, installation))) ** 2)))


def line(what: str, words: str, rows: list, bounds: list) -> str:
    """A row of the table, of rows of scores, and bounds, m, of the flights."""
    errors, nees = (np.array([row[name] for row in rows]) for name in ("rmse_3d", "nees_mean"))
    ratio = np.max(errors / bounds)
    return (
        f"| {what} | {words} | {errors.mean():.3f} m | {np.mean(bounds):.3f} m | {ratio:.2f} | "
        f"{nees.mean():.2f} |"
    )
