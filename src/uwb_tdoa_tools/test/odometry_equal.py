"""Whether a change of nothing but speed has left the odometry of the measured flights as it was.

    python odometry_equal.py --save before.npz FOLDER        # with the old sources; FOLDER holds flights/ and surveys/
    python odometry_equal.py --compare before.npz FOLDER     # with the new ones: prints the largest difference of each flight

Each raw flight goes through the offline engine, and as it would come live, through an Estimator in
batches of up to 20 messages. With --network or --effects it is corrected, off line alone. Exit code
1 if a position differs by more than --limit (default 1e-9 m).
"""

import argparse
from pathlib import Path
import sys

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import SHIPPED, load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.readers import inputs


def offline(flight, effects, network):
    """(t, p) of the offline engine."""
    odometry = run_offline(flight, None, Corrector(flight.anchors, effects, network)).odometry
    return odometry.t, odometry.p


def live(flight):
    """(t, p) of an Estimator that is given the messages in the order of their stamps, a few at a
    time.
    """
    estimator, random, parts, first = (
        Estimator(flight.anchors),
        np.random.default_rng(0),
        [],
        [0, 0],
    )
    stamps = flight.imu.t, flight.tdoa.t
    order = np.sort(np.concatenate(stamps))
    place = 0
    while place < len(order):
        place = min(place + random.integers(1, 21), len(order))
        end = [int(np.searchsorted(t, order[place - 1], side="right")) for t in stamps]
        imu, tdoa = (slice(a, b) for a, b in zip(first, end))
        if end[0] > first[0]:
            estimator.add_imu(flight.imu.t[imu], flight.imu.gyro[imu], flight.imu.accel[imu])
        if end[1] > first[1]:
            estimator.add_tdoa(
                flight.tdoa.t[tdoa], flight.tdoa.a[tdoa], flight.tdoa.b[tdoa], flight.tdoa.d[tdoa]
            )
        first = end
        parts.append(estimator.advance()[0])
    parts.append(estimator.finish()[0])
    return np.concatenate([part.t for part in parts]), np.concatenate([part.p for part in parts])


def main():
    """Save or compare; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--compare", type=Path)
    parser.add_argument("--network", action="store_true", help="the shipped one")
    parser.add_argument("--effects", help="effects.yaml")
    parser.add_argument("--limit", type=float, default=1e-9, help="m")
    args = parser.parse_args()
    effects = EffectSet.from_yaml(args.effects) if args.effects else None
    network = load_network(SHIPPED) if args.network else None
    before, made, worst = np.load(args.compare) if args.compare else {}, {}, 0.0
    for flight in inputs.Reading(args.folder / "surveys").flights([args.folder / "flights"]):
        ways = {"offline": offline(flight, effects, network)} | (
            {} if effects or network else {"live": live(flight)}
        )
        for way, (t, p) in ways.items():
            name = f"{flight.name}, {way}"
            made[f"{name}, t"], made[name] = t, p
            if args.compare:
                same = np.array_equal(before[f"{name}, t"], t)
                largest = np.abs(before[name] - p).max() if same else np.inf
                worst = max(worst, largest)
                print(f"{name}: {len(t)} positions, largest difference {largest:.3g} m")
    if args.save:
        np.savez_compressed(args.save, **made)
    print(
        f"{len(made) // 2} runs" + (f", largest difference {worst:.3g} m" if args.compare else "")
    )
    return int(worst > args.limit)


if __name__ == "__main__":
    sys.exit(main())
