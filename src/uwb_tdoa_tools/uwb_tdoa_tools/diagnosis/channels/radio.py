# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels of TDOAs and of distances to anchors: residuals, averaged over cells.

Successive TDOAs of a pair have correlated errors. They are averaged, pair by pair, over cells of
half a second without outliers. Near the floor a cell has similar heights. The fit counts the
correlation that remains between cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np
from scipy.sparse import csc_array, csr_array

from uwb_tdoa_bias.common.sensors import COMPARED
from uwb_tdoa_bias.effects import RADIO, Effect, Samples, SmoothTerm, samples_at
from uwb_tdoa_bias.effects.samples import CATEGORIES, EXTRA, OF_ARRIVAL, OF_TDOA, ONLY_TDOA
from uwb_tdoa_bias.effects.smooth_term import OF_LINKS
from uwb_tdoa_ekf.smoother import Innovations

from ...checking.pair_rules import MANY
from ...scoring.phases import in_the_air
from ..regression.algebra import Matrix
from .base import Channel, ChannelResidual, Comparison, Figures, Rows
from .figures import figures, health_of_pairs, rows_by_value
from .views import OF_EACH, CovariateView, extra_at, extra_names, knots_of, views_of_arrivals

CELL = 0.5  # s, length of a cell
LOWEST, LEVEL = 0.02, 0.5  # m, and span of the logarithm of the height of a cell near the floor
OUTLIER = 4.0  # spreads from the median of a cell, beyond which a measurement is left out
# Effects with parameters that act on TDOAs of one or two anchors only
OF_ANCHORS = "anchor_delay", "anchor_position", "anchor_clock_drift", "pair_offset", "nlos"
WILD = 20.0  # m, largest residual of a valid measurement
FEWEST_ON_FLOOR = 50  # TDOAs near the floor; fewer are not fitted
QUICK = ("interval", *CATEGORIES)  # covariates that change from one TDOA to the next

Radio = TypeVar("Radio", bound="RadioResidual")


