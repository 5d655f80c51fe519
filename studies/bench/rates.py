# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The highest rate of a replay at which nothing is lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_tools.bags.bag import read_odometry, write_bag
from uwb_tdoa_tools.bags.files import open_bag
from uwb_tdoa_tools.live.session import accounts, run_live

from .figures import Figure
from .flights import make_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

RATES = (4.0, 10.0, 16.0, 32.0, 64.0)
KEPT_UP = 0.8  # of the rate that was asked for; a run that is slower than that has found the limit
NEEDED = 10.0
SECTION = "replay of a bag through both nodes, reliable links, odometry recorded"


def measure(
    progress: Callable[[str], object], folder: Path, quick: bool = False
) -> Iterator[Figure]:
    """Generator of Figures; folder : for bags and the output of the processes. progress(text)."""
    flight = make_flight(8.0 if quick else 45.0)
    bag, highest = folder / "flight.bag", 0.0
    write_bag(flight, bag, force=True)
    for rate in RATES[:1] if quick else RATES:
        progress(f"replay at rate {rate:g}")
        live = run_live(bag, folder, rate, say=lambda text: None)
        recorded, reached = len(read_odometry(live.recorded)), speed(live.recorded)
        became = accounts(live.bias, live.ekf, flight, recorded)
        lost = became["lost"] + became["imu_lost"]
        late = became["late"] + became["imu_late"]
        yield Figure.of(
            SECTION, f"lost at rate {rate:g}", "messages", lost, 0.0 if rate <= NEEDED else None
        )
        yield Figure.of(
            SECTION, f"too late at rate {rate:g}", "messages", late, 0.0 if rate <= NEEDED else None
        )
        yield Figure.of(SECTION, f"reached at rate {rate:g}", "s of flight/s", reached)
        if lost or late:
            break
        highest = max(highest, reached)
        if reached < KEPT_UP * rate:
            break
    yield Figure.of(SECTION, "highest without loss", "s of flight/s", highest)


def speed(recorded: str | Path) -> float:
    """Seconds of flight per second of recording, of a bag with odometry."""
    with open_bag(recorded) as reader:
        arrived = [stamp for _, stamp, _ in reader.messages()]
    return float(np.ptp(read_odometry(recorded).t) / (1e-9 * np.ptp(arrived)))
