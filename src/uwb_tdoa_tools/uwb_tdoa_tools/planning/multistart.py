"""The brute-force check of the bifurcation: solve for the position from many starts and see what
comes out.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.foundation.geometry import ranges

SWEEPS = 40
SOLVED = 1e-9  # m, residual of a solution
APART = 3e-4  # of the anchors' extent: two solutions nearer than this are one
DIRECTIONS = 12  # of the starts in a plane; in space three times as many
RADII = (
    0.03,
    0.1,
    0.3,
    0.7,
    1.5,
    4.0,
    12.0,
    40.0,
    150.0,
)  # of the starts, over the anchors' extent


def solutions(points: np.ndarray, corners: np.ndarray, dimensions: int) -> np.ndarray:
    """All positions that a solver finds with the TDOAs that k + 1 anchors have at each point.

    points : (n, 3) m; corners : (k + 1, 3) anchors, m; dimensions : k. Levenberg-Marquardt on the k
        TDOAs from starts
    in many directions and distances. Returns (n, s, k), a row per start, NaN where it did not end
    in a solution.
    """
    centre = corners[:, :dimensions].mean(axis=0)
    extent = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
    rays = _directions(dimensions)
    starts = centre + extent * np.concatenate([radius * rays for radius in RADII])
    x: np.ndarray = np.tile(starts, (len(points), 1))
    heights = np.repeat(points[:, 2:], len(starts), axis=0)[:, : 3 - dimensions]
    wanted = np.repeat(_tdoas(points, corners)[0], len(starts), axis=0)

    found = np.full_like(x, np.nan)
    row: np.ndarray = np.arange(len(x))  # of those that are not solved yet
    cost, gradient, normal = _normal_equations(x, heights, wanted, corners)
    damping: np.ndarray = np.full(len(x), 1e-3)
    for _ in range(SWEEPS):
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-24))
        damped = normal / (scale[:, :, None] * scale[:, None, :]) + damping[:, None, None] * np.eye(
            dimensions
        )
        step = np.linalg.solve(damped, (gradient / scale)[..., None])[..., 0] / scale
        longest = extent + np.linalg.norm(x - centre, axis=1)
        step *= np.minimum(1.0, longest / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        new = _normal_equations(x + step, heights, wanted, corners)
        better = new[0] < cost
        x[better] += step[better]
        for old, value in zip((cost, gradient, normal), new):
            old[better] = value[better]
        damping = np.clip(damping * np.where(better, 0.2, 5.0), 1e-14, 1e14)
        solved = cost < SOLVED**2
        found[row[solved]] = x[solved]
        row, x, heights, wanted, damping, cost, gradient, normal = (
            array[~solved] for array in (row, x, heights, wanted, damping, cost, gradient, normal)
        )
    return found.reshape(len(points), len(starts), dimensions)


def same_place(points: np.ndarray, found: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Whether positions (..., k) are points (..., 3) but for what the solver leaves, on the scale
    of anchors (N, 3).
    """
    apart = APART * np.linalg.norm(np.ptp(anchors, axis=0))
    return np.linalg.norm(found - points[..., : found.shape[-1]], axis=-1) <= apart


def _normal_equations(
    x: np.ndarray, heights: np.ndarray, wanted: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    d, jacobian = _tdoas(np.hstack([x, heights]), corners)
    jacobian, residual = jacobian[:, :, : x.shape[1]], wanted - d
    cost = np.einsum("ni,ni->n", residual, residual)
    return cost, np.einsum("nik,ni->nk", jacobian, residual), jacobian.swapaxes(1, 2) @ jacobian


def _tdoas(x: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """TDOAs (n, k) m of the other corners against the first, and their derivatives (n, k, 3)."""
    distance, unit = ranges(x[:, None], corners)
    return distance[:, 1:] - distance[:, :1], unit[:, 1:] - unit[:, :1]


def _directions(dimensions: int) -> np.ndarray:
    """Unit vectors spread evenly: (DIRECTIONS, 2) in the plane, or a Fibonacci sphere of (3
    DIRECTIONS, 3).
    """
    if dimensions == 2:
        angle = 2.0 * np.pi * (np.arange(DIRECTIONS) + 0.31) / DIRECTIONS
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(3 * DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * k / (3 * DIRECTIONS), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack(
        [np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z]
    )
