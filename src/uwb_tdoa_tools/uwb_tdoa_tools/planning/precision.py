# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute how precise a position can be, and where the TDOAs of k + 1 anchors have two solutions, by a formula.

Precision is Fisher information, the Cramer-Rao bound, dilution of precision and ellipses.

With m_0 one of k + 1 anchors and r the tag's distance to it, the TDOAs D_i = |x - m_i| - r turn
    (r + D_i)^2 = |x - m_i|^2
into k equations that are linear in x and r,
    a_i . (x - m_0) + D_i r = (|a_i|^2 - D_i^2) / 2,   a_i = m_i - m_0.
Their solution is a line in the space of (x, r): x = m_0 + p + q r with A q = -D. The line meets
the cone |x - m_0| = r where
    (|q|^2 - 1) r^2 + 2 p.q r + |p|^2 = 0.
One root is the tag. The product of both roots is |p|^2 / (|q|^2 - 1). If |q| < 1, the other root
is negative and belongs to no position. If |q| > 1, it belongs to a second position with the same
TDOAs. So |q| = 1 is the bifurcation curve (k = 2) or surface (k = 3).

For k = 2, times det(A)^2, this is the polynomial of Compagnoni et al. (Inverse Problems 30, 2014,
035004) that Grasso et al. use in sec. 2.3.1. If the height is known and the anchors have other
heights, only the right-hand sides change, not |q|.

`other_solutions` weighs all TDOAs of a round. With d(x) the distances from x to the N anchors that
are heard at p, D the anchor pairs of the TDOAs of a round, F the covariance of these TDOAs, and
Q = D' F^-1 D the information matrix of the distances, 1/m^2 (`round_weights`),
    f(x) = (d(x) - d(p))' Q (d(x) - d(p))
is the squared misfit, in standard deviations, of a tag at x with the TDOAs of a tag at p. Its
smallest minimum is p, with 0. Levenberg-Marquardt searches a second one, from the mirrored places
of choices of k + 1 anchors; k is the number of unknown coordinates, 2 or 3. An estimator that weighs
all TDOAs prefers the second minimum with probability Phi(-sqrt(f) / 2).

One more anchor raises f everywhere, but it may also make a second minimum. A long valley may come
apart in two minima, or a minimum outside of the room may move into it. That is a property of this
definition, not of the search.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import Delaunay

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import ranges
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, Antenna, RadioLink, received_power_dbm
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from ..checking.coverage import sides_of, to_copy
from ..simulation.config import Room

BOLTZMANN = 1.380649e-23  # J/K
ROOM_TEMPERATURE = 298.15  # K
_ANY_ATTITUDE = (0.0, 0.0, 0.0, 1.0)  # the tag's antenna is taken as omnidirectional
_STEP = 1e-5  # m, for numerical derivatives


@dataclass(frozen=True)
class Omnidirectional:
    """An antenna with one gain, dBi, in all directions."""

    dbi: float = 0.0

    def gain(self, direction: np.ndarray) -> np.ndarray:
        """Return the gain towards directions (..., 3): (...) dBi."""
        return np.full(np.shape(direction)[:-1], self.dbi)


