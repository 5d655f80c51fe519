# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrate anchors from flights and prior knowledge, and decide whether to use the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import AnchorDelay, Covariance, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.evidence import DELAY, ODDS, POSITION, ChangeKey, changes_of, eliminated, keys_of

from ...checking.pair_rules import MANY
from ...parallel import MapFunction
from ..constraints import Constraint
from ..over_flights import Share
from .equations import SYSTEMATIC, Equations, Runs
from .prior import ANYWHERE, TAG_DELAY, Prior, Solution, Tape, solve, to_keep, with_calibration
from .single import PLACED_STD, Misfit, lateness, place

LEAST = 30.0  # s in the air, fewest; fewer do not show how correlated errors are
SAME_PLACE = 0.05  # m, largest difference of an anchor between flights of one installation
NOTHING_KNOWN = 1e3  # m, reported standard deviation of a coordinate of an unknown anchor
IMPROVED = 0.7  # largest ratio of the new to the given standard deviation that counts as improved
LEFT = 0.055  # m, largest scale of the remaining slow innovations, set on measured flights
# Ratio of the slow innovations with given and with estimated anchors, set on measured flights.
# Above it the tape errs more than everything else, and the result may be used.
CLEARLY = 2.6
# The same ratio for flights of ranges alone, whatever remains: obstacles and reflections leave slow
# errors of every range. On simulated flights with such errors and a larger ratio, the position of
# another flight got at most 6 % worse; with smaller ratios up to 20 % (docs/notebook/ranges.md).
CLEARLY_OF_RANGES = 1.25
PLAINLY = 5.0  # smallest shift, in standard deviations, of an anchor that moved alone
WELL_PLACED = 0.08  # m, 3D standard deviation of a moved anchor below which no advice is given
MEASURE = (
    "hold the tag at some measured places in the air and give them to survey with --marks "
    "(docs/calibration.md), or record ground truth, which diagnose uses"
)
NEARER = 0.75  # smallest share of marks, each left out once, at which the estimate must improve


