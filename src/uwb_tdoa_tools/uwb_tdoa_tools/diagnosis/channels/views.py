# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Covariates of a channel: views of its rows over one, knots, and columns of logs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import ImuSamples, Samples, SensorSamples
from uwb_tdoa_bias.effects.samples import CATEGORIES, EXTRA

MOST_LINKS = 400  # pairs, both directions, whose functions are searched: as of 20 anchors
OF_EACH = "time", "range"  # covariates of single anchors if there are many anchors
PIECES = 4  # pieces of a spline
FEWEST_VALUES = 100  # fewest values of a covariate with knots
MOST_NAMES = 64  # largest number of names of a covariate of names
FEWEST_SAMPLES = 10  # fewest samples of a further stream of a log


@dataclass(frozen=True, eq=False)
class CovariateView:
    """A covariate of a subset of the rows of a channel.

    channel, form, covariate : as of a SmoothTerm; key : "", an anchor or a pair
    sides : ((signs (m,), values (m,)), ...); a function f adds the sum of sign * f(value) to a row
    rows : (m,) these rows
    means : whether rows have several values; then a row has the mean of their sums
    """

    channel: str
    form: str
    key: str
    covariate: str
    sides: tuple[tuple[np.ndarray, np.ndarray], ...]
    rows: np.ndarray
    means: bool = False


def views_of_axes(
    channels: Sequence[str], covariates: Mapping[str, np.ndarray], axis: np.ndarray
) -> list[CovariateView]:
    """Return the views of one channel per axis, such as "gyro.x".

    covariates : {name: (m,)}; axis : (m,) number of the axis
    """
    out = []
    for number, channel in enumerate(channels):
        rows = np.flatnonzero(axis == number)
        for name, values in covariates.items():
            sides = ((np.ones(len(rows)), values[rows]),)
            out.append(CovariateView(channel, "common", "", name, sides, rows))
    return out


def views_of_arrivals(
    channel: str,
    ends: np.ndarray,
    common: Mapping[str, np.ndarray],
    of_arrival: Mapping[str, np.ndarray],
    cell: np.ndarray | None = None,
    many: bool = False,
) -> list[CovariateView]:
    """Return the views of TDOAs, or of distances to anchors.

    ends : (e, n) ids of the anchors of n measurements: both of a TDOA, or one
    common : {name: (n,)}; of_arrival : {name: (e, n)}, at each end
    cell : (n,) row of each measurement, if rows have several
    many : whether there are many anchors: single ones are viewed over OF_EACH only
    """
    out: list[CovariateView] = []
    everywhere = np.arange(ends.shape[1])
    row = everywhere if cell is None else cell
    signs = (-1.0, 1.0)[-len(ends) :]  # of the arrival at each end

    def add(
        form: str, key: str, name: str, chosen: np.ndarray, *sides: tuple[np.ndarray, np.ndarray]
    ) -> None:
        there = tuple((weights, values[chosen]) for weights, values in sides)
        out.append(CovariateView(channel, form, key, name, there, row[chosen], cell is not None))

    ones = np.ones(len(everywhere))
    for name, values in common.items():
        add("common", "", name, everywhere, (ones, values))
    for name, at in of_arrival.items():
        add("arrival", "", name, everywhere, *zip([sign * ones for sign in signs], at))
    if many:
        common = {name: values for name, values in common.items() if name in OF_EACH}
        of_arrival = {name: values for name, values in of_arrival.items() if name in OF_EACH}
    for anchor in np.unique(ends).tolist():
        chosen = np.flatnonzero((ends == anchor).any(axis=0))
        own = [sign * (its[chosen] == anchor) for sign, its in zip(signs, ends)]
        for name, values in common.items():
            add("anchor", str(anchor), name, chosen, (np.sum(own, axis=0), values))
        for name, at in of_arrival.items():
            add("anchor", str(anchor), name, chosen, *zip(own, at))
    for form, first, second, chosen, signs_there in _links(*ends) if len(ends) == 2 else ():
        for name, values in common.items():
            add(form, f"{first}-{second}", name, chosen, (signs_there, values))
    return out


def _links(a: np.ndarray, b: np.ndarray) -> Iterator[tuple[str, int, int, np.ndarray, np.ndarray]]:
    """Return (form, a, b, rows, signs (m,)) of every pair, and of its directions if both occur.

    Only the MOST_LINKS most frequent ones count.
    """
    heard, count = np.unique(np.column_stack([a, b]), axis=0, return_counts=True)
    most = np.sort(np.argsort(-count, kind="stable")[:MOST_LINKS])
    for first, second in heard[most].tolist():
        forth, back = (a == first) & (b == second), (a == second) & (b == first)
        if first < second or not back.any():
            both = np.flatnonzero(forth | back)
            yield "pair", first, second, both, 1.0 * forth[both] - 1.0 * back[both]
        if back.any():
            rows = np.flatnonzero(forth)
            yield "direction", first, second, rows, np.ones(len(rows))


def knots_of(name: str, parts: Sequence[np.ndarray | None]) -> tuple[float, ...] | None:
    """Return knots of a spline over a covariate, quantiles of its values.

    For a covariate of names they are the names. None if the covariate hardly varies, or if a part
    lacks it.

    parts : values (n,) of the covariate in each flight, None if it is unknown there
    """
    known = [values for values in parts if values is not None]
    if len(known) < len(parts):
        return None
    values = np.concatenate(known)
    values = values[np.isfinite(values)]
    if len(values) < FEWEST_VALUES:
        return None
    if name in CATEGORIES:
        names = np.unique(values[values >= 0])
        return tuple(names.tolist()) if 2 <= len(names) <= MOST_NAMES else None
    low, high = np.quantile(values, [0.005, 0.995])
    if high - low < 1e-3 * max(abs(low), abs(high), 1e-3):
        return None
    knots = np.quantile(values, np.linspace(0.005, 0.995, PIECES + 1))
    # knots too close to each other to be determined
    if np.min(np.diff(knots)) < 0.02 * (high - low):
        knots = np.linspace(low, high, PIECES + 1)
    return tuple(float(f"{knot:.6g}") for knot in knots)


def extra_at(flight: Flight, t: np.ndarray) -> dict[str, np.ndarray]:
    """Return {"stream.column": (n,)} of further streams of a Flight at stamps t (n,), s.

    Such columns are temperatures, voltages or powers. Truth that a simulation logs is left out.
    """
    out = {}
    for name, columns in flight.extra.items():
        stamps = np.asarray(columns.get("t", ()), dtype=float)
        if name.endswith("_truth") or len(stamps) < FEWEST_SAMPLES:
            continue
        for column, values in columns.items():
            values = np.asarray(values)
            numeric = column != "t" and values.dtype.kind in "fiu" and values.ndim == 1
            if numeric and np.ptp(values) > 0:
                out[f"{name}.{column}"] = np.interp(t, stamps, values.astype(float))
    return out


def extra_names(parts: Sequence[Samples | ImuSamples | SensorSamples]) -> list[str]:
    """Return the covariates "extra.STREAM.COLUMN" that all samples have."""
    common = set.intersection(*(set(getattr(part, "extra", None) or ()) for part in parts))
    return [EXTRA + name for name in sorted(common)]