@dataclass(frozen=True)
class RadioResidual(ChannelResidual):
    """Residual of measurements between the tag and anchors.

    samples : Samples of the whole recording; residual : (n,) m
    airborne : (n,) bool, False near the floor before and after the flight
    fitted : (n,) bool, measurements that a fit uses: those in the air, or of `of_floor`
    floor_known : whether they are TDOAs, and the reference is valid near the floor too
    innovations : Innovations if the path is an estimate: they are the residual, and the part of an
        effect that the path follows is removed from regressors
    """

    label: ClassVar[str]  # of plots, with unit

    samples: Samples
    residual: np.ndarray
    airborne: np.ndarray
    fitted: np.ndarray
    floor_known: bool = False
    innovations: Innovations | None = None

    def of_floor(self: Radio) -> Radio | None:
        """Return the residual near the floor.

        It is None if the path is unknown there, or TDOAs are few.
        """
        near = ~self.airborne & (np.abs(self.residual) < WILD)
        if not self.floor_known or near.sum() < FEWEST_ON_FLOOR:
            return None
        return replace(self, fitted=near)

    @cached_property
    def cells(self) -> Cells:
        """Return the cells of the fitted measurements."""
        return Cells(self)

    def rows(self) -> Rows:
        cells, samples = self.cells, self.samples
        place = np.stack([cells.mean(column) for column in samples.p.T], axis=1)
        return Rows(
            cells.mean(self.residual),
            np.zeros_like(cells.pair),
            cells.pair,
            cells.t - samples.start,
            cells.size,
            place,
        )

    def columns(self, effect: Effect, keys: Sequence[str]) -> Matrix:
        samples, rows = self.samples, None
        if are_many([self]) and self.innovations is None and _of_single_anchors(effect):
            # Other measurements do not depend on these parameters.
            ids = [int(i) for key in keys for i in key.partition(".")[0].split("-")]
            named = np.isin(samples.anchors.ids, ids)
            rows = np.flatnonzero(named[samples.a] | named[samples.b])
            samples = of_rows(samples, rows)
        values = effect.regressors(samples, list(keys))
        values = np.where(np.isfinite(values), values, 0.0)
        if self.innovations is not None:
            values = self.innovations.by_bias(values)
        return self.cells.means(values, rows)

    def covariate(self, name: str) -> np.ndarray | None:
        if name in OF_ARRIVAL:
            return of_arrivals(OF_ARRIVAL[name], self.samples)[:, self.fitted].ravel()
        values = covariate_at(name, self.samples)
        return None if values is None else values[self.fitted]

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        return {self.label: (self.samples.t[self.airborne], self.residual[self.airborne])}

    @property
    def ends(self) -> np.ndarray:
        """Return the ids of the anchors of each cell, both of a TDOA or one, (e, m)."""
        rows = np.stack(self.arrivals(self.cells.pair))
        return self.samples.anchors.ids[rows][-self.samples.ends :]

    def arrivals(self, series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of anchors (a, b) for series numbers (m,) of Rows."""
        return np.divmod(series, len(self.samples.anchors))

    def place_in_room(self, series: int) -> str:
        rows = divmod(series, len(self.samples.anchors))[-self.samples.ends :]
        return "-".join(str(self.samples.anchors.ids[row]) for row in rows)


class Cells:
    """The cells of one flight, and averages over them.

    Attributes
    ----------
    chosen : (c,) indices in `samples` of the measurements that are in a cell.
    group : (c,) number of the cell of each of them.
    size : (m,) number of measurements of each cell.
    t : (m,) s, mean stamp.
    pair : (m,) number of the pair of anchors.
    """

    def __init__(self, part: RadioResidual) -> None:
        """Assign the fitted measurements of a residual to cells, without outliers."""
        samples, chosen = part.samples, np.flatnonzero(part.fitted)
        n = len(samples.anchors)
        t = samples.t[chosen]
        cell = ((t - t[0]) / CELL).astype(np.int64)
        level = (np.log(np.maximum(samples.p[chosen, 2], LOWEST) / LOWEST) / LEVEL).astype(np.int64)
        level[part.airborne[chosen]] = 0
        cell = cell * (level.max() + 1) + level
        pair = samples.a[chosen].astype(np.int64) * n + samples.b[chosen]
        label = cell * n * n + pair
        y = part.residual[chosen]
        order = np.lexsort((y, label))
        _, first, group, size = np.unique(
            label[order], return_index=True, return_inverse=True, return_counts=True
        )
        median = 0.5 * (y[order][first + (size - 1) // 2] + y[order][first + size // 2])
        away = np.abs(y[order] - median[group])
        crowded = size[group] >= 4
        scatter = 1.4826 * np.median(away[crowded]) * 1.2 if crowded.sum() > 50 else np.inf
        good = (away <= OUTLIER * scatter) & (np.abs(y[order]) < WILD)
        self.chosen = chosen[order][good]
        self.group = np.unique(group[good], return_inverse=True)[1]
        self.size = np.bincount(self.group).astype(float)
        start = np.searchsorted(self.group, np.arange(len(self.size)))
        self._members = csr_array(
            (np.ones(len(self.chosen)), self.chosen, [*start, len(self.chosen)]),
            (len(self.size), len(samples)),
        )
        self.t = self.mean(samples.t)
        self.pair = samples.a[self.chosen][start] * n + samples.b[self.chosen][start]

    def means(self, values: np.ndarray, rows: np.ndarray | None = None) -> Matrix:
        """Return means of values (n, k) of all n measurements over the m cells, (m, k).

        rows : (r,) indices of the measurements in `samples` to which values (r, k) belong. All
            other measurements count as 0, and the result is sparse.
        """
        if rows is None:
            return self._members @ values / self.size[:, None]
        # For each measurement its row of `values`, or -1. Measurements after the last one in a cell
        # have no entry.
        row_of = np.full(self.chosen.max(initial=-1) + 1, -1)
        has_entry = rows < len(row_of)
        row_of[rows[has_entry]] = np.flatnonzero(has_entry)
        inside = np.flatnonzero(row_of[self.chosen] >= 0)
        group = self.group[inside]
        members = csr_array(
            (1.0 / self.size[group], (group, row_of[self.chosen[inside]])),
            shape=(len(self.size), len(rows)),
        )
        return (members @ csc_array(values)).tocsc()

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return means of values (n,) of all n measurements over the m cells, (m,)."""
        return self._members @ values / self.size


def compared(comparison: Comparison, kind: type[Samples], made: type[Radio]) -> Radio | None:
    """Return the residual of measurements of a kind in a Comparison.

    It is None without any in the air.
    """
    flight, anchors, poses = comparison.flight, comparison.flight.anchors, comparison.poses
    innovations = comparison.view.innovations
    if innovations is not None and kind.channel not in innovations.streams:
        return None
    raw, a, b = kind.measured(flight)
    if innovations is None:
        inside = (raw.t >= poses.t[0]) & (raw.t <= poses.t[-1])
        usable = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(raw.d) & inside)
    else:
        places = innovations.places(kind.channel)
        usable = innovations.rows[places]
    t, a, b = raw.t[usable], a[usable], b[usable]
    first, last = comparison.span
    airborne = (t >= first) & (t <= last)
    if not airborne.any():
        return None
    samples = kind(**vars(samples_at(t, a, b, poses, anchors, comparison.start)))
    samples = replace(samples, vibration=comparison.vibration_at(t), extra=extra_at(flight, t))
    if kind is Samples:
        previous = np.concatenate([[-1], anchors.ids[b[:-1]]])
        samples = replace(samples, interval=np.diff(t, prepend=t[:1]), previous=previous)
    if innovations is None:
        residual = raw.d[usable] - samples.predicted() - comparison.effects.bias(samples)
    else:
        residual = innovations.value[places]
    # A vehicle that never takes off has no separate time on the floor. Late anchors near the floor
    # are searched in TDOAs only.
    knows_floor = comparison.reference.knows_floor and kind is Samples
    floor_known = knows_floor and in_the_air(poses) is not None
    return made(samples, residual, airborne, airborne, floor_known, innovations)


