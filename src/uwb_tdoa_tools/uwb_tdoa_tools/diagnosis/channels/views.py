"""What a part of a channel may depend on: one covariate of an anchor, a pair, a direction, an axis,
or of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

MOST_LINKS = (
    400  # pairs of anchors, in both directions, whose functions are looked for: those of 20 anchors
)
OF_EACH = "time", "range"  # covariates of each of many anchors


@dataclass(frozen=True, eq=False)
class CovariateView:
    """A covariate of a subset of the rows of a channel.

    channel, form, covariate : as of a SmoothTerm; key : "" or an anchor or a pair; sides : ((signs
        (m,), values (m,)), ...): a
    function f of the covariate adds the sum of sign * f(value) to a row; rows (m,) : to which.
    Where there is more than one value to a row, `means`, the sum is their mean.
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
    """[CovariateView] of SmoothTerm channels such as "gyro.x", one for each axis; covariates :
    {name: (m,)}; axis (m,) number.
    """
    return [
        CovariateView(channel, "common", "", name, ((np.ones(len(rows)), values[rows]),), rows)
        for channel, rows in zip(
            channels, map(np.flatnonzero, axis == np.arange(len(channels))[:, None])
        )
        for name, values in covariates.items()
    ]


def views_of_anchors(
    channel: str,
    anchor: np.ndarray,
    common: Mapping[str, np.ndarray],
    of_each: Mapping[str, np.ndarray],
    many: bool = False,
) -> list[CovariateView]:
    """[CovariateView] of distances to anchors of ids `anchor` (n,). common, of_each : {name: (n,)},
    of the tag, and of the anchor; many : as of `views_of_pairs`.
    """
    everywhere, ones, both = np.arange(len(anchor)), np.ones(len(anchor)), {**common, **of_each}
    out = [
        CovariateView(
            channel,
            "common" if name in common else "arrival",
            "",
            name,
            ((ones, values),),
            everywhere,
        )
        for name, values in both.items()
    ]
    for i in np.unique(anchor).tolist():
        chosen = np.flatnonzero(anchor == i)
        names = [name for name in both if name in OF_EACH or not many]
        out += [
            CovariateView(
                channel, "anchor", str(i), name, ((ones[chosen], both[name][chosen]),), chosen
            )
            for name in names
        ]
    return out


def views_of_pairs(
    a: np.ndarray,
    b: np.ndarray,
    of_tdoa: Mapping[str, np.ndarray],
    of_arrival: Mapping[str, np.ndarray],
    cell: np.ndarray | None = None,
    many: bool = False,
) -> list[CovariateView]:
    """[CovariateView] of TDOAs between anchors of ids a, b (n,). of_tdoa : {name: (n,)}; of_arrival
    : {name: (2, n)}, of a and of b; cell (n,) : row of each, where there are several to a row; many
    : whether there are so many anchors that single ones are looked at over OF_EACH alone.
    """
    out: list[CovariateView] = []
    n = len(a)
    row = np.arange(n) if cell is None else cell

    def add(
        form: str, key: str, name: str, chosen: np.ndarray, *sides: tuple[np.ndarray, np.ndarray]
    ) -> None:
        out.append(
            CovariateView(
                "tdoa",
                form,
                key,
                name,
                tuple((signs, values[chosen]) for signs, values in sides),
                row[chosen],
                cell is not None,
            )
        )

    everywhere, ones = np.arange(n), np.ones(n)
    for name, values in of_tdoa.items():
        add("common", "", name, everywhere, (ones, values))
    for name, (at_a, at_b) in of_arrival.items():
        add("arrival", "", name, everywhere, (-ones, at_a), (ones, at_b))
    if many:
        of_tdoa, of_arrival = (
            {name: values for name, values in some.items() if name in OF_EACH}
            for some in (of_tdoa, of_arrival)
        )
    for anchor, chosen in _members(a, b):
        from_a, to_b = -1.0 * (a[chosen] == anchor), 1.0 * (b[chosen] == anchor)
        for name, values in of_tdoa.items():
            add("anchor", str(anchor), name, chosen, (from_a + to_b, values))
        for name, (at_a, at_b) in of_arrival.items():
            add("anchor", str(anchor), name, chosen, (from_a, at_a), (to_b, at_b))
    for form, first, second, chosen, signs in _links(a, b):
        for name, values in of_tdoa.items():
            add(form, f"{first}-{second}", name, chosen, (signs, values))
    return out


def _members(a: np.ndarray, b: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(anchor, rows (m,) that it is in) of every anchor."""
    for anchor in np.unique(np.concatenate([a, b])).tolist():
        yield anchor, np.flatnonzero((a == anchor) | (b == anchor))


def _links(a: np.ndarray, b: np.ndarray) -> Iterator[tuple[str, int, int, np.ndarray, np.ndarray]]:
    """(form, a, b, rows, signs (m,)) of every pair, and of its directions where both were heard; of
    MOST_LINKS that were heard most.
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
