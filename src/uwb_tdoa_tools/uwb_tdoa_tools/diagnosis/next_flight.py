"""Plan the next flight: the path that settles what a diagnosis leaves open.

Two explanations of a finding predict different measurements on another path. The planner makes a
library of motions in a box. The channels of the diagnosis predict the rows of a fit on each motion.
The distance between two explanations is the misfit of one to the prediction of the other, after a
fit to the old flights and the new rows. It is twice the expected log Bayes factor, and averaged over
the values that the old flights allow. The planner joins the motions with the largest gain per
second. The worth of a finding, in metres, is the weight of its gain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.base import listed

from ..choices import PLAN_SPEED, PLAN_TIME
from ..simulation.paths import SPEED_UP, STEP
from ..simulation.vehicles import Trajectory
from .channels import CHANNELS, Comparison
from .references import GroundTruth
from .refinement import recurs
from .regression.algebra import dense, product, weighted
from .regression.fit import NU, prior_sizes, refit
from .regression.select import AMBIGUOUS
from .regression.table import table_of
from .regression.terms import columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from uwb_tdoa_bias.common.anchors import Anchors

    from ..simulation.rooms import Room
    from .attribution import Attribution
    from .channels import ChannelResiduals
    from .findings import EffectFinding
    from .regression.select import Selection
    from .regression.terms import Candidate, Column

RATE = 20.0  # Hz, of planned poses
ANCHOR_CLEARANCE = 0.8  # m, smallest distance of the path to an anchor
STEEPEST = 315.0 / 128.0  # largest derivative of STEP
SLOW = 0.3  # share of the speed in a slow pass
SHORTEST = 8.0  # s, a shorter flight is continued: its ends do not count in a diagnosis
ENOUGH = 0.95  # value of all questions, relative to their worth, from which no motion is added
CELL = 0.25  # s, between TDOAs of a pair in a prediction, two per cell of a fit
IMU_RATE, TRUTH_RATE = 100.0, 50.0  # Hz, of a prediction
SMALLEST_WORTH = 1e-4  # m, so that each question has a weight
MOST_RIVALS = 5  # rivals of a finding, the nearest first
DRAWS = 24  # values of an explanation that the old flights allow
MARGIN = 0.25  # s, without a prediction at both ends of a motion
FEW = 0.02  # share of the most frequent pair, below which a pair is not predicted
MOST_PAIRS = 200  # pairs that are predicted
NEAR_ANCHORS = 16  # anchors that motions approach


@dataclass(frozen=True)
class Limits:
    """Limits of a planned flight: s, m/s, m/s^2 and rad/s."""

    time: float = PLAN_TIME
    speed: float = PLAN_SPEED
    acceleration: float = 1.5
    turning: float = 0.8

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"--plan-{name}: {value!r} is not a finite number above 0.")


@dataclass(frozen=True, eq=False)
class TimedPath:
    """Timed poses at RATE, at rest at both ends.

    p : (n, 3) m, world; yaw : (n,) rad, without jumps; what : the motion, in words
    stops : rows at rest, the first and the last among them
    """

    p: np.ndarray
    yaw: np.ndarray
    what: str
    stops: tuple[int, ...]

    @property
    def t(self) -> np.ndarray:
        """Return the stamps, (n,) s from 0."""
        return np.arange(len(self.p)) / RATE

    @property
    def duration(self) -> float:
        """Return the duration, s."""
        return (len(self.p) - 1) / RATE

    def then(self, other: TimedPath) -> TimedPath:
        """Return this and another that starts at its end; whole turns of the yaw are undone."""
        turns = np.round((other.yaw[0] - self.yaw[-1]) / (2.0 * np.pi))
        yaw = np.concatenate([self.yaw, other.yaw[1:] - 2.0 * np.pi * turns])
        p, last = np.concatenate([self.p, other.p[1:]]), len(self.p) - 1
        stops = (*self.stops, *(last + stop for stop in other.stops[1:]))
        return TimedPath(p, yaw, f"{self.what}, {other.what}", stops)


class Library(NamedTuple):
    """Motions that a planned flight can consist of, the anchors, and its limits."""

    paths: tuple[TimedPath, ...]
    anchors: Anchors
    limits: Limits


class _Known(NamedTuple):
    """The information that the old flights hold.

    columns : k Columns; gram : (k, k) information on them; sizes : (k,) standard deviations of
        their priors
    """

    columns: tuple[Column, ...]
    gram: np.ndarray
    sizes: np.ndarray

    def places(self, candidates: Sequence[Candidate]) -> np.ndarray:
        """Return the places of the columns of Candidates."""
        where = {column: k for k, column in enumerate(self.columns)}
        return np.array([where[column] for column in columns_of(candidates)], dtype=int)


@dataclass(frozen=True, eq=False)
class Model:
    """An explanation of the old flights.

    name : of its finding; places : of its m columns among all k; values : (m,) fitted
    information : (m, m) of the old flights and the prior
    """

    name: str
    places: np.ndarray
    values: np.ndarray
    information: np.ndarray

    def draws(self, count: int) -> np.ndarray:
        """Return values of all columns from its posterior, (DRAWS, count); the rest is 0."""
        rng = np.random.default_rng(0)
        root = np.linalg.cholesky(np.linalg.inv(self.information))
        out = np.zeros((DRAWS, count))
        out[:, self.places] = self.values + rng.standard_normal((DRAWS, len(root))) @ root.T
        return out

    def misfit(self, gram: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Return its misfit to new rows that `truth` (d, k) predicts, fitted anew, (d,).

        It is in squared deviations, of the new rows and of the old values. gram : (k, k)
        information of the new rows
        """
        away = truth.copy()
        away[:, self.places] -= self.values
        pull = away @ gram
        vector = pull[:, self.places]
        inside = self.information + gram[np.ix_(self.places, self.places)]
        explained = np.sum(vector * np.linalg.solve(inside, vector.T).T, axis=1)
        return np.sum(pull * away, axis=1) - explained