def of_rows(samples: Samples, rows: np.ndarray) -> Samples:
    """Return some of the Samples, with the fields that effects of single anchors use."""
    t, a, b, p, q = (
        values[rows] for values in (samples.t, samples.a, samples.b, samples.p, samples.q)
    )
    return type(samples)(t, a, b, p, q, samples.anchors, samples.start)


def _of_single_anchors(effect: Effect) -> bool:
    """Return whether each parameter acts only on TDOAs of the anchors in its name."""
    if isinstance(effect, SmoothTerm):
        return effect.form in ("anchor", *OF_LINKS) and effect.covariate in OF_EACH
    return effect.name in OF_ANCHORS


def are_many(residuals: Sequence[RadioResidual]) -> bool:
    """Return whether there are too many anchors to search functions of each anchor."""
    return any(len(part.samples.anchors) > MANY for part in residuals)


def covariate_at(name: str, samples: Samples) -> np.ndarray | None:
    """Return a covariate of OF_TDOA, or "extra.STREAM.COLUMN", (n,); None if samples lack it."""
    if name in OF_TDOA:
        return OF_TDOA[name](samples)
    return (samples.extra or {}).get(name.removeprefix(EXTRA))


def of_arrivals(
    function: Callable[[Samples, np.ndarray], np.ndarray], samples: Samples
) -> np.ndarray:
    """Return a covariate of the first and, for TDOAs, of the second anchor, (ends, n)."""
    return function(samples, samples.rows).reshape(samples.ends, -1)


class TdoaResidual(RadioResidual):
    """Residuals of TDOAs."""

    label = "TDOA [m]"


class RangeResidual(RadioResidual):
    """Residuals of distances to anchors."""

    label = "range [m]"


