# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Train the different kinds of models by one call, `train`: effects by their physics, or the network of a paper.

`labels` are the errors of the TDOAs of a flight at their true poses.
The network is that of Zhao et al. (RA-L 2021). It has three layers of 30 neurons. If the orientation of an
anchor is unknown, it has no inputs that need orientations. As published (section V-B), inputs are scaled,
and mini-batch gradient descent minimizes squared errors. It stops if the validation error has not fallen
for five epochs in a row. The standard deviation is that on the validation flights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import copy
from dataclasses import dataclass, replace
from functools import partial
import hashlib
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from onnx import ModelProto
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist
from sklearn.neural_network import MLPRegressor

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError, refuse_others
from uwb_tdoa_bias.common.files import temporary_folder, write_bytes, write_picture
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD
from uwb_tdoa_bias.correction.model import ATTITUDE, FEATURES, Network, columns
from uwb_tdoa_bias.effects import EFFECTS, RADIO, EffectSet, Samples, samples_at

from ..checking.pair_rules import least_height
from ..choices import MODELS
from ..diagnosis.attribution import Attribution, attribute
from ..diagnosis.comparison import Baseline
from ..diagnosis.findings import usable
from ..diagnosis.references import GroundTruth
from ..diagnosis.refinement import effects_of
from ..diagnosis.regression.fit import refit
from ..diagnosis.regression.terms import columns_of
from ..diagnosis.validation import select_by_error
from ..exporting.onnx_file import GraphBuilder
from ..parallel import MapFunction
from ..scoring.evaluation import evaluate
from ..scoring.metrics import SHARES, Errors, Shrinkage, best_share, rms, scored_phase

# s after take-off and before landing that are excluded: near the floor TDOAs are wrong by metres
MARGIN = 0.5
LARGEST_ERROR = 1.0  # m; a larger error is an outlier, not bias (Zhao et al., section V-B)
ZERO_ERROR = 1e-3  # m; smaller labels mean that the TDOAs were computed, not measured
FEWEST_LABELS = 100  # least number of labels of a flight
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
HasAnchors = TypeVar("HasAnchors", Flight, "Labels")


@dataclass(frozen=True)
class Labels:
    """Hold the labelled TDOAs of one flight.

    Parameters
    ----------
    name : str
        Name of the flight.
    samples : Samples
        With poses from ground truth.
    error : numpy.ndarray
        Measured minus geometric TDOAs (n,), m.
    digest : str
        Hexadecimal digest of the data.
    """

    name: str
    samples: Samples
    error: np.ndarray
    digest: str

    def __len__(self) -> int:
        return len(self.error)

    @property
    def anchors(self) -> Anchors:
        """Return the anchors of the flight."""
        return self.samples.anchors


def labels(flight: Flight) -> Labels:
    """Return the labels of the airborne part of a flight without outliers.

    Raises
    ------
    InputError
        If the flight has too few usable TDOAs or no ground truth.
    """
    flight = with_level_attitude(flight)
    truth, data, anchors = required_truth(flight), flight.tdoa, flight.anchors
    _, first, last = scored_phase(truth)
    first, last = first + MARGIN, last - MARGIN
    chosen = (data.t > first) & (data.t < last)
    unknown = np.setdiff1d(np.concatenate([data.a[chosen], data.b[chosen]]), anchors.ids)
    if len(unknown):
        raise InputError(
            f"{flight.name}: anchor {unknown[0]} is heard but not in the survey; add it there."
        )
    lost = int(np.sum(~np.isfinite(data.d[chosen])))
    if lost:
        raise InputError(
            f"{flight.name}: {lost} TDOAs are not finite; remove them from the recording."
        )
    if not np.isfinite(truth.p).all():
        raise InputError(
            f"{flight.name}: the ground truth has positions that are not finite; remove them."
        )
    a, b = anchors.index(data.a[chosen]), anchors.index(data.b[chosen])
    samples = samples_at(data.t[chosen], a, b, truth, anchors, float(data.t[0]), lag=None)
    error = data.d[chosen] - tdoa(samples.p, samples.position_a, samples.position_b)
    kept = (np.abs(error) <= LARGEST_ERROR) & (samples.p[:, 2] > least_height(truth)) & (a != b)
    if kept.sum() < FEWEST_LABELS:
        raise InputError(
            f"{flight.name}: only {kept.sum()} TDOAs are right to {LARGEST_ERROR:g} m; check that "
            "survey and "
            "ground truth are in one frame."
        )
    if np.max(np.abs(error[kept])) < ZERO_ERROR:
        raise InputError(
            f"{flight.name}: all labels are zero: its TDOAs were made from the ground truth itself."
        )
    samples = _rows(samples, kept)
    return Labels(flight.name, samples, error[kept], _digest(samples, error[kept]))


