"""Walls that no radio signal comes through, for simulated flights and plans of halls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.safe_yaml import read_yaml

if TYPE_CHECKING:
    from pathlib import Path

HOW = (
    "write walls: [[x0, y0, x1, y1], ...], in metres, and after these the height of a wall over "
    "which signals go"
)
AT_ONCE = 200_000  # straight lines that are compared with all walls at once


@dataclass(frozen=True)
class Walls:
    """Upright walls between two points seen from above. segments : ((x0, y0, x1, y1, height), ...)
    m, in the frame of the anchors; a signal goes over a wall above its height, inf for none.
    """

    segments: tuple[tuple[float, ...], ...]

    @classmethod
    def from_yaml(cls, path: str | Path) -> Walls:
        """Read `walls: [[x0, y0, x1, y1], [x0, y0, x1, y1, height], ...]`. Raises InputError."""
        content = read_yaml(path)
        entries = content.get("walls") if isinstance(content, dict) else None
        if not isinstance(entries, list) or not entries:
            raise InputError(f"{path}: has no list 'walls'; {HOW}.")
        return cls(
            tuple(_segment(path, number, entry) for number, entry in enumerate(entries, start=1))
        )

    def between(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """(n,) whether a wall stands on the straight line between points p and q, (n, 3) m each.

        Their ends are on no wall.
        """
        out = np.zeros(len(p), bool)
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # lines along a wall, which cross it nowhere
            for x0, y0, x1, y1, height in self.segments:
                d, e, w = q - p, (x1 - x0, y1 - y0), (x0 - p[:, 0], y0 - p[:, 1])
                crossed = d[:, 0] * e[1] - d[:, 1] * e[0]
                along_line = (w[0] * e[1] - w[1] * e[0]) / crossed
                along_wall = (w[0] * d[:, 1] - w[1] * d[:, 0]) / crossed
                out |= (
                    (along_line > 0.0)
                    & (along_line < 1.0)
                    & (along_wall >= 0.0)
                    & (along_wall <= 1.0)
                    & (p[:, 2] + along_line * d[:, 2] < height)
                )
        return out


def heard_at(
    p: np.ndarray, positions: np.ndarray, reach: float, walls: Walls | None = None
) -> list[np.ndarray]:
    """Rows of the anchors at positions (N, 3) m that are heard at each of p (n, 3) m: within reach,
    m, and behind no wall. List of (k,).
    """
    near = cKDTree(positions).query_ball_point(p, reach, return_sorted=True)
    if walls is None:
        return [np.array(rows, int) for rows in near]
    out: list[np.ndarray] = []
    counts = np.array([len(rows) for rows in near], int)
    ends = np.cumsum(counts)
    for some in np.split(np.arange(len(p)), np.flatnonzero(np.diff(ends // AT_ONCE)) + 1):
        rows = np.concatenate([np.empty(0, int), *(np.array(near[k], int) for k in some)])
        free = ~walls.between(np.repeat(p[some], counts[some], axis=0), positions[rows])
        out += [
            part[kept]
            for part, kept in zip(
                *(np.split(each, np.cumsum(counts[some])[:-1]) for each in (rows, free))
            )
        ]
    return out


def _segment(path: str | Path, number: int, entry: Any) -> tuple[float, ...]:
    good = (
        isinstance(entry, list)
        and len(entry) in (4, 5)
        and all(type(value) in (int, float) for value in entry)
    )
    if not good or entry[:2] == entry[2:4]:
        raise InputError(
            f"{path}: walls: number {number} is {entry!r}, which is no wall from one point to "
            f"another; {HOW}."
        )
    return (*map(float, entry[:4]), float(entry[4]) if len(entry) == 5 else np.inf)