@dataclass(frozen=True, eq=False)
class Rivalry:
    """Explanations of a finding that fit nearly equally well.

    worth : m, by which the answer can change positions
    models : m Models; gaps : (m,) by how much their criteria are worse than that of the first, twice
        a log-likelihood
    """

    worth: float
    models: tuple[Model, ...]
    gaps: np.ndarray

    @property
    def beliefs(self) -> np.ndarray:
        """Return the probabilities of the models after the old flights, (m,)."""
        likelihood = np.exp(-0.5 * (self.gaps - self.gaps.min()))
        out: np.ndarray = likelihood / likelihood.sum()
        return out

    def distances(self, information: np.ndarray) -> np.ndarray:
        """Return the growth of each gap without noise, (true model, other model, DRAWS).

        It is averaged over draws, since a flight must not settle the question for the fitted values
        alone. A model has an infinite distance to itself.
        """
        count = len(self.models)
        out = np.full((count, count, DRAWS), np.inf)
        for true, model in enumerate(self.models):
            values = model.draws(len(information))
            own = model.misfit(information, values)
            for k, other in enumerate(self.models):
                if k != true:
                    growth = other.misfit(information, values) - own
                    out[true, k] = np.maximum(growth, 0.0)
        return out

    def value(self, information: np.ndarray) -> float:
        """Return the value of more information (k, k) on all columns, 0 to 1."""
        nearest = self.distances(information).min(axis=1)
        # A concave function, so more evidence than decides does not attract motions.
        return float(self.beliefs @ np.mean(-np.expm1(-nearest / (2.0 * AMBIGUOUS)), axis=1))

    def probability(self, information: np.ndarray) -> float:
        """Return the probability that all gaps exceed AMBIGUOUS in favour of the true model.

        Noise adds 4 D to the variance of a gap that it leaves at D on the mean.
        """
        distance = np.minimum(self.distances(information), 1e9)
        start = (self.gaps - self.gaps[:, None])[:, :, None]
        sure = (start + distance - AMBIGUOUS) / (2.0 * np.sqrt(np.maximum(distance, 1e-9)))
        return float(self.beliefs @ np.mean(ndtr(sure.min(axis=1)), axis=1))

    def without_twins(self, everything: np.ndarray) -> tuple[Rivalry, list[str]]:
        """Return (Rivalry without models that no flight distinguishes from one before; sentences).

        everything : (k, k) information of all motions together
        """
        distance = self.distances(everything).mean(axis=2)
        kept: list[int] = []
        sentences = []
        for k in range(len(self.models)):
            twin = next((one for one in kept if distance[one, k] < AMBIGUOUS), None)
            if twin is None:
                kept.append(k)
                continue
            names = self.models[twin].name, self.models[k].name
            sentences.append("No flight in this box distinguishes {} from {}.".format(*names))
        models = tuple(self.models[k] for k in kept)
        return replace(self, models=models, gaps=self.gaps[kept]), sentences

    def answer(self, information: np.ndarray) -> str:
        """Return a clause: what a flight with this information is expected to settle."""
        first, *others = (model.name for model in self.models)
        return (
            f"It distinguishes {first} from {listed(others)} with a probability of "
            f"{100.0 * self.probability(information):.0f} %"
        )


