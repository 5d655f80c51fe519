# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""two-errors: measure how much accelerometers rectify vibration, and the lateness of each anchor
over the height of the tag.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.vibration import VIBRATION_AVERAGE, VIBRATION_CORNER
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.scoring.metrics import position_at

GRAVITY = np.array([0.0, 0.0, 9.81])  # m/s^2
AIRBORNE = 0.5  # m, ground-truth height
HEIGHTS = (0.0, 0.045, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 2.0)  # m
FEWEST, OUTLIER, SCALE = 40, 6.0, 0.15  # TDOAs of a height; m, not looked at; m, of the robust fit


def rectified(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """(vibration, mean of the specific force beyond hovering), each (3,) m/s^2, of a Flight in the
    air.
    """
    t, accel = flight.imu.t, flight.imu.accel
    step = float(np.median(np.diff(t)))

    def low_pass(values: np.ndarray, time: float) -> np.ndarray:
        share = min(1.0, step / time)
        return lfilter([share], [1.0, share - 1.0], values, axis=0)

    slow = low_pass(accel, VIBRATION_CORNER)
    power = low_pass((accel - slow) ** 2, VIBRATION_AVERAGE)
    air = np.interp(t, flight.truth.t, flight.truth.p[:, 2]) > AIRBORNE
    return np.sqrt(power[air].mean(axis=0)), (slow - GRAVITY)[air].mean(axis=0)


def lateness(flight: Flight) -> dict[int, np.ndarray]:
    """{number of an interval of HEIGHTS: lateness (n,) m of the anchors of a Flight}.

    It is relative to the mean of the anchors above 1.5 m.
    """
    tdoa, positions = flight.tdoa, flight.anchors.positions
    inside = (tdoa.t > flight.truth.t[0]) & (tdoa.t < flight.truth.t[-1])
    a, b, p = (
        flight.anchors.index(tdoa.a[inside]),
        flight.anchors.index(tdoa.b[inside]),
        position_at(tdoa.t[inside], flight.truth),
    )
    r = (
        tdoa.d[inside]
        - np.linalg.norm(p - positions[b], axis=1)
        + np.linalg.norm(p - positions[a], axis=1)
    )
    out = {}
    for k, (low, high) in enumerate(zip(HEIGHTS, HEIGHTS[1:])):
        chosen = np.flatnonzero((p[:, 2] >= low) & (p[:, 2] < high) & (np.abs(r) < OUTLIER))
        if len(chosen) < FEWEST:
            continue
        rows, weight, late = (
            np.zeros((len(chosen), len(positions))),
            np.ones(len(chosen)),
            np.zeros(len(positions)),
        )
        rows[np.arange(len(chosen)), b[chosen]] = 1.0
        rows[np.arange(len(chosen)), a[chosen]] -= 1.0
        for _ in range(20):
            normal = rows.T @ (weight[:, None] * rows) + 1e-3 * np.eye(len(positions))
            late = np.linalg.solve(normal, rows.T @ (weight * r[chosen]))
            weight = 1.0 / (1.0 + ((r[chosen] - rows @ late) / SCALE) ** 2)
        out[k] = late - late[positions[:, 2] > 1.5].mean()
    return out


def add_options(add):
    """The options of the study."""
    add("data", metavar="DATA", type=Path, help="folder of measured flights")


def run(args):
    """Print both tables of the micro-SD logs below DATA/flights, by day."""
    folder = args.data
    shaking, late = defaultdict(list), defaultdict(lambda: defaultdict(list))
    for log in sorted(
        path for path in (folder / "flights").rglob("*") if path.is_file() and not path.suffix
    ):
        day = log.relative_to(folder / "flights").parts[0]
        flight = read_flight(log, folder / "surveys" / f"anchor_{day}.txt")
        shaking[day].append(rectified(flight))
        for k, each in lateness(flight).items():
            late[day][k].append(each)
    print("| day | vibration x, y, z, m/s^2 | mean beyond hovering x, y, z, m/s^2 |\n|---|---|---|")
    for day, both in shaking.items():
        print(
            f"| {day} |",
            " | ".join(
                ", ".join(f"{value:.2f}" for value in np.median(part, axis=0))
                for part in zip(*both)
            ),
            "|",
        )
    for day, by_height in late.items():
        print(
            f"\n{day}, lateness of the anchors in the order of their ids, m, median of the flights"
        )
        for k, each in sorted(by_height.items()):
            print(
                f"| {HEIGHTS[k]:g} - {HEIGHTS[k + 1]:g} |",
                " | ".join(f"{value:.2f}" for value in np.median(each, axis=0)),
                "|",
            )
