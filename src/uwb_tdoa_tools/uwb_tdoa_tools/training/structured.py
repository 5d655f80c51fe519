# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Model the error of a pair as the difference of two one-anchor errors: e_ab = g(b) - g(a).

The model is antisymmetric. It holds for pairs, protocols and numbers of anchors outside the training.
g of an anchor is a sum of maps:

- A "site" map over the position of the tag: reflections and shadows of the room, and the delay. It
  belongs to an anchor at a place. It is zero for a moved or unknown anchor.
- "Link" maps over distance and direction of the anchor in the frame of the tag. If orientations are
  known, there is one over the direction of the tag in the frame of the anchor too. They model antennas
  and received power and are shared by all anchors. Gains add up in the power budget, so both maps are
  summed.

All maps are Gaussian processes on Nystroem features of some hundred centres (Williams and Seeger, NIPS
2000). The fit is one linear regression, and the standard deviation is that of its posterior. Away from
the training data the mean tends to zero and the deviation to the prior.

The regression is robust and Bayesian. The model of a row is y = w[site_b] . phi - w[site_a] . phi +
dense . v + noise, with Gaussian priors on the weights. A site is one anchor at one place. It has its own
weights on features phi of the tag. Only the blocks of two sites meet in a row, so the normal equations
are summed block by block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from onnx import ModelProto
from scipy.cluster.vq import kmeans2
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri, dtrtri
from scipy.spatial.distance import cdist

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.features import columns
from uwb_tdoa_bias.effects import Samples

from ..exporting.onnx_file import GraphBuilder
from .labels import SAME_PLACE, Labels, constellations

# Priors, chosen on the validation flights of docs/notebook/bias.md. The data scale those of the maps.
SITE_STD = (0.1, 0.1)  # m, of the short and the long part of a site map
LENGTH = (1.0, 1.0, 0.6)  # m, of the short part
LINK_STD = 0.1  # m, of each link map
NOISE = 0.1  # m, scale of the remaining errors
# largest number of Nystroem centres of a site map and of a link map
CENTRES, LINK_CENTRES = 200, 150
COARSE = 4.0  # ratio of the long to the short length of the site map
NEAREST = 0.1  # m; smaller distances are set to this value before the logarithm
LINK_LENGTH = 0.5  # of the link maps, in unit vectors and logarithms of distance
# directions of the posterior that give the deviation; others count as unknown
RANK = 64
# limit for all sites together: memory and time of the fit grow with its square and cube
SITE_WEIGHTS = 2400
_DELTA = ("dx", "dy", "dz")
_PLACE = ("x", "y", "z")
_END = ("id", "x", "y", "z")


@dataclass(frozen=True)
class Map:
    """Compute Nystroem features of a kernel.

    Parameters
    ----------
    centres : numpy.ndarray
        Centres (m, k) in scaled inputs.
    whiten : numpy.ndarray
        From kernel values to features (m, m).
    amplitudes, lengths : tuple
        Of the exponentials that add up to the kernel.
    squared : bool
        Gaussians instead of exponentials.
    """

    centres: np.ndarray
    whiten: np.ndarray
    amplitudes: tuple[float, ...]
    lengths: tuple[float, ...]
    squared: bool

    @property
    def variance(self) -> float:
        """Return the prior variance at one point, m^2."""
        return float(sum(a**2 for a in self.amplitudes))

    def scaled(self, factor: float) -> Map:
        """Return the map of a process that is `factor` times as large."""
        return replace(
            self, whiten=self.whiten / factor, amplitudes=tuple(factor * a for a in self.amplitudes)
        )

    def kernel(self, x: np.ndarray) -> np.ndarray:
        """Return kernel values (n, m) between scaled inputs (n, k) and the centres."""
        far = cdist(x, self.centres)
        parts = (-0.5 * (far / s) ** 2 if self.squared else -far / s for s in self.lengths)
        return sum(a**2 * np.exp(part) for a, part in zip(self.amplitudes, parts))

    def features(self, x: np.ndarray) -> np.ndarray:
        """Return features (n, m), uncorrelated with unit variance under the prior."""
        return self.kernel(x) @ self.whiten