@dataclass(frozen=True, eq=False)
class Precision:
    """A finding without a rival; more data make its values more precise.

    what : its label; worth : m, as of Rivalry
    mine, all : places of its columns, and of those of the whole model
    """

    what: str
    worth: float
    known: _Known
    mine: np.ndarray
    all: np.ndarray

    def shrinkage(self, information: np.ndarray) -> np.ndarray:
        """Return standard deviations with more information, relative to those of today, (k,)."""
        variances = []
        for more in (np.zeros_like(information), information):
            gram = (self.known.gram + more)[np.ix_(self.all, self.all)]
            scaled = np.linalg.inv(gram + np.diag(self.known.sizes[self.all] ** -2.0))
            variances.append(np.diag(scaled)[np.isin(self.all, self.mine)])
        return np.sqrt(variances[1] / variances[0])

    def value(self, information: np.ndarray) -> float:
        """Return the value of more information (k, k) on all columns, 0 to 1."""
        return float(1.0 - np.mean(self.shrinkage(information) ** 2))

    def answer(self, information: np.ndarray) -> str:
        """Return a clause: how much more precise the values become."""
        left = float(np.mean(self.shrinkage(information)))
        return f"It reduces the standard deviations of {self.what} to {100.0 * left:.0f} %"


Question = Rivalry | Precision