def required_truth(flight: Flight) -> Truth:
    """Return the ground truth of a flight.

    Raises
    ------
    InputError
        If it has none.
    """
    if flight.truth is None:
        raise InputError(f"{flight.name}: it holds no ground truth to learn from.")
    return flight.truth


def with_level_attitude(flight: Flight) -> Flight:
    """Return the flight with level attitudes at yaw 0 if some true attitudes are missing."""
    truth = required_truth(flight)
    if np.isfinite(truth.q).all():
        return flight
    return replace(flight, truth=replace(truth, q=np.tile(LEVEL, (len(truth), 1))))


def split(
    names: Sequence[str], seed: int, validation: Sequence[str] | None = None
) -> tuple[list[str], list[str]]:
    """Split flights into (training, validation) names.

    Parameters
    ----------
    names : sequence of str
    seed : int
        Draws a fifth of the flights for validation.
    validation : sequence of str, optional
        Names of the validation flights.

    Raises
    ------
    InputError
        If a part would be empty or a name is unknown or repeated.
    """
    if len(set(names)) != len(names):
        raise InputError(f"flights: {max(names, key=list(names).count)} is there twice.")
    if len(names) < 2:
        raise InputError(
            f"flights: {len(names)} is too few; give at least two, as one must be held out to "
            "validate: samples of one "
            "flight are too alike to validate each other."
        )
    if validation is None:
        count = max(1, round(0.2 * len(names)))
        validation = (
            np.random.default_rng(seed).choice(sorted(names), count, replace=False).tolist()
        )
    unknown = set(validation) - set(names)
    if unknown:
        raise InputError(
            f"validation: {sorted(unknown)[0]} is not one of the flights: {', '.join(names)}."
        )
    training = [name for name in names if name not in validation]
    if not training or not validation:
        raise InputError(
            "validation: leaves no flight to train, or none to validate; hold out some of them."
        )
    return training, sorted(validation)


def thinned(all_labels: Sequence[Labels], seconds: float, rng: np.random.Generator) -> list[Labels]:
    """Return labels with at most one random sample per `seconds` on average."""
    out = []
    for one in all_labels:
        duration = one.samples.t[-1] - one.samples.t[0]
        count = min(len(one), int(duration / seconds) + 1)
        rows = np.sort(rng.choice(len(one), count, replace=False))
        out.append(replace(one, samples=_rows(one.samples, rows), error=one.error[rows]))
    return out


def white_noise(all_labels: Sequence[Labels]) -> float:
    """Return the standard deviation of successive TDOAs of a pair, m.

    A model of the pose cannot explain it.
    """
    steps = []
    for one in all_labels:
        pair = one.samples.a * len(one.anchors) + one.samples.b
        order = np.argsort(pair, kind="stable")  # in time within each pair
        steps.append(np.diff(one.error[order])[np.diff(pair[order]) == 0])
    return float(1.4826 * np.median(np.abs(np.concatenate(steps))) / np.sqrt(2.0))


def digest(all_labels: Sequence[Labels]) -> str:
    """Return the hexadecimal digest of several Labels, in any order."""
    return hashlib.sha256("".join(sorted(one.digest for one in all_labels)).encode()).hexdigest()[
        :16
    ]


def by_constellation(some: Sequence[HasAnchors]) -> list[list[HasAnchors]]:
    """Return flights, or their labels, in groups with the same anchors at the same places."""
    groups: list[list[HasAnchors]] = []
    for one in some:
        known = one.anchors
        for group in groups:
            if group[0].anchors.stand_at(known.ids, known.positions, known.frame):
                group.append(one)
                break
        else:
            groups.append([one])
    return groups


