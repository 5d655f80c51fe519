"""Which TDOAs and ranges one round of measurements holds, and how their errors hang together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Pairing:
    """The TDOAs of one round.

    Attributes
    ----------
    a, b : (M,) rows of the anchors, d_ab = |p - b| - |p - a|
    shared : the TDOAs of a round use one reception per anchor, whose error they share; otherwise
        every TDOA has its own
    times : how often each TDOA comes in a round (default 1)
    ranges : not differences but the distances to the anchors of `a` themselves, each measured once
        a round
    beside : Pairing, what the round holds besides, measured independently; or None
    """

    a: np.ndarray
    b: np.ndarray
    shared: bool
    times: float = 1.0
    ranges: bool = False
    beside: Pairing | None = None

    @property
    def parts(self) -> tuple[Pairing, ...]:
        """What it holds that is measured independently of each other: Pairings with nothing beside."""
        return (replace(self, beside=None), *(self.beside.parts if self.beside else ()))

    @property
    def one_solution(self) -> bool:
        """Whether it holds distances: among anchors that are not in a plane these are so from one
        place only.
        """
        return any(part.ranges for part in self.parts)

    def incidence(self) -> np.ndarray:
        """(M, N) matrix of -1 at a and +1 at b; of ranges the identity."""
        rows = np.arange(len(self.a))
        matrix = np.zeros((len(rows), 1 + max(self.a.max(), self.b.max())))
        matrix[rows, self.a], matrix[rows, self.b] = -1.0, 1.0
        return matrix

    def covariance(self, variance: np.ndarray, link_std: float = 0.0) -> np.ndarray:
        """Covariance of the TDOAs: (n, M, M) m^2.

        variance : (n, N) m^2 of the receptions. link_std : m, error that every TDOA has of its own
            besides (the
        anchor's reception of the other anchor's packet, which the tag's TDOA also contains).
        Source: eqs. 4 and 5 of Grasso et al. (Sensors 2022, 22, 9136); A18 for a common reference.
        """
        own = link_std**2 * np.eye(len(self.a))
        if self.ranges:
            return variance[:, self.a, None] * np.eye(len(self.a)) + own
        if self.shared:
            d = self.incidence()
            return (d * variance[:, None, :]) @ d.T + own
        return (variance[:, self.a] + variance[:, self.b])[:, :, None] * np.eye(len(self.a)) + own


def ring(n: int, shared: bool = True) -> Pairing:
    """TDOA2: every anchor with the next one, and the last with the first; N TDOAs."""
    return Pairing(np.arange(n), (np.arange(n) + 1) % n, shared)


def common_reference(n: int) -> Pairing:
    """Every anchor with anchor 0; N - 1 TDOAs. The case of eq. A18."""
    return Pairing(np.zeros(n - 1, int), np.arange(1, n), True)


def all_pairs(n: int) -> Pairing:
    """TDOA3: any anchor with any other, each TDOA with an error of its own; weighted to N TDOAs a
    round.
    """
    a, b = np.triu_indices(n, 1)
    return Pairing(a, b, False, 2.0 / (n - 1))


def every_range(n: int) -> Pairing:
    """Two-way ranging: the distance to every anchor; N ranges."""
    return Pairing(np.arange(n), np.arange(n), False, ranges=True)


def _beside_ranges(make: Callable[[int], Pairing]) -> Callable[[int], Pairing]:
    """Of a maker of Pairings that of the same with the distance to every anchor beside."""
    return lambda n: replace(make(n), beside=every_range(n))


PAIRINGS: dict[str, Callable[[int], Pairing]] = {
    "ring": ring,
    "ring_uncorrelated": lambda n: ring(n, shared=False),
    "common_reference": common_reference,
    "all_pairs": all_pairs,
    "every_range": every_range,
    "ring+every_range": _beside_ranges(ring),
    "all_pairs+every_range": _beside_ranges(all_pairs),
}
OF_PROTOCOL = {
    "tdoa2": "ring",
    "tdoa3": "all_pairs",
    "ranges": "every_range",
    "tdoa2+ranges": "ring+every_range",
    "tdoa3+ranges": "all_pairs+every_range",
}