@dataclass(frozen=True, eq=False)
class NextFlight:
    """A planned flight.

    path : TimedPath; parts : ((start s, motion in words), ...); answers : sentences, the most valuable
        question first; probability : that all questions of rivals are settled, None without any
    """

    path: TimedPath
    parts: tuple[tuple[float, str], ...]
    answers: tuple[str, ...]
    probability: float | None

    @property
    def sentences(self) -> list[str]:
        """Return the plan in words: how long, how fast, what it tells."""
        steps = np.linalg.norm(np.diff(self.path.p, axis=0), axis=1)
        return [
            f"Fly next_flight.csv: {self.path.duration:.0f} s, {steps.sum():.0f} m, at most "
            f"{steps.max() * RATE:.1f} m/s.",
            *self.answers,
            "Then diagnose the old flights and this one together.",
        ]

    def as_json(self) -> dict[str, object]:
        """Return plain values for diagnosis.json."""
        return {
            "duration": self.path.duration,
            "settles": list(self.answers),
            "probability": self.probability,
            "parts": [{"from": start, "motion": what} for start, what in self.parts],
        }

    def files(self) -> dict[str, str]:
        """Return {name of a file: its text}: a timed path, TUM poses, and waypoints."""
        t, p, yaw = self.path.t, self.path.p, self.path.yaw
        rows = [",".join(f"{x:.4f}" for x in row) for row in np.column_stack([t, p, yaw])]
        half = 0.5 * yaw
        turns = np.column_stack([np.zeros((len(t), 2)), np.sin(half), np.cos(half)])
        poses = [" ".join(f"{x:.6f}" for x in row) for row in np.column_stack([t, p, turns])]
        points = ["x,y,z,yaw,t,motion"]
        for k, what in self._waypoints():
            values = (*p[k], np.angle(np.exp(1j * yaw[k])), t[k])
            points.append(",".join([*(f"{x:.2f}" for x in values), f'"{what}"']))
        return {
            "next_flight.csv": "\n".join(["t,x,y,z,yaw", *rows]) + "\n",
            "next_flight.tum": "\n".join(poses) + "\n",
            "next_flight_waypoints.csv": "\n".join(points) + "\n",
        }

    def _waypoints(self) -> Iterator[tuple[int, str]]:
        """Yield (row of the path, motion) at each stop, and every two seconds between them."""
        begins = np.array([start for start, _ in self.parts])
        for first, last in zip(self.path.stops, self.path.stops[1:]):
            count = max(1, round((last - first) / (2.0 * RATE)))
            part = np.searchsorted(begins, first / RATE + 1e-6, side="right") - 1
            for k in range(count):
                yield first + round(k * (last - first) / count), self.parts[part][1]
        yield self.path.stops[-1], "end"


def plan_flight(
    flights: Sequence[Flight],
    found: Attribution,
    findings: Sequence[EffectFinding],
    library: Library,
) -> NextFlight | None:
    """Plan the flight that settles what the diagnosis of some Flights leaves open.

    Parameters
    ----------
    flights : sequence of Flight
        The diagnosed flights, with TDOAs and ground truth.
    found : Attribution
        Their attribution; `findings` hold the worth of its candidates.
    library : Library
        Motions to join, as of `motions`.

    Returns
    -------
    NextFlight, or None if the diagnosis found nothing.
    """
    if not found.selection.chosen:
        return None
    rivalries, values, known, told = questions_of(found, findings)
    forecast = Forecast(flights, found.selection, known, told)
    gains = forecast.information(library.paths)
    apart = [one.without_twins(gains.sum(axis=0)) for one in rivalries]
    twins = [sentence for _, sentences in apart for sentence in sentences]
    open_ones = [one for one, _ in apart if len(one.models) > 1]
    questions: Sequence[Question] = open_ones or values

    def value(information: np.ndarray) -> float:
        return sum(question.worth * question.value(information) for question in questions)

    worth = sum(question.worth for question in questions)
    path, parts = _joined(library, gains, value, worth)
    information = forecast.information([path])[0]
    most = sorted(questions, key=lambda one: -one.worth * one.value(information))
    answers = [f"{one.answer(information)} (worth {100.0 * one.worth:.1f} cm)." for one in most]
    chances = [one.probability(information) for one in open_ones]
    return NextFlight(path, parts, (*answers, *twins), min(chances) if chances else None)


