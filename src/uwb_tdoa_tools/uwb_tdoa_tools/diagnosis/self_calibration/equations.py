# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of anchor positions and delays, from flights without ground truth.

A filter run gives innovations and their derivatives by each position and delay, with the path
marginalized (`uwb_tdoa_ekf/smoother.py`). Other systematic errors, from antennas, metal or
floors, are a smooth function of the place for each anchor, also marginalized. It is a Gaussian
process in random Fourier features (Rahimi and Recht, Random features for large-scale kernel
machines, NIPS 2007). The evidence selects the sizes of delays and functions (`prior.py`). Where
functions explain an error as well as shifts do, the shifts stay at the prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csr_array, hstack

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import AnchorDelay, Effect, EffectSet, Samples
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_bias.effects.samples import RADIO
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.evidence import FUNCTION_LENGTH, MOVED
from uwb_tdoa_ekf.offline import without_unknown_offset
from uwb_tdoa_ekf.results import Odometry
from uwb_tdoa_ekf.smoother import TDOAS

from ...checking.pair_rules import MANY
from ...parallel import MapFunction
from ...scoring.phases import AIRBORNE
from ..channels import Comparison, RadioResidual
from ..channels.radio import RangeResidual, TdoaResidual, compared, of_rows
from ..constraints import Constraint, Distance, Mark
from ..references import Nothing
from ..regression.fit import NU, student_scale
from .prior import Prior

COUNTED = 6.0  # TDOAs that the filter counts as one on flights with some 400 TDOAs a second
BLOCK = 3.0  # s, length of the blocks whose score sums measure the inflation
# Divisor of the information in addition to the inflation: errors that last a flight are not noise.
SYSTEMATIC = 12.0
PRELIMINARY = 20.0  # the same, for the preliminary solution that measures the inflation
DETERMINED = 1e-4  # smallest eigenvalue of a determined direction, relative to the largest
FEWEST = 4  # fewest measurements in a cell; with fewer, noise hides slow errors
RESIDUALS = {
    kind.channel: RangeResidual if kind.ends == 1 else TdoaResidual for kind in RADIO.values()
}
FEATURES = 20  # number of features of a function
AT_ONCE = 32  # regressors that are computed together


def tdoa_std_of(
    flights: Sequence[Flight],
    effects: EffectSet,
    config: FilterConfig | None = None,
    map_function: MapFunction = map,
) -> float:
    """Return the tdoa_std, m, that matches the innovations of Flights with the EffectSet `effects`.

    Ground truth is not used.

    map_function : as of `attribution.attribute`
    """
    config, anchors = config or FilterConfig(), flights[0].anchors
    prior_std = Prior.of(anchors, np.full((len(anchors), 3), MOVED)).loose
    runs, no_delays = Runs(flights, effects, config, streams=(TDOAS,)), np.zeros(len(anchors))
    return runs.equations(
        anchors, no_delays, prior_std, map_function=map_function, functions=False
    ).tdoa_std(config)


def measured_noise(
    flights: Sequence[Flight],
    effects: EffectSet,
    config: FilterConfig | None = None,
    map_function: MapFunction = map,
    say: Callable[[str], object] = lambda why: None,
) -> float | None:
    """Return `tdoa_std_of`, or call say(reason) and return None if the flights are too short."""
    try:
        return tdoa_std_of(flights, effects, config, map_function)
    except InputError as error:
        say(f"the noise of TDOAs is not measured: {error}")
        return None


def slow_innovations(
    flights: Sequence[Flight], effects: EffectSet, config: FilterConfig | None = None
) -> float:
    """Return the scale of the slow innovations of Flights with the EffectSet `effects`, m.

    Innovations are averaged over half a second. Wrong anchor positions and delays leave slow
    innovations. Ground truth is not used. Raises InputError for a flight that is too short.
    """
    anchors = flights[0].anchors
    return Runs(flights, effects, config or FilterConfig()).slow_innovations(
        anchors, np.zeros(len(anchors))
    )


