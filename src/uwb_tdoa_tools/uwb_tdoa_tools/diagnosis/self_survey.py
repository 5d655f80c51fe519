"""Where anchors stand and how late they are, from flights of which nobody knows the path.

A run of the filter gives innovations and their derivatives by every position and delay, with the path integrated out
(`uwb_tdoa_ekf/sensitivity.py`). Whatever else is systematic, by antennas, metal or floors, is a smooth function of the
place for every anchor, integrated out as well: a Gaussian process, by random Fourier features (Rahimi and Recht, Random
features for large-scale kernel machines, NIPS 2007). How large delays and functions are, the evidence says (MacKay,
Bayesian interpolation, Neural Computation 1992). Where functions explain what shifts would, shifts stay where the prior is.
"""

from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig

from .channels import CHANNELS, Comparison
from .references import Nothing
from .regression.fit import NU, student_scale

FEWEST = 4  # TDOAs in a cell; noise of fewer hides what is slow
ROUNDS = 2  # linear solutions, each about the last
BLOCK = 3.0  # s over which sums of scores show how alike errors are
SYSTEMATIC = 12.0  # by which the information is divided beside that: errors that last are no noise
PRELIMINARY = 20.0  # the same for the solution about which that is measured
PRELIMINARY_DELAY_STD = 0.05  # m
DETERMINED = 1e-4  # share of the largest eigenvalue that a direction must have to count there
DELAY_STDS = 0.02, 0.05, 0.1, 0.2, 0.4  # m, that the evidence chooses from
FUNCTION_STDS = 0.003, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3  # m, the same of the functions of the place
WITHIN_MARK = 5  # stamps at which the estimate is averaged over a mark
FEATURES, LENGTH = 20, 1.2  # of each function, and m over which it changes


@dataclass(frozen=True, eq=False)
class Surveyed:
    """anchors : Anchors; delays (N,) m; covariance (4N, 4N) m^2, of positions, anchor by anchor, and then of delays;
    seconds : s in the air that tell; before, left : m, scale of the slow innovations with the anchors as given, and with these; tdoa_std : m, for the filter: so
    that it believes in as many independent TDOAs as there are; delay_std, function_std : m, what the evidence says of the
    size of delays, and of functions of the place."""

    anchors: Anchors
    delays: np.ndarray
    covariance: np.ndarray
    seconds: float
    before: float
    left: float
    tdoa_std: float
    delay_std: float
    function_std: float

    @property
    def position_std(self):
        """(N, 3) m."""
        return np.sqrt(np.diag(self.covariance))[: 3 * len(self.anchors)].reshape(-1, 3)


@dataclass(frozen=True)
class Mark:
    """Where the tag was on average from `first` to `last`, s since the first TDOA of a flight: position (3,) m +- std, m."""

    flight: str
    first: float
    last: float
    position: tuple
    std: float


def survey(flights, position_std, base=EffectSet(), config=None, marks=(), progress=lambda: None):
    """Surveyed of Flights of the same anchors, which are where they say within position_std, (N, 3) m.

    base : EffectSet that is in the model; config : FilterConfig; marks : Marks. The frame is that of the coordinates with
    the smallest std. Raises InputError for a flight that is too short.
    """
    given, reference = flights[0].anchors, Nothing(config)
    flights = [reference.prepare(flight) for flight in flights]
    n = len(given)
    start = np.concatenate([given.positions.ravel(), np.zeros(n)])
    config = config or FilterConfig()
    best, found = start, None
    for _ in range(ROUNDS):
        anchors = given.at(best[: 3 * n].reshape(n, 3))
        gram, vector, alike, slow, seconds = 0.0, 0.0, [], [], 0.0
        for flight in flights:
            here = [mark for mark in marks if mark.flight == flight.name]
            part = _residual(replace(flight, anchors=anchors), best[3 * n :], base, reference)
            slow.append(_slow(part))
            grams, vectors, marked = _equations(part, flight, here)
            seconds += BLOCK * len(grams)
            alike.append(_inflation(grams[:, : 4 * n, : 4 * n], vectors[:, : 4 * n], position_std.ravel()))
            inflation = SYSTEMATIC * alike[-1]
            gram = gram + grams.sum(axis=0) / inflation + marked[0]
            vector = vector + vectors.sum(axis=0) / inflation + marked[1]
            progress()
        step, covariance, sizes = _by_evidence(gram, vector, position_std.ravel(), best - start)
        if found is None:
            before = student_scale(np.concatenate(slow))
        tdoa_std = config.tdoa_std * float(np.sqrt(np.mean(alike) / config.tdoa_correlation_length))
        best, found = best + step, (covariance, tdoa_std, *sizes)
    moved = given.at(best[: 3 * n].reshape(n, 3))
    parts = [_residual(replace(flight, anchors=moved), best[3 * n :], base, reference) for flight in flights]
    left = student_scale(np.concatenate([_slow(part) for part in parts]))
    covariance, *sizes = found
    return Surveyed(moved, best[3 * n :], covariance, seconds, before, left, *sizes)


def delay_effect(anchors, delays):
    """The effect anchor_delay with delays (N,) m of Anchors."""
    return EFFECTS["anchor_delay"]({str(i): float(delay) for i, delay in zip(anchors.ids, delays)})


