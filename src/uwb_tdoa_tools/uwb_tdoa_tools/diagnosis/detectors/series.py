"""TDOA residuals in the air, sorted by pair and time: what the detectors of noise look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...clock import numbered
from ..channels import tdoa_parts
from ..regression.table import BLOCK

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..channels import ChannelResiduals
    from ..channels.tdoa import TdoaResidual


@dataclass(frozen=True)
class Series:
    """t (n,) s; residual (n,) m; a, b (n,) anchor rows; pair (n,) a number for each ordered pair;
    block (n,) of 5 s.
    """

    t: np.ndarray
    residual: np.ndarray
    a: np.ndarray
    b: np.ndarray
    pair: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, part: TdoaResidual) -> Series:
        """Series of a TdoaResidual."""
        samples, rows = part.samples, np.flatnonzero(part.airborne)
        pair = samples.a * 100000 + samples.b
        order = rows[np.lexsort((samples.t[rows], pair[rows]))]
        t = samples.t[order]
        block = numbered(t, BLOCK)
        return cls(t, part.residual[order], samples.a[order], samples.b[order], pair[order], block)

    def steps(self, lag: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """(places, following places) of one pair, `lag` apart in order."""
        first = np.flatnonzero(self.pair[lag:] == self.pair[:-lag])
        return first, first + lag

    def label(self) -> np.ndarray:
        """(n,) pairs numbered from 0 on without gaps."""
        return np.unique(self.pair, return_inverse=True)[1]


def series_of(residuals: Sequence[ChannelResiduals]) -> list[Series]:
    """[Series] of [{channel: ChannelResidual}]."""
    return [Series.of(part) for part in tdoa_parts(residuals)]