def path_by_anchors(
    flight: Flight, effects: EffectSet, config: FilterConfig | None = None
) -> list[np.ndarray]:
    """Return derivatives of the position in each BLOCK by anchors, [(3, 4N)].

    They are by all coordinates, anchor by anchor, then by all delays. In a block the error of the position is
    constant, and fits the TDOAs best, or the ranges: both are returned. Ground truth is not used.
    """
    runs, anchors = Runs([flight], effects, config), flight.anchors
    _, parts = _residuals(
        effects, runs._of_innovations, anchors, np.zeros(len(anchors)), runs.flights[0], None
    )
    out = []
    for part in parts:
        samples = part.samples
        by_place, by_anchor = samples.position_jacobian(), _regressors(samples, functions=False)
        block = np.floor((samples.t - samples.t[0]) / BLOCK)
        for number in np.unique(block):
            rows = block == number
            out.append((by_anchor[rows].T @ np.linalg.pinv(by_place[rows]).T).T)
    return out


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of one flight, or of all flights.

    The parameters are the errors of positions and delays that the run did not model.

    gram : (k, k); vector : (k,); marks : [_Mark] that add to them
    slow : (n,) m, slow innovations
    inflation : variance of score sums over blocks, relative to independent errors, for which it is 1.
        A score is the gradient of the log-likelihood.
    seconds : s of data used; marks_on_floor : number of marks on the floor, which are not used
    flights : [Equations] of single flights; empty above MANY anchors, where they would take
        gigabytes
    """

    gram: np.ndarray
    vector: np.ndarray
    marks: list[_Mark]
    slow: np.ndarray
    inflation: float
    seconds: float
    marks_on_floor: int
    flights: Sequence[Equations] = ()

    @property
    def slow_scale(self) -> float:
        """Return the scale of the slow innovations, m."""
        return student_scale(self.slow)

    def tdoa_std(self, config: FilterConfig) -> float:
        """Return the tdoa_std, m, at which the filter's information matches the inflated noise.

        The filter divides the information of each TDOA by about COUNTED. The data ask for a division
        by the inflation.
        """
        return config.tdoa_std * float(np.sqrt(self.inflation / COUNTED))


class Runs:
    """Filter runs of Flights under varied anchor positions and delays.

    spans : {flight: (first, last) s} in the air, or in motion on the floor, from the first run.
        Later runs keep it: other anchors can move the estimate to the floor, but not the tag.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        base: EffectSet,
        config: FilterConfig | None,
        constraints: Sequence[Constraint] = (),
        streams: Sequence[str] = tuple(RADIO),
    ) -> None:
        """Prepare Flights without their ground truth.

        base : EffectSet of the model; config : FilterConfig
        constraints : marks and distances; streams : names in RADIO that are used
        """
        self._base = base
        self._config = config or FilterConfig()
        self._reference = Nothing(config, streams=streams)
        self._of_innovations = Nothing(config, streams=streams, derivatives=False)
        self.spans: dict[str, tuple[float, float]] = {}
        self.flights = [self._reference.prepare(flight) for flight in flights]
        self._of_anchors = [one for one in constraints if isinstance(one, Distance)]
        self._marks = [one for one in constraints if isinstance(one, Mark)]

    def slow_innovations(self, anchors: Anchors, delays: np.ndarray) -> float:
        """Return the scale of the slow innovations of all flights under Anchors, m.

        The offset of all ranges is corrected first, because the filter estimates it.

        delays : (N,) m
        """
        corrector = Corrector(anchors, _with_delays(self._base, anchors, delays))
        slow = []
        for prepared in self.flights:
            flight = without_unknown_offset(
                replace(prepared, anchors=anchors), self._config, corrector
            )
            span = self.spans.get(flight.name)
            slow.append(
                _slow(
                    _residuals(self._base, self._of_innovations, anchors, delays, flight, span)[1]
                )
            )
        return student_scale(_joined(slow))

    def equations(
        self,
        anchors: Anchors,
        delays: np.ndarray,
        prior_std: np.ndarray,
        progress: Callable[[], object] = lambda: None,
        map_function: MapFunction = map,
        functions: bool = True,
    ) -> Equations:
        """Return the Equations linearized at Anchors and delays.

        delays : (N,) m
        prior_std : (4N,) m, of positions and delays in the preliminary solution. At this solution
            the mean score is near 0, and the inflation is measured.
        functions : whether to include functions of the place; the inflation does not need them
        """
        items = [
            (
                flight,
                self.spans.get(flight.name),
                [one for one in self._marks if one.flight == flight.name],
            )
            for flight in self.flights
        ]
        of_flight = partial(
            _of_flight, self._base, self._reference, (anchors, delays), prior_std, functions
        )
        several = []
        for (one, span), flight in zip(map_function(of_flight, items), self.flights):
            self.spans[flight.name] = span
            several.append(one)
            progress()
        marks = [mark for one in several for mark in one.marks]
        pieces = [(one.gram, one.vector) for one in several]
        pieces += [(mark.gram, mark.vector) for mark in marks]
        pieces += [one.equations(anchors, len(several[0].vector)) for one in self._of_anchors]
        return Equations(
            gram=sum((gram for gram, _ in pieces), np.zeros(())),
            vector=sum((vector for _, vector in pieces), np.zeros(())),
            marks=marks,
            slow=_joined([one.slow for one in several]),
            inflation=float(np.mean([one.inflation for one in several])),
            seconds=sum(one.seconds for one in several),
            marks_on_floor=sum(one.marks_on_floor for one in several),
            flights=several if len(anchors) <= MANY else (),
        )


