"""A recording in order, as the rules that try things see it, and what is found unexplained in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.flight import Flight, Imu, Tdoas
from uwb_tdoa_ekf.core.memory import TDOA, structured
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_ekf.streams.explain import unexplained
from uwb_tdoa_ekf.streams.ranging import BEYOND

from .survey_fit import SurveyFit

if TYPE_CHECKING:
    from uwb_tdoa_ekf.streams.explain import Unexplained

    from .recording import Recording

LONG, SHORT = (
    60.0,
    14.0,
)  # s of the recording that are tried: to be sure, and to choose what is worth being sure of
PERIOD = 1.0  # s over which the motion is measured that says which part is tried


@dataclass(frozen=True)
class OrderedRecording:
    """anchors : Anchors; tdoa : Tdoas and imu : Imu or None, in order of their stamps and finite."""

    anchors: Anchors
    tdoa: Tdoas
    imu: Imu | None

    @classmethod
    def of(cls, recording: Recording) -> OrderedRecording:
        """OrderedRecording of a Recording."""
        tdoa, imu = recording.tdoa, recording.imu
        good = np.flatnonzero(np.isfinite(tdoa.t) & np.isfinite(tdoa.d))
        tdoa = rows_of(tdoa, good[np.argsort(tdoa.t[good], kind="stable")])
        if imu is not None:
            good = np.flatnonzero(
                np.isfinite(np.column_stack([imu.t, imu.gyro, imu.accel])).all(axis=1)
            )
            imu = rows_of(imu, good[np.argsort(imu.t[good], kind="stable")])
        return cls(recording.anchors, tdoa, imu if imu is not None and len(imu) else None)

    def part(self, length: float) -> OrderedRecording:
        """The `length` s in which the TDOAs move most; the whole if it is not longer."""
        t = self.tdoa.t
        if not len(t) or t[-1] - t[0] <= length:
            return self
        begin = _busiest(self, length)
        first, end = np.searchsorted(t, [begin, begin + length])
        imu = self.imu
        if imu is not None:
            imu = rows_of(imu, slice(*np.searchsorted(imu.t, [begin, begin + length])))
        return replace(
            self,
            tdoa=rows_of(self.tdoa, slice(first, end)),
            imu=imu if imu is not None and len(imu) else None,
        )

    def with_tdoa(self, **columns: np.ndarray) -> OrderedRecording:
        """The same with other columns of the TDOAs."""
        return replace(self, tdoa=replace(self.tdoa, **columns))

    def with_imu(self, **columns: np.ndarray) -> OrderedRecording:
        """The same with other columns of the inertial samples."""
        assert self.imu is not None
        return replace(self, imu=replace(self.imu, **columns))

    def possible(self) -> OrderedRecording:
        """The same without TDOAs that are longer than their anchors are apart."""
        a, b = self.rows()
        apart = np.linalg.norm(self.anchors.positions[a] - self.anchors.positions[b], axis=1)
        kept = (a < 0) | (b < 0) | (np.abs(self.tdoa.d) <= apart + BEYOND)
        return replace(self, tdoa=rows_of(self.tdoa, np.flatnonzero(kept)))

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the anchors of each TDOA: two (n,) arrays, -1 where an id is unknown."""
        return self.anchors.index(self.tdoa.a), self.anchors.index(self.tdoa.b)

    def unexplained(self, limit: float = math.inf) -> Unexplained:
        """Unexplained of the TDOAs alone. limit : mean loss from which on it is of no interest (see
        streams.explain).
        """
        rows = structured(TDOA, self.tdoa.t, *self.rows(), self.tdoa.d)
        return unexplained(rows, self.anchors.positions, limit=limit)

    @cached_property
    def survey_fit(self) -> SurveyFit:
        """SurveyFit of the TDOAs between known anchors."""
        a, b = self.rows()
        known = (a >= 0) & (b >= 0) & (a != b)
        return SurveyFit(
            self.tdoa.t[known], a[known], b[known], self.tdoa.d[known], self.anchors.positions
        )

    def flight(self) -> Flight:
        """Flight without ground truth."""
        return Flight("checked", self.anchors, self.tdoa, self.imu)


def _busiest(recording: OrderedRecording, length: float) -> float:
    """Stamp at which the `length` s begin in which the TDOAs of each pair change most from second
    to second.
    """
    t, d = recording.tdoa.t, recording.tdoa.d
    pair = np.unique(recording.tdoa.a * 65536 + recording.tdoa.b, return_inverse=True)[1].reshape(
        -1
    )
    second = np.floor((t - t[0]) / PERIOD).astype(np.int64)
    order = np.lexsort((second, pair))
    begins = np.flatnonzero(np.diff(pair[order], prepend=-1) | np.diff(second[order], prepend=-1))
    mean = np.add.reduceat(d[order], begins) / np.diff(begins, append=len(order))
    pair, second = (
        pair[order][begins],
        second[order][begins],
    )  # a row for each pair and each second in which it has TDOAs
    following = (np.diff(pair) == 0) & (np.diff(second) == 1)
    seconds, place = np.unique(
        second, return_inverse=True
    )  # those with TDOAs: a pause takes no room
    motion = np.bincount(
        place[1:][following],
        np.minimum(np.abs(np.diff(mean))[following], 1.0),
        minlength=len(seconds),
    )
    total, n = np.concatenate([[0.0], np.cumsum(motion)]), int(length / PERIOD)
    until = np.searchsorted(seconds, seconds + n)
    best = int(seconds[np.argmax(total[until] - total[:-1])])
    return t[0] + min(best * PERIOD, t[-1] - t[0] - length)
