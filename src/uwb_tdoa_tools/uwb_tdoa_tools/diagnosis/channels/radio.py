"""What TDOAs and distances to anchors share: residuals, and the cells that they are averaged over.

Neighbouring TDOAs are alike, so that hundreds a second are not hundreds of facts. They are
averaged, pair by pair, over cells of half a second, near the floor of half the height at most,
without the outliers of the cell; what likeness is left between cells is counted in the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np
from scipy.sparse import csc_array, csr_array

from uwb_tdoa_bias.effects import Samples, SmoothTerm, samples_at
from uwb_tdoa_bias.effects.covariates import EXTRA, OF_ARRIVAL, OF_TDOA
from uwb_tdoa_bias.effects.smooth_term import OF_LINKS
from uwb_tdoa_ekf.sensitivity import Innovations

from ...checking.pair_rules import MANY
from ...scoring.phases import in_the_air
from ..regression.algebra import Matrix
from .base import ChannelResidual, Rows
from .extra import extra_at
from .inertial import vibration_at
from .views import OF_EACH

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from .base import Comparison

CELL = 0.5  # s
LOWEST, LEVEL = (
    0.02,
    0.5,
    # m, and by how much the logarithm of a height may differ within a cell near the floor, where
    # heights matter
)
OUTLIER = 4.0  # spreads within a cell
# Effects, each of whose parameters acts on TDOAs of one or two anchors
OF_ANCHORS = "anchor_delay", "anchor_position", "anchor_clock_drift", "pair_offset", "nlos"
WILD = 20.0  # m; a larger residual is no measurement
FEWEST_ON_FLOOR = 50  # TDOAs


Radio = TypeVar("Radio", bound="RadioResidual")


@dataclass(frozen=True)
class RadioResidual(ChannelResidual):
    """samples : Samples, of the whole recording; residual (n,) m; airborne (n,) bool, False for
    those near the floor before and after; fitted (n,) bool, those that are looked at: in the air,
    but for `of_floor`; floor_known : whether the reference knows the path near the floor too;
    innovations : Innovations where the path is only an estimate: these are the residual, and what
    the path follows is taken out of regressors.
    """

    label: ClassVar[str]  # of what is plotted, with unit

    samples: Samples
    residual: np.ndarray
    airborne: np.ndarray
    fitted: np.ndarray
    floor_known: bool = False
    innovations: Innovations | None = None

    def of_floor(self: Radio) -> Radio | None:
        """The residual that looks at those near the floor alone; None if there is no telling of
        them, or they are few.
        """
        near = ~self.airborne & (np.abs(self.residual) < WILD)
        return (
            replace(self, fitted=near)
            if self.floor_known and near.sum() >= FEWEST_ON_FLOOR
            else None
        )

    @cached_property
    def cells(self) -> Cells:
        """How the TDOAs that are looked at are averaged."""
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
        if (
            are_many([self]) and self.innovations is None and _of_single_anchors(effect)
        ):  # nothing else has to do with these anchors
            named = np.isin(
                samples.anchors.ids,
                [int(i) for key in keys for i in key.partition(".")[0].split("-")],
            )
            rows = np.flatnonzero(named[samples.a] | named[samples.b])
            samples = of_rows(samples, rows)
        values = np.nan_to_num(effect.regressors(samples, list(keys)))
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

    def arrivals(self, series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Anchor rows (a, b) of series numbers (m,) in Rows."""
        return np.divmod(series, len(self.samples.anchors))


class Cells:
    """The cells of one flight, and the averages over them."""

    def __init__(self, part: RadioResidual) -> None:
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
        self.t = self.mean(samples.t)
        start = np.searchsorted(self.group, np.arange(len(self.size)))
        self.pair = samples.a[self.chosen][start] * n + samples.b[self.chosen][start]

    def means(self, values: np.ndarray, rows: np.ndarray | None = None) -> Matrix:
        """The same of several (n, k): (m, k). rows (r,) : the TDOAs that values (r, k) are of, the
        others being zero; then it is sparse.
        """
        if rows is None:
            return np.stack([self.mean(column) for column in values.T], axis=1)
        place = np.full(self.chosen.max(initial=-1) + 1, -1)
        place[rows[rows < len(place)]] = np.flatnonzero(rows < len(place))
        inside = np.flatnonzero(place[self.chosen] >= 0)
        group = self.group[inside]
        members = csr_array(
            (1.0 / self.size[group], (group, place[self.chosen[inside]])),
            shape=(len(self.size), len(rows)),
        )
        return (members @ csc_array(values)).tocsc()

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Means of values of all TDOAs (n,) over the cells: (m,)."""
        return np.bincount(self.group, values[self.chosen]) / self.size


def compared(comparison: Comparison, kind: type[Samples], made: type[Radio]) -> Radio | None:
    """What measurements of a kind in the flight of a Comparison leave of the geometry; None without
    any in the air.
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
    samples = replace(samples, vibration=vibration_at(flight.imu, t), extra=extra_at(flight, t))
    if kind is Samples:
        previous = np.concatenate([[-1], anchors.ids[b[:-1]]])
        samples = replace(samples, interval=np.diff(t, prepend=t[:1]), previous=previous)
    if innovations is None:
        residual = raw.d[usable] - samples.true() - comparison.effects.bias(samples)
    else:
        residual = innovations.value[places]
    floor_known = (
        comparison.reference.knows_floor and in_the_air(poses) is not None
    )  # what never leaves it has no time there apart
    return made(samples, residual, airborne, airborne, floor_known, innovations)


def of_rows(samples: Samples, rows: np.ndarray) -> Samples:
    """Some of the Samples, with what effects of single anchors ask for."""
    t, a, b, p, q = (
        values[rows] for values in (samples.t, samples.a, samples.b, samples.p, samples.q)
    )
    return type(samples)(t, a, b, p, q, samples.anchors, samples.start)


def _of_single_anchors(effect: Effect) -> bool:
    """Whether each parameter of an Effect acts on TDOAs of the anchors that its name begins with
    alone, whatever the others are.
    """
    if isinstance(effect, SmoothTerm):
        return effect.form in ("anchor", *OF_LINKS) and effect.covariate in OF_EACH
    return effect.name in OF_ANCHORS


def are_many(residuals: Sequence[RadioResidual]) -> bool:
    """Whether functions of each anchor of some residuals are too many to be looked for: what a few
    parameters tell is found, and those of all anchors alike.
    """
    return any(len(part.samples.anchors) > MANY for part in residuals)


def covariate_at(name: str, samples: Samples) -> np.ndarray | None:
    """One of OF_TDOA, or "extra.STREAM.COLUMN": (n,); None where the samples do not hold it."""
    return (
        OF_TDOA[name](samples)
        if name in OF_TDOA
        else (samples.extra or {}).get(name.removeprefix(EXTRA))
    )


def of_arrivals(
    function: Callable[[Samples, np.ndarray], np.ndarray], samples: Samples
) -> np.ndarray:
    """(ends, n): of the first and, where there are two, of the second anchor."""
    return function(samples, samples.rows).reshape(samples.ends, -1)