@dataclass(frozen=True, eq=False)
class AnchorChange:
    """A change of one anchor since the last calibration.

    effect : name; anchor : id; values, std : (m,) m, size of the change
    rivals : names of effects that the flights do not distinguish from it
    others : ids of anchors that can have changed instead
    """

    effect: str
    anchor: str
    values: np.ndarray
    std: np.ndarray
    rivals: tuple[str, ...] = ()
    others: tuple[str, ...] = ()

    def as_text(self) -> str:
        """Return a sentence."""
        by = ", ".join(
            f"{100 * value:+.1f} +- {100 * std:.1f}" for value, std in zip(self.values, self.std)
        )
        if self.effect == POSITION:
            text = f"anchor {self.anchor} has moved by {by} cm (x, y, z)"
            text += ", or is later than it was" * bool(self.rivals)
            text += "".join(f", or anchor {other} has moved instead" for other in self.others)
            return text + self._doubt
        text = f"anchor {self.anchor} is later than it was by {by} cm"
        text += ", or has moved" * bool(self.rivals)
        return text + "".join(f", or anchor {other} has changed instead" for other in self.others)

    @property
    def _doubt(self) -> str:
        """Return advice for an anchor whose position the flights hardly determine, else ""."""
        off = float(np.linalg.norm(self.std))
        if off <= WELL_PLACED and not self.others:
            return ""
        return (
            f". The flights determine its place to {100 * off:.0f} cm only: fly on all sides of "
            "it, high and low, or measure it again"
        )


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Anchors estimated from flights, and their uncertainty.

    given : Anchors; prior : their Prior; flights : names; base : EffectSet of the model
    surveyed : estimated Anchors; delays : (N,) m
    solution : Solution; its covariance holds positions, anchor by anchor, then delays
    seconds : s in the air that were used
    before, left : m, scale of the slow innovations with the given and with the estimated anchors,
        without the common offset of ranges
    tdoa_std : m, for the filter, so that its information matches the inflated noise; None without
        TDOAs
    changes : (AnchorChange, ...) since the last calibration
    marks : (before, after, nearer): RMS error of the estimate at marks in the air, m, and the share
        of marks at which it falls; each mark is left out of its fit. None without marks.
    marks_on_floor : number of marks left out on the floor, where estimates err by metres without showing
        it
    shares : {effect: (Share, ...)}, its amount in each flight; inflation : as of Equations
    blocked : sentences on blocked anchors, filled by `surveying/blocked.py`
    """

    given: Anchors
    prior: Prior
    flights: tuple[str, ...]
    base: EffectSet
    surveyed: Anchors
    delays: np.ndarray
    solution: Solution
    seconds: float
    before: float
    left: float
    tdoa_std: float | None
    changes: tuple[AnchorChange, ...]
    marks: tuple[float, float, float] | None
    marks_on_floor: int
    shares: dict[str, tuple[Share, ...]]
    inflation: float = 1.0
    blocked: tuple[str, ...] = ()

    @property
    def why_not(self) -> str | None:
        """Return why the result must not be used; None if it may be used.

        If another systematic error exists, positions and delays absorb it, and the position error
        grows. Large remaining slow innovations, or errors at marks, show that.
        """
        if self.marks:
            before, after, nearer = self.marks
            if after < before and nearer >= NEARER:
                return None
            return (
                f"at marks, each left out once, the estimate is off by {100 * before:.1f} cm "
                f"with the anchors as given, and by {100 * after:.1f} cm with "
                f"others, and nearer at {nearer:.0%} of them: the position would suffer; "
                "give more marks, or record ground truth, which diagnose uses"
            )
        slow = (
            f"{100 * self.before:.1f} cm of the innovations are slow with the anchors as "
            f"given, and {100 * self.left:.1f} cm with others"
        )
        if self.tdoa_std is None:
            if self.before > CLEARLY_OF_RANGES * self.left:
                return None
            return (
                f"{slow}: that is less than {CLEARLY_OF_RANGES:g} times as much. The anchors are "
                f"not the largest error, and the position might suffer; {MEASURE}"
            )
        if self.left <= LEFT or self.before > CLEARLY * self.left:
            return None
        return (
            f"{slow}: more than {100 * LEFT:.1f} cm: something else is wrong too, and the position might "
            f"suffer; {MEASURE}"
        )

    @property
    def explained(self) -> float:
        """Return the explained share of the power of the slow innovations."""
        return 1.0 - (self.left / self.before) ** 2

    @property
    def anchors(self) -> Anchors:
        """Return the Anchors to use."""
        return self.surveyed if self.why_not is None else self.given

    @property
    def effects(self) -> EffectSet:
        """Return the EffectSet to use with `anchors`, including the base.

        Its covariance is the prior of the next calibration.
        """
        if self.why_not is not None:
            return self.base
        return with_calibration(self.base, self.found(np.zeros_like(self.shifts)), self.covariance)

    def found(self, shifts: np.ndarray) -> tuple[AnchorPosition, AnchorDelay]:
        """Return the effects of position errors `shifts`, (N, 3) m, and of the estimated delays."""
        keys = [key for _, key in keys_of(self.given.ids)]
        values = np.concatenate([shifts.ravel(), self.delays]).tolist()
        std = np.sqrt(np.diag(self.solution.covariance)).tolist()
        n = shifts.size
        places = dict(zip(keys[:n], values[:n])), dict(zip(keys[:n], std[:n]))
        delays = dict(zip(keys[n:], values[n:])), dict(zip(keys[n:], std[n:]))
        return AnchorPosition(*places, source="survey"), AnchorDelay(*delays, source="survey")

    @property
    def tag_delay(self) -> tuple[float, float] | None:
        """Return the antenna delay of the tag and its standard deviation, (m, m).

        It lengthens all ranges, and the delays of all anchors include it. It is None without
        ranges.
        """
        if not self.prior.common:
            return None
        common = self.solution.covariance[self.shifts.size :, self.shifts.size :].mean()
        return float(self.delays.mean()), float(np.sqrt(common))

    @property
    def covariance(self) -> Covariance:
        """Return the Covariance that is the prior of the next calibration."""
        return to_keep(keys_of(self.given.ids), self.solution.covariance)

    @property
    def shifts(self) -> np.ndarray:
        """Return the estimated minus the given positions, (N, 3) m, world."""
        return self.surveyed.positions - self.given.positions

    @property
    def offset(self) -> np.ndarray:
        """Return the shifts, anchor by anchor, then the delays, (4N,) m."""
        return np.concatenate([self.shifts.ravel(), self.delays])

    @property
    def given_std(self) -> np.ndarray:
        """Return the standard deviations of the given positions, (N, 3) m."""
        return _of_positions(self.prior.covariance)

    @property
    def position_std(self) -> np.ndarray:
        """Return the standard deviations of the estimated positions, (N, 3) m."""
        return _of_positions(self.solution.covariance)

    @property
    def improved(self) -> np.ndarray:
        """Return whether each coordinate is determined better than before, (N, 3) bool."""
        return self.position_std < IMPROVED * self.given_std


def self_calibrate(
    flights: Sequence[Flight],
    tape: Tape = Tape(),
    base: EffectSet = EffectSet(),
    config: FilterConfig | None = None,
    constraints: Sequence[Constraint] = (),
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> SelfCalibration:
    """Return the SelfCalibration of Flights. Ground truth is not used.

    The coordinates with the smallest std define the frame. Each anchor is also tried as the only
    moved one, as with `Tape.unknown`, before its error is spread, and the likeliest one as the only
    late one. Raises InputError for flights
    with different anchors, flights that are too short, and a Tape that does not fit.

    Parameters
    ----------
    flights : sequence of Flight
        All with the same anchors.
    tape : Tape
        Prior uncertainty of the anchors.
    base : EffectSet
        Effects in the model. Its covariance, of the last calibration, replaces the tape.
    config : FilterConfig, optional
    constraints : sequence of Constraint
        Marks and distances (`diagnosis/constraints`).
    map_function : function
        As of `attribution.attribute`.
    """
    same_anchors(flights)
    config = config or FilterConfig()
    calibrated = partial(
        _calibrated,
        flights,
        base=base,
        config=config,
        constraints=constraints,
        progress=progress,
        map_function=map_function,
    )
    spread = calibrated((tape, None))
    many = len(flights[0].anchors) > MANY
    if tape.unknown or tape.steady or many or not all(len(flight.tdoa) for flight in flights):
        return spread
    misfit, of_spread = Misfit.about(flights, config, spread.surveyed, _in_model(spread))
    found: dict[ChangeKey | None, SelfCalibration] = {None: spread}
    suspects = misfit.suspects(base, progress, map_function)
    for row, placed in suspects.items():
        unknown = replace(tape, unknown=(spread.prior.ids[row],))
        try:
            one = _alone(spread, calibrated((unknown, placed)))
            one.found(one.shifts)  # refuses a place beyond what an effect may state
            found[POSITION, row] = one
        except InputError:  # too few anchors are left, or it is nowhere near
            continue
    for row in list(suspects)[:1]:
        later = np.eye(len(spread.prior.ids))[row] * lateness(flights, row, config)
        effect = AnchorDelay({spread.prior.ids[row]: float(later[row])})
        one = calibrated((tape, None), base=with_calibration(base, (effect,), None))
        found[DELAY, row] = _alone(spread, replace(one, delays=one.delays + later))
    return _most_probable(found, misfit, of_spread)


def _calibrated(
    flights: Sequence[Flight],
    known: tuple[Tape, Anchors | None],
    base: EffectSet,
    config: FilterConfig,
    constraints: Sequence[Constraint],
    progress: Callable[[], object],
    map_function: MapFunction,
) -> SelfCalibration:
    """Return the SelfCalibration for one Tape; the other arguments as of `self_calibrate`.

    known : the Tape, and Anchors with its unknown ones placed; None to place them here
    """
    tape, placed = known
    given = flights[0].anchors
    std, rows = tape.position_std(given), tape.unknown_rows(given)
    tdoas = any(len(flight.tdoa) for flight in flights)
    if rows and not tdoas:
        raise InputError(
            f"--unknown {given.ids[rows[0]]}: only TDOAs place an anchor; measure it roughly, "
            "and give --std."
        )
    # `start` is the prior of the solution. `std` is reported as the uncertainty before it.
    start, start_std = given, std.copy()
    if rows:
        start = placed if placed is not None else place(flights, rows, config)
        start_std[rows], std[rows] = PLACED_STD, NOTHING_KNOWN
        if base.covariance is not None:
            base = replace(base, covariance=base.covariance.without(tape.unknown))
    runs = Runs([replace(flight, anchors=start) for flight in flights], base, config, constraints)
    ranged = config.use_range and any(flight.range is not None for flight in flights)  # type: ignore[attr-defined]  # as of SENSORS
    common = TAG_DELAY if ranged else 0.0
    prior = replace(Prior.of(given, start_std, base.covariance, common), steady=tape.steady)
    n = len(given)
    no_delays = np.zeros(n)
    mean = np.concatenate([start.positions.ravel(), no_delays])

    def parts(x: np.ndarray) -> tuple[Anchors, np.ndarray]:
        return given.at(x[: 3 * n].reshape(n, 3)), x[3 * n :]

    first = runs.equations(*parts(mean), prior.loose, progress, map_function)
    solution = solve(first.gram, first.vector, prior, np.zeros(4 * n))
    best = mean + solution.step
    # The second solution is linearized at the first one.
    last = runs.equations(*parts(best), prior.loose, progress, map_function)
    solution = solve(last.gram, last.vector, prior, best - mean)
    if last.seconds < LEAST:
        raise InputError(
            f"the flights are {last.seconds:g} s in the air, or in motion on the floor, together; "
            f"{LEAST:g} s are needed: record motion for longer."
        )
    names = tuple(flight.name for flight in flights)
    shares = _shares(last, best - mean, solution, names) if n <= MANY else {}
    best = best + solution.step
    moved, delays = parts(best)
    return SelfCalibration(
        given=given,
        prior=Prior.of(given, std, base.covariance, common),
        flights=names,
        base=base,
        surveyed=moved,
        delays=delays,
        solution=solution,
        seconds=last.seconds,
        before=runs.slow_innovations(start, no_delays) if ranged else first.slow_scale,
        left=runs.slow_innovations(moved, delays),
        tdoa_std=last.tdoa_std(config) if tdoas else None,
        changes=_changes(prior, solution, best - mean),
        marks=_left_out(first, prior),
        marks_on_floor=last.marks_on_floor,
        shares=shares,
        inflation=last.inflation,
    )


def _in_model(found: SelfCalibration) -> EffectSet:
    """Return the EffectSet for the surveyed anchors, whether they may be used or not."""
    _, delays = found.found(found.shifts)
    return with_calibration(found.base, (delays,), None)


def _alone(spread: SelfCalibration, found: SelfCalibration) -> SelfCalibration:
    """Return a SelfCalibration of one changed anchor, with the prior of the spread solution."""
    return replace(
        found, given=spread.given, prior=spread.prior, before=spread.before, base=spread.base
    )


def _most_probable(
    found: dict[ChangeKey | None, SelfCalibration], misfit: Misfit, of_spread: float
) -> SelfCalibration:
    """Return the most probable of several SelfCalibrations.

    A single changed anchor must be ODDS times more probable than the error spread over all anchors,
    and its change significant. It must also leave few slow innovations, as any result that may be
    used: errors of antennas and obstacles are no shift, but one anchor can absorb part of them.

    found : {(effect, row) of the only changed anchor, None for the spread solution: SelfCalibration}
    of_spread : the Misfit of the spread solution
    """
    alike = SYSTEMATIC * max(1.0, min(one.inflation for one in found.values()))
    likelihood: dict[ChangeKey | None, float] = {None: -of_spread}
    for key, one in found.items():
        if key is not None and one.why_not is None and _is_plain(one, key):
            likelihood[key] = -misfit.of(one.surveyed, _in_model(one))
    volume = {key: _log_evidence(found[key], key) for key in likelihood}
    evidence = {key: volume[key] + likelihood[key] / alike for key in volume}
    likely = [key for key in evidence if key and evidence[key] > evidence[None] + np.log(ODDS)]
    if not likely:
        return found[None]
    # Independent innovations decide between a shift and a delay, and are too sure to refuse one.
    same = [key for key in evidence if key and key[1] in {row for _, row in likely}]
    best = max(same, key=lambda key: volume[key] + likelihood[key])
    most = max(evidence[key] for key in likely)
    rivals = {key: evidence[key] for key in likely if evidence[key] > most - np.log(ODDS)}
    return _with_rivals(found, best, {**rivals, best: most})


def _is_plain(found: SelfCalibration, key: ChangeKey) -> bool:
    """Return whether the change of an anchor exceeds PLAINLY standard deviations."""
    places, _ = changes_of(len(found.prior.ids))[key]
    covariance, change = found.solution.covariance[np.ix_(places, places)], found.offset[places]
    return bool(change @ np.linalg.solve(covariance, change) > PLAINLY**2)


def _log_evidence(found: SelfCalibration, alone: ChangeKey | None) -> float:
    """Return the log-evidence of a SelfCalibration without the likelihood (Laplace approximation).

    alone : change of the only changed anchor, or None
    """
    prior = found.prior.covariance.copy()
    if not found.prior.known.any():
        prior = found.prior.with_delays(found.solution.delay_std)
    free = {
        (one.effect, found.prior.ids.index(one.anchor))
        for one in found.changes
        if one.effect == POSITION
    }
    for key in free if alone is None else {alone, *free}:
        places, _ = changes_of(len(found.prior.ids))[key]
        prior[places], prior[:, places] = 0.0, 0.0
        prior[places, places] = ANYWHERE**2
    # Laplace: half of log|posterior| - log|prior| - squared distance from the prior mean.
    posterior_volume = np.linalg.slogdet(found.solution.covariance)[1]
    prior_volume = np.linalg.slogdet(prior)[1]
    offset = found.offset
    distance = offset @ np.linalg.solve(prior, offset)
    return float(0.5 * (posterior_volume - prior_volume - distance))


def _with_rivals(
    found: dict[ChangeKey | None, SelfCalibration], best: ChangeKey, likely: dict[ChangeKey, float]
) -> SelfCalibration:
    """Return the best of several SelfCalibrations, with its rivals.

    The covariance is the mixture covariance of all likely ones about the best.

    likely : {change of an anchor: log-evidence}
    """
    one = found[best]
    covariance, total = np.zeros_like(one.solution.covariance), 0.0
    for key, value in likely.items():
        weight, off = np.exp(value - likely[best]), found[key].offset - one.offset
        covariance = covariance + weight * (found[key].solution.covariance + np.outer(off, off))
        total += weight
    solution = replace(one.solution, covariance=covariance / total)
    (effect, row), ids = best, one.prior.ids
    places = changes_of(len(ids))[best][0]
    rivals = tuple(other for other, at in likely if at == row and other != effect)
    others = tuple(dict.fromkeys(ids[at] for _, at in likely if at != row))
    std = np.sqrt(np.diag(solution.covariance))[places]
    changed = AnchorChange(effect, ids[row], one.offset[places], std, rivals, others)
    return replace(one, solution=solution, changes=(changed, *one.changes))


def same_anchors(flights: Sequence[Flight]) -> None:
    """Raise InputError unless all Flights, at least one, have the same anchors."""
    if not flights:
        raise InputError("give at least one flight.")
    first = flights[0]
    for flight in flights[1:]:
        same = np.array_equal(flight.anchors.ids, first.anchors.ids)
        if not (
            same and np.allclose(flight.anchors.positions, first.anchors.positions, atol=SAME_PLACE)
        ):
            raise InputError(
                f"{flight.name}: its anchors are not those of {first.name}; take each "
                "installation and day alone."
            )


def _of_positions(covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations of positions, (N, 3) m, of a covariance (4N, 4N) m^2."""
    return np.sqrt(np.diag(covariance))[: 3 * (len(covariance) // 4)].reshape(-1, 3)


def _left_out(equations: Equations, prior: Prior) -> tuple[float, float, float] | None:
    """Return SelfCalibration.marks: each mark is left out of the Equations once.

    equations : linearized at the given anchors
    """
    if not equations.marks:
        return None
    n = len(prior.covariance)
    off = []
    for one in equations.marks:
        gram, vector = equations.gram - one.gram, equations.vector - one.vector
        step = solve(gram, vector, prior, np.zeros(n)).step
        off.append((one.off, one.off - one.columns[:, :n] @ step))
    before, after = np.sum(np.square(off), axis=2).T
    rms = float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))
    return (*rms, float(np.mean(after < before)))


