# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Residuals of flights and channels, and regressors, as one immutable table of a linear fit."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from uwb_tdoa_bias.effects import Effect
from uwb_tdoa_bias.effects.samples import RADIO

from ...checking.pair_rules import MANY
from ..channels import CHANNELS, ChannelResidual, ChannelResiduals, RadioResidual, TdoaResidual
from ..channels.views import CovariateView
from .algebra import stacked
from .terms import Column, Term

BLOCK = 5.0  # s, length of a block; blocks count as independent
AXES = 3  # largest number of axes of a channel
AT_ONCE = 32  # sparse columns that are computed together


@dataclass(frozen=True, eq=False)
class RegressionTable:
    """The n rows of a linear model y = X beta + noise, channel after channel.

    channels : names; channel : (n,) index into `channels`
    y : (n,) residual, in the unit of its channel
    group : (n,) number of an axis of a channel, AXES per channel; rows of a group share a noise
        scale
    series : (n,) int, time series of a row, distinct in each flight; block : (n,) number of its
        independent block
    flight : (n,) number; t : (n,) s since the start; count : (n,) averaged samples; place : (n, 3)
        m, world
    parts : ((flight, name of the channel, first row, ChannelResidual), ...)
    columns : {Column: (n,)}, the columns of X, shared between tables
    sparse : whether columns are pairs (rows, values); used above MANY anchors, since few are
        measured at once
    """

    channels: tuple[str, ...]
    y: np.ndarray
    channel: np.ndarray
    group: np.ndarray
    series: np.ndarray
    block: np.ndarray
    flight: np.ndarray
    t: np.ndarray
    count: np.ndarray
    place: np.ndarray
    parts: tuple[tuple[int, str, int, ChannelResidual], ...]
    columns: dict[Column, Any]
    sparse: bool = False

    @property
    def present(self) -> tuple[str, ...]:
        """Return the names of the channels with rows."""
        return tuple(self.channels[place] for place in np.unique(self.channel))

    @property
    def tdoa_parts(self) -> list[TdoaResidual]:
        """Return its residuals of TDOAs."""
        return [part for *_, part in self.parts if isinstance(part, TdoaResidual)]

    @cached_property
    def groups(self) -> list[tuple[int, slice | np.ndarray]]:
        """Return [(number, rows)] of the groups with rows.

        rows : a slice if they are contiguous, else (n,) bool
        """
        return [(k, self._rows_of_group(k)) for k in np.unique(self.group).tolist()]

    def _rows_of_group(self, group: int) -> slice | np.ndarray:
        inside = self.group == group
        first, count = int(np.argmax(inside)), int(inside.sum())
        together = slice(first, first + count)
        return together if inside[together].all() else inside

    @property
    def flights(self) -> int:
        """Return the number of flights."""
        return int(self.flight.max()) + 1

    def views(self) -> dict[str, list[CovariateView]]:
        """Return {channel: [CovariateView]} of its channels."""
        parts: dict[str, list[ChannelResidual]] = {}
        for _, name, _, part in self.parts:
            parts.setdefault(name, []).append(part)
        return {name: CHANNELS[name].views(several) for name, several in parts.items()}

    @property
    def radio_parts(self) -> list[RadioResidual]:
        """Return its residuals of measurements between the tag and anchors."""
        return [part for *_, part in self.parts if isinstance(part, RadioResidual)]

    @property
    def radio_rows(self) -> np.ndarray:
        """Return the rows of measurements between tag and anchors, (m,), channel after channel."""
        return np.flatnonzero(np.isin(self.channel, [self.channels.index(name) for name in RADIO]))

    def rows_of(self, channel: str) -> slice:
        """Return the slice of the rows of a channel, by name."""
        place = self.channels.index(channel)
        return slice(*np.searchsorted(self.channel, [place, place + 1]))

    def matrix(self, columns: Sequence[Column], rows: slice | np.ndarray = slice(None)) -> Any:
        """Return X of some Columns, (n, k), or some of its rows; sparse if the table is sparse."""
        if self.sparse and isinstance(rows, slice) and rows != slice(None):
            edges, several = (rows.start, rows.stop), [self.columns[column] for column in columns]
            parts = [(its, values, *np.searchsorted(its, edges)) for its, values in several]
            return stacked(
                [(its[i:j] - rows.start, values[i:j]) for its, values, i, j in parts],
                rows.stop - rows.start,
            )
        if self.sparse:
            x = stacked([self.columns[column] for column in columns], len(self.y))
            return x if isinstance(rows, slice) else x[rows]
        out = np.empty((len(self.y[rows]), len(columns)), order="F")
        for place, column in enumerate(columns):
            out[:, place] = self.columns[column][rows]
        return out

    def with_terms(self, terms: Iterable[Term]) -> RegressionTable:
        """Return a RegressionTable with the columns of some Terms too.

        The columns are derivatives at the values that the effects have.
        """
        wanted: dict[Hashable, tuple[Effect, dict[str, Column]]] = {}
        for term in terms:
            effect, keys = wanted.setdefault(term.effect.merge_key, (term.effect, {}))
            keys.update(
                (column.key, column) for column in term.columns if column not in self.columns
            )
        wanted = {identity: item for identity, item in wanted.items() if item[1]}
        if not wanted:
            return self
        columns = dict(self.columns)
        for effect, keys in wanted.values():
            names = tuple(keys)
            some = range(0, len(names), AT_ONCE if self.sparse else len(names))
            values = (self._values(effect, names[first : first + some.step]) for first in some)
            columns.update(zip(keys.values(), (column for x in values for column in x)))
        return replace(self, columns=columns)

    def _values(self, effect: Effect, keys: tuple[str, ...]) -> Any:
        """Return one column per key, the derivatives of y by this parameter of an Effect.

        Dense: (k, n). Sparse: an iterator of k pairs (rows, values). Rows of channels on which the
        effect does not act are 0.
        """
        blocks = (
            (first_row, part.columns(effect, keys))
            for _, channel, first_row, part in self.parts
            if channel in effect.channels
        )
        if self.sparse:
            parts = [
                (
                    first_row,
                    csc_array(np.nan_to_num(values)) if isinstance(values, np.ndarray) else values,
                )
                for first_row, values in blocks
            ]
            return _joined(parts, len(keys))
        x = np.zeros((len(self.y), len(keys)), order="F")
        for first_row, values in blocks:
            x[first_row : first_row + len(values)] = np.nan_to_num(values)
        return x.T

    def rows(self, chosen: np.ndarray) -> RegressionTable:
        """Return the RegressionTable of some rows, (n,) bool, with its columns."""
        each = ("y", "channel", "group", "series", "block", "flight", "t", "count", "place")
        arrays = {name: getattr(self, name)[chosen] for name in each}
        if not self.sparse:
            return replace(
                self,
                **arrays,
                columns={column: values[chosen] for column, values in self.columns.items()},
            )
        place = np.cumsum(chosen) - 1
        kept = {
            column: (place[rows[chosen[rows]]], values[chosen[rows]])
            for column, (rows, values) in self.columns.items()
        }
        return replace(self, **arrays, columns=kept)

    def with_contribution(
        self, effects: Iterable[tuple[Effect, Sequence[Column]]]
    ) -> RegressionTable:
        """Return a RegressionTable with the contribution of Effects, at their values, added to y.

        effects : [(Effect, its Columns)]; the table has these columns
        """
        y = self.y.copy()
        for effect, columns in effects:
            values = np.array([effect.values[column.key] for column in columns])
            y += self.matrix(columns) @ values
        return replace(self, y=y)