@dataclass(frozen=True)
class RadioNoise:
    """Noise from the link budget: Friis, thermal noise and the anchors' radiation pattern.

    Source: eqs. 9 - 12 of Grasso et al. (Sensors 2022, 22, 9136). The gain of the receiving antenna
    is left out, as there.

    Attributes
    ----------
    antenna : Antenna of the anchors (default DWM1000-like). An anchor without orientation radiates
        the mean of the azimuth cut in all directions.
    tx_power_dbm : into the antenna, dBm (default: that of RadioLink)
    bandwidth : Hz (default 499.2e6, channels 1, 2, 3 and 5)
    full_strength : m, r_0 of eq. 9: nearer than this the noise does not fall (default 1.0)
    """

    antenna: Antenna = field(default_factory=Antenna)
    tx_power_dbm: float = RadioLink.tx_power_dbm
    bandwidth: float = 499.2e6
    full_strength: float = 1.0

    def __post_init__(self) -> None:
        if not -60.0 <= self.tx_power_dbm <= 30.0:
            raise InputError(
                f"tx_power_dbm: {self.tx_power_dbm!r} is outside -60 ... 30, the range of a DW1000."
            )

    def variance(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """Return the variance of the range of one reception: (n, N) m^2.

        points : (n, 3) m; anchors : N Anchors. Source: eqs. 9 and 12.
        """
        thermal_noise_dbm = 10.0 * np.log10(BOLTZMANN * ROOM_TEMPERATURE * self.bandwidth * 1e3)
        snr_db = self._received(points, anchors) - thermal_noise_dbm
        return (SPEED_OF_LIGHT / self.bandwidth) ** 2 * 10.0 ** (-0.1 * snr_db)

    def _received(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """Return the received power at full_strength or farther: (n, N) dBm. Source: eq. 11."""
        away = points[:, None, :] - anchors.positions
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        away *= np.maximum(self.full_strength / np.maximum(distance, 1e-9), 1.0)
        power = np.empty(away.shape[:2])
        turned = np.isfinite(anchors.orientations).all(axis=1)
        mean = Omnidirectional(float(np.mean(self.antenna.azimuth)) + self.antenna.gain_offset)
        for rows, antenna in ((turned, self.antenna), (~turned, mean)):
            if rows.any():
                link = RadioLink(
                    antenna,  # type: ignore[arg-type]  # has `gain`
                    Omnidirectional(),  # type: ignore[arg-type]  # has `gain`
                    tx_power_dbm=self.tx_power_dbm,
                )
                q = np.where(turned[rows, None], anchors.orientations[rows], _ANY_ATTITUDE)
                power[:, rows] = received_power_dbm(
                    away[:, rows], _ANY_ATTITUDE, np.zeros(3), q, link
                )
        return power


@dataclass(frozen=True)
class FixedNoise:
    """The same noise everywhere. std : m, standard deviation of one reception."""

    std: float

    def __post_init__(self) -> None:
        if not 0.0 < self.std < 100.0:
            raise InputError(
                f"noise: {self.std!r} m is not a standard deviation; give one above 0, e.g. 0.06."
            )

    def variance(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """Return the variance of the range of one reception: (n, N) m^2."""
        return np.full((len(points), len(anchors)), self.std**2)


def variance_gradient(
    noise: RadioNoise | FixedNoise,
    points: np.ndarray,
    anchors: Anchors,
    variance: np.ndarray,
    dimensions: int,
) -> np.ndarray:
    """Return the derivative of noise.variance along x, y (and z): (n, N, dimensions) m.

    One-sided differences. variance : (n, N) m^2, noise.variance at the points.
    """
    steps = _STEP * np.eye(3)[:dimensions]
    return (
        np.stack([noise.variance(points + step, anchors) - variance for step in steps], axis=-1)
        / _STEP
    )


def antenna_from_yaml(path: str | Path) -> Antenna:
    """Read an Antenna from a YAML file. Raises InputError.

    The fields are azimuth, elevation_1 and elevation_2 (dBi, around the full circle), and optionally
    gain_offset, see `uwb_tdoa_bias.common.radio.Antenna`.
    """
    content = read_yaml(path)
    try:
        cuts: dict[str, Any] = {
            name: tuple(content.pop(name)) for name in ("azimuth", "elevation_1", "elevation_2")
        }
        return Antenna(**cuts, **content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is no antenna ({error!r}); give lists azimuth, elevation_1 and "
            "elevation_2 of gains in dBi."
        ) from error


# Parts of a round, by the words of choices.OF_PROTOCOL. The errors of two parts are independent.
RING, ALL_PAIRS, EVERY_RANGE = "ring", "all_pairs", "every_range"


SAME_PLACE = 0.01  # m; two anchors nearer than this are one
# of the largest distance: so close to one plane (line), its two sides are ambiguous
FLAT = 0.01


@dataclass(frozen=True)
class Installation:
    """Anchors, their radio, and what the tag measures. Raises InputError for useless anchors.

    Attributes
    ----------
    anchors : Anchors
    noise : RadioNoise or FixedNoise of a reception
    pairing : what one round holds, of choices.OF_PROTOCOL (default: the ring of TDOA2)
    dimensions : 3, or 2 for a tag at a known height
    height_std : m, of a height sensor on the tag, used with each round; inf for none (default)
    hall : True if each place hears only a part of the anchors (default False). The part may be
        small, or in a plane.
    """

    anchors: Anchors
    noise: RadioNoise | FixedNoise = field(default_factory=RadioNoise)
    pairing: str = RING
    dimensions: int = 3
    height_std: float = np.inf
    hall: bool = False

    def __post_init__(self) -> None:
        if not self.height_std > 0.0 or (self.dimensions == 2 and self.height_std < np.inf):
            raise InputError(
                f"height std: {self.height_std!r} m is not the standard deviation of a height "
                "sensor; give one above 0, "
                "e.g. 0.02, and none for a tag of known height."
            )
        if not self.hall:
            check_anchors(self.anchors, self.unknowns)

    def with_anchors(self, anchors: Anchors) -> Installation:
        """Return a copy for a hall with other Anchors."""
        return replace(self, anchors=anchors, hall=True)

    @property
    def parts(self) -> list[str]:
        """The parts of a round, measured independently."""
        return self.pairing.split("+")

    @property
    def unknowns(self) -> int:
        """Coordinates that TDOAs must determine: 2 if the height is known or measured, else 3."""
        return 2 if self.height_std < np.inf else self.dimensions

    def with_height(self, information: np.ndarray) -> np.ndarray:
        """Return the information (n, k, k) 1/m^2 plus that of the height sensor."""
        if self.height_std < np.inf:
            information = information + np.diag([0.0, 0.0, self.height_std**-2])
        return information

    def inside_hull(self, points: np.ndarray) -> np.ndarray:
        """Return whether points (n, 3) m are inside the convex hull of the anchors: (n,).

        The hull is two-dimensional, seen from above, if the height is known or measured.
        """
        k = self.unknowns
        hull = Delaunay(self.anchors.positions[:, :k])
        return hull.find_simplex(points[:, :k]) >= 0


def check_anchors(anchors: Anchors, dimensions: int) -> None:
    """Raise InputError, with the remedy, for anchors that determine no position."""
    what = {2: "a position at known height", 3: "a position in space"}[dimensions]
    if len(anchors) < dimensions + 1:
        raise InputError(
            f"anchors: {len(anchors)} were given; {what} needs at least {dimensions + 1}."
        )
    away = np.linalg.norm(anchors.positions[:, None] - anchors.positions, axis=-1) + 1e9 * np.eye(
        len(anchors)
    )
    i, j = np.unravel_index(np.argmin(away), away.shape)
    if away[i, j] < SAME_PLACE:
        raise InputError(
            f"anchors: {anchors.ids[i]} and {anchors.ids[j]} are at the same place; move or "
            "delete one."
        )
    size = principal_extents(anchors.positions[:, :dimensions])
    if size[1] <= FLAT * size[0]:
        seen = "seen from above " if dimensions == 2 else ""
        raise InputError(
            f"anchors: all are on one line {seen}to {size[1]:.3f} m; move one of them out of it."
        )
    if dimensions == 3 and size[2] <= FLAT * size[0]:
        sides = sides_of(anchors.positions)
        raise InputError(
            f"anchors: all are in one plane to {size[2]:.3f} m, so that its two sides cannot "
            "be told apart; move one "
            "of them out of it, or plan for a tag of known height (--planar) or one that "
            "measures it (--with height)"
            f"{'; or ' + to_copy(sides) if sides else ''}."
        )


def principal_extents(positions: np.ndarray) -> np.ndarray:
    """Return the extents of positions (..., N, k) m along their principal axes: (..., k) m.

    The longest comes first.
    """
    centred = positions - positions.mean(axis=-2, keepdims=True)
    return np.ptp(
        centred @ np.linalg.svd(centred, full_matrices=False)[2].swapaxes(-1, -2), axis=-2
    )


# standard deviations of a normal variable that hold 99 %, as rounded in Grasso et al., sec. 2.2.3
NORMAL_99 = 2.58
UNUSABLE = 100.0  # m, stands for an infinite bound, and for a layout that determines no position
_CHUNK = 200_000  # numbers in the largest array of one step: what a processor cache holds


def information(
    points: np.ndarray,
    installation: Installation,
    correction: bool = True,
    columns: np.ndarray | None = None,
) -> np.ndarray:
    """Return the Fisher information of one round about the position: (n, k, k) 1/m^2.

    A round holds TDOAs or ranges and, if the tag measures it, a height. points : (n, 3) m; k : the
    dimensions of the installation. correction : True adds the second term of eq. 1, the information
    in the size of the errors. columns : (n, K) rows of the anchors that are heard at each point,
    None for all.
    Source: eq. 1 of Grasso et al. (Sensors 2022, 22, 9136).
    """
    anchors = installation.anchors
    if columns is None:
        columns = np.broadcast_to(np.arange(len(anchors)), (len(points), len(anchors)))
    size = len(points) * max(columns.shape[1] ** 2, 9 * len(anchors))
    parts = [
        _information(points[rows], installation, correction, columns[rows])
        for rows in np.array_split(np.arange(len(points)), max(1, size // _CHUNK))
    ]
    return installation.with_height(np.concatenate(parts))


def _information(
    points: np.ndarray, installation: Installation, correction: bool, columns: np.ndarray
) -> np.ndarray:
    anchors, k = installation.anchors, installation.dimensions
    variances = installation.noise.variance(points, anchors)
    variance = np.take_along_axis(variances, columns, axis=1)
    unit = ranges(points[:, None, :], anchors.positions[columns])[1][..., :k]
    gradient: np.ndarray = np.empty(0)
    if correction:
        gradient = variance_gradient(installation.noise, points, anchors, variances, k)
        gradient = np.take_along_axis(gradient, columns[..., None], axis=1)
    total = np.zeros((len(points), k, k))
    for part in installation.parts:
        weights = range_weights(variance, part)
        total += weigh(unit, weights)
        if correction:
            total += 0.5 * weigh(gradient, _weights_of_sizes(weights, part))
    return total


def weigh(change: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the information change' weights change about k unknowns: (n, k, k).

    change : (n, N, k) derivatives of the ranges to all N anchors; weights : (n, N, N), of
    `range_weights`. For derivatives by the position it is the first term of eq. 1, in 1/m^2.
    """
    return change.swapaxes(1, 2) @ (weights @ change)


def round_weights(variance: np.ndarray, installation: Installation) -> np.ndarray:
    """Return the weights of the ranges in a whole round: (n, N, N) 1/m^2. variance : (n, N) m^2."""
    return np.sum([range_weights(variance, part) for part in installation.parts], axis=0)


def range_weights(variance: np.ndarray, part: str) -> np.ndarray:
    """Return D' F^-1 D, the weights of the ranges in a part of a round: (n, N, N) 1/m^2.

    D (M, N) has -1 at anchor a and +1 at anchor b of each pair; it is the identity for ranges. F = D S D'
    is the covariance of the measurements, S = diag(variance).

    RING : the N TDOAs of TDOA2, each anchor with the next one. Each TDOA shares a reception, and its
    error, with its neighbours. If the pairs connect all anchors, the result does not
    depend on the pairs: with W = S^-1 and w its diagonal, D' (D S D')^-1 D = W - w w' / sum(w).
    That is the information of N ranges with one unknown offset, the tag's clock. A closed ring,
    whose D S D' is singular, has the same information.
    ALL_PAIRS : the TDOAs of TDOA3, each anchor with each other, with independent errors. A round
    counts as N TDOAs.
    EVERY_RANGE : the N distances of two-way ranging.

    variance : (n, N) m^2, of the receptions
    Source: eqs. 4 and 5 of Grasso et al. (Sensors 2022, 22, 9136); A18 for a common reference.
    """
    each = np.eye(variance.shape[1])
    if part == EVERY_RANGE:
        return each / variance[:, None]
    if part == RING:
        w = 1.0 / variance
        return each * w[:, None] - w[:, :, None] * (w / w.sum(axis=1, keepdims=True))[:, None]
    of_pair = variance[:, :, None] + variance[:, None, :]
    between = (1.0 - each) * (_times(len(each)) / of_pair)
    return each * between.sum(axis=1)[:, None] - between


def _times(n: int) -> float:
    """Return how often each of ALL_PAIRS of n anchors comes in a round, which counts as n TDOAs."""
    return 2.0 / (n - 1)


def _weights_of_sizes(weights: np.ndarray, part: str) -> np.ndarray:
    """Return the weights of the variances in the second term of eq. 1, times 2: (n, N, N) 1/m^4.

    weights : P, of `range_weights`. With dF_i = D diag(g_i) D', the trace of eq. 1 is g_i' (P o P)
    g_j. If the errors are independent, F is diagonal, and a pair adds (g_a + g_b)^2 / F^2.
    """
    squared = weights**2
    if part != ALL_PAIRS:
        return squared
    each = np.eye(weights.shape[1])
    squared *= 1.0 - each
    return (squared + each * squared.sum(axis=1)[:, None]) / _times(len(each))


def bound(information: np.ndarray) -> np.ndarray:
    """Return the Cramer-Rao bound: (n, k, k) m^2; inf where the information is singular."""
    finite = np.isfinite(information).all(axis=(1, 2))
    checked = np.where(finite[:, None, None], information, 0.0)
    values, vectors = np.linalg.eigh(checked)
    lost = values[:, 0] <= 1e-12 * np.maximum(values[:, -1], 1e-300)
    covariance = (vectors / np.where(lost[:, None], 1.0, values)[:, None, :]) @ vectors.swapaxes(
        1, 2
    )
    return np.where(lost[:, None, None], np.inf, covariance)


def position_error(covariance: np.ndarray) -> np.ndarray:
    """Return the root of the summed variances of x, y (and z): (n,) m."""
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def dilution(points: np.ndarray, installation: Installation) -> np.ndarray:
    """Return the dilution of precision along each axis: (n, k).

    The error along an axis is the dilution times the error of one reception, if all have the same. k
    is the number of coordinates that TDOAs must determine. Root sums of squares give the horizontal dilution (x
    and y) and the position dilution, PDOP (all).
    """
    unit_noise = replace(
        installation,
        noise=FixedNoise(1.0),
        dimensions=installation.unknowns,
        height_std=np.inf,
    )
    covariance = bound(information(points, unit_noise, correction=False))
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def ellipses(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 99 % ellipses in the xy plane: (semi-axes (n, 2) m, angle (n,) rad).

    The longer semi-axis comes first; the angle is from x to it.
    """
    values, vectors = np.linalg.eigh(covariance[:, :2, :2])
    axes = np.sqrt(-2.0 * np.log(1.0 - 0.99) * values[:, ::-1])
    return axes, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


# thickness over length: anchors so close to a line (plane) mirror each position in it
FLAT_SUBSET = 0.05
MOST_SUBSETS = 2000
# numbers in the largest array of one step: of mirrored places, of second minima
_OF_PLACES, _OF_MINIMA = 500_000, 2_000_000


class Subsets:
    """All choices of k + 1 anchors that are not flat.

    rows : (Q, k + 1) rows of the anchors. A flat choice mirrors every position. If there are more
    than MOST_SUBSETS choices, only anchors that come close together in the round are combined.
    """

    def __init__(self, anchors: Anchors, dimensions: int) -> None:
        """Choose the subsets of Anchors for k dimensions, 2 or 3.

        Raises InputError if all choices are flat.
        """
        self.anchors, self.dimensions = anchors, dimensions
        candidates = _choices(len(anchors), dimensions + 1)
        corners = anchors.positions[candidates][:, :, :dimensions]
        extents = principal_extents(corners)
        flat = extents[:, -1] <= FLAT_SUBSET * extents[:, 0]
        self.rows = candidates[~flat]
        if not len(self.rows):
            raise InputError(
                f"anchors: every {dimensions + 1} of them are nearly in one "
                f"{'line' if dimensions == 2 else 'plane'}; "
                "spread them out."
            )
        corners = corners[~flat]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # (Q, k, k)
        self._q = np.zeros((len(self.rows), dimensions, len(anchors)))  # q = self._q @ distances
        q = np.arange(len(self.rows))[:, None]
        self._q[q, :, self.rows[:, 1:]] = -inverse.swapaxes(1, 2)
        self._q[q[:, 0], :, self.rows[:, 0]] = inverse.sum(axis=2)

    def discriminant(self, points: np.ndarray) -> np.ndarray:
        """Return |q|^2 - 1 of each subset: (n, Q), negative where there is one solution.

        points : (n, 3) m.
        """
        size, k = len(self.rows), self.dimensions
        matrix = self._q.reshape(size * k, -1).T
        out = np.empty((len(points), size))
        at = 0
        for chunk in np.array_split(points, max(1, len(points) * size * k // _OF_PLACES)):
            away = np.linalg.norm(chunk[:, None] - self.anchors.positions, axis=-1)
            q = away @ matrix
            out[at : at + len(chunk)] = (
                np.einsum("nqk,nqk->nq", *[q.reshape(len(chunk), size, k)] * 2) - 1.0
            )
            at += len(chunk)
        return out

    def ambiguous(self, points: np.ndarray) -> np.ndarray:
        """Return the share of the subsets with two solutions: (n,)."""
        return np.mean(self.discriminant(points) > 0.0, axis=1)


def _choices(n: int, k: int) -> np.ndarray:
    """Return choices of k out of n: (Q, k).

    If there are more than MOST_SUBSETS, each choice lies within the longest stretch of the ring that
    keeps their number below it.
    """
    every = np.array(list(combinations(range(min(n, 40)), k)))
    if n <= 40 and len(every) <= MOST_SUBSETS:
        return every
    stretch = k
    while n * len(list(combinations(range(stretch), k - 1))) <= MOST_SUBSETS:
        stretch += 1
    starts = np.array([(0, *rest) for rest in combinations(range(1, stretch), k - 1)])
    return (starts[None] + np.arange(n)[:, None, None]).reshape(-1, k) % n


FLIP = 0.5  # m; a minimum nearer than this is no failure, but imprecision
CLEAR = 4.65  # standard deviations of misfit from which on at most 1 % of the estimates flip
NEAREST = 8  # anchors whose choices of k + 1 are mirrored
DESCENTS = 12  # from the mirrored places of least misfit
MAX_TRIES = 100  # of a descent
MOST_REFUSED = 12  # tries in a row that do not lead down
SETTLED = 0.01  # a descent ends where another step would lower f by less than this
LONGEST = 5.0  # m, of a step
AROUND = 2.0  # m outside of the room, to which starts farther out are moved
SAME = 0.5 * FLIP  # m between starts that count as one
_FLAT = 1e-6  # of the volume of a cube; k + 1 anchors of less are in one plane (line)


def other_solutions(
    points: np.ndarray, installation: Installation, room: Room, columns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the second minimum of least misfit inside a room: (misfit (n,), place (n, 3) m).

    The misfit is in standard deviations; inf and NaN if no descent ends inside the room
    and more than FLIP away.
    points : (n, 3) m; columns : (n, K) rows of the anchors that are heard at each point; None for all.
    """
    anchors, unknowns = installation.anchors, installation.unknowns
    if columns is None:
        columns = np.tile(np.arange(len(anchors)), (len(points), 1))
    heard = columns.shape[1]
    choices = np.array(list(combinations(range(min(NEAREST, heard)), unknowns + 1)))
    size = len(points) * max(DESCENTS * heard**2, len(anchors), 9 * len(choices))
    out = np.full((len(points), 4), np.nan)
    for some in np.array_split(np.arange(len(points)), max(1, size // _OF_MINIMA)):
        variances = installation.noise.variance(points[some], anchors)
        weights = round_weights(np.take_along_axis(variances, columns[some], axis=1), installation)
        rounds = _Rounds(points[some], anchors.positions[columns[some]], weights, unknowns)
        row, x = rounds.starts(choices, room)
        f, x = rounds.descended(row, x)
        inside = ((x >= room.lower) & (x <= room.upper))[:, :unknowns].all(axis=1)
        f[~inside | (np.linalg.norm(x - points[some][row], axis=1) <= FLIP)] = np.inf
        out[some, 0] = np.inf
        least = np.lexsort((f, row))
        least = least[np.unique(row[least], return_index=True)[1]]
        least = least[f[least] < np.inf]
        out[some[row[least]]] = np.column_stack([f, x])[least]
    return np.sqrt(out[:, 0]), out[:, 1:]


@dataclass(frozen=True)
class _Rounds:
    """Rounds of TDOAs at n points, and descents along their misfits.

    Attributes
    ----------
    points : (n, 3) m
    anchors : (n, K, 3) m, that are heard at each point
    weights : (n, K, K) 1/m^2, Q
    unknowns : k, 2 or 3
    """

    points: np.ndarray
    anchors: np.ndarray
    weights: np.ndarray
    unknowns: int

    def misfit(self, row: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return f at places x (m, 3) for the points `row`, its gradient and Hessian, both halved.

        The Hessian is that of Gauss and Newton: without the curvature of the distances.
        """
        away = x[:, None] - self.anchors[row]
        r = _length(away)
        true = _length(self.points[row, None] - self.anchors[row])
        both = np.concatenate(
            [away[..., : self.unknowns] / np.maximum(r, 1e-9)[..., None], (r - true)[..., None]],
            axis=-1,
        )
        normal = both.swapaxes(1, 2) @ (self.weights[row] @ both)
        return np.maximum(normal[:, -1, -1], 0.0), normal[:, :-1, -1], normal[:, :-1, :-1]

    def starts(self, choices: np.ndarray, room: Room) -> tuple[np.ndarray, np.ndarray]:
        """Return the mirrored places of least misfit, apart from each other: (row (m,), x (m, 3) m).

        choices : (C, k + 1) indices into the heard anchors, nearest first
        """
        true = _length(self.points[:, None] - self.anchors)
        nearest = np.argsort(true, axis=1)
        corners = np.take_along_axis(self.anchors, nearest[..., None], axis=1)[:, choices]
        x = _mirrored(self.points, corners, self.unknowns)
        k = slice(self.unknowns)
        x[..., k] = np.clip(x[..., k], room.lower[k] - AROUND, room.upper[k] + AROUND)
        change = _length(x[:, :, None] - self.anchors[:, None]) - true[:, None]
        f = np.einsum("nck,nck->nc", change @ self.weights, change)
        best = np.argsort(f, axis=1)[:, :DESCENTS]  # NaN comes last
        x = np.take_along_axis(x, best[..., None], axis=1)
        apart = _length(x[:, :, None] - x[:, None]) >= SAME
        kept = (apart | np.triu(np.ones(apart.shape[1:], bool))).all(axis=2)
        kept &= _length(x - self.points[:, None]) >= SAME
        return np.nonzero(kept)[0], x[kept]

    def descended(self, row: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where descents from x (m, 3) end: (f (m,), place (m, 3) m).

        f is inf if the descent does not end, or ends at the point itself.
        """
        x, end = x.copy(), np.full(len(x), np.inf)
        f, gradient, hessian = self.misfit(row, x)
        damping, refused = np.full(len(x), 1e-2), np.zeros(len(x), int)
        going = np.arange(len(x))
        for _ in range(MAX_TRIES):
            lifted = damping[going, None] * np.diagonal(hessian[going], axis1=1, axis2=2) + 1e-12
            damped = hessian[going] + lifted[..., None] * np.eye(self.unknowns)
            step = -np.linalg.solve(damped, gradient[going, :, None])[..., 0]
            length = _length(step)
            gain = -np.sum(step * gradient[going], axis=1)
            settled = (gain < SETTLED) & (damping[going] <= 1e-2) & (length < 0.5 * FLIP)
            # a corner of f, at an anchor: it is lower there than around
            settled |= refused[going] == MOST_REFUSED
            end[going[settled]] = f[going[settled]]
            step *= np.minimum(1.0, LONGEST / np.maximum(length, 1e-12))[:, None]
            going, step = going[~settled], step[~settled]
            tried = x[going]
            tried[:, : self.unknowns] += step
            found = self.misfit(row[going], tried)
            lower = found[0] < f[going]
            for kept, value in zip((x, f, gradient, hessian), (tried, *found)):
                kept[going[lower]] = value[lower]
            damping[going] = np.where(
                lower, np.maximum(0.2 * damping[going], 1e-6), 6.0 * damping[going]
            )
            refused[going] = np.where(lower, 0, refused[going] + 1)
            away = _length(x[going] - self.points[row[going]])
            going = going[away >= FLIP]
            if not len(going):
                break
        return end, x


def _mirrored(points: np.ndarray, corners: np.ndarray, unknowns: int) -> np.ndarray:
    """Return the other solutions of choices of k + 1 anchors: (n, C, 3) m, NaN where there is none.

    If the anchors are in a plane (line), it is the place on its other side.
    points : (n, 3) m; corners : (n, C, k + 1, 3) m, the anchors; unknowns : k
    """
    true = _length(points[:, None, None] - corners)
    away = points[:, None] - corners[:, :, 0]
    edges = np.broadcast_to(np.eye(3), (*away.shape, 3)).copy()
    block = corners[:, :, 1:, :unknowns] - corners[:, :, :1, :unknowns]
    edges[..., :unknowns, :unknowns] = block
    size = np.maximum(np.abs(block).max(axis=(2, 3)), 1e-9)
    flat = np.abs(np.linalg.det(edges)) < _FLAT * size**unknowns
    normal = np.cross(edges[..., 0, :], edges[..., 4 - unknowns, :])
    length = _length(normal)
    normal /= np.where(length < _FLAT * size ** (unknowns - 1), np.nan, length)[..., None]
    across = -2.0 * np.sum(away * normal, axis=-1, keepdims=True) * normal
    r, right = true[..., :1], np.zeros((*away.shape, 1))
    right[..., :unknowns, 0] = r - true[..., 1:]
    q = np.linalg.solve(np.where(flat[..., None, None], np.eye(3), edges), right)[..., 0]
    squared = np.sum(q**2, axis=-1, keepdims=True)
    product = np.sum((away - q * r) ** 2, axis=-1, keepdims=True)
    other = product / (np.where(squared > 1.0, squared - 1.0, np.nan) * np.maximum(r, 1e-12))
    return points[:, None] + np.where(flat[..., None], across, q * (other - r))


def _length(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors (..., k): (...). It is faster than np.linalg.norm."""
    return np.sqrt(np.einsum("...k,...k", vectors, vectors))