def constellations(some: Sequence[Labels]) -> list[dict[str, list[float]]]:
    """Return the different anchor constellations as {id: position in m}, rounded to 1 cm."""
    different = [group[0].anchors for group in by_constellation(some)]
    return [
        dict(zip(map(str, anchors.ids.tolist()), anchors.positions.round(2).tolist()))
        for anchors in different
    ]


def _rows(s: Samples, rows: np.ndarray) -> Samples:
    return Samples(s.t[rows], s.a[rows], s.b[rows], s.p[rows], s.q[rows], s.anchors, s.start)


def _digest(samples: Samples, error: np.ndarray) -> str:
    content = hashlib.sha256()
    for array in (
        samples.t,
        samples.a,
        samples.b,
        samples.p,
        samples.q,
        error,
        samples.anchors.positions,
    ):
        content.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return content.hexdigest()


# effects of the tag, the vehicle and the anchor modules, valid in another installation
PORTABLE = tuple(name for name, effect in EFFECTS.items() if effect.portable)


# Errors that belong to a place, of one anchor: standard deviation, m, of a short and of a long part of
# them, and over how many m of x, y and z these change. Chosen on the validation flights of
# docs/notebook/bias.md, as the standard deviation, m, of the mean error of a pair over a second.
PLACE_STD, LENGTH, LONG = 0.1, (1.0, 1.0, 0.6), 4.0
NOISE = 0.1
MOST_MEANS = 3000  # of a constellation: the time of the fit grows with the cube


@dataclass(frozen=True)
class Physics:
    """Hold the effects that were found.

    Parameters
    ----------
    effects : EffectSet
        Fitted to all flights.
    attribution : Attribution or None
        Its regression, or None to keep the values.
    labels : sequence of Labels
        Of all flights of several constellations. Errors that belong to a place are fitted to them.
    """

    effects: EffectSet
    attribution: Attribution | None = None
    labels: Sequence[Labels] = ()

    def fitted_to(self, flights: Sequence[int]) -> EffectSet:
        """Return the same effects with values fitted to the flights of these numbers.

        Effects of detectors keep their values.
        """
        if self.attribution is None:
            return self.effects
        selection = self.attribution.selection
        rows = np.isin(selection.table.flight, flights)
        model = refit(selection.table, columns_of(selection.chosen), selection.fit, rows)
        detected = (detection.effect for detection in self.attribution.detections)
        effects = usable([*effects_of(replace(selection, fit=model)), *detected])
        return beside_places(effects, [self.labels[k] for k in flights]) if self.labels else effects


def find_effects(flights: Sequence[Flight]) -> Physics:
    """Find the effects of flights with ground truth.

    Flights of one constellation can have all effects of `diagnose`. Flights of several constellations can
    have the PORTABLE ones, with values of `beside_places`. An effect stays if it improves the likelihood
    and the filter error on flights that were excluded from its fit.

    Parameters
    ----------
    flights : sequence of Flight

    Returns
    -------
    Physics
    """
    flights, reference = [with_level_attitude(flight) for flight in flights], GroundTruth()
    several = len(by_constellation(flights)) > 1
    kinds = PORTABLE if several else None
    attribution = attribute(flights, reference, kinds=kinds, undeclared=False)
    model = select_by_error(attribution, flights, Baseline(EffectSet())).applied(attribution)
    effects = usable(model.effects)
    if not several:
        return Physics(effects, model)
    known = [labels(flight) for flight in flights]
    return Physics(beside_places(effects, known), model, known)