def questions_of(
    found: Attribution, findings: Sequence[EffectFinding]
) -> tuple[list[Rivalry], list[Precision], _Known, list[Candidate]]:
    """Return the open questions, and what the old flights know.

    Returns
    -------
    Rivalries of findings with the nearest MOST_RIVALS rivals; the Precision of every finding; the
    information of the old flights; the Candidates that all this is about.
    """
    selection = found.selection
    near = {
        candidate: sorted(
            (rival for rival in rivals if rival.gap < AMBIGUOUS), key=lambda one: one.gap
        )[:MOST_RIVALS]
        for candidate, rivals in zip(selection.chosen, selection.rivals)
    }
    rivals = [rival.candidate for several in near.values() for rival in several]
    told = list(dict.fromkeys([*selection.chosen, *rivals]))
    table = selection.table.with_terms([term for one in told for term in one.terms])
    columns = tuple(columns_of(told))
    x, weight = table.matrix(columns), selection.fit.information(table)
    known = _Known(columns, product(weighted(x, weight), x), prior_sizes(columns))
    worths = {
        candidate: finding.worth
        for finding in findings
        for candidate in finding.candidates
        if finding.worth is not None
    }

    def worth(candidate: Candidate) -> float:
        size = table.matrix(candidate.columns) @ selection.fit.values(candidate.columns)
        # Where no filter was run without it, its contribution to a row counts.
        return max(worths.get(candidate, float(np.sqrt(np.mean(size**2)))), SMALLEST_WORTH)

    def model_of(own: Candidate, rest: Sequence[Candidate]) -> Model:
        places = known.places([*rest, own])
        fitted = refit(table, columns_of([*rest, own]), selection.fit)
        information = known.gram[np.ix_(places, places)] + np.diag(known.sizes[places] ** -2.0)
        return Model(own.label, places, fitted.beta, information)

    rivalries = []
    for candidate, several in near.items():
        rest = [one for one in selection.chosen if one is not candidate]
        models = [model_of(one, rest) for one in (candidate, *(each.candidate for each in several))]
        # A rival with a better criterion was refused for another reason: nothing is decided.
        gaps = np.array([0.0, *(max(rival.gap, -AMBIGUOUS) for rival in several)])
        if several:
            rivalries.append(Rivalry(worth(candidate), tuple(models), gaps))
    every = known.places(selection.chosen)
    values = [
        Precision(one.label, worth(one), known, known.places([one]), every)
        for one in selection.chosen
    ]
    return rivalries, values, known, told


class Forecast:
    """Predicts the information of paths about the columns of a diagnosis."""

    def __init__(
        self,
        flights: Sequence[Flight],
        selection: Selection,
        known: _Known,
        told: Sequence[Candidate],
    ) -> None:
        """Take the old flights, their Selection, and the Candidates of the columns of `known`.

        New rows have the mean curvature of old rows of the same axis and channel.
        """
        self._selection, self._known, self._told = selection, known, told
        self._anchors = flights[0].anchors
        self._pairs, self._reach = _links(flights)
        self._with_imu = any(CHANNELS[name].stream == "imu" for name in selection.table.present)
        group = selection.table.group
        most = 3 * len(CHANNELS)
        total = np.bincount(group, _curvature(selection), most)
        self._mean = total / np.maximum(np.bincount(group, minlength=most), 1)

    def information(self, paths: Sequence[TimedPath]) -> np.ndarray:
        """Return the information of each TimedPath on all columns, (len(paths), k, k)."""
        table = table_of([self._predicted(path) for path in paths])
        table = table.with_terms([term for one in self._told for term in one.terms])
        x = dense(table.matrix(self._known.columns))
        # An event of an old flight is not in another one.
        events = [one for one in self._told if not recurs(one)]
        x[:, self._known.places(events)] = 0.0
        weight = self._mean[table.group]
        out = []
        for number in range(len(paths)):
            rows = table.flight == number
            out.append(x[rows].T @ (x[rows] * weight[rows, None]))
        return np.array(out)

    def _predicted(self, path: TimedPath) -> ChannelResiduals:
        """Return the residuals of a TimedPath without errors and noise, whose regressors count."""
        flown = Trajectory.along(path.t, path.p, path.yaw)
        count = len(self._pairs)
        cells = np.arange(0.0, path.duration, CELL)
        t = (cells[:, None] + CELL * np.arange(count) / count).ravel()
        a, b = np.tile(self._pairs, (len(cells), 1)).T
        p = flown.motion(t).p
        rows = self._anchors.index(a), self._anchors.index(b)
        to = [np.linalg.norm(p - self._anchors.positions[row], axis=1) for row in rows]
        heard = (np.maximum(*to) <= self._reach) & (t <= path.duration)
        tdoa = Tdoas(t[heard], a[heard], b[heard], (to[1] - to[0])[heard])
        t_truth = np.arange(0.0, path.duration, 1.0 / TRUTH_RATE)
        motion = flown.motion(t_truth)
        imu = None
        if self._with_imu:
            t_imu = np.arange(0.0, path.duration, 1.0 / IMU_RATE)
            felt = flown.motion(t_imu)
            imu = Imu(t_imu, felt.body_rates, felt.specific_force)
        flight = Flight("next", self._anchors, tdoa, imu, Truth(t_truth, motion.p, motion.q))
        span = MARGIN, path.duration - MARGIN
        comparison = Comparison.of(flight, GroundTruth(), EffectSet(), span)
        parts = {name: channel.residual(comparison) for name, channel in CHANNELS.items()}
        return {name: part for name, part in parts.items() if part is not None}