def _joined(several: Sequence[np.ndarray]) -> np.ndarray:
    """Return the slow innovations of all flights, (n,) m; raise InputError without any."""
    slow = np.concatenate(several)
    if not len(slow):
        raise InputError(
            f"no pair of anchors, and no anchor, is measured {FEWEST} times in half a second: "
            "raise the rate of the radio."
        )
    return slow


def _residuals(
    base: EffectSet,
    reference: Nothing,
    anchors: Anchors,
    delays: np.ndarray,
    flight: Flight,
    span: tuple[float, float] | None,
) -> tuple[Comparison, list[RadioResidual]]:
    """Return the Comparison and residuals of a Flight: the innovations under Anchors and delays.

    delays : (N,) m; span : (first, last) s, None to compute it
    returns : Comparison, [RadioResidual] of each stream
    """
    comparison = Comparison.of(
        replace(flight, anchors=anchors), reference, _with_delays(base, anchors, delays), span
    )
    innovations = comparison.view.innovations
    assert innovations is not None  # as of a Reference that does not know the path
    found = [compared(comparison, RADIO[name], RESIDUALS[name]) for name in innovations.streams]
    parts = [part for part in found if part is not None]
    if not parts:
        raise InputError(
            f"{flight.name}: has no TDOAs or ranges in the air, or in motion on the floor, to "
            "survey with; record motion for half a minute at least."
        )
    return comparison, parts


def _of_flight(
    base: EffectSet,
    reference: Nothing,
    about: tuple[Anchors, np.ndarray],
    prior_std: np.ndarray,
    functions: bool,
    item: tuple[Flight, tuple[float, float] | None, list[Mark]],
) -> tuple[Equations, tuple[float, float]]:
    """Return the Equations and the span of one flight.

    about : Anchors and their delays (N,) m; prior_std, functions : as of `Runs.equations`
    item : Flight, span or None, its marks
    """
    flight, known_span, marks = item
    comparison, parts = _residuals(base, reference, *about, flight, known_span)
    on_floor = reference.on_floor(comparison.poses)
    some = [one for one in marks if on_floor or one.position[2] > AIRBORNE]
    gram, vector, blocks, known = _equations(parts, flight, some, functions)
    n = len(prior_std)
    inflation = _inflation(gram[:n, :n], vector[:n], blocks, prior_std)
    less = SYSTEMATIC * inflation
    made = Equations(
        gram=gram / less,
        vector=vector / less,
        marks=known,
        slow=_slow(parts),
        inflation=inflation,
        seconds=BLOCK * len(blocks),
        marks_on_floor=len(marks) - len(some),
    )
    return made, comparison.span


def _with_delays(base: EffectSet, anchors: Anchors, delays: np.ndarray) -> EffectSet:
    """Return the EffectSet `base` plus delays (N,) m of Anchors, if any is not 0."""
    return EffectSet((*base.effects, delay_effect(anchors, delays))) if delays.any() else base


def delay_effect(anchors: Anchors, delays: np.ndarray) -> Effect:
    """Return the effect anchor_delay with delays (N,) m of Anchors."""
    return AnchorDelay({str(i): float(delay) for i, delay in zip(anchors.ids, delays)})


def _slow(parts: Sequence[RadioResidual]) -> np.ndarray:
    """Return innovations averaged over cells of half a second, (n,) m.

    Cells with fewer than FEWEST measurements are left out, because noise dominates them.
    """
    rows = [part.rows() for part in parts]
    return np.concatenate([one.y[one.count >= FEWEST] for one in rows])


