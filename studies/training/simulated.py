# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated flights to compare models on: some constellations to train on, others never seen."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from uwb_tdoa_tools.simulation import SimulationConfig, simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from uwb_tdoa_bias.common.flight import Flight

TRAINING = ("corners", "wall_middles", "staircase")
UNSEEN = ("pillars", "low_ceiling", "random-7")
TRAJECTORIES = ("sines", "sines", "rising_circle", "circle", "square")
DURATION = 40.0  # s


def flights(
    constellations: Sequence[str],
    count: int,
    first_seed: int,
    progress: Callable[[list[tuple[str, int]]], Iterable[tuple[str, int]]] = lambda names: names,
) -> dict[str, list[Flight]]:
    """{constellation: [Flight, ...]}, `count` each, of varied paths, yaws, protocols and tag
    specimens.

    The anchors' own delays are calibrated (zero): they are constants of single modules, which no
    model of poses can know.
    progress : wraps the list of flights to simulate, e.g. tqdm
    """
    out: dict[str, list[Flight]] = {name: [] for name in constellations}
    for name, k in progress([(name, k) for name in constellations for k in range(count)]):
        config = SimulationConfig(
            seed=first_seed + k,
            constellation=name,
            trajectory=TRAJECTORIES[k % len(TRAJECTORIES)],
            duration=DURATION,
            yaw=("rotating", "along_track", "fixed")[k % 3],
            yaw_angle=0.7 * k,
            protocol=("tdoa2", "tdoa3")[k % 2],
            imu_rate=200.0,
            tag_unit=k % 5,
            anchor_delay_std=0.0,
        )
        out[name].append(replace(simulate(config), name=f"{name}-{k}"))
    return out
