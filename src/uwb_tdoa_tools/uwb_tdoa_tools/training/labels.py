# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute labels: the errors of the TDOAs of a flight at their true poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import hashlib
from typing import TypeVar

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import Samples, samples_at

from ..checking.pair_rules import least_height
from ..scoring.metrics import scored_phase

# s after take-off and before landing that are excluded: near the floor TDOAs are wrong by metres
MARGIN = 0.5
LARGEST_ERROR = 1.0  # m; a larger error is an outlier, not bias (Zhao et al., section V-B)
ZERO_ERROR = 1e-3  # m; smaller labels mean that the TDOAs were computed, not measured
FEWEST_LABELS = 100  # least number of labels of a flight
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
HasAnchors = TypeVar("HasAnchors", Flight, "Labels")


@dataclass(frozen=True)
class Labels:
    """Hold the labelled TDOAs of one flight.

    Parameters
    ----------
    name : str
        Name of the flight.
    samples : Samples
        With poses from ground truth.
    error : numpy.ndarray
        Measured minus geometric TDOAs (n,), m.
    digest : str
        Hexadecimal digest of the data.
    """

    name: str
    samples: Samples
    error: np.ndarray
    digest: str

    def __len__(self) -> int:
        return len(self.error)

    @property
    def anchors(self) -> Anchors:
        """Return the anchors of the flight."""
        return self.samples.anchors


def labels(flight: Flight) -> Labels:
    """Return the labels of the airborne part of a flight without outliers.

    Raises
    ------
    InputError
        If the flight has too few usable TDOAs or no ground truth.
    """
    flight = with_level_attitude(flight)
    truth, data, anchors = required_truth(flight), flight.tdoa, flight.anchors
    _, first, last = scored_phase(truth)
    first, last = first + MARGIN, last - MARGIN
    chosen = (data.t > first) & (data.t < last)
    unknown = np.setdiff1d(np.concatenate([data.a[chosen], data.b[chosen]]), anchors.ids)
    if len(unknown):
        raise InputError(
            f"{flight.name}: anchor {unknown[0]} is heard but not in the survey; add it there."
        )
    lost = int(np.sum(~np.isfinite(data.d[chosen])))
    if lost:
        raise InputError(
            f"{flight.name}: {lost} TDOAs are not finite; remove them from the recording."
        )
    if not np.isfinite(truth.p).all():
        raise InputError(
            f"{flight.name}: the ground truth has positions that are not finite; remove them."
        )
    a, b = anchors.index(data.a[chosen]), anchors.index(data.b[chosen])
    samples = samples_at(data.t[chosen], a, b, truth, anchors, float(data.t[0]), lag=None)
    error = data.d[chosen] - tdoa(samples.p, samples.position_a, samples.position_b)
    kept = (np.abs(error) <= LARGEST_ERROR) & (samples.p[:, 2] > least_height(truth)) & (a != b)
    if kept.sum() < FEWEST_LABELS:
        raise InputError(
            f"{flight.name}: only {kept.sum()} TDOAs are right to {LARGEST_ERROR:g} m; check that "
            "survey and "
            "ground truth are in one frame."
        )
    if np.max(np.abs(error[kept])) < ZERO_ERROR:
        raise InputError(
            f"{flight.name}: all labels are zero: its TDOAs were made from the ground truth itself."
        )
    samples = _rows(samples, kept)
    return Labels(flight.name, samples, error[kept], _digest(samples, error[kept]))


def required_truth(flight: Flight) -> Truth:
    """Return the ground truth of a flight.

    Raises
    ------
    InputError
        If it has none.
    """
    if flight.truth is None:
        raise InputError(f"{flight.name}: it holds no ground truth to learn from.")
    return flight.truth


def with_level_attitude(flight: Flight) -> Flight:
    """Return the flight with level attitudes at yaw 0 if some true attitudes are missing."""
    truth = required_truth(flight)
    if np.isfinite(truth.q).all():
        return flight
    return replace(flight, truth=replace(truth, q=np.tile(LEVEL, (len(truth), 1))))