def make_map(
    x: np.ndarray,
    count: int,
    amplitudes: Sequence[float],
    lengths: Sequence[float],
    squared: bool,
    seed: int,
) -> Map:
    """Return a map with up to `count` centres spread over the scaled inputs x (n, k)."""
    rng = np.random.default_rng(seed)
    some = x[rng.choice(len(x), min(len(x), 5000), replace=False)]
    centres, _ = kmeans2(some, min(count, len(some)), minit="++", seed=seed)
    centres = np.unique(centres[np.isfinite(centres).all(axis=1)], axis=0)
    made = Map(centres, np.eye(len(centres)), tuple(amplitudes), tuple(lengths), squared)
    value, vector = np.linalg.eigh(made.kernel(centres))
    kept = value > 1e-6 * value[-1]
    return replace(made, whiten=vector[:, kept] / np.sqrt(value[kept]))


class Structured:
    """Predict errors from site and link maps. `prepare` and `set_posterior` make it."""

    validity_features = ()  # it fades over positions by itself

    def __init__(self, site: Map, site_ids: np.ndarray, site_positions: np.ndarray) -> None:
        """Store the site map.

        Parameters
        ----------
        site : Map
            Over scaled positions.
        site_ids, site_positions : numpy.ndarray
            Ids (s,) and positions (s, 3), m, of the anchors.
        """
        self.site = site
        self.site_ids = site_ids
        self.site_positions = site_positions
        # "T": direction of the anchor in the frame of the tag, "A": the opposite. Empty for one place
        self.links: dict[str, Map] = {}
        self.floor = 0.0  # m, standard deviation of the remaining error

    def design(
        self, samples: Samples, error: np.ndarray | None = None, sample_weight: float = 1.0
    ) -> Design:
        """Return the design of samples.

        Anchors at no known site get the row after the last. Link maps are the dense part.
        """
        phi = self.site.features(samples.p / LENGTH)
        a, b = (self._site_of(samples.anchors)[rows] for rows in (samples.a, samples.b))
        dense = [np.zeros((len(samples), 0))]
        for viewer, link in self.links.items():
            one, other = (link.features(link_inputs(samples, side, viewer)) for side in "ab")
            dense.append(other - one)
        y = np.zeros(len(samples)) if error is None else error
        return Design(
            phi,
            a,
            b,
            np.concatenate(dense, axis=1),
            y,
            np.broadcast_to(sample_weight, len(samples)),
        )

    def _site_of(self, anchors: Anchors) -> np.ndarray:
        far = np.linalg.norm(anchors.positions[:, None] - self.site_positions, axis=2)
        far[anchors.ids[:, None] != self.site_ids] = np.inf
        return np.argmin(
            np.column_stack([far, np.full(len(far), SAME_PLACE)]), axis=1
        )  # the last row: no site is near

    def set_posterior(self, posterior: Posterior) -> None:
        """Store the weights and the sizes of the priors."""
        s = posterior.site_std
        self.site = self.site.scaled(s)
        self.weights, self.site_covariance = posterior.site / s, posterior.site_covariance / s**2
        s, first = posterior.dense_std, 0
        self.link_weights, self.link_covariances = {}, {}
        for viewer, link in self.links.items():
            mine = slice(first, first + link.whiten.shape[1])
            self.links[viewer] = link.scaled(s)
            self.link_weights[viewer] = posterior.dense[mine] / s
            self.link_covariances[viewer] = posterior.dense_covariance[mine, mine] / s**2
            first = mine.stop

    @property
    def sees_attitude(self) -> bool:
        """Return whether the prediction depends on the attitude of the tag."""
        return bool(self.links)

    @property
    def link_columns(self) -> int:
        """Return the number of dense columns of `design`."""
        return sum(link.whiten.shape[1] for link in self.links.values())

    @property
    def prior(self) -> float:
        """Return the prior variance of the error of one arrival, m^2."""
        return self.site.variance + sum(link.variance for link in self.links.values())

    def mean(self, samples: Samples) -> np.ndarray:
        """Return the predicted errors (n,), m."""
        sites = np.vstack([self.weights, np.zeros(self.weights.shape[1])])
        links = np.concatenate([np.zeros(0), *(self.link_weights[viewer] for viewer in self.links)])
        return predict(self.design(samples), sites, links)

    def variance(self, samples: Samples) -> np.ndarray:
        """Return the variance of the maps (n,), m^2, without the floor."""
        phi = self.site.features(samples.p / LENGTH)
        known, sites = _quadratic(phi, self.site_covariance), self._site_of(samples.anchors)
        at_site = sites < len(self.site_ids)
        at_a, at_b = (
            np.where(at_site[rows], known, self.site.variance) for rows in (samples.a, samples.b)
        )
        total = at_a + at_b
        for viewer, link in self.links.items():
            for side in "ab":
                phi = link.features(link_inputs(samples, side, viewer))
                total += _quadratic(phi, self.link_covariances[viewer])
        return total

    def _end_inputs(self, side: str = "a") -> list[str]:
        sites = (*_PLACE, *(f"{name}_{side}" for name in _END)) if len(self.site_ids) else ()
        angles = [
            f"{angle}_{viewer}_{side}"
            for angle in ("azimuth", "elevation")
            for viewer in self.links
        ]
        return [*sites, *(f"{name}_{side}" for name in _DELTA if self.links), *angles]

    def inputs(self) -> list[str]:
        """Return the names of the input features of one end, then of the other."""
        return [name for side in "ab" for name in self._end_inputs(side)]

    def onnx(self, meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model with the outputs bias, standard deviation and known share."""
        graph, names = GraphBuilder(), self.inputs()
        end = graph.reshaped(graph.input, -1, len(names) // 2)  # (2n, ...): each row is one end
        maps = [self._site_graph(graph, end)] if len(self.site_ids) else []
        maps += [self._link_graph(graph, end)] if self.links else []
        means, explained = zip(*maps)
        variance = graph.op("Max", graph.op("Sub", [self.prior], graph.total(explained)), [0.0])
        both, variances = (
            graph.reshaped(graph.total(means), -1, 2),
            graph.reshaped(variance, -1, 2),
        )  # (n, 2): a, b
        bias = graph.op("MatMul", both, [[-1.0], [1.0]])
        std = graph.op("Sqrt", graph.op("Add", graph.row_sum(variances), [self.floor**2]))
        worst = graph.op("ReduceMax", variances, axes=[1])
        known = graph.op("Sub", [1.0], graph.op("Mul", worst, [1.0 / self.prior]))
        meta = {
            **meta,
            "features": names,
            "offset": [0.0] * len(names),
            "scale": [1.0] * len(names),
        }
        return graph.model(len(names), [bias, std, known], meta)

    def _site_graph(self, graph: GraphBuilder, end: str) -> tuple[str, str]:
        """Return (mean, explained variance) of the site maps, each (2n, 1), from features of one end."""
        place, who, where = (graph.take(end, some) for some in ([0, 1, 2], [3], [4, 5, 6]))
        place = graph.op("Div", place, [LENGTH])
        far = graph.op("Sqrt", graph.distance2(place, self.site.centres))
        parts = [graph.op("Exp", graph.op("Mul", far, [-1.0 / s])) for s in self.site.lengths]
        values = graph.total(
            [graph.op("Mul", part, [a**2]) for part, a in zip(parts, self.site.amplitudes)]
        )
        # another id counts as far away
        other = graph.op("Mul", graph.op("Abs", graph.op("Sub", who, self.site_ids[None])), [1e3])
        far = graph.op("Add", graph.distance2(where, self.site_positions), other)
        here = graph.op("Exp", graph.op("Mul", far, [-0.5 / SAME_PLACE**2]))  # (2n, sites)
        weights = graph.op("MatMul", here, self.weights @ self.site.whiten.T)
        at_site = graph.op("Min", graph.row_sum(here), [1.0])
        known = _power(graph, values, _known_directions(self.site, self.site_covariance))
        return graph.row_sum(graph.op("Mul", weights, values)), graph.op("Mul", at_site, known)

    def _link_graph(self, graph: GraphBuilder, end: str) -> tuple[str, str]:
        """Return (mean, explained variance) of the link maps, each (2n, 1).

        The input x is the log distance and a unit vector. A Gaussian of the distance to a centre c is an
        exponential of a linear function of x and |x|^2 = (log distance)^2 + 1. One matrix product therefore
        serves all centres.
        """
        n = len(self.links)
        # the columns: 3 of the distance, n azimuths, n elevations
        first = len(self._end_inputs()) - 2 * n - 3
        delta = graph.take(end, range(first, first + 3))
        far = graph.op("Max", graph.row_sum(graph.op("Mul", delta, delta)), [NEAREST**2])
        far = graph.op("Mul", graph.op("Log", far), [0.5])
        azimuth, elevation = (graph.take(end, range(k, k + n)) for k in (first + 3, first + 3 + n))
        flat = graph.op("Cos", elevation)
        seen = [graph.op("Mul", flat, graph.op(turn, azimuth)) for turn in ("Cos", "Sin")]
        x = graph.op(
            "Concat", far, graph.op("Mul", far, far), *seen, graph.op("Sin", elevation), axis=1
        )
        slopes, levels, weights, factors = [], [], [], []
        for k, (viewer, link) in enumerate(self.links.items()):
            ((amplitude,), (length,)), c = (link.amplitudes, link.lengths), link.centres
            slope = np.zeros((2 + 3 * n, len(c)))
            slope[[0, *range(2 + k, 2 + 3 * n, n)]], slope[1] = c.T, -0.5
            slopes.append(slope / length**2)
            levels.append(np.log(amplitude**2) - 0.5 * (1.0 + np.sum(c**2, axis=1)) / length**2)
            weights.append(link.whiten @ self.link_weights[viewer])
            factors.append(_known_directions(link, self.link_covariances[viewer]))
        values = graph.op("Exp", graph.op("Gemm", x, np.hstack(slopes), np.concatenate(levels)))
        mean = graph.op("MatMul", values, np.concatenate(weights)[:, None])
        return mean, _power(graph, values, block_diag(*factors))


def _quadratic(phi: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the variance (n,) of phi (n, m) times weights with a covariance (m, m)."""
    return np.einsum("ni,ni->n", phi @ covariance, phi)


def link_inputs(samples: Samples, side: str, viewer: str) -> np.ndarray:
    """Return the inputs (n, 4) of a link map: log distance and unit vector to the other end.

    Parameters
    ----------
    samples : Samples
    side : str
        "a" or "b".
    viewer : str
        "T" for the tag or "A" for the anchor.
    """
    names = [f"{name}_{side}" for name in (*_DELTA, f"azimuth_{viewer}", f"elevation_{viewer}")]
    dx, dy, dz, azimuth, elevation = columns(samples, names).T
    far, flat = np.log(np.maximum(np.sqrt(dx**2 + dy**2 + dz**2), NEAREST)), np.cos(elevation)
    return np.stack(
        [far, flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1
    )


def _known_directions(of: Map, covariance: np.ndarray) -> np.ndarray:
    """Return the RANK directions (m, RANK) of kernel values that the data determine best."""
    share, vector = np.linalg.eigh(np.eye(len(covariance)) - covariance)
    leading = np.argsort(share)[::-1][:RANK]
    return of.whiten @ (vector[:, leading] * np.sqrt(np.maximum(share[leading], 0.0)))


def _power(graph: GraphBuilder, values: str, directions: np.ndarray) -> str:
    """Return the sum of squares (n, 1) of values (n, m) along directions (m, k)."""
    part = graph.op("MatMul", values, directions)
    return graph.row_sum(graph.op("Mul", part, part))


def prepare(all_labels: Sequence[Labels], seed: int) -> Structured:
    """Return a model without weights: sites, centres and kernels for labels."""
    ids: list[int] = []
    positions: list[np.ndarray] = []
    for one in all_labels:
        for i, p in zip(one.anchors.ids, one.anchors.positions):
            if not any(
                i == k and np.linalg.norm(p - at) < SAME_PLACE for k, at in zip(ids, positions)
            ):
                ids.append(i)
                positions.append(p)
    places = np.concatenate([one.samples.p for one in all_labels]) / LENGTH
    centres = min(CENTRES, SITE_WEIGHTS // len(ids))
    site = make_map(places, centres, SITE_STD, (1.0, COARSE), False, seed)
    model = Structured(site, np.array(ids, dtype=float), np.array(positions))
    if len(constellations(all_labels)) > 1:  # in a single one, place and direction are equivalent
        oriented = all(np.isfinite(one.anchors.orientations).all() for one in all_labels)
        for viewer in "TA" if oriented else "T":
            inputs = np.concatenate(
                [link_inputs(one.samples, side, viewer) for one in all_labels for side in "ab"]
            )
            model.links[viewer] = make_map(
                inputs, LINK_CENTRES, (LINK_STD,), (LINK_LENGTH,), True, seed
            )
    return model


ITERATIONS = 8
PRECISION = (1e-1, 1e4)  # limits of 1 / s^2
DEGREES = 3.0  # of freedom of the Student t errors


@dataclass(frozen=True)
class Design:
    """Hold the rows of a regression.

    Parameters
    ----------
    phi : numpy.ndarray
        Features of the tag (n, m).
    a, b : numpy.ndarray
        Site of each end (n,).
    dense : numpy.ndarray
        Dense columns (n, q).
    y : numpy.ndarray
        Errors (n,), m.
    sample_weight : numpy.ndarray
        Independent observations per row (n,).
    """

    phi: np.ndarray
    a: np.ndarray
    b: np.ndarray
    dense: np.ndarray
    y: np.ndarray
    sample_weight: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """Hold the fitted weights.

    Parameters
    ----------
    site, dense : numpy.ndarray
        Weights (sites, m) and (q,).
    site_covariance, dense_covariance : numpy.ndarray
        Covariances (m, m), the mean over the sites, and (q, q).
    site_std, dense_std : float
        Standard deviations of the fitted priors.
    """

    site: np.ndarray
    dense: np.ndarray
    site_covariance: np.ndarray
    dense_covariance: np.ndarray
    site_std: float
    dense_std: float


def fit(
    design: Design, sites: int, noise: float, known_std: Sequence[float] | np.ndarray = ()
) -> Posterior:
    """Fit the weights.

    The priors are N(0, s^2). The last dense weights have the standard deviations `known_std`. The other
    dense weights share one s, and the sites share another. Both maximize the evidence (MacKay, Neural
    Computation 4, 1992). Iteratively re-weighted least squares give the weights for Student t errors
    (Lange, Little and Taylor, JASA 84, 1989).

    Parameters
    ----------
    design : Design
    sites : int
        Number of sites.
    noise : float
        Scale of the errors, m.
    known_std : sequence of float

    Returns
    -------
    Posterior
    """
    m, q = design.phi.shape[1], design.dense.shape[1]
    size = sites * m
    blocks = (slice(0, size), slice(size, size + q - len(known_std)))
    prior = np.concatenate([np.ones(blocks[1].stop), np.asarray(known_std, dtype=float) ** -2.0])
    robust, groups = np.ones(len(design.y)), _groups(design.a, design.b, sites)
    for iteration in range(ITERATIONS):
        left, right = _normal_equations(
            design, groups, size, robust * design.sample_weight / noise**2
        )
        left[np.diag_indices_from(left)] += prior
        factor, _ = cho_factor(left, overwrite_a=True)
        solution = cho_solve((factor, False), right)
        weights, dense = solution[:size].reshape(sites, m), solution[size:]
        residual = design.y - predict(design, weights, dense)
        robust = (DEGREES + 1.0) / (DEGREES + (residual / noise) ** 2)
        if iteration < ITERATIONS - 1:
            variance = _inverse_diagonal(factor)
            for block in blocks:
                # number of well-determined weights
                determined = np.sum(1.0 - prior[block] * variance[block])
                prior[block] = np.clip(
                    determined / max(np.sum(solution[block] ** 2), 1e-12), *PRECISION
                )
    covariance, _ = dpotri(factor, overwrite_c=True)  # its upper triangle
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    site_covariance = np.zeros((m, m))
    for k in range(sites):
        site_covariance += covariance[k * m : (k + 1) * m, k * m : (k + 1) * m] / sites
    std = [float(prior[block][0] ** -0.5) if prior[block].size else 0.0 for block in blocks]
    return Posterior(weights, dense, site_covariance, covariance[size:, size:], *std)


def _inverse_diagonal(factor: np.ndarray) -> np.ndarray:
    """Return the diagonal (k,) of an inverse from the upper Cholesky factor (k, k).

    The factor is overwritten. This takes half the time of the whole inverse.
    """
    inverse, _ = dtrtri(factor, overwrite_c=True)
    return np.array([row[k:] @ row[k:] for k, row in enumerate(inverse)])


def _normal_equations(
    design: Design, groups: Sequence[tuple[int, int, np.ndarray]], size: int, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides of the normal equations without priors, (size + q, size + q), (size + q,).

    A row predicts the map of site b minus that of site a, plus its dense part (`predict`).

    groups : of `_groups`; size : sites * m; weight : (n,) 1/m^2, of the rows
    """
    m, q = design.phi.shape[1], design.dense.shape[1]
    left, right = np.zeros((size + q, size + q)), np.zeros(size + q)
    for a, b, rows in groups:
        phi, w = design.phi[rows], weight[rows, None]
        gram = phi.T @ (w * phi)
        vector = phi.T @ (w[:, 0] * design.y[rows])
        cross = phi.T @ (w * design.dense[rows])
        of_a, of_b = slice(a * m, (a + 1) * m), slice(b * m, (b + 1) * m)
        left[of_a, of_a] += gram
        left[of_b, of_b] += gram
        left[of_a, of_b] -= gram
        left[of_b, of_a] -= gram
        for weights_of_site, sign in ((of_a, -1.0), (of_b, 1.0)):
            right[weights_of_site] += sign * vector
            left[weights_of_site, size:] += sign * cross
    left[size:, :size] = left[:size, size:].T
    left[size:, size:] = design.dense.T @ (weight[:, None] * design.dense)
    right[size:] = design.dense.T @ (weight * design.y)
    return left, right


def predict(design: Design, weights: np.ndarray, dense: np.ndarray) -> np.ndarray:
    """Return the prediction (n,) of weights (sites, m) and dense (q,)."""
    return (
        np.einsum("nm,nm->n", design.phi, weights[design.b] - weights[design.a])
        + design.dense @ dense
    )


def _groups(a: np.ndarray, b: np.ndarray, sites: int) -> list[tuple[int, int, np.ndarray]]:
    """Return [(site a, site b, rows with these sites)]."""
    pair = a * sites + b
    order = np.argsort(pair, kind="stable")
    starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
    return [
        (int(pair[rows[0]] // sites), int(pair[rows[0]] % sites), rows)
        for rows in np.split(order, starts[1:])
    ]
