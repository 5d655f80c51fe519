# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute how constant errors of TDOAs and ranges change the innovations of a run.

The path is marginalized. The derivative of the state by each parameter follows the recorded
transitions and gains, as the state does (B. Friedland, Treatment of bias in recursive filtering,
IEEE Trans. Automatic Control 14, 1969). A fit of innovations to these derivatives therefore uses
all that the filter used: IMU, process noise, and every other measurement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.recfunctions import repack_fields

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.correction.corrector import Corrector

from .core import auxiliary
from .core.config import FilterConfig
from .core.history import RESET
from .core.memory import RESIDUAL, USED, joined, structured
from .core.state import ERROR_STATES, MOVING_STATES
from .offline import Run, run_offline, without_unknown_offset
from .results import OF_ROW

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike
    from scipy.sparse import csr_array

    from uwb_tdoa_bias.common.flight import Flight

# names of streams: TDOAs, which are not in SENSORS, and ranges
TDOAS, RANGES = ("tdoa", "range")
NEEDED = "t", "kind", "transition", "jacobian", "gain", "innovation"  # fields of a history record
# s after which a parameter without further measurements no longer affects the estimate
FORGOTTEN = 10.0


@dataclass(frozen=True, eq=False)
class Innovations:
    """Store the innovations of some streams of one run.

    Attributes
    ----------
    streams : tuple of str
        Names of the streams.
    stream : (n,) int array
        Stream of each innovation, as a place in `streams`.
    rows : (n,) int array
        Row of the measurement in its stream. Only used measurements are listed, in the order of
        their stamps.
    t : (n,) array
        Stamps, in s.
    value : (n,) array
        Innovations, in m.
    variance : (n,) array
        Variance of the innovation, in m^2: of the prediction plus one measurement.
    run : Run
        Result of the filter.
    records : list of arrays
        History of the run; empty if no derivatives are wanted.
    of : list of (m,) int arrays
        For each record the place in `rows`, or -1 for other records.
    """

    streams: tuple[str, ...]
    stream: np.ndarray
    rows: np.ndarray
    t: np.ndarray
    value: np.ndarray
    variance: np.ndarray
    run: Run
    records: list
    of: list

    def places(self, stream: str) -> np.ndarray:
        """Return the places of the innovations of one stream, (m,) int."""
        return np.flatnonzero(self.stream == self.streams.index(stream))

    def by_bias(self, regressors: np.ndarray) -> np.ndarray:
        """Return the derivative of the innovations by parameters of a bias, (n, k).

        The measured values contain the bias, and the run did not model it. A correction of the bias
        changes the innovations by minus this. The result is what remains of the regressors after
        the filter has followed the bias. A bias that the position can follow does not change the
        innovations.

        Parameters
        ----------
        regressors : (n, k) array
            Derivative of the measured values by the parameters.
        """
        regressors = np.ascontiguousarray(regressors, dtype=float)
        out, states = np.zeros_like(regressors), np.zeros((2, ERROR_STATES, regressors.shape[1]))
        no_path = np.empty(0), np.empty((0, 3, regressors.shape[1]))
        for records, of in zip(self.records, self.of):
            _propagate(records, of, regressors, states, out, no_path, 0)
        return out

    def in_blocks(
        self,
        regressors: csr_array,
        block: np.ndarray,
        stamps: ArrayLike = (),
        positions: np.ndarray | None = None,
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield the result of `by_bias` for one block of measurements at a time.

        Each block costs only as much as the parameters that matter there. A parameter matters until
        FORGOTTEN s after the last measurement that depends on it.

        Parameters
        ----------
        regressors : (n, k) sparse array
            Stored by rows; as for `by_bias`.
        block : (n,) int array
            Ascending block number of each row.
        stamps : (m,) array
            Ascending stamps of positions, in s.
        positions : (m, 3, k) array or None
            Filled with the derivatives of the estimated position at the stamps, as of `by_bias`: a
            correction moves the estimate by minus this.

        Yields
        ------
        rows : slice
            Rows of the block.
        columns : (c,) int array
            Parameters that matter in the block.
        derivative : (rows, c) array
            Derivative of the innovations.
        """
        stamps, t = np.asarray(stamps, dtype=float), self.t
        ends = np.append(np.flatnonzero(np.diff(block)) + 1, len(block))
        state = np.zeros((ERROR_STATES, regressors.shape[1]))
        last = np.full(regressors.shape[1], -np.inf)
        pieces, passed, first = _pieces(self.records, self.of, ends), 0, 0
        for end, piece in zip(ends.tolist(), pieces):
            rows = slice(first, end)
            last[regressors.indices[regressors.indptr[first] : regressors.indptr[end]]] = t[end - 1]
            columns = np.flatnonzero(last >= t[first] - FORGOTTEN)
            states = np.zeros((2, ERROR_STATES, len(columns)))
            states[0], state[:] = state[:, columns], 0.0
            known = regressors[rows][:, columns].toarray()
            path = stamps, np.zeros((len(stamps), 3, len(columns)))
            out, before = np.zeros_like(known), passed
            for records, of in piece:
                own = np.where(of >= 0, of - first, -1)
                passed = _propagate(records, own, known, states, out, path, passed)
            state[:, columns] = states[0]
            if positions is not None and passed > before:
                positions[before:passed, :, columns] = path[1][before:passed]
            yield rows, columns, out
            first = end


def _pieces(
    records: Sequence[np.ndarray], of: Sequence[np.ndarray], ends: np.ndarray
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Return [[(records, of)]] for each block of rows.

    A block includes all records before the first row of the next block.

    Parameters
    ----------
    records, of : sequence of arrays
        As in Innovations.
    ends : (b,) int array
        End of each block of rows, exclusive.
    """
    out: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in ends]
    now = 0
    for some, places in zip(records, of):
        number = np.maximum.accumulate(
            np.where(places >= 0, np.searchsorted(ends, places, side="right"), now)
        )
        for k in np.unique(number):
            first, last = np.searchsorted(number, [k, k + 1])
            out[k].append((some[first:last], places[first:last]))
        now = number[-1] if len(number) else now
    return out