class RadioChannel(Channel[Radio]):
    """The channel of measurements between the tag and anchors.

    covariates : names of its covariates that are not of an arrival; of_arrival : of the others
    """

    unit: str = "m"
    covariates: tuple[str, ...]
    of_arrival: tuple[str, ...]

    def by_anchor(self, covariate: str) -> bool:
        """Return whether each anchor may have a function of a covariate of its own."""
        return True

    def smooth_terms(self, residuals: Sequence[Radio]) -> list[SmoothTerm]:
        out = []
        extra = extra_names([part.samples for part in residuals])
        for name in (*self.covariates, *extra, *self.of_arrival):
            knots = knots_of(name, [part.covariate(name) for part in residuals])
            if knots is None:
                continue
            forms = ["arrival" if name in OF_ARRIVAL else "common"]
            if self.by_anchor(name) and not are_many(residuals):
                forms.append("anchor")
            for form in forms:
                out.append(SmoothTerm(channel=self.name, covariate=name, form=form, knots=knots))
        return out

    def views(self, residuals: Sequence[Radio]) -> list[CovariateView]:
        if any(part.innovations is not None for part in residuals):
            return []  # what the path follows is not left in them
        cells = [part.cells for part in residuals]
        many = are_many(residuals)
        ends = np.concatenate([part.ends for part in residuals], axis=1)
        slow, quick, of_arrival = {}, {}, {}
        for name in (*self.covariates, *extra_names([part.samples for part in residuals])):
            found = (covariate_at(name, part.samples) for part in residuals)
            known = [values for values in found if values is not None]
            if len(known) < len(residuals) or (many and name in CATEGORIES):
                continue
            if name in QUICK:
                quick[name] = np.concatenate([v[cell.chosen] for cell, v in zip(cells, known)])
            else:
                slow[name] = np.concatenate([cell.mean(v) for cell, v in zip(cells, known)])
        for name in self.of_arrival:
            both = [of_arrivals(OF_ARRIVAL[name], part.samples) for part in residuals]
            means = [[cell.mean(v) for v in values] for cell, values in zip(cells, both)]
            of_arrival[name] = np.concatenate(means, axis=1)
        out = views_of_arrivals(self.name, ends, slow, of_arrival, many=many)
        if quick:
            first = np.cumsum([0, *(len(cell.size) for cell in cells)])
            row = np.concatenate([part.group + start for part, start in zip(cells, first)])
            out += views_of_arrivals(self.name, ends[:, row], quick, {}, row, many)
        return out


class Tdoa(RadioChannel[TdoaResidual]):
    """Differences of the distances to two anchors."""

    name = "tdoa"
    needs = "TDOAs"
    negligible = 0.004
    maps = ("x", "y", "height", "range")
    covariates = tuple(OF_TDOA)
    of_arrival = tuple(OF_ARRIVAL)

    def residual(self, comparison: Comparison) -> TdoaResidual | None:
        return compared(comparison, Samples, TdoaResidual)

    def by_anchor(self, covariate: str) -> bool:
        return covariate not in CATEGORIES and not covariate.startswith(EXTRA)

    def health(self, residuals: Sequence[TdoaResidual]) -> Figures:
        return health_of_pairs(residuals[0].samples.anchors.ids, *_flown(residuals))


class Ranging(RadioChannel[RangeResidual]):
    """The channel of a sensor that measures distances to anchors."""

    # A node corrects them without a history of the motion.
    covariates, of_arrival = (
        tuple(name for name in names if name not in ONLY_TDOA) for names in (OF_TDOA, OF_ARRIVAL)
    )

    def __init__(self, name: str) -> None:
        self.name = name
        vars(self).update(vars(COMPARED[name]))

    def residual(self, comparison: Comparison) -> RangeResidual | None:
        known = all(comparison.reference.positions_known) or comparison.view.innovations is not None
        if getattr(comparison.flight, self.name) is None or not known:
            return None
        return compared(comparison, RADIO[self.name], RangeResidual)

    def health(self, residuals: Sequence[RangeResidual]) -> Figures:
        ids = residuals[0].samples.anchors.ids
        r, _, b = _flown(residuals)
        return {
            "axes": [
                {"axis": f"{self.name} {ids[row]}", **figures(r[mine])}
                for row, mine in rows_by_value(b)
            ]
        }


def _flown(parts: Sequence[RadioResidual]) -> tuple[np.ndarray, ...]:
    """Return residuals and rows of both anchors, (n,) each, of flights in the air."""
    columns = [
        [column[part.airborne] for column in (part.residual, part.samples.a, part.samples.b)]
        for part in parts
    ]
    return tuple(np.concatenate(column) for column in zip(*columns))
