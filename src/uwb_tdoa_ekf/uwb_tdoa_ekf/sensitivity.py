"""What constant errors of TDOAs, and of distances to anchors, would have done to the innovations of
a run: the path integrated out.

The derivative of the state by every parameter goes through the recorded transitions and gains as
the state itself does (B. Friedland, Treatment of bias in recursive filtering, IEEE Trans. Automatic
Control 14, 1969). A fit of innovations to these derivatives knows of the path whatever the filter
knew: the inertial sensor, the motion, every other measurement.
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

# streams: that of TDOAs, which is none of the SENSORS, and that of ranges
TDOAS, RANGES = ("tdoa", "range")
NEEDED = "t", "kind", "transition", "row", "gain", "innovation"  # of a record of the history
# s after which a parameter that no measurement depends on any more has left the estimate
FORGOTTEN = 10.0


@dataclass(frozen=True, eq=False)
class Innovations:
    """Those of one run, of some streams.

    streams : their names; stream (n,) int, which of them, and rows (n,) places in it of the
        measurements that were used, in the order of
    their stamps t (n,) s; value (n,) m; variance (n,) m^2, prior and one measurement; run : Run;
    records, of : history of the run, and for each record its place in `rows`, -1 for what is not of
    these streams.
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
        """(m,) places, among all, of those of one of the streams."""
        return np.flatnonzero(self.stream == self.streams.index(stream))

    def by_bias(self, regressors: np.ndarray) -> np.ndarray:
        """Derivative of minus the innovations by parameters: (n, k).

        regressors (n, k): derivative of what was measured by the parameters, of which the run knew
        nothing. A bias that the position can follow leaves no trace.
        """
        return self.and_positions(regressors, ())[0]

    def and_positions(
        self, regressors: np.ndarray, stamps: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `by_bias` gives, and the derivative of the estimated position at stamps (m,), s,
        ascending: (m, 3, k).
        """
        regressors, stamps = (
            np.ascontiguousarray(regressors, dtype=float),
            np.asarray(stamps, dtype=float),
        )
        out, positions = np.zeros_like(regressors), np.zeros((len(stamps), 3, regressors.shape[1]))
        states, passed = np.zeros((2, ERROR_STATES, regressors.shape[1])), 0
        for records, of in zip(self.records, self.of):
            passed = _through(records, of, regressors, states, out, (stamps, positions), passed)
        return out, positions

    def in_blocks(
        self,
        regressors: csr_array,
        block: np.ndarray,
        stamps: ArrayLike = (),
        positions: np.ndarray | None = None,
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """What `by_bias` gives, a block of measurements at a time, at the cost of those parameters
        that matter there: yields (rows, a slice; columns (c,); derivative (rows, c)).

        regressors : sparse, in rows, (n, k); block (n,) int, rising: number of the block of each
            row. A parameter matters until FORGOTTEN s
        after the last measurement that depends on it. positions (m, 3, k) : filled with what
        `and_positions` gives at stamps (m,).
        """
        stamps, t = np.asarray(stamps, dtype=float), self.t
        ends = np.append(np.flatnonzero(np.diff(block)) + 1, len(block))
        state, last = (
            np.zeros((ERROR_STATES, regressors.shape[1])),
            np.full(regressors.shape[1], -np.inf),
        )
        pieces, passed, first = _pieces(self.records, self.of, ends), 0, 0
        for end, piece in zip(ends.tolist(), pieces):
            rows = slice(first, end)
            last[regressors.indices[regressors.indptr[first] : regressors.indptr[end]]] = t[end - 1]
            columns = np.flatnonzero(last >= t[first] - FORGOTTEN)
            states = np.zeros((2, ERROR_STATES, len(columns)))
            states[0], state[:] = state[:, columns], 0.0
            known, moved = (
                regressors[rows][:, columns].toarray(),
                np.zeros((len(stamps), 3, len(columns))),
            )
            out, before = np.zeros_like(known), passed
            for records, of in piece:
                passed = _through(
                    records,
                    np.where(of >= 0, of - first, -1),
                    known,
                    states,
                    out,
                    (stamps, moved),
                    passed,
                )
            state[:, columns] = states[0]
            if positions is not None and passed > before:
                positions[before:passed, :, columns] = moved[before:passed]
            yield rows, columns, out
            first = end


def _pieces(
    records: Sequence[np.ndarray], of: Sequence[np.ndarray], ends: np.ndarray
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """[[(records, of)]] of each block of rows, which end before `ends` (b,): whatever comes before
    the first row of the next block.
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
    """Arrays of a history, of each of which only the fields that `_through` reads are kept: less
    than half.
    """

    def append(self, records: np.ndarray) -> None:
        super().append(repack_fields(records[[*NEEDED]]))


def record_innovations(
    flight: Flight,
    config: FilterConfig | None = None,
    corrector: Corrector | None = None,
    streams: Sequence[str] = (TDOAS,),
) -> Innovations:
    """Run a Flight through bias correction and filter, without its pressure, and keep what
    `Innovations` need of the TDOAS, and of those SENSORS among `streams` that the flight has and
    the filter uses. Takes what run_offline takes. An unknown offset of all ranges
    (`range_offset_std`) is found first and taken out of them, unless ranges are among `streams`:
    then it is among the parameters.
    """
    corrector = corrector or Corrector(flight.anchors)
    config = replace(config or FilterConfig(), **auxiliary.NO_PRESSURE)
    if RANGES not in streams:
        flight = without_unknown_offset(flight, config, corrector)
    config = replace(config, **auxiliary.NONE)
    records = _Needed()
    run = run_offline(flight, config, corrector, records)
    streams = [name for name in streams if name == TDOAS or name in run.aids]
    corrected = corrector.effects.correct_streams(flight)
    of_tdoas = structured(RESIDUAL, *(getattr(run.residuals, name) for name in OF_ROW))
    sources = [of_tdoas if name == TDOAS else run.aids[name] for name in streams]
    outcomes = joined(RESIDUAL, sources)
    stamps = np.concatenate([getattr(corrected, name).t for name in streams])
    used = np.flatnonzero(outcomes["verdict"] == USED)
    used = used[np.argsort(stamps[used], kind="stable")]
    t, value = stamps[used], outcomes["innovation"][used]
    waiting: dict[tuple[float, float], list[int]] = {}
    for place, key in enumerate(zip(t.tolist(), value.tolist())):
        waiting.setdefault(key, []).append(place)
    of = []
    for some in records:
        keys = zip(some["t"].tolist(), some["innovation"].tolist())
        of.append(
            np.array(
                [waiting[key].pop(0) if waiting.get(key) else -1 for key in keys], dtype=np.int64
            )
        )
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
        of,
    )


@compiled
def _through(
    records: np.ndarray,
    of: np.ndarray,
    regressors: np.ndarray,
    states: np.ndarray,
    out: np.ndarray,
    path: tuple[np.ndarray, np.ndarray],
    passed: int,
) -> int:
    """states (2, 15, k): derivative of the error state by the parameters, and room for the next
    one. path: stamps (m,) of which `passed` lie behind, and positions (m, 3, k); returns how many
    do then, and fills their positions.
    """
    stamps, positions = path[0], path[1]
    before, after = states[0], states[1]
    n = regressors.shape[1]
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
            change = regressors[place, j] if place >= 0 else 0.0
            for c in range(ERROR_STATES):
                change -= record.row[c] * after[c, j]
            if place >= 0:
                out[place, j] = change
            for r in range(ERROR_STATES):
                after[r, j] += record.gain[r] * change
        before[:, :] = after
    return passed