def _joined(parts: Sequence[tuple[int, Any]], k: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (rows, values) of each of k columns of stacked sparse matrices; rows ascend.

    parts : [(first row, csc_array (n, k))], by rising first row; none gives empty columns
    """
    for column in range(k):
        # the entries of this column in each matrix
        some = [(first_row, x, slice(*x.indptr[column : column + 2])) for first_row, x in parts]
        rows = [first_row + x.indices[entries].astype(np.int64) for first_row, x, entries in some]
        yield (
            np.concatenate([np.empty(0, np.int64), *rows]),
            np.concatenate([np.empty(0), *(x.data[entries] for _, x, entries in some)]),
        )


def table_of(residuals: Sequence[ChannelResiduals]) -> RegressionTable:
    """Return the RegressionTable of residuals, without columns.

    residuals : [{channel: ChannelResidual}], one dict per flight
    """
    parts, each = [], ("y", "channel", "group", "series", "block", "flight", "t", "count", "place")
    pieces: dict[str, list[np.ndarray]] = {key: [] for key in each}
    rows = [{name: part.rows() for name, part in flight.items()} for flight in residuals]
    start = [min(part.t.min() for part in flight.values()) for flight in rows]
    blocks = [
        1 + max(int((part.t.max() - t) / BLOCK) for part in flight.values())
        for flight, t in zip(rows, start)
    ]
    offset, first = np.concatenate([[0], np.cumsum(blocks)]), 0
    channels = tuple(CHANNELS)
    for place, name in enumerate(channels):
        for number, flight in enumerate(rows):
            if name not in flight:
                continue
            part = flight[name]
            n = len(part.y)
            parts.append((number, name, first, residuals[number][name]))
            first += n
            pieces["block"].append(offset[number] + ((part.t - start[number]) / BLOCK).astype(int))
            pieces["channel"].append(np.full(n, place))
            pieces["group"].append(AXES * place + part.axis)
            pieces["flight"].append(np.full(n, number))
            for key in ("y", "series", "t", "count", "place"):
                pieces[key].append(getattr(part, key))
    merged = {key: np.concatenate(several) for key, several in pieces.items()}
    many = any(
        len(part.samples.anchors) > MANY for *_, part in parts if isinstance(part, RadioResidual)
    )
    return RegressionTable(channels, **merged, parts=tuple(parts), columns={}, sparse=many)
