"""What a part of a channel may depend on: one covariate of an anchor, a pair, a direction, an axis, or of all."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class View:
    """A covariate of a subset of the rows of a channel.

    channel, form, covariate : as of a SmoothTerm; key : "" or an anchor or a pair; sides : ((signs (n,), values (n,)), ...): a
    function f of the covariate adds the sum of sign * f(value) to each row; cell (n,), if there is more than one value to a row: the
    row, of which the sum is the mean.
    """

    channel: str
    form: str
    key: str
    covariate: str
    sides: tuple
    cell: np.ndarray | None = None


def views_of_axes(channels, covariates, axis):
    """[View] of SmoothTerm channels such as "gyro.x", one for each axis; covariates : {name: (m,)}; axis (m,) number."""
    return [
        View(channel, "common", "", name, ((1.0 * (axis == k), values),))
        for k, channel in enumerate(channels)
        for name, values in covariates.items()
    ]


def views_of_pairs(a, b, of_tdoa, of_arrival, cell=None):
    """[View] of TDOAs between anchors of ids a, b (n,). of_tdoa : {name: (n,)}; of_arrival : {name: (2, n)}, of a and of b; cell :
    see View."""
    out, ones = [], np.ones(len(a))
    for name, values in of_tdoa.items():
        out.append(View("tdoa", "common", "", name, ((ones, values),)))
    for name, (at_a, at_b) in of_arrival.items():
        out.append(View("tdoa", "arrival", "", name, ((-ones, at_a), (ones, at_b))))
    for anchor in np.unique(np.concatenate([a, b])).tolist():
        from_a, to_b = -1.0 * (a == anchor), 1.0 * (b == anchor)
        out += [View("tdoa", "anchor", str(anchor), name, ((from_a + to_b, values),)) for name, values in of_tdoa.items()]
        out += [
            View("tdoa", "anchor", str(anchor), name, ((from_a, at_a), (to_b, at_b)))
            for name, (at_a, at_b) in of_arrival.items()
        ]
    for form, first, second, signs in _links(a, b):
        out += [View("tdoa", form, f"{first}-{second}", name, ((signs, values),)) for name, values in of_tdoa.items()]
    return out if cell is None else [replace(view, cell=cell) for view in out]


def _links(a, b):
    """(form, a, b, signs (m,)) of every pair, and of its directions where both were heard."""
    heard = np.unique(np.column_stack([a, b]), axis=0).tolist()
    for first, second in heard:
        forth, back = 1.0 * ((a == first) & (b == second)), 1.0 * ((a == second) & (b == first))
        if first < second or not back.any():
            yield "pair", first, second, forth - back
        if back.any():
            yield "direction", first, second, forth