def _curvature(selection: Selection) -> np.ndarray:
    """Return minus the second derivative of the log-likelihood by each row, (n,), 1 / unit^2.

    On average it is below `Fit.information`, whose weights belong to iterations of a fit: a row of
    Student's t distinguishes explanations less than a Gaussian row.
    """
    model, table = selection.fit, selection.table
    scale = model.scale[table.group]
    power = (model.residual / scale) ** 2
    each = (NU + 1.0) * (NU - power) / (NU + power) ** 2
    out: np.ndarray = each / (scale**2 * model.inflation[table.group])
    return out


def route(places: np.ndarray, yaw: Sequence[float], limits: Limits) -> TimedPath:
    """Return the TimedPath from place to place, (n, 3) m, with a yaw (n,), rad, at each."""
    out = TimedPath(places[:1], np.array(yaw[:1]), "start", (0,))
    for place, angle in zip(places[1:], yaw[1:]):
        out = out.then(_line(out.p[-1], place, (out.yaw[-1], angle), limits, "line"))
    return out


def motions(room: Room, flights: Sequence[Flight], limits: Limits) -> Library:
    """Return the Library of motions in a Room: lines, circles, turns, and passes at anchors.

    They keep the clearance of `Room.flyable` to walls, floor and ceiling, and ANCHOR_CLEARANCE to
    anchors. Raises InputError if none fits, or if a Flight lacks TDOAs.
    """
    anchors = flights[0].anchors
    if not all(len(flight.tdoa) for flight in flights):
        raise InputError("--plan-flight: needs TDOAs in each flight; leave it out.")
    every = _everywhere(room, anchors, limits)
    out = [path for path in every if path.duration <= limits.time and _is_clear(path, anchors)]
    if not out:
        raise InputError(
            "--plan-flight: no motion fits into this box, this time and the distance of "
            f"{ANCHOR_CLEARANCE:g} m to anchors; give a larger box or more time."
        )
    return Library(tuple(out), anchors, limits)