def beside_places(effects: EffectSet, known: Sequence[Labels]) -> EffectSet:
    """Return effects with values fitted together with errors that belong to places.

    Such an error of an anchor is a smooth function of the position of the tag, a Gaussian process. It is
    marginalized. Otherwise the effects absorb it, and do harm in another constellation. Effects that do
    not change a TDOA linearly keep their values.
    """
    fitted = [
        effect
        for effect in effects
        if effect.fitted
        and effect.values
        and "tdoa" in effect.channels
        and set(effect.channels) <= RADIO.keys()
    ]
    if not fitted:
        return effects
    others = effects.where(lambda effect: effect not in fitted)
    prior = [effect.prior_std_of(key) for effect in fitted for key in effect.values]
    gram, vector = np.diag(np.array(prior) ** -2.0), np.zeros(len(prior))
    for group in by_constellation(known):
        parts = []
        for one in group:
            slopes = [type(effect)().regressors(one.samples, [*effect.values]) for effect in fitted]
            left = one.error - others.bias(one.samples)
            table = np.column_stack([*slopes, left, one.samples.p])
            parts.append(_over_seconds(one, group[0].anchors, table))
        ends, means = (np.concatenate(columns) for columns in zip(*parts))
        some = np.random.default_rng(0).permutation(len(ends))[:MOST_MEANS]
        covariance = _of_places(ends[some], means[some, -3:])
        x, y = means[some, :-4], means[some, -4]
        solved = cho_solve(cho_factor(covariance), np.column_stack([x, y]))
        gram += x.T @ solved[:, :-1]
        vector += x.T @ solved[:, -1]
    posterior = np.linalg.inv(gram)
    values, std = iter((posterior @ vector).tolist()), iter(np.sqrt(np.diag(posterior)).tolist())
    beside = [
        type(effect)(
            {key: next(values) for key in effect.values},
            {key: next(std) for key in effect.values},
            "train",
        )
        for effect in fitted
    ]
    return EffectSet((*beside, *others))


