"""What a part of a channel may depend on: one covariate of an anchor, a pair, a direction, an axis, or of all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


@dataclass(frozen=True, eq=False)
class CovariateView:
    """A covariate of a subset of the rows of a channel.

    channel, form, covariate : as of a SmoothTerm; key : "" or an anchor or a pair; sides : ((signs (n,), values (n,)), ...): a
    function f of the covariate adds the sum of sign * f(value) to each row; cell (n,), if there is more than one value to a row: the
    row, of which the sum is the mean.
    """

    channel: str
    form: str
    key: str
    covariate: str
    sides: tuple[tuple[np.ndarray, np.ndarray], ...]
    cell: np.ndarray | None = None


def views_of_axes(
    channels: Sequence[str], covariates: Mapping[str, np.ndarray], axis: np.ndarray
) -> list[CovariateView]:
    """[CovariateView] of SmoothTerm channels such as "gyro.x", one for each axis; covariates : {name: (m,)}; axis (m,)
    number."""
    return [
        CovariateView(channel, "common", "", name, ((1.0 * (axis == k), values),))
        for k, channel in enumerate(channels)
        for name, values in covariates.items()
    ]


def views_of_pairs(
    a: np.ndarray, b: np.ndarray, of_tdoa: Mapping[str, np.ndarray], of_arrival: Mapping[str, np.ndarray],
    cell: np.ndarray | None = None,
) -> list[CovariateView]:  # fmt: skip
    """[CovariateView] of TDOAs between anchors of ids a, b (n,). of_tdoa : {name: (n,)}; of_arrival : {name: (2, n)},
    of a and of b; cell : see CovariateView."""
    out, ones = [], np.ones(len(a))
    for name, values in of_tdoa.items():
        out.append(CovariateView("tdoa", "common", "", name, ((ones, values),)))
    for name, (at_a, at_b) in of_arrival.items():
        out.append(CovariateView("tdoa", "arrival", "", name, ((-ones, at_a), (ones, at_b))))
    for anchor in np.unique(np.concatenate([a, b])).tolist():
        from_a, to_b = -1.0 * (a == anchor), 1.0 * (b == anchor)
        out += [
            CovariateView("tdoa", "anchor", str(anchor), name, ((from_a + to_b, values),))
            for name, values in of_tdoa.items()
        ]
        out += [
            CovariateView("tdoa", "anchor", str(anchor), name, ((from_a, at_a), (to_b, at_b)))
            for name, (at_a, at_b) in of_arrival.items()
        ]
    for form, first, second, signs in _links(a, b):
        key = f"{first}-{second}"
        out += [CovariateView("tdoa", form, key, name, ((signs, values),)) for name, values in of_tdoa.items()]
    return out if cell is None else [replace(view, cell=cell) for view in out]


def _links(a: np.ndarray, b: np.ndarray) -> Iterator[tuple[str, int, int, np.ndarray]]:
    """(form, a, b, signs (m,)) of every pair, and of its directions where both were heard."""
    heard = np.unique(np.column_stack([a, b]), axis=0).tolist()
    for first, second in heard:
        forth, back = 1.0 * ((a == first) & (b == second)), 1.0 * ((a == second) & (b == first))
        if first < second or not back.any():
            yield "pair", first, second, forth - back
        if back.any():
            yield "direction", first, second, forth
