"""The first seconds in the air of measured flights, from switched on on the floor: a table of
docs/measured.md.

python src/uwb_tdoa_tools/test/takeoff_table.py DATA
"""

import argparse
from pathlib import Path

import numpy as np
from time_offset_table import measured

from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.scoring.metrics import position_at

AIR, FIRST = 0.3, 3.0  # m above which the tag is in the air; s that are judged
LARGEST_NEES, LARGEST_ERROR = 9.0, 1.0  # aimed at


def first_seconds(flight):
    """(mean NEES of the position, largest error m) of the first seconds in the air."""
    odometry, truth = run_offline(flight).odometry, flight.truth
    begin = truth.t[truth.p[:, 2] > AIR][0]
    inside = (odometry.t >= begin) & (odometry.t <= begin + FIRST)
    error = odometry.p[inside] - position_at(odometry.t[inside], truth)
    P = odometry.covariance[inside, :3, :3]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)
    return float(nees.mean()), float(np.linalg.norm(error, axis=1).max())


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("data", type=Path)
    rows = {flight.name: first_seconds(flight) for flight in measured(arguments.parse_args().data)}
    for name, (nees, error) in rows.items():
        print(f"{name:16s} NEES {nees:5.1f}  largest error {error:.2f} m")
    nees, error = np.array([*rows.values()]).T
    print(
        f"NEES at most {LARGEST_NEES:g}: {np.sum(nees <= LARGEST_NEES)} of {len(rows)}, "
        f"largest {nees.max():.1f}"
    )
    print(
        f"error at most {LARGEST_ERROR:g} m: {np.sum(error <= LARGEST_ERROR)} of {len(rows)}, "
        f"largest {error.max():.2f} m"
    )


if __name__ == "__main__":
    main()