def _equations(
    parts: Sequence[RadioResidual], flight: Flight, constraints: Sequence[Mark], functions: bool
) -> tuple[np.ndarray, np.ndarray, list[_BlockEquations], list[_Mark]]:
    """Return the normal equations of the RadioResiduals of a Flight, and of its marks.

    functions : as of `Runs.equations`
    returns : gram (k, k), vector (k,), [_BlockEquations], [_Mark]
    """
    innovations = parts[0].innovations
    assert innovations is not None  # as of a Reference that does not know the path
    n = 4 * len(flight.anchors)  # columns of positions and delays, before those of functions
    t = innovations.t
    air = np.zeros(len(t), bool)
    placed = []  # regressors of each stream in the rows of its innovations
    for part in parts:
        places = innovations.places(part.samples.channel)
        air[places] = part.airborne
        own = _regressors(part.samples, functions)
        placed.append(own if len(places) == len(t) else _selection(places, len(t)) @ own)
    regressors = sum(placed[1:], placed[0])
    stamps = [one.stamps(flight.start) for one in constraints]
    # derivatives of the estimated position at the stamps of marks; in_blocks fills them
    jacobian = np.zeros((sum(map(len, stamps)), 3, regressors.shape[1]))
    error = innovations.value[air] / np.sqrt(innovations.variance[air])
    scale = max(1.4826 * np.median(np.abs(error)), 1e-3)  # for the weights alone
    gram = np.zeros((regressors.shape[1],) * 2)
    vector = np.zeros(regressors.shape[1])
    blocks = []
    number = np.floor((t - t[air][0]) / BLOCK).astype(int)
    for rows, columns, derivative in innovations.in_blocks(
        regressors, number, np.sort(np.concatenate([[], *stamps])), jacobian
    ):
        inside = air[rows]
        if not inside.any():
            continue
        some = derivative[inside]
        value = innovations.value[rows][inside]
        variance = innovations.variance[rows][inside]
        weight = (NU + 1.0) / (NU + (value / np.sqrt(variance) / scale) ** 2) / variance
        more, right = (some * weight[:, None]).T @ some, some.T @ (weight * value)
        gram[np.ix_(columns, columns)] += more
        vector[columns] += right
        last = np.searchsorted(columns, n)  # without functions
        # a copy, since a view would keep all of `more` in memory: megabytes
        blocks.append(_BlockEquations(columns[:last], more[:last, :last].copy(), right[:last]))
    marks = _mark_equations(constraints, stamps, jacobian, innovations.run.odometry)
    return gram, vector, blocks, marks


def _regressors(samples: Samples, functions: bool) -> csr_array:
    """Return derivatives of TDOAs by coordinates and delays of anchors, sparse, (n, 4 N).

    With `functions`, features of the place of each anchor follow, (n, 24 N).
    """
    ids = [str(i) for i in samples.anchors.ids]
    positions = _sparse(AnchorPosition(), samples, [f"{i}.{axis}" for i in ids for axis in "xyz"])
    late = _sparse(AnchorDelay(), samples, ids)
    parts = [positions, late]
    if functions:
        parts.append(_of_places(late, samples.p))
    return hstack(parts, format="csr")


def _of_places(late: csr_array, p: np.ndarray) -> csr_array:
    """Return each entry of `late` times all features of the place, sparse, (n, N FEATURES).

    late : (n, N) derivatives by delays; p : (n, 3) m, world
    """
    values = np.nan_to_num(features(p))
    n, times = late.shape[0], values.shape[1]
    row = np.repeat(np.arange(n), np.diff(late.indptr))
    data = (late.data[:, None] * values[row]).ravel()
    indices = (late.indices[:, None] * times + np.arange(times)).ravel()
    return csr_array((data, indices, late.indptr * times), shape=(n, late.shape[1] * times))


def _selection(places: np.ndarray, n: int) -> csr_array:
    """Return the sparse matrix that moves rows (m, ...) to `places` (m,) among n, (n, m)."""
    return csr_array(
        (np.ones(len(places)), (places, np.arange(len(places)))), shape=(n, len(places))
    )