def _over_seconds(
    one: Labels, anchors: Anchors, table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return ends (m, N) of the pairs, and means (m, c) of a table (n, c), for each pair and second.

    The ends are 1 for anchor b, -1 for anchor a, and 0 for the other ones of `anchors`.
    """
    row = anchors.index(one.anchors.ids)
    second = np.floor(one.samples.t - one.samples.start).astype(int)
    key = np.column_stack([second, row[one.samples.a], row[one.samples.b]])
    kinds, of, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(of.ravel(), column) for column in table.T]
    each = np.eye(len(anchors))
    return each[kinds[:, 2]] - each[kinds[:, 1]], np.stack(sums, axis=1) / count[:, None]


def _of_places(ends: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the covariance (m, m), m^2, of errors of pairs with `ends` (m, N) at positions p (m, 3), m."""
    far = cdist(p / LENGTH, p / LENGTH)
    of_one = PLACE_STD**2 * (np.exp(-far) + np.exp(-far / LONG))
    return (ends @ ends.T) * of_one + NOISE**2 * np.eye(len(p))


LAYERS = (30, 30, 30)
PATIENCE, MOST_EPOCHS = 5, 200
BATCH, RATE = 64, 0.005
WITHOUT = tuple(name for name in FEATURES if "_A_" not in name)  # without anchor orientations


class Paper:
    """Hold the fitted network of the paper, see `fit`."""

    def __init__(
        self,
        names: Sequence[str],
        offset: np.ndarray,
        scale: np.ndarray,
        layers: list[tuple[np.ndarray, np.ndarray]],
        std: float,
    ) -> None:
        """Store the network.

        Parameters
        ----------
        names : sequence of str
            Features.
        offset, scale : numpy.ndarray
            Scaling of the features (k,).
        layers : list
            (weights (i, o), biases (o,)) of each layer.
        std : float
            Standard deviation, m.
        """
        self.names, self.offset, self.scale, self.layers, self.std = (
            names,
            offset,
            scale,
            layers,
            std,
        )
        self.validity_features = tuple(name for name in names if name[0] == "d")

    def mean(self, samples: Samples) -> np.ndarray:
        """Return the predicted errors (n,), m."""
        x = (columns(samples, self.names) - self.offset) / self.scale
        for k, (weights, biases) in enumerate(self.layers):
            x = x @ weights + biases
            x = np.maximum(x, 0.0) if k < len(self.layers) - 1 else x
        return x[:, 0]

    def onnx(self, meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model with the outputs bias and standard deviation."""
        graph = GraphBuilder()
        x = graph.input
        for k, (weights, biases) in enumerate(self.layers):
            x = graph.op("Gemm", x, weights, biases)
            x = graph.op("Relu", x) if k < len(self.layers) - 1 else x
        std = graph.op("Add", graph.op("Mul", x, [0.0]), [self.std])
        meta = {
            **meta,
            "features": list(self.names),
            "offset": self.offset.tolist(),
            "scale": self.scale.tolist(),
        }
        graph.op("Concat", x, std, axis=1)
        return graph.model(len(self.names), 2, meta)


def fit(
    training: Sequence[Labels],
    validation: Sequence[Labels],
    seed: int,
    progress: Callable[[int, float], object] = lambda epoch, error: None,
) -> tuple[Paper, tuple[list[float], list[float]]]:
    """Train the network of the paper.

    Parameters
    ----------
    training, validation : sequence of Labels
    seed : int
    progress : callable
        Called with epoch and validation error, m.

    Returns
    -------
    tuple
        Paper, and RMS errors per epoch of training and validation, m.
    """
    oriented = all(np.isfinite(one.anchors.orientations).all() for one in (*training, *validation))
    names = FEATURES if oriented else WITHOUT
    (x, y), (x_held, y_held) = (_table(group, names) for group in (training, validation))
    low, high = x.min(axis=0), x.max(axis=0)
    offset, scale = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-6)
    x, x_held = (x - offset) / scale, (x_held - offset) / scale
    network = MLPRegressor(
        hidden_layer_sizes=LAYERS,
        solver="sgd",
        batch_size=BATCH,
        learning_rate_init=RATE,
        random_state=seed,
    )
    curve: tuple[list[float], list[float]] = ([], [])
    best: tuple[float, tuple[list[np.ndarray], list[np.ndarray]]] | None = None
    since = 0
    for epoch in range(MOST_EPOCHS):
        network.partial_fit(x, y)
        for errors, inputs, outputs in zip(curve, (x, x_held), (y, y_held)):
            errors.append(float(np.sqrt(np.mean((network.predict(inputs) - outputs) ** 2))))
        progress(epoch, curve[1][-1])
        if best is None or curve[1][-1] < best[0]:
            best, since = (curve[1][-1], copy.deepcopy((network.coefs_, network.intercepts_))), 0
        else:
            since += 1
            if since == PATIENCE:
                break
    assert best is not None  # after one epoch at least
    return Paper(names, offset, scale, list(zip(*best[1])), best[0]), curve


def _table(group: Sequence[Labels], names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.concatenate([columns(one.samples, names) for one in group]),
        np.concatenate([one.error for one in group]),
    )


# label, x, training and validation RMS, m
LearningCurve = tuple[str, list[int], list[float], list[float]]

SPACING = 0.01  # s between training samples: closer samples hold no more information
CLIP = 1.0  # m
# the correction fades over: positions, m, components of the forward axis and of the up axis
MARGINS = {"d": 1.0, "f": 2.0, "u": 0.5}
# added to the box of attitudes on every side: occasional error of an estimated attitude
SLACK = 0.2
SMALLEST_STD = 0.01  # m, least standard deviation of the remaining error
POINTS = 4  # of a learning curve over flights
HEADINGS = 1.0  # range of the forward axis in training, from which a model depends on the heading


class Recipe(NamedTuple):
    """Describe a training.

    Parameters
    ----------
    kind : str
        One of MODELS.
    seed : int
        Seed of all random numbers.
    """

    kind: str
    seed: int


@dataclass(frozen=True)
class Trained:
    """Hold the result of a training: a network or effects.

    Parameters
    ----------
    model : Paper or None
    effects : EffectSet or None
    curve : tuple
        Label, x, RMS errors of training and validation, m.
    meta : dict
        Metadata of the ONNX file.
    errors : dict
        RMS errors of the TDOAs of each validation flight (before, after), m.
    """

    model: Paper | None
    effects: EffectSet | None
    curve: LearningCurve
    meta: dict[str, Any]
    errors: dict[str, tuple[float, float]]


def train(
    recipe: Recipe,
    training: Sequence[Flight],
    validation: Sequence[Flight],
    name: str,
    progress: Callable[[str], object] = lambda text: None,
    found: Physics | None = None,
) -> Trained:
    """Train the model of a recipe.

    The validation flights stop the training of the paper's network. For all models they give the error on
    unseen flights. Effects are then fitted to all flights.

    Parameters
    ----------
    recipe : Recipe
    training, validation : sequence of Flight
    name : str
        Name of the model, written to every corrected message.
    progress : callable
        Called with lines of text.
    found : Physics, optional
        Effects of the training and then the validation flights. The default is to find them.

    Returns
    -------
    Trained

    Raises
    ------
    InputError
        If the kind is unknown or a flight cannot be used.
    """
    kind, seed = recipe
    refuse_others("model", [kind], MODELS)
    first, second = ([labels(flight) for flight in group] for group in (training, validation))
    meta: dict[str, Any] = {
        "name": name,
        "kind": kind,
        "clip": CLIP,
        "seed": seed,
        "data": digest([*first, *second]),
        "trained_on": sorted(one.name for one in training),
        "validated_on": sorted(one.name for one in validation),
        "constellations": constellations([*first, *second]),
    }
    model: Paper | None = None
    effects: EffectSet | None = None
    if kind == "physics":
        if found is None:
            progress("looking for effects")
            found = find_effects([*training, *validation])
        effects = found.effects
        progress(f"effects: {effects.name}")
        curve, left = _evaluate_effects(found, first, second, seed)
    else:
        model, curve, left = _paper(seed, first, second, progress)
        meta |= _limits(model, first, second)
    errors = {one.name: (rms(one.error), rms(after)) for one, after in zip(second, left)}
    return Trained(model, effects, curve, meta, errors)


def _paper(
    seed: int,
    training: list[Labels],
    validation: list[Labels],
    progress: Callable[[str], object],
) -> tuple[Paper, LearningCurve, list[np.ndarray]]:
    """Return (Paper, learning curve over epochs, remaining errors of each validation flight)."""
    thin, held = (
        thinned(group, SPACING, np.random.default_rng(seed)) for group in (training, validation)
    )
    model, errors = fit(
        thin, held, seed, lambda epoch, error: progress(f"epoch {epoch}: validation {error:.4f} m")
    )
    if len(model.names) < len(FEATURES):
        progress("an anchor has no orientation: the network does without all of them")
    left = [one.error - model.mean(one.samples) for one in validation]
    variance = rms(np.concatenate(left)) ** 2 - white_noise(validation) ** 2
    model.std = float(np.sqrt(max(variance, SMALLEST_STD**2)))
    return model, ("epochs", list(range(1, len(errors[0]) + 1)), *errors), left


def _limits(
    model: Paper, training: Sequence[Labels], validation: Sequence[Labels]
) -> dict[str, Any]:
    """Return the metadata that bound the use of a network."""
    validity = {}
    for names, more in ((ATTITUDE, SLACK), (model.validity_features, 0.0)):
        table = np.concatenate([columns(one.samples, names) for one in training])
        for name, low, high in zip(names, table.min(axis=0) - more, table.max(axis=0) + more):
            validity[name] = [round(float(low), 3), round(float(high), 3), MARGINS[name[0]]]
    limits: dict[str, Any] = {
        "validity": validity,
        "fade_std": rms(np.concatenate([one.error for one in validation])),
    }
    heads = [validity[name] for name in ("forward_x", "forward_y")]
    if any(high - low - 2.0 * SLACK > HEADINGS for low, high, _ in heads):
        limits["largest_yaw_std"] = LARGEST_YAW_STD  # the model needs the yaw
    return limits


def _evaluate_effects(
    found: Physics, training: list[Labels], validation: list[Labels], seed: int
) -> tuple[LearningCurve, list[np.ndarray]]:
    """Return (learning curve over flights, remaining errors of validation flights) of the effects.

    `found` counts the training flights first. The curve grows by training flights in random order.
    """
    order = np.random.default_rng(seed).permutation(len(training)).tolist()
    counts = sorted({round(n) for n in np.geomspace(1, len(order), min(len(order), POINTS))})
    curve: tuple[list[float], list[float]] = ([], [])
    for count in counts:
        some = order[:count]
        effects = found.fitted_to(some)
        of_fit, left = (
            [one.error - effects.bias(one.samples) for one in group]
            for group in ([training[k] for k in some], validation)
        )
        curve[0].append(rms(np.concatenate(of_fit)))
        curve[1].append(rms(np.concatenate(left)))
    return ("training flights", counts, *curve), left


def save(result: Trained, folder: Path) -> tuple[Path | None, Path | None]:
    """Write model.onnx or effects.yaml and return (path or None, path or None).

    The other file, of an earlier training, is removed.
    """
    model, effects = folder / "model.onnx", folder / "effects.yaml"
    if result.model is None:
        model.unlink(missing_ok=True)
        assert result.effects is not None
        result.effects.to_yaml(effects)
        return None, effects
    effects.unlink(missing_ok=True)
    write_bytes(model, result.model.onnx(result.meta).SerializeToString(deterministic=True))
    return model, None


def plot_curve(
    label: str,
    x: Sequence[float],
    training: Sequence[float],
    validation: Sequence[float],
    path: Path,
) -> None:
    """Draw the learning curve: RMS errors of training and validation flights, m.

    `label` names the x axis: epochs or number of flights.
    """
    import matplotlib.pyplot as plt  # takes a second to import

    figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, errors in (("training", training), ("validation", validation)):
        ax.plot(x, errors, "o-", ms=3, label=name)
    ax.set(xlabel=label, ylabel="error of the TDOAs, RMS [m]")
    ax.grid(alpha=0.3)
    ax.legend()
    write_picture(path, figure)
    plt.close(figure)


FOLDS = 5


def cross_validated(
    recipe: Recipe,
    flights: Sequence[Flight],
    found: Physics | None = None,
    progress: Callable[[str], object] = lambda text: None,
    map_function: MapFunction = map,
) -> Shrinkage:
    """Return the Shrinkage of a recipe on flights.

    Parameters
    ----------
    recipe : Recipe
    flights : sequence of Flight
    found : Physics, optional
        Effects of these flights in this order, for kinds with effects.
    progress : callable
        Called with lines of text.
    map_function : callable
        Like `map`. It may use other processes.
    """
    order = np.random.default_rng(recipe.seed).permutation(len(flights))
    count = min(FOLDS, len(flights))
    folds = [order[k::count].tolist() for k in range(count)]
    rest = [[k for k in range(len(flights)) if k not in fold] for fold in folds]
    known = [found and Physics(found.fitted_to(others)) for others in rest]
    errors: Errors = {
        flight.name: {None: error} for flight, error in zip(flights, map_function(_error, flights))
    }
    for result in map_function(partial(_left_out, recipe, flights), list(zip(folds, rest, known))):
        for name, by_share in result.items():
            errors[name] |= by_share
            progress(
                f"{name} left out: {errors[name][None]:.3f} m without, {by_share[1.0]:.3f} m with all"
            )
    return Shrinkage(best_share(errors), errors)


def train_shrunk(
    recipe: Recipe,
    training: Sequence[Flight],
    validation: Sequence[Flight],
    name: str,
    progress: Callable[[str], object] = lambda text: None,
    map_function: MapFunction = map,
) -> tuple[Trained, Shrinkage]:
    """Train with `train` and set the share that cross-validation supports.

    Returns
    -------
    tuple of Trained and Shrinkage
    """
    flights = [*training, *validation]
    found = None
    if recipe.kind == "physics":
        progress("looking for effects")
        found = find_effects(flights)
    trained = train(recipe, training, validation, name, progress, found)
    shrinkage = cross_validated(recipe, flights, found, progress, map_function)
    if trained.model:
        trained = replace(trained, meta={**trained.meta, "share": shrinkage.share})
    return trained, shrinkage


def _left_out(
    recipe: Recipe,
    flights: Sequence[Flight],
    fold: tuple[list[int], list[int], Physics | None],
) -> Errors:
    """Return the Errors of the flights of a fold by share.

    `fold` holds the numbers of the excluded flights, of the other flights, and their Physics or None.
    """
    left_out, others, known = fold
    some = [flights[k] for k in others]
    trained = train(recipe, some[:-1] or some, some[-1:], recipe.kind, found=known)
    with temporary_folder() as folder:
        model, _ = save(trained, folder)
        network = Network(model) if model else None
    errors: Errors = {flights[k].name: {} for k in left_out}
    for share in SHARES if network else (1.0,):
        if network:
            network.share = share
        for k in left_out:
            errors[flights[k].name][share] = _error(flights[k], trained.effects, network)
    return errors


def _error(
    flight: Flight, effects: EffectSet | None = None, network: Network | None = None
) -> float:
    return evaluate(flight.without(*SENSOR_NAMES), None, effects, network)[0].row()["rmse_3d"]