def split(
    names: Sequence[str], seed: int, validation: Sequence[str] | None = None
) -> tuple[list[str], list[str]]:
    """Split flights into (training, validation) names.

    Parameters
    ----------
    names : sequence of str
    seed : int
        Draws a fifth of the flights for validation.
    validation : sequence of str, optional
        Names of the validation flights.

    Raises
    ------
    InputError
        If a part would be empty or a name is unknown or repeated.
    """
    if len(set(names)) != len(names):
        raise InputError(f"flights: {max(names, key=list(names).count)} is there twice.")
    if len(names) < 2:
        raise InputError(
            f"flights: {len(names)} is too few; give at least two, as one must be held out to "
            "validate: samples of one "
            "flight are too alike to validate each other."
        )
    if validation is None:
        count = max(1, round(0.2 * len(names)))
        validation = (
            np.random.default_rng(seed).choice(sorted(names), count, replace=False).tolist()
        )
    unknown = set(validation) - set(names)
    if unknown:
        raise InputError(
            f"validation: {sorted(unknown)[0]} is not one of the flights: {', '.join(names)}."
        )
    training = [name for name in names if name not in validation]
    if not training or not validation:
        raise InputError(
            "validation: leaves no flight to train, or none to validate; hold out some of them."
        )
    return training, sorted(validation)


def thinned(all_labels: Sequence[Labels], seconds: float, rng: np.random.Generator) -> list[Labels]:
    """Return labels with at most one random sample per `seconds` on average."""
    out = []
    for one in all_labels:
        duration = one.samples.t[-1] - one.samples.t[0]
        count = min(len(one), int(duration / seconds) + 1)
        rows = np.sort(rng.choice(len(one), count, replace=False))
        out.append(replace(one, samples=_rows(one.samples, rows), error=one.error[rows]))
    return out


def white_noise(all_labels: Sequence[Labels]) -> float:
    """Return the standard deviation of successive TDOAs of a pair, m.

    A model of the pose cannot explain it.
    """
    steps = []
    for one in all_labels:
        pair = one.samples.a * len(one.anchors) + one.samples.b
        order = np.argsort(pair, kind="stable")  # in time within each pair
        steps.append(np.diff(one.error[order])[np.diff(pair[order]) == 0])
    return float(1.4826 * np.median(np.abs(np.concatenate(steps))) / np.sqrt(2.0))


def digest(all_labels: Sequence[Labels]) -> str:
    """Return the hexadecimal digest of several Labels, in any order."""
    return hashlib.sha256("".join(sorted(one.digest for one in all_labels)).encode()).hexdigest()[
        :16
    ]


def by_constellation(some: Sequence[HasAnchors]) -> list[list[HasAnchors]]:
    """Return flights, or their labels, in groups with the same anchors at the same places."""
    groups: list[list[HasAnchors]] = []
    for one in some:
        known = one.anchors
        for group in groups:
            if group[0].anchors.stand_at(known.ids, known.positions, known.frame):
                group.append(one)
                break
        else:
            groups.append([one])
    return groups


def constellations(some: Sequence[Labels]) -> list[dict[str, list[float]]]:
    """Return the different anchor constellations as {id: position in m}, rounded to 1 cm."""
    different = [group[0].anchors for group in by_constellation(some)]
    return [
        dict(zip(map(str, anchors.ids.tolist()), anchors.positions.round(2).tolist()))
        for anchors in different
    ]


def _rows(s: Samples, rows: np.ndarray) -> Samples:
    return Samples(s.t[rows], s.a[rows], s.b[rows], s.p[rows], s.q[rows], s.anchors, s.start)


def _digest(samples: Samples, error: np.ndarray) -> str:
    content = hashlib.sha256()
    for array in (
        samples.t,
        samples.a,
        samples.b,
        samples.p,
        samples.q,
        error,
        samples.anchors.positions,
    ):
        content.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return content.hexdigest()