class _Needed(list):
    """Collect arrays of a history, reduced to the fields that `_propagate` reads.

    This saves more than half of the memory.
    """

    def append(self, records: np.ndarray) -> None:
        super().append(repack_fields(records[[*NEEDED]]))


def record_innovations(
    flight: Flight,
    config: FilterConfig | None = None,
    corrector: Corrector | None = None,
    streams: Sequence[str] = (TDOAS,),
    derivatives: bool = True,
) -> Innovations:
    """Run bias correction and filter on a Flight without its pressure and return Innovations.

    An unknown common offset of all ranges (`range_offset_std`) is estimated first and subtracted.
    If ranges are among `streams`, the offset stays a parameter instead.

    Parameters
    ----------
    flight : Flight
        Recording.
    config : FilterConfig or None
        As for run_offline.
    corrector : Corrector or None
        As for run_offline.
    streams : sequence of str
        TDOAS, and names of SENSORS. Streams that the flight lacks or the filter does not use are
        ignored.
    derivatives : bool
        Whether to record the history, from which the Innovations compute derivatives.
    """
    corrector = corrector or Corrector(flight.anchors)
    config = replace(config or FilterConfig(), **auxiliary.NO_PRESSURE)
    if RANGES not in streams:
        flight = without_unknown_offset(flight, config, corrector)
    config = replace(config, **auxiliary.NONE)
    records = _Needed()
    run = run_offline(flight, config, corrector, records if derivatives else None)
    streams = [name for name in streams if name == TDOAS or name in run.sensors]
    corrected = corrector.effects.correct_streams(flight)
    of_tdoas = structured(RESIDUAL, *(getattr(run.residuals, name) for name in OF_ROW))
    sources = [of_tdoas if name == TDOAS else run.sensors[name] for name in streams]
    outcomes = joined(RESIDUAL, sources)
    stamps = np.concatenate([getattr(corrected, name).t for name in streams])
    used = np.flatnonzero(outcomes["verdict"] == USED)
    used = used[np.argsort(stamps[used], kind="stable")]
    t, value = stamps[used], outcomes["innovation"][used]
    first = np.cumsum([0, *map(len, sources[:-1])])
    stream = np.searchsorted(first, used, side="right") - 1
    return Innovations(
        tuple(streams),
        stream,
        used - first[stream],
        t,
        value,
        outcomes["variance"][used],
        run,
        records,
        _places_of(records, t, value),
    )


def _places_of(records: Sequence[np.ndarray], t: np.ndarray, value: np.ndarray) -> list[np.ndarray]:
    """Return Innovations.of for records and the stamps and values, (n,), of innovations."""
    waiting: dict[tuple[float, float], list[int]] = {}
    for place, key in enumerate(zip(t.tolist(), value.tolist()) if records else ()):
        waiting.setdefault(key, []).append(place)
    of = []
    for some in records:
        keys = zip(some["t"].tolist(), some["innovation"].tolist())
        of.append(
            np.array(
                [waiting[key].pop(0) if waiting.get(key) else -1 for key in keys], dtype=np.int64
            )
        )
    return of


@compiled
def _propagate(
    records: np.ndarray,
    of: np.ndarray,
    regressors: np.ndarray,
    states: np.ndarray,
    out: np.ndarray,
    path: tuple[np.ndarray, np.ndarray],
    passed: int,
) -> int:
    """Propagate derivatives through records and return how many of the stamps are passed.

    Parameters
    ----------
    records : (r,) array
        Records of the history.
    of : (r,) int array
        Row of `regressors` for each record, or -1.
    regressors : (n, k) array
        Derivative of the measured values by the parameters.
    states : (2, 15, k) array
        Derivative of the estimated state by the parameters, and room for the next one.
    out : (n, k) array
        Filled with derivatives of the innovations.
    path : ((m,) array, (m, 3, k) array)
        Stamps, in s, and position derivatives to fill.
    passed : int
        Number of stamps that are already passed.
    """
    stamps, positions = path[0], path[1]
    before, after = states[0], states[1]
    n = regressors.shape[1]
    change = np.empty(n)  # row by row below: loops over the parameters are vectorized
    for i in range(len(records)):
        record = records[i]
        while passed < len(stamps) and stamps[passed] < record.t:
            positions[passed] = before[:3]
            passed += 1
        if record.kind == RESET:
            before[:, :] = 0.0
            continue
        for r in range(ERROR_STATES):
            for j in range(n):
                after[r, j] = before[r, j] if r >= MOVING_STATES else 0.0
        for r in range(MOVING_STATES):
            for c in range(ERROR_STATES):
                step = record.transition[r, c]
                if step != 0.0:
                    for j in range(n):
                        after[r, j] += step * before[c, j]
        place = of[i]
        for j in range(n):
            change[j] = regressors[place, j] if place >= 0 else 0.0
        for c in range(ERROR_STATES):
            entry = record.jacobian[c]
            for j in range(n):
                change[j] -= entry * after[c, j]
        if place >= 0:
            out[place] = change
        for r in range(ERROR_STATES):
            gain = record.gain[r]
            for j in range(n):
                after[r, j] += gain * change[j]
        before[:, :] = after
    return passed
