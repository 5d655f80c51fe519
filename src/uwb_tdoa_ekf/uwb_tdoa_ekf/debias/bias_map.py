# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Store, apply and save the map from a measured position to its bias.

The map follows Grasso et al. (Sensors 2022, 22, 9136), eqs. 20 and 21. Its interpolator `network` is
the radial-basis-function network of their appendix A, extended to 3D.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import ConvexHull, QhullError, cKDTree

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_arrays, write_filled
from uwb_tdoa_bias.common.limits import MAP_MARKERS

SHARE = 0.5  # c1: share of a node in the value at its own place (eq. A7)
# smallest ratio of a neighbour's value to a node's in the logarithm of eq. A5
SMALLEST_RATIO = 1e-6
CHUNK = 2000  # places per call, which limits the memory


class AngularNetwork:
    """Interpolate with one Gaussian per node, whose width depends on the direction (eqs. A1 - A8).

    At the place of a neighbour, the Gaussian has fallen to the neighbour's share of the neighbour's
    value (A3 - A5). This determines the width in the direction of the neighbour. Between
    neighbours, the width is interpolated over the direction (A6). At a node with all its
    neighbours, the result is the node's value plus the tails of more distant nodes.

    In a plane a node has 8 neighbours, and the width is linear in the angle, as published. In space
    it has 26 neighbours. The weight of each is the inverse of one minus the cosine (Shepard). In
    the direction of a neighbour, the width is that of this neighbour.

    Where eq. A5 has no real positive width, two minimal repairs apply. First, c2 is not negative.
    It would be negative if a neighbour's value exceeds 8 times the node's, or 26 times in space.
    The "Gaussian" would then grow with distance. Second, a neighbour of value 0 counts as
    SMALLEST_RATIO of the node's value.

    The number of neighbours in eq. A3 stays 8 (26) at the rim, as published. Values at the rim are
    therefore too close to the smallest value.
    """

    def __init__(self, cell: np.ndarray, at: np.ndarray, values: np.ndarray, step: float) -> None:
        """Compute the widths of all nodes.

        Parameters
        ----------
        cell : (n, d) int array
            Place in the grid.
        at : (n, d) array
            Places of the nodes, in m.
        values : (n, k) array
            Values at the nodes.
        step : float
            Cell size of the grid, in m.
        """
        self._at, d = np.asarray(at, dtype=float), at.shape[1]
        self._cutoff = 2.0 * step  # the 1 m of eq. A8, on the paper's grid of 0.5 m
        self._offset = np.minimum(values.min(axis=0), 0.0)  # b_min, A1
        self._values = values - self._offset
        offsets = np.array([offset for offset in product((-1, 0, 1), repeat=d) if any(offset)])
        neighbour, there = _neighbours(cell, offsets)
        away = self._at[neighbour] - self._at[:, None]
        distance = np.linalg.norm(away, axis=2)
        there = there & np.asarray(distance > 0.0)
        c3 = (1.0 - SHARE) / (len(offsets) * SHARE)  # A4
        own = np.where(self._values > 0.0, self._values, 1.0)
        ratio = np.clip(c3 * self._values[neighbour] / own[:, None], SMALLEST_RATIO, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._widths = -np.log(ratio) / distance[:, :, None] ** 2  # A5: (n, K, k)
            self._towards = np.where(there[:, :, None], away / distance[:, :, None], 0.0)
        self._widths[~there] = 0.0
        self._there = there
        self._alone = ~there.any(axis=1)
        self._width_alone = -np.log(c3) / step**2  # as if all neighbours had the value of the node
        self._width_of = _over_angle if d == 2 else _over_direction

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the values at places x (m, d), in m: (m, k).

        Far from every node the result is the smallest value, or 0 if no value is negative (A8).
        """
        return np.concatenate(
            [self._at_places(part) for part in np.array_split(x, len(x) // CHUNK + 1)]
        )

    def _at_places(self, x: np.ndarray) -> np.ndarray:
        # Sum the Gaussians of all nodes within the cutoff, eq. A7.
        away = x[:, None] - self._at
        squared = np.einsum("mnd,mnd->mn", away, away)
        place, node = np.nonzero(squared < self._cutoff**2)
        squared, away = squared[place, node, None], away[place, node]
        there = self._there[node]
        width = self._width_of(away, self._towards[node], there, self._widths[node])
        width[self._alone[node]] = self._width_alone
        terms = SHARE * self._values[node] * np.exp(-width * squared)  # A7
        return self._offset + np.stack(
            [np.bincount(place, column, len(x)) for column in terms.T], axis=1
        )


def _neighbours(cell: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbours of each node.

    Parameters
    ----------
    cell : (n, d) int array
        Place of each node in the grid.
    offsets : (K, d) int array
        Steps to the K neighbours.

    Returns
    -------
    rows : (n, K) int array
        Rows of the neighbours.
    there : (n, K) bool array
        Whether the neighbour exists.
    """
    shifted = cell - cell.min(axis=0) + 1
    shape = tuple(shifted.max(axis=0) + 2)
    key = np.ravel_multi_index(tuple(shifted.T), shape)
    order = np.argsort(key)
    wanted = np.ravel_multi_index(tuple(np.moveaxis(shifted[:, None] + offsets, 2, 0)), shape)
    place = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    found = order[place]
    return found, key[found] == wanted


def _over_angle(
    away: np.ndarray, towards: np.ndarray, there: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Return widths (P, k) in the directions `away` (P, 2), linear in the angle between neighbours.

    Parameters
    ----------
    away : (P, 2) array
        Directions, of any length.
    towards : (P, K, 2) array
        Unit vectors to the neighbours.
    there : (P, K) bool array
        Whether the neighbour exists.
    widths : (P, K, k) array
        Widths in the directions of the neighbours.
    """
    full = 2.0 * np.pi
    angle = np.arctan2(away[:, 1], away[:, 0])[:, None] - np.arctan2(
        towards[:, :, 1], towards[:, :, 0]
    )
    behind = np.where(there, np.mod(angle, full), np.inf)
    ahead = np.where(there, np.mod(-angle, full), np.inf)
    row, last, following = np.arange(len(away)), np.argmin(behind, axis=1), np.argmin(ahead, axis=1)
    before, after = behind[row, last], ahead[row, following]
    span = before + after
    with np.errstate(invalid="ignore"):
        part = np.where(
            np.isfinite(span) & (span > 0.0), before / np.where(span > 0.0, span, 1.0), 0.0
        )[:, None]
    return (1.0 - part) * widths[row, last] + part * widths[row, following]


def _over_direction(
    away: np.ndarray, towards: np.ndarray, there: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Return widths (P, k) in the directions `away` (P, 3), weighted by the cosine (Shepard).

    The other parameters are as for `_over_angle`, in three dimensions.
    """
    length = np.linalg.norm(away, axis=1, keepdims=True)
    cosine = np.einsum("pd,pkd->pk", away / np.maximum(length, 1e-12), towards)
    weight = np.where(there, 1.0 / (1.0 - np.minimum(cosine, 1.0) + 1e-9), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    return np.einsum("pk,pkc->pc", weight / np.where(total > 0.0, total, 1.0), widths)


FORMAT, VERSION = "uwb_tdoa position bias map", 2
UNITS = (
    "metres, square metres for added, in the world frame named by frame; bias is measured minus "
    "true"
)
INTERPOLATORS = ("thin_plate", "network")
# smoothing of the thin plate at a marker of median count; see docs/notebook/debiasing.md
SMOOTHING = 0.3
# m beyond the known region over which the correction fades to 0; see docs/notebook/debiasing.md
FADE = 1.0
LARGEST = 1e5  # m; a larger place or bias is an error
_ARRAYS = {
    "cell": int,
    "at": float,
    "bias": float,
    "std": float,
    "count": int,
    "added": float,
    "ids": int,
    "positions": float,
}


@dataclass(frozen=True)
class BiasMap:
    """Store biases at n markers in d = 2 or 3 dimensions and interpolate between them.

    A position is known inside the convex hull of the markers and within one step of the nearest
    marker. Beyond that region, the correction fades to 0 over FADE.

    Attributes
    ----------
    cell : (n, d) int array
        Place in the grid of `step`.
    at : (n, d) array
        Measured places of the markers in the world frame, in m, eq. 19.
    bias : (n, d) array
        Bias b*, measured minus true, in m, eqs. 17 and 18.
    std : (n, d) array
        Standard deviation of the measurements, in m.
    count : (n,) int array
        Number of measurements.
    added : (d, d) array
        Covariance to add to that of a corrected position, in m^2; see `fit`.
    step : float
        Cell size of the grid, in m.
    interpolator : str
        "thin_plate" (scipy's RBFInterpolator, closer to markers with more measurements) or
        "network" (Grasso et al., appendix A).
    frame : str
        Name of the world frame.
    source : str
        Origin of the map, free text.
    ids, positions : (N,) and (N, 3) array
        Ids and positions, in m, of the anchors of the map. Without any, the map belongs to no
        anchors.
    """

    cell: np.ndarray
    at: np.ndarray
    bias: np.ndarray
    std: np.ndarray
    count: np.ndarray
    added: np.ndarray
    step: float
    interpolator: str = "thin_plate"
    frame: str = "map"
    source: str = ""
    ids: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    positions: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    _hull: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False, compare=False)
    _tree: cKDTree = field(init=False, repr=False, compare=False)
    _surface: Callable[[np.ndarray], np.ndarray] = field(init=False, repr=False, compare=False)
    _mean_square: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the fields, raise InputError, and prepare hull, tree and interpolator."""
        for name, kind in _ARRAYS.items():
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        n, d = self.at.shape if self.at.ndim == 2 else (0, 0)
        shapes = (
            self.cell.shape,
            self.bias.shape,
            self.std.shape,
            self.count.shape,
            self.added.shape,
        )
        if d not in (2, 3) or shapes != ((n, d), (n, d), (n, d), (n,), (d, d)):
            raise InputError("bias map: cell, at, bias, std, count and added do not fit together.")
        if (
            self.ids.ndim != 1
            or self.positions.shape != (len(self.ids), 3)
            or not np.isfinite(self.positions).all()
        ):
            raise InputError("bias map: ids and positions of its anchors do not fit together.")
        if n > MAP_MARKERS:
            raise InputError(
                f"bias map: {n} markers are more than {MAP_MARKERS}; map with a larger step."
            )
        arrays = (self.at, self.bias, self.std, self.added)
        if not (all(np.isfinite(array).all() for array in arrays) and 0.0 < self.step < np.inf):
            raise InputError(
                "bias map: it holds a number that is not finite, or a step that is not above 0."
            )
        if (
            max(np.abs(array).max(initial=0.0) for array in (self.at, self.bias, self.std))
            > LARGEST
        ):
            raise InputError(f"bias map: it holds a place or a bias of more than {LARGEST:g} m.")
        if (
            (self.std < 0.0).any()
            or (self.count < 1).any()
            or np.linalg.eigvalsh(self.added).min() < -1e-9
        ):
            raise InputError(
                "bias map: it holds a deviation or a variance below 0, or a marker of no "
                "measurements."
            )
        if not np.allclose(self.added, self.added.T):
            raise InputError("bias map: added is no covariance: it is not symmetric.")
        if self.interpolator not in INTERPOLATORS:
            raise InputError(
                f"interpolator: {self.interpolator!r} is not one of {', '.join(INTERPOLATORS)}."
            )
        try:
            hull = ConvexHull(self.at).equations
        except (QhullError, ValueError) as error:
            remedy = "lie on one line" if d == 2 else "lie in one plane: make a planar map of them"
            raise InputError(
                f"bias map: its {n} markers are too few, or {remedy}; measure more places."
            ) from error
        if self.interpolator == "network":
            surface = AngularNetwork(self.cell, self.at, self.bias, self.step)
        else:
            smoothing = SMOOTHING * np.median(self.count) / self.count
            surface = RBFInterpolator(
                self.at, self.bias, kernel="thin_plate_spline", smoothing=smoothing
            )
        object.__setattr__(self, "_hull", (hull[:, :d], hull[:, d]))
        object.__setattr__(self, "_tree", cKDTree(self.at))
        object.__setattr__(self, "_surface", surface)
        object.__setattr__(self, "_mean_square", self.bias.T @ self.bias / n)

    @property
    def planar(self) -> bool:
        """Return whether the map has x and y only; z is then not corrected."""
        return self.at.shape[1] == 2

    def belongs_to(self, anchors: Anchors) -> bool:
        """Return whether the map was made for these Anchors."""
        return bool(len(self.ids)) and anchors.stand_at(self.ids, self.positions, self.frame)

    def scaled(self, share: float) -> BiasMap:
        """Return a BiasMap with all biases scaled by `share`, 0 to 1.

        The uncorrected part of the bias is included in `added`.
        """
        return replace(
            self,
            bias=share * self.bias,
            added=share**2 * self.added + (1.0 - share) ** 2 * self._mean_square,
        )

    def validity(self, p: np.ndarray) -> np.ndarray:
        """Return the validity of the map at positions p (m, 3), in m: (m,), 0 to 1.

        The validity is 1 in the known region and 0 from a distance of FADE.
        """
        p = p[:, : self.at.shape[1]]
        normals, offsets = self._hull
        outside = (p @ normals.T + offsets).max(axis=1)
        far_from_markers = self._tree.query(p)[0] - self.step
        return np.clip(1.0 - np.maximum(outside, far_from_markers) / FADE, 0.0, 1.0)

    def bias_at(self, p: np.ndarray) -> np.ndarray:
        """Return the faded bias beta of eq. 20 at measured positions p (m, 3), in m: (m, 3) m.

        The z component is 0 if the map is planar.
        """
        return self._faded(p, self.validity(p))

    def _faded(self, p: np.ndarray, validity: np.ndarray) -> np.ndarray:
        # Return the interpolated bias times its validity, (m, 3) m.
        out = np.zeros((len(p), 3))
        known = validity > 0.0
        if known.any():
            d = self.at.shape[1]
            out[known, :d] = validity[known, None] * self._surface(p[known, :d])
        return out

    def correct(
        self, p: np.ndarray, covariance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions without their bias (eq. 21) and the covariance of the remaining error.

        At validity w, the covariance increases by two terms. The term w^2 `added` covers errors of
        the map. The term (1 - w)^2 times the mean square of all biases covers the uncorrected bias.

        Parameters
        ----------
        p : (m, 3) array
            Positions in the world frame, in m.
        covariance : (m, 3, 3) array
            Their covariance, in m^2.

        Returns
        -------
        p : (m, 3) array
            Corrected positions, in m.
        covariance : (m, 3, 3) array
            Their covariance, in m^2.
        validity : (m,) array
            Validity of the map, 0 to 1.
        """
        validity, d = self.validity(p), self.at.shape[1]
        covariance = covariance.copy()
        known, unknown = validity[:, None, None] ** 2, (1.0 - validity[:, None, None]) ** 2
        covariance[:, :d, :d] += known * self.added + unknown * self._mean_square
        return p - self._faded(p, validity), covariance, validity

    def save(self, path: Path) -> None:
        """Write the map to a numpy .npz file that states its format, version and units."""
        about: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "units": UNITS,
            "frame": self.frame,
            "source": self.source,
        }
        content: dict[str, Any] = {
            "step": self.step,
            "interpolator": self.interpolator,
            **{name: getattr(self, name) for name in _ARRAYS},
        }
        write_filled(path, lambda file: np.savez_compressed(file, **{**about, **content}))

    @classmethod
    def load(cls, path: str | Path) -> BiasMap:
        """Read a file that `save` wrote.

        Raises InputError if the file is damaged, of another version, or no valid map.
        """
        what, remedy = f"position bias map of version {VERSION}", "make one with `debias`"
        kinds = {name: "i" if kind is int else "f" for name, kind in _ARRAYS.items()}
        fields_of_text = ("frame", "source", "interpolator")
        kinds |= dict.fromkeys(("format", "units", *fields_of_text), "U")
        kinds |= {"version": "i", "step": "f"}
        content = read_arrays(path, kinds, what, remedy)
        try:
            if str(content["format"]) != FORMAT or int(content["version"]) != VERSION:
                raise ValueError(f"format {content['format']}, version {content['version']}")
            fields: dict[str, Any] = {name: content[name] for name in _ARRAYS} | {
                name: str(content[name]) for name in fields_of_text
            }
            return cls(**fields, step=float(content["step"]))
        except (TypeError, ValueError, OverflowError) as error:  # InputError is a ValueError
            raise InputError(f"{path}: is no {what} ({error}); {remedy}.") from error
