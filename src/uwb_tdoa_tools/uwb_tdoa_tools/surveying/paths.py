"""Paths of another odometry or SLAM: a CSV file, or a topic of the bags that the flights are in."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.limits import TABLE_CELLS

from ..bags.bag import read_odometry
from ..diagnosis.constraints import OdometryPath
from ..readers.tables import number, read_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.foundation.flight import Flight

COLUMNS = "t", "x", "y", "z"
# m per square root of a second: visual-inertial odometry that is off by 1 % of 200 m, flown at 1
# m/s, after that
DRIFT = 0.02


def read_paths(
    source: str, flights: Sequence[Flight], drift: float = DRIFT, namespace: str = ""
) -> list[OdometryPath]:
    """[OdometryPath], one for each of some Flights that it has. source : a CSV file with the
    columns flight, t (s, clock of the recording), x, y, z (m), or the name of a nav_msgs/Odometry
    topic of the bags; drift : m per square root of a second. Raises InputError.
    """
    if not 0.0 <= drift <= 10.0:
        raise InputError(f"--drift: {drift:g} must be from 0 to 10 m per square root of a second.")
    if Path(source).is_file():
        return _of_table(source, flights, drift)
    out = []
    for flight in flights:
        if "bag" not in flight.meta:
            raise InputError(
                f"--odometry {source}: is no CSV file, and {flight.name} is no bag that could "
                "have such a topic."
            )
        found = read_odometry(flight.meta["bag"], namespace, topics={"odometry": source})
        sound = np.isfinite(found.p).all(axis=1)
        out.append(OdometryPath(flight.name, found.t[sound], found.p[sound], drift))
    return out


def _of_table(path: str, flights: Sequence[Flight], drift: float) -> list[OdometryPath]:
    rows = {flight.name: array("d") for flight in flights}
    for line, row in read_table(path, ("flight", *COLUMNS), TABLE_CELLS):
        if row["flight"] in rows:
            rows[row["flight"]].extend(number(path, line, row, name) for name in COLUMNS)
    out = []
    for name, some in rows.items():
        if not some:
            raise InputError(
                f"{path}: holds no row of flight {name}; its first column names the flight."
            )
        table = np.array(some).reshape(-1, len(COLUMNS))
        if (np.diff(table[:, 0]) <= 0.0).any():
            raise InputError(
                f"{path}: the stamps of flight {name} do not rise; sort its rows by t."
            )
        out.append(OdometryPath(name, table[:, 0], table[:, 1:], drift))
    return out
