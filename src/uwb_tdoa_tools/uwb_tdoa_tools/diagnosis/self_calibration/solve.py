"""The one way from flights and what is known of their anchors to better anchors, and whether these
may be used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import AnchorDelay, Covariance, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.evidence import DELAY, ODDS, POSITION, eliminated, keys_of

from ...checking.pair_rules import MANY
from ..over_flights import Share
from .equations import SYSTEMATIC, Runs
from .placing import PLACED_STD, place
from .prior import ANYWHERE, TAG_DELAY, Prior, solve, to_keep, with_calibration
from .single import Misfit
from .tape import Tape

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.flight import Flight

    from ...parallel import MapFunction
    from ..constraints import Constraint
    from .equations import Equations
    from .prior import Solution

ROUNDS = 2  # linear solutions, each about the last
LEAST = 30.0  # s in the air; fewer do not tell how alike errors are
SAME_PLACE = 0.05  # m by which an anchor may differ between flights of one installation
NOTHING_KNOWN = 1e3  # m, standard deviation of a coordinate of which nothing is known
IMPROVED = 0.7  # of the standard deviation as given; less is an improvement
LEFT = 0.055  # m that may be left of slow innovations
# slow innovations as given over those that are left, beyond which the tape was worse than what else
# is wrong
CLEARLY = 2.6
PLAINLY = 5.0  # standard deviations that an anchor must be off by to be tried as the only one
WELL_PLACED = 0.08  # m, 3D standard deviation of a moved anchor that leaves nothing to do
NEARER = 0.75  # share of marks, each left out once, at which the estimate must come nearer


@dataclass(frozen=True, eq=False)
class AnchorChange:
    """What is not as the last calibration had it: effect : name; anchor : id; values, std : (m,) m,
    by how much; rivals : names of effects that the flights cannot tell from it; others : ids of
    anchors, one of which may have moved instead.
    """

    effect: str
    anchor: str
    values: np.ndarray
    std: np.ndarray
    rivals: tuple[str, ...] = ()
    others: tuple[str, ...] = ()

    def as_text(self) -> str:
        """One sentence."""
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
        """What to do where the flights hardly determine the place of the anchor."""
        off = float(np.linalg.norm(self.std))
        if off <= WELL_PLACED and not self.others:
            return ""
        return (
            f". The flights determine its place to {100 * off:.0f} cm only: fly on all sides of "
            "it, high and low, or measure it again"
        )


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """What flights tell of their anchors.

    given : Anchors; prior : Prior of them; flights : names; base : EffectSet that was in the model;
    surveyed : Anchors where the flights put them; delays (N,) m; solution : Solution, whose
        covariance is of positions, anchor by anchor,
    and then of delays; seconds : s in the air that tell;
    before, left : m, scale of the slow innovations with the anchors as given, and with these,
        beside the offset of all ranges;
    tdoa_std : m, for the filter: so that it believes in as many independent TDOAs as there are;
        None without any;
    changes : (AnchorChange, ...) since the last calibration;
    marks : (before, after, nearer), root mean square of what estimates at marks in the air are off
        by, m, and share of marks that they
    come nearer to, each after a fit without it; None where there are none;
    grounded : how many marks were left out, because they are on the floor: estimates there are
        metres off and do not know it;
    shares : {name of an effect: (Share, ...)}, how much of it each flight shows;
    inflation : as of Equations;
    blocked : sentences on what makes anchors late somewhere, once somebody has looked
        (`surveying/blocked.py`).
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
    grounded: int
    shares: dict[str, tuple[Share, ...]]
    inflation: float = 1.0
    blocked: tuple[str, ...] = ()

    @property
    def why_not(self) -> str | None:
        """Why it must not be used instead of what was given; None if it may.

        Where something else is wrong as well, positions and delays take the place of what they look
        like, and the position gets worse. That shows in what is left of the slow innovations, or at
        marks.
        """
        if self.marks:
            before, after, nearer = self.marks
            if after < before and nearer >= NEARER:
                return None
            return (
                f"at marks, each left out once, the estimate is off by {100 * before:.1f} cm "
                f"with the anchors as given, and by {100 * after:.1f} cm with "
                f"others, and nearer at {nearer:.0%} of them: the position would suffer; "
                "measure more marks, or fly where it is known"
            )
        if self.left <= LEFT or self.before > CLEARLY * self.left:
            return None
        return (
            f"{100 * self.before:.1f} cm of the innovations are slow with the anchors as "
            f"given, and {100 * self.left:.1f} cm with others: more than "
            f"{100 * LEFT:.1f} cm: something else is wrong too, and the position might "
            "suffer; give --marks, or fly where it is known"
        )

    @property
    def explained(self) -> float:
        """Share of the power of the slow innovations that is gone."""
        return 1.0 - (self.left / self.before) ** 2

    @property
    def anchors(self) -> Anchors:
        """The Anchors to use."""
        return self.surveyed if self.why_not is None else self.given

    @property
    def effects(self) -> EffectSet:
        """The EffectSet to use with them, with what was in the model; its covariance is the prior
        of the next calibration.
        """
        if self.why_not is not None:
            return self.base
        return with_calibration(self.base, self.found(np.zeros_like(self.shifts)), self.covariance)

    def found(self, shifts: np.ndarray) -> tuple[AnchorPosition, AnchorDelay]:
        """The effects of positions that are off by shifts (N, 3) m, and of delays."""
        n, keys = shifts.size, [key for _, key in keys_of(self.given.ids)]
        values = np.concatenate([shifts.ravel(), self.delays]).tolist()
        std = np.sqrt(np.diag(self.solution.covariance)).tolist()
        position, delay = (
            (dict(zip(keys[some], values[some])), dict(zip(keys[some], std[some])))
            for some in (slice(n), slice(n, None))
        )
        return AnchorPosition(*position, source="survey"), AnchorDelay(*delay, source="survey")

    @property
    def tag_delay(self) -> tuple[float, float] | None:
        """(m, m): what all ranges are too long by, which is in the delays of all anchors, and its
        standard deviation. None without ranges.
        """
        if not self.prior.common:
            return None
        first = self.shifts.size
        return float(self.delays.mean()), float(
            np.sqrt(self.solution.covariance[first:, first:].mean())
        )

    @property
    def covariance(self) -> Covariance:
        """What the next calibration starts from."""
        return to_keep(keys_of(self.given.ids), self.solution.covariance)

    @property
    def shifts(self) -> np.ndarray:
        """(N, 3) m, from what was given."""
        return self.surveyed.positions - self.given.positions

    @property
    def given_std(self) -> np.ndarray:
        """(N, 3) m, of the positions as given."""
        return _of_positions(self.prior.covariance)

    @property
    def position_std(self) -> np.ndarray:
        """(N, 3) m, of the positions as surveyed."""
        return _of_positions(self.solution.covariance)

    @property
    def improved(self) -> np.ndarray:
        """(N, 3) bool: coordinates that are known better than before."""
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
    """SelfCalibration of Flights with the anchors that a Tape speaks of. Ground truth is not used.

    base : EffectSet that is in the model already; its covariance, of the last calibration, counts
        where there is one, not the
    Tape; config : FilterConfig; constraints : what else is known (`diagnosis/constraints`);
    map_function : as of `attribution.attribute`. The frame is that of the coordinates with the
    smallest std. Each anchor is tried as the only one that has moved, as `Tape.unknown` has it,
    before its error is spread. Raises InputError for flights of different anchors or that are too
    short, and for a Tape that does not fit.
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
    spread = calibrated(tape)
    many = len(flights[0].anchors) > MANY
    if tape.unknown or many or not all(len(flight.tdoa) for flight in flights):
        return spread
    misfit = Misfit.about(flights, config, spread.surveyed, _in_model(spread))
    found: dict[int | None, SelfCalibration] = {None: spread}
    for row in misfit.suspects(base):
        progress()
        try:
            found[row] = _alone(spread, calibrated(replace(tape, unknown=(spread.prior.ids[row],))))
        except InputError:  # too few TDOAs tell of it, or too few anchors are left
            continue
    return _most_probable(found, misfit)


def _calibrated(
    flights: Sequence[Flight],
    tape: Tape,
    base: EffectSet,
    config: FilterConfig,
    constraints: Sequence[Constraint],
    progress: Callable[[], object],
    map_function: MapFunction,
) -> SelfCalibration:
    """Return the SelfCalibration with one solution, about the anchors that a Tape speaks of."""
    given, names = flights[0].anchors, tuple(flight.name for flight in flights)
    std, rows, tdoas = (
        tape.position_std(given),
        tape.unknown_rows(given),
        any(len(flight.tdoa) for flight in flights),
    )
    if rows and not tdoas:
        raise InputError(
            f"--unknown {given.ids[rows[0]]}: only TDOAs place an anchor; measure it roughly, "
            "and give --std."
        )
    start, start_std = given, std.copy()
    if rows:
        start = place(flights, rows, config)
        start_std[rows], std[rows] = PLACED_STD, NOTHING_KNOWN
        if base.covariance is not None:
            base = replace(base, covariance=base.covariance.without(tape.unknown))
    runs = Runs([replace(flight, anchors=start) for flight in flights], base, config, constraints)
    ranged = config.use_range and any(flight.range is not None for flight in flights)  # type: ignore[attr-defined]  # as of SENSORS
    common = TAG_DELAY if ranged else 0.0
    n, prior = len(given), Prior.of(given, start_std, base.covariance, common)
    mean = np.concatenate([start.positions.ravel(), np.zeros(n)])

    def linearised(about: np.ndarray) -> Equations:
        return runs.equations(
            given.at(about[: 3 * n].reshape(n, 3)),
            about[3 * n :],
            prior.loose,
            progress,
            map_function,
        )

    best, first = mean, linearised(mean)
    last = first
    found = solve(first.gram, first.vector, prior, np.zeros(4 * n))
    for _ in range(ROUNDS - 1):
        best = best + found.step
        last = linearised(best)
        found = solve(last.gram, last.vector, prior, best - mean)
    if last.seconds < LEAST:
        raise InputError(
            f"the flights are {last.seconds:g} s in the air, or in motion on the floor, together; "
            f"{LEAST:g} s are needed: record motion for longer."
        )
    shares = _shares(last, best - mean, found, names) if n <= MANY else {}
    best = best + found.step
    moved, delays, tdoa_std = (
        given.at(best[: 3 * n].reshape(n, 3)),
        best[3 * n :],
        last.tdoa_std(config) if tdoas else None,
    )
    before = runs.slow_innovations(start, np.zeros(n)) if ranged else first.slow
    return SelfCalibration(
        given,
        Prior.of(given, std, base.covariance, common),
        names,
        base,
        moved,
        delays,
        found,
        last.seconds,
        before,
        runs.slow_innovations(moved, delays),
        tdoa_std,
        _changes(prior, found, best - mean),
        _left_out(first, prior),
        runs.grounded,
        shares,
        last.inflation,
    )


def _in_model(found: SelfCalibration) -> EffectSet:
    """Return the EffectSet to use with the surveyed anchors, whether they are used or not."""
    return with_calibration(found.base, found.found(np.zeros_like(found.shifts)), None)


def _alone(spread: SelfCalibration, found: SelfCalibration) -> SelfCalibration:
    """Return the SelfCalibration of one unknown anchor as one of a tape that knew it."""
    return replace(
        found, given=spread.given, prior=spread.prior, before=spread.before, base=spread.base
    )


def _most_probable(found: dict[int | None, SelfCalibration], misfit: Misfit) -> SelfCalibration:
    """Return the most probable of several SelfCalibrations.

    found : {row of the anchor that was tried alone, None of none: SelfCalibration}. One anchor
        alone must be ODDS times as probable as the error spread over all, and must stand plainly
        elsewhere.
    """
    alike = SYSTEMATIC * max(1.0, min(one.inflation for one in found.values()))
    evidence = {
        row: _log_evidence(one, row) - misfit.of(one.surveyed, _in_model(one)) / alike
        for row, one in found.items()
        if row is None or _stands_elsewhere(one, row)
    }
    best = max(evidence, key=evidence.__getitem__)
    doubt = evidence[best] - np.log(ODDS)
    if best is None or evidence[None] > doubt:
        return found[None]
    likely = {row: value for row, value in evidence.items() if row is not None and value > doubt}
    return _with_rivals(found, best, likely)


def _stands_elsewhere(found: SelfCalibration, row: int) -> bool:
    """Whether a SelfCalibration puts an anchor plainly elsewhere than it was given."""
    places = slice(3 * row, 3 * row + 3)
    covariance, shift = found.solution.covariance[places, places], found.shifts[row]
    return bool(shift @ np.linalg.solve(covariance, shift) > PLAINLY**2)


def _log_evidence(found: SelfCalibration, alone: int | None) -> float:
    """Return the logarithm of the evidence of a SelfCalibration beside the likelihood (Laplace).

    alone : row of the anchor of which nothing was known.
    """
    prior = found.prior.covariance
    if not found.prior.known.any():
        prior = found.prior.with_delays(found.solution.delay_std)
    prior = prior.copy()
    free = {alone} if alone is not None else set()
    free |= {found.prior.ids.index(one.anchor) for one in found.changes if one.effect == POSITION}
    for row in free:
        places = slice(3 * row, 3 * row + 3)
        prior[places], prior[:, places] = 0.0, 0.0
        prior[places, places] = ANYWHERE**2 * np.eye(3)
    offset = np.concatenate([found.shifts.ravel(), found.delays])
    volumes = [np.linalg.slogdet(one)[1] for one in (found.solution.covariance, prior)]
    return float(0.5 * (volumes[0] - volumes[1] - offset @ np.linalg.solve(prior, offset)))


def _with_rivals(
    found: dict[int | None, SelfCalibration], best: int, likely: dict[int, float]
) -> SelfCalibration:
    """Return the best of several SelfCalibrations, with what the others leave open.

    likely : {row: logarithm of the evidence}. The covariance is that of all of them about the best.
    """
    one, total = found[best], 0.0
    covariance = np.zeros_like(one.solution.covariance)
    whole = {row: np.concatenate([found[row].shifts.ravel(), found[row].delays]) for row in likely}
    for row, value in likely.items():
        weight, off = np.exp(value - likely[best]), whole[row] - whole[best]
        covariance = covariance + weight * (found[row].solution.covariance + np.outer(off, off))
        total += weight
    solution = replace(one.solution, covariance=covariance / total)
    places = slice(3 * best, 3 * best + 3)
    others = tuple(one.prior.ids[row] for row in likely if row != best)
    std = np.sqrt(np.diag(solution.covariance))[places]
    change = AnchorChange(POSITION, one.prior.ids[best], one.shifts[best], std, (), others)
    return replace(one, solution=solution, changes=(change, *one.changes))


def same_anchors(flights: Sequence[Flight]) -> None:
    """Raises InputError unless all of some Flights, at least one, were flown among the same
    anchors.
    """
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
    """(N, 3) m, of a covariance (4N, 4N) m^2."""
    return np.sqrt(np.diag(covariance))[: 3 * (len(covariance) // 4)].reshape(-1, 3)


def _left_out(equations: Equations, prior: Prior) -> tuple[float, float, float] | None:
    """SelfCalibration.marks: each is left out of Equations about the anchors as given."""
    if not equations.marks:
        return None
    n, off = len(prior.covariance), []
    for one in equations.marks:
        step = solve(
            equations.gram - one.gram, equations.vector - one.vector, prior, np.zeros(n)
        ).step
        off.append((one.off, one.off - one.columns[:, :n] @ step))
    before, after = np.sum(np.square(off), axis=2).T
    return (
        float(np.sqrt(before.mean())),
        float(np.sqrt(after.mean())),
        float(np.mean(after < before)),
    )


def _changes(prior: Prior, found: Solution, offset: np.ndarray) -> tuple[AnchorChange, ...]:
    """(AnchorChange, ...) of a Solution."""
    std, out = np.sqrt(np.diag(found.covariance)), []
    for (effect, anchor), others in found.changed.items():
        places, _ = prior.changes()[effect, anchor]
        rivals = tuple(other for other, row in others if row == anchor)
        instead = tuple(dict.fromkeys(prior.ids[row] for _, row in others if row != anchor))
        out.append(
            AnchorChange(effect, prior.ids[anchor], offset[places], std[places], rivals, instead)
        )
    return tuple(out)


def _shares(
    equations: Equations, offset: np.ndarray, found: Solution, names: Sequence[str]
) -> dict[str, tuple[Share, ...]]:
    """SelfCalibration.shares: a fit of one factor to what each flight alone tells in Equations that
    were made an offset (4N,) from the mean of the prior; with the information of `over_flights`,
    which errors that last do not make less.
    """
    n, whole, out = len(offset), offset + found.step, {}
    reduced = [
        eliminated(SYSTEMATIC * one.gram, SYSTEMATIC * one.vector, n, found.function_std)[:2]
        for one in equations.flights
    ]
    for name, columns in ((POSITION, slice(3 * n // 4)), (DELAY, slice(3 * n // 4, n))):
        part = np.zeros(n)
        part[columns] = whole[columns]
        out[name] = tuple(
            Share.fitted(
                flight, part @ gram @ part, part @ (vector + gram @ (offset - whole + part))
            )
            for flight, (gram, vector) in zip(names, reduced)
        )
    return out