def _everywhere(room: Room, anchors: Anchors, limits: Limits) -> list[TimedPath]:
    """Return the motions in a Room, whether they fit or not."""
    low, high = room.flyable
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    levels = {"low": low[2], "middle": centre[2], "high": high[2]}
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    slow = replace(limits, speed=SLOW * limits.speed)
    out = []
    for name, z in levels.items():
        at = np.array([*centre[:2], z])
        for k, axis in enumerate("xy"):
            reach = half * np.eye(3)[k]
            for turn, how in ((0.0, ""), (2.0 * np.pi, ", turning once")):
                words = f"line along {axis}, {name}{how}"
                out.append(_line(at - reach, at + reach, (0.0, turn), limits, words))
        for share, size in ((1.0, "wide"), (0.5, "narrow")):
            radius = share * min(half[:2])
            for along, how in ((False, "yaw kept"), (True, "yaw along the track")):
                out.append(_circle(at, radius, along, limits, f"{size} circle, {name}, {how}"))
    for corner in corners[:2]:
        reach = half * [*corner, -1.0]
        out.append(_line(centre + reach, centre - reach, (0.0, 0.0), limits, "rising diagonal"))
    reach = half * [1.0, 1.0, 0.0]
    for each, how in ((slow, "slowly"), (limits, "fast")):
        there = _line(centre - reach, centre + reach, (0.0, 0.0), each, f"diagonal, {how}")
        back = _line(centre + reach, centre - reach, (0.0, 0.0), each, "back")
        out.append(there.then(back))
    for place, name in (
        (centre, "in the middle"),
        *((centre + half * [*c, 0], "in a corner") for c in corners),
    ):
        out.append(_line(place, place, (0.0, 2.0 * np.pi), limits, f"full turn {name}"))
    for anchor in np.argsort(np.linalg.norm(anchors.positions - centre, axis=1))[:NEAR_ANCHORS]:
        near = _beside(anchors.positions[anchor], low, high)
        number = anchors.ids[anchor]
        to = _line(centre, near, (0.0, 0.0), limits, f"to anchor {number}")
        out.append(to.then(_line(near, centre, (0.0, 0.0), limits, "back")))
        foot, top = np.array([*near[:2], low[2]]), np.array([*near[:2], high[2]])
        up = _line(foot, top, (0.0, 0.0), limits, f"up at anchor {number}")
        out.append(up.then(_line(top, foot, (0.0, 0.0), limits, "down")))
    return out


def _joined(
    library: Library, gains: np.ndarray, value: Callable[[np.ndarray], float], worth: float
) -> tuple[TimedPath, tuple[tuple[float, str], ...]]:
    """Return the (TimedPath, parts) of the motions with the largest gain of value per second.

    gains : (n, k, k) information of each motion; value : of information, m; worth : its largest, m
    """
    paths, anchors, limits = library
    path: TimedPath | None = None
    parts: list[tuple[float, str]] = []
    information = np.zeros_like(gains[0])
    while True:
        now, choices = value(information), []
        if path is not None and path.duration >= SHORTEST and now >= ENOUGH * worth:
            break
        for motion, gain in zip(paths, gains):
            longer, start = _continued(path, motion, limits)
            if longer.duration <= limits.time and _is_clear(longer, anchors):
                spent = longer.duration - (0.0 if path is None else path.duration)
                choices.append(((value(information + gain) - now) / spent, start, longer, motion))
        if not choices:
            break
        gained, start, longer, motion = max(choices, key=lambda one: one[0])
        if gained <= 0.0 and path is not None and path.duration >= SHORTEST:
            break
        information = information + gains[paths.index(motion)]
        if path is not None and start > path.duration:
            parts.append((path.duration, "way"))
        parts.append((start, motion.what))
        path = longer
    assert path is not None  # each motion of the library fits into the time
    return path, tuple(parts)


def _continued(
    path: TimedPath | None, motion: TimedPath, limits: Limits
) -> tuple[TimedPath, float]:
    """Return (the path, the way to a motion and the motion; when the motion starts, s)."""
    if path is None:
        return motion, 0.0
    turn = float(np.angle(np.exp(1j * (motion.yaw[0] - path.yaw[-1]))))
    if max(float(np.linalg.norm(motion.p[0] - path.p[-1])), abs(turn)) > 1e-6:
        ends = path.yaw[-1], path.yaw[-1] + turn
        path = path.then(_line(path.p[-1], motion.p[0], ends, limits, "way"))
    return path.then(motion), path.duration


