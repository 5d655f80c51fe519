# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Plan the next flight: the path that settles what a diagnosis leaves open.

Two explanations of a finding predict different measurements on another path. The planner makes a
library of motions in a box. The channels of the diagnosis predict the rows of a fit on each motion.
The distance between two explanations is the misfit of one to the prediction of the other, after a
fit to the old flights and the new rows. It is twice the expected log Bayes factor, and averaged over
the values that the old flights allow. The planner joins the motions with the largest gain per
second. The worth of a finding, in metres, is the weight of its gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.base import listed

from ..simulation.vehicles import Trajectory
from .attribution import Attribution
from .channels import CHANNELS, ChannelResiduals, Comparison, of_comparison
from .findings import EffectFinding
from .motions import RATE, Library, TimedPath, continued, is_clear
from .references import GroundTruth
from .refinement import recurs
from .regression.algebra import dense, product, weighted
from .regression.fit import NU, prior_sizes, refit
from .regression.select import AMBIGUOUS, Selection
from .regression.table import AXES, table_of
from .regression.terms import Candidate, Column, columns_of

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
        """Return by how much a new flight separates the models, (true model, other model, DRAWS).

        It is the growth of the gap between both models if the first is true, without noise. There is
        one growth per draw of its values, since a flight must not settle the question for the fitted
        values alone. A model has an infinite distance to itself.

        information : (k, k) of the new flight, on all columns
        """
        count = len(self.models)
        out = np.full((count, count, DRAWS), np.inf)
        for true, true_model in enumerate(self.models):
            values = true_model.draws(len(information))
            own_misfit = true_model.misfit(information, values)
            for other, other_model in enumerate(self.models):
                if other != true:
                    growth = other_model.misfit(information, values) - own_misfit
                    out[true, other] = np.maximum(growth, 0.0)
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
    information_of = partial(forecast, flights, found.selection, known, told)
    gains = information_of(library.paths)
    apart = [one.without_twins(gains.sum(axis=0)) for one in rivalries]
    twins = [sentence for _, sentences in apart for sentence in sentences]
    open_ones = [one for one, _ in apart if len(one.models) > 1]
    questions: Sequence[Question] = open_ones or values

    def value(information: np.ndarray) -> float:
        return sum(question.worth * question.value(information) for question in questions)

    worth = sum(question.worth for question in questions)
    path, parts = _joined(library, gains, value, worth)
    (information,) = information_of([path])
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


def forecast(
    flights: Sequence[Flight],
    selection: Selection,
    known: _Known,
    told: Sequence[Candidate],
    paths: Sequence[TimedPath],
) -> np.ndarray:
    """Return the information of each TimedPath on the columns of `known`, (len(paths), k, k).

    New rows have the mean curvature of old rows of the same axis and channel.

    flights : the old ones, with their Selection; told : Candidates of the columns
    """
    pairs, reach = _links(flights)
    with_imu = any(CHANNELS[name].stream == "imu" for name in selection.table.present)
    table = table_of(
        [_predicted(path, flights[0].anchors, pairs, reach, with_imu) for path in paths]
    )
    table = table.with_terms([term for one in told for term in one.terms])
    x = dense(table.matrix(known.columns))
    # An event of an old flight is not in another one.
    x[:, known.places([one for one in told if not recurs(one)])] = 0.0
    old = selection.table.group
    most = AXES * len(CHANNELS)
    total = np.bincount(old, _curvature(selection), most)
    mean = total / np.maximum(np.bincount(old, minlength=most), 1)
    weighted_x = x * mean[table.group][:, None]
    of_path = [table.flight == number for number in range(len(paths))]
    return np.array([x[rows].T @ weighted_x[rows] for rows in of_path])


def _predicted(
    path: TimedPath, anchors: Anchors, pairs: np.ndarray, reach: float, with_imu: bool
) -> ChannelResiduals:
    """Return the residuals of a TimedPath without errors and noise, whose regressors count.

    pairs : (m, 2) ids of the anchors that are heard together, up to `reach`, m
    """
    flown = Trajectory(path.t, path.p, path.yaw)
    cells = np.arange(0.0, path.duration, CELL)
    t = (cells[:, None] + CELL * np.arange(len(pairs)) / len(pairs)).ravel()
    a, b = np.tile(pairs, (len(cells), 1)).T
    p = flown.motion(t).p
    to_a, to_b = (
        np.linalg.norm(p - anchors.positions[anchors.index(ids)], axis=1) for ids in (a, b)
    )
    heard = (np.maximum(to_a, to_b) <= reach) & (t <= path.duration)
    tdoa = Tdoas(t[heard], a[heard], b[heard], (to_b - to_a)[heard])
    t_truth = np.arange(0.0, path.duration, 1.0 / TRUTH_RATE)
    motion = flown.motion(t_truth)
    imu = None
    if with_imu:
        t_imu = np.arange(0.0, path.duration, 1.0 / IMU_RATE)
        felt = flown.motion(t_imu)
        imu = Imu(t_imu, felt.body_rates, felt.specific_force)
    flight = Flight("next", anchors, tdoa, imu, Truth(t_truth, motion.p, motion.q))
    span = MARGIN, path.duration - MARGIN
    return of_comparison(Comparison.of(flight, GroundTruth(), EffectSet(), span))


def _curvature(selection: Selection) -> np.ndarray:
    """Return minus the second derivative of the log-likelihood by each row, (n,), 1 / unit^2.

    On average it is below `Fit.information`, whose weights belong to iterations of a fit: a row of
    Student's t distinguishes explanations less than a Gaussian row.
    """
    model, group = selection.fit, selection.table.group
    scale = model.scale[group]
    power = (model.residual / scale) ** 2
    each = (NU + 1.0) * (NU - power) / (NU + power) ** 2
    out: np.ndarray = each / (scale**2 * model.inflation[group])
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
            longer, start = continued(path, motion, limits)
            if longer.duration <= limits.time and is_clear(longer, anchors):
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