def _sparse(effect: Effect, samples: Samples, keys: list[str]) -> csr_array:
    """Return sparse regressors of an Effect of single anchors, (n, keys).

    Rows without a named anchor are 0 and are not computed.
    """
    parts = []
    for first in range(0, len(keys), AT_ONCE):
        some = keys[first : first + AT_ONCE]
        named = np.isin(samples.anchors.ids, [int(key.partition(".")[0]) for key in some])
        rows = np.flatnonzero(named[samples.a] | named[samples.b])
        values = csr_array(np.nan_to_num(effect.regressors(of_rows(samples, rows), some)))
        held = np.zeros(len(samples.t), np.int64)
        held[rows] = np.diff(values.indptr)
        parts.append(
            csr_array(
                (values.data, values.indices, np.append(0, np.cumsum(held))),
                shape=(len(held), len(some)),
            )
        )
    return hstack(parts, format="csr")


@dataclass(frozen=True, eq=False)
class _BlockEquations:
    """Normal equations of a block of TDOAs, for the coordinates and delays that occur in it.

    columns : (c,) indices; gram : (c, c); vector : (c,)
    """

    columns: np.ndarray
    gram: np.ndarray
    vector: np.ndarray


@dataclass(frozen=True, eq=False)
class _Mark:
    """Normal equations of a mark of a flight.

    gram : (k, k); vector : (k,)
    off : (3,) m, estimate minus mark, axes of the world; columns : (3, k), its derivative by the
        parameters
    """

    gram: np.ndarray
    vector: np.ndarray
    off: np.ndarray
    columns: np.ndarray


def _mark_equations(
    constraints: Sequence[Mark],
    stamps: Sequence[np.ndarray],
    jacobian: np.ndarray,
    odometry: Odometry,
) -> list[_Mark]:
    """Return the [_Mark] of marks of a flight.

    stamps : s, of the estimates that each mark needs
    jacobian : (m, 3, k) derivative of the estimate by the parameters, at all stamps in order of time
    """
    order = np.argsort(np.concatenate([[], *stamps]), kind="stable")
    jacobian = jacobian[np.argsort(order, kind="stable")]  # in the order of the marks
    first, out = 0, []
    for one, t in zip(constraints, stamps):
        estimate = np.stack([np.interp(t, odometry.t, odometry.p[:, k]) for k in range(3)], axis=1)
        rows = np.minimum(np.searchsorted(odometry.t, t), len(odometry.t) - 1)
        here = jacobian[first : first + len(t)]
        # persistent errors of anchors are unknowns of the equations
        covariance = odometry.covariance[rows, :3, :3] - odometry.consider_covariance[rows]
        out.append(_Mark(*one.equations(t, estimate, covariance, here), *one.off(estimate, here)))
        first += len(t)
    return out


def _inflation(
    gram: np.ndarray, vector: np.ndarray, blocks: Sequence[_BlockEquations], sizes: np.ndarray
) -> float:
    """Return the variance of score sums over blocks, relative to independent errors.

    Independent errors give score sums with covariance `gram`. The result is the mean ratio over the
    eigenvectors of `gram` that the data determine.

    gram : (k, k), vector : (k,) sums over the blocks; sizes : (k,) prior standard deviations
    """
    # Scores at the preliminary solution, where the mean score is near 0.
    step = np.linalg.solve(gram / PRELIMINARY + np.diag(sizes**-2.0), vector / PRELIMINARY)
    scores = np.zeros((len(blocks), len(vector)))
    for score, block in zip(scores, blocks):
        score[block.columns] = block.vector - block.gram @ step[block.columns]
    values, directions = np.linalg.eigh(gram)
    determined = values > DETERMINED * values[-1]
    return float(
        np.mean(np.sum((scores @ directions[:, determined]) ** 2, axis=0) / values[determined])
    )


def features(p: np.ndarray, length: float = FUNCTION_LENGTH) -> np.ndarray:
    """Return random Fourier features f of a Gaussian kernel, (n, FEATURES).

    The mean of f(p)' f(q) over random waves is exp(-|p - q|^2 / (2 length^2)). The seed is fixed, so
    that all flights share the features.

    p : (n, 3) m, places; length : m, length scale of the kernel
    """
    waves = np.random.default_rng(3).standard_normal((3, FEATURES // 2)) / length
    phase = p @ waves
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=1) * np.sqrt(2.0 / FEATURES)