def _links(flights: Sequence[Flight]) -> tuple[np.ndarray, float]:
    """Return (pairs of anchors (m, 2) that were heard, the most frequent first; reach, m)."""
    anchors = flights[0].anchors
    heard = np.concatenate([np.column_stack([one.tdoa.a, one.tdoa.b]) for one in flights])
    heard = heard[np.isin(heard, anchors.ids).all(axis=1) & (heard[:, 0] != heard[:, 1])]
    pairs, count = np.unique(heard, axis=0, return_counts=True)
    order = np.argsort(-count, kind="stable")[:MOST_PAIRS]
    farthest = 0.0
    for flight in flights:
        assert flight.truth is not None  # of GroundTruth
        some = flight.truth.p[:: max(1, len(flight.truth.p) // 500)]
        away = np.linalg.norm(some[:, None] - flight.anchors.positions, axis=2)
        inside = np.isin(flight.anchors.ids, heard)
        farthest = max(farthest, float(away[:, inside].min(axis=0).max()))
    # All anchors of a room are heard everywhere; of a hall those that were ever near.
    span = float(np.linalg.norm(np.ptp(anchors.positions, axis=0)))
    return pairs[order][count[order] >= FEW * count.max()], max(farthest, span)


def _beside(anchor: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a place in a box near an anchor, (3,) m, ANCHOR_CLEARANCE away if there is one."""
    near = np.clip(anchor, low, high)
    away = np.linalg.norm(near - anchor)
    if away >= ANCHOR_CLEARANCE:
        return near
    inwards = 0.5 * (low + high) - anchor
    step = 1.01 * ANCHOR_CLEARANCE / max(float(np.linalg.norm(inwards)), 1e-9)
    out: np.ndarray = np.clip(anchor + min(1.0, step) * inwards, low, high)
    return out


def _is_clear(path: TimedPath, anchors: Anchors) -> bool:
    """Return whether a TimedPath keeps its distance to all anchors."""
    away = np.linalg.norm(path.p[::5, None] - anchors.positions, axis=2)
    return bool(away.min() >= ANCHOR_CLEARANCE)


def _line(
    start: np.ndarray, end: np.ndarray, yaw: tuple[float, float], limits: Limits, what: str
) -> TimedPath:
    """Return the straight TimedPath between two places, from rest to rest, while the yaw turns."""
    s = _progress(float(np.linalg.norm(end - start)), abs(yaw[1] - yaw[0]), limits)
    p, turned = start + s[:, None] * (end - start), yaw[0] + s * (yaw[1] - yaw[0])
    return TimedPath(p, turned, what, (0, len(s) - 1))


def _circle(centre: np.ndarray, radius: float, along: bool, limits: Limits, what: str) -> TimedPath:
    """Return a level circle, from rest to rest."""
    speed = min(limits.speed, np.sqrt(limits.acceleration * radius))
    turned = 2.0 * np.pi if along else 0.0
    s = _progress(2.0 * np.pi * radius, turned, replace(limits, speed=speed))
    angle = 2.0 * np.pi * s
    around = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(s))])
    yaw = 0.5 * np.pi + angle if along else np.zeros(len(s))
    return TimedPath(centre + around, yaw, what, (0, len(s) - 1))


def _progress(length: float, turn: float, limits: Limits) -> np.ndarray:
    """Return the progress, 0 to 1, at RATE on the way over a length, m, with a turn, rad.

    Speed and turning rate rise and fall smoothly, within the limits.
    """
    speed = min(limits.speed, np.sqrt(max(length, 1e-6) * limits.acceleration / STEEPEST))
    ramp = max(STEEPEST * speed / limits.acceleration, min(SPEED_UP, turn / limits.turning), 0.5)
    cruise = max(length / speed, turn / limits.turning, ramp)
    t = np.arange(np.ceil((cruise + ramp) * RATE) + 1) / RATE
    scale = (cruise + ramp) / t[-1]  # the last sample is at the end

    def since(x: np.ndarray) -> np.ndarray:
        inside = np.clip(x, 0.0, 1.0)
        return STEP.integ()(inside) + np.maximum(x - 1.0, 0.0)

    t = t * scale
    out: np.ndarray = ramp * (since(t / ramp) - since((t - cruise) / ramp)) / cruise
    return out