def _residual(flight, delays, base, reference):
    """TdoaResidual of a prepared Flight with late anchors: the innovations of a run."""
    effects = EffectSet((*base.effects, delay_effect(flight.anchors, delays))) if delays.any() else base
    part = CHANNELS["tdoa"].residual(Comparison.of(flight, reference, effects))
    if part is None:
        raise InputError(f"{flight.name}: has no TDOAs in the air to survey with; fly for half a minute at least.")
    return part


def _slow(part):
    """Innovations averaged over cells of half a second, (n,) m, those of which hold enough to hide the noise."""
    rows = part.rows()
    return rows.y[rows.count >= FEWEST]


def _equations(part, flight, marks):
    """(grams (b, k, k), vectors (b, k)) of the normal equations that a TdoaResidual gives, block by block, and (gram (k, k),
    vector (k,)) of those that the Marks of its Flight give."""
    samples, air, anchors = part.samples, part.airborne, part.samples.anchors
    ids = [str(i) for i in anchors.ids]
    positions = EFFECTS["anchor_position"]().regressors(samples, [f"{i}.{axis}" for i in ids for axis in "xyz"])
    late = EFFECTS["anchor_delay"]().regressors(samples, ids)
    functions = (late[:, :, None] * _features(samples.p)[:, None, :]).reshape(len(late), -1)
    stamps = [flight.tdoa.t[0] + np.linspace(mark.first, mark.last, WITHIN_MARK) for mark in marks]
    regressors = np.nan_to_num(np.concatenate([positions, late, functions], axis=1))
    columns, moved = part.innovations.and_positions(regressors, np.sort(np.concatenate([[], *stamps])))
    columns = columns[air]
    innovation, variance = part.innovations.value[air], part.innovations.variance[air]
    error = innovation / np.sqrt(variance)
    scale = max(1.4826 * np.median(np.abs(error)), 1e-3)
    weight = (NU + 1.0) / (NU + (error / scale) ** 2) / variance
    block = ((samples.t[air] - samples.t[air][0]) / BLOCK).astype(int)
    parts = [(columns[block == k], weight[block == k], innovation[block == k]) for k in np.unique(block)]
    grams = np.stack([(some * w[:, None]).T @ some for some, w, _ in parts])
    vectors = np.stack([some.T @ (w * value) for some, w, value in parts])
    return grams, vectors, _marked(marks, stamps, moved, part.innovations.run.odometry)


def _marked(marks, stamps, moved, odometry):
    """(gram (k, k), vector (k,)): the estimate at a mark, averaged over it, is off by what the parameters do to it."""
    gram, vector = np.zeros((moved.shape[2],) * 2), np.zeros(moved.shape[2])
    order = np.argsort(np.concatenate([[], *stamps]), kind="stable")
    moved = moved[np.argsort(order, kind="stable")].reshape(-1, WITHIN_MARK, *moved.shape[1:]).mean(axis=1)
    for mark, t, columns in zip(marks, stamps, moved):
        estimate = [np.interp(t, odometry.t, odometry.p[:, k]).mean() for k in range(3)]
        place = min(int(np.searchsorted(odometry.t, t[WITHIN_MARK // 2])), len(odometry.t) - 1)
        weight = 1.0 / (np.diag(odometry.covariance[place, :3, :3]) + mark.std**2)
        gram += (columns * weight[:, None]).T @ columns
        vector += columns.T @ (weight * (np.array(estimate) - mark.position))
    return gram, vector


def _inflation(grams, vectors, position_std):
    """By how much sums of scores over blocks (b, k, k), (b, k) are larger than those of independent errors, averaged over the
    directions that the data tell."""
    gram, vector = grams.sum(axis=0) / PRELIMINARY, vectors.sum(axis=0) / PRELIMINARY
    sizes = np.concatenate([position_std, np.full(len(vector) - len(position_std), PRELIMINARY_DELAY_STD)])
    step = np.linalg.solve(gram + np.diag(sizes**-2.0), vector)
    scores = vectors - grams @ step
    values, directions = np.linalg.eigh(grams.sum(axis=0))
    told = values > DETERMINED * values[-1]
    return float(np.mean(np.sum((scores @ directions[:, told]) ** 2, axis=0) / values[told]))


def _features(p):
    """Random Fourier features of a Gaussian kernel at places p (n, 3) m: (n, FEATURES)."""
    waves = np.random.default_rng(3).standard_normal((3, FEATURES // 2)) / LENGTH
    phase = p @ waves
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=1) * np.sqrt(2.0 / FEATURES)


def _by_evidence(gram, vector, position_std, offset):
    """(step (4N,), covariance (4N, 4N), (delay_std, function_std)) of the normal equations with the largest evidence.

    position_std (3N,) m; offset (4N,) m: where the equations were made, from what is given.
    """
    n = len(position_std) // 3
    best = None
    for delay_std in DELAY_STDS:
        for function_std in FUNCTION_STDS:
            sizes = np.concatenate([position_std, np.full(n, delay_std), np.full(n * FEATURES, function_std)])
            prior, centre = sizes**-2.0, np.concatenate([offset, np.zeros(n * FEATURES)])
            right = vector - prior * centre
            information = gram + np.diag(prior)
            step = np.linalg.solve(information, right)
            evidence = 0.5 * (right @ step - np.linalg.slogdet(information)[1] + np.sum(np.log(prior) - prior * centre**2))
            if best is None or evidence > best[0]:
                best = evidence, step, information, (delay_std, function_std)
    _, step, information, chosen = best
    return step[: 4 * n], np.linalg.inv(information)[: 4 * n, : 4 * n], chosen