def _changes(prior: Prior, found: Solution, offset: np.ndarray) -> tuple[AnchorChange, ...]:
    """Return the (AnchorChange, ...) of a Solution.

    offset : (4N,) m, point of linearization minus prior mean
    """
    std = np.sqrt(np.diag(found.covariance))
    out = []
    for (effect, anchor), others in found.changed.items():
        places, _ = prior.changes()[effect, anchor]
        rivals = tuple(other for other, row in others if row == anchor)
        instead = tuple(dict.fromkeys(prior.ids[row] for _, row in others if row != anchor))
        values = offset[places], std[places]
        out.append(AnchorChange(effect, prior.ids[anchor], *values, rivals, instead))
    return tuple(out)


def _shares(
    equations: Equations, offset: np.ndarray, found: Solution, names: Sequence[str]
) -> dict[str, tuple[Share, ...]]:
    """Return SelfCalibration.shares: per flight, a fit of one factor to its equations.

    The information is defined as in `over_flights`: errors that last a flight do not reduce it.

    offset : (4N,) m, point of linearization minus prior mean
    """
    n = len(offset)
    whole = offset + found.step
    kinds = {POSITION: slice(3 * n // 4), DELAY: slice(3 * n // 4, n)}
    out: dict[str, list[Share]] = {name: [] for name in kinds}
    for flight, one in zip(names, equations.flights):
        whole_gram, whole_vector = SYSTEMATIC * one.gram, SYSTEMATIC * one.vector
        gram, vector, *_ = eliminated(whole_gram, whole_vector, n, found.function_std)
        for name, columns in kinds.items():
            part = np.zeros(n)
            part[columns] = whole[columns]
            score = part @ (vector + gram @ (offset - whole + part))
            out[name].append(Share.fitted(flight, part @ gram @ part, score))
    return {name: tuple(shares) for name, shares in out.items()}
