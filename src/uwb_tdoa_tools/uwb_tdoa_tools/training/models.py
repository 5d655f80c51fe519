# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Train the different kinds of models by one call, `train`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from onnx import ModelProto

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_bytes, write_filled
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD
from uwb_tdoa_bias.correction.features import columns
from uwb_tdoa_bias.effects import EffectSet

from ..choices import MODELS
from . import labels as labelling, network, physics, structured
from .labels import Labels
from .network import Paper
from .structured import Structured

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
_ATTITUDE = ("forward_x", "forward_y", "up_x", "up_y")


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
    """Hold the result of a training.

    Parameters
    ----------
    model : Paper or Structured or None
    effects : EffectSet or None
    curve : tuple
        Label, x, RMS errors of training and validation, m.
    meta : dict
        Metadata of the ONNX file.
    errors : dict
        RMS errors of the TDOAs of each validation flight (before, after), m.
    """

    model: Paper | Structured | None
    effects: EffectSet | None
    curve: LearningCurve
    meta: dict[str, Any]
    errors: dict[str, tuple[float, float]]

    def onnx(self) -> ModelProto | None:
        """Return the ONNX model, or None for a kind without a network."""
        return self.model.onnx(self.meta) if self.model else None


def train(
    recipe: Recipe,
    training: Sequence[Flight],
    validation: Sequence[Flight],
    name: str,
    progress: Callable[[str], object] = lambda text: None,
    found: physics.Physics | None = None,
    curve: bool = True,
) -> Trained:
    """Train the model of a recipe.

    The validation flights stop the training of the paper's network. For all models they give the error on
    unseen flights. Linear models are then fitted again to all flights.

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
    curve : bool
        Whether to compute a whole learning curve.

    Returns
    -------
    Trained

    Raises
    ------
    InputError
        If the kind is unknown or a flight cannot be used.
    """
    kind, seed = recipe
    if kind not in MODELS:
        raise InputError(f"model: {kind!r} is not known; choose {', '.join(MODELS)}.")
    raw = groups = _labels(training, validation)
    effects: EffectSet | None = None
    model: Paper | Structured | None = None
    free = EffectSet()
    if kind.startswith("physics"):
        if found is None:
            progress("looking for effects")
            found = physics.find_effects([*training, *validation])
        effects = found.effects
        if len(labelling.constellations([*training, *validation])) > 1:
            free, effects = physics.split_linear(effects)
        progress(f"effects: {found.effects.name}")
        groups = _labels(training, validation, effects)
    if kind.startswith("paper"):
        model, errors, left = _paper(recipe, groups[0], groups[1], progress)
    elif found is not None and kind == "physics" and not len(free):
        errors, left = _evaluate_effects(
            found, raw[0], raw[1], _curve_subsets(len(training), seed, curve)
        )
    else:
        growing = _curve_subsets(len(training), seed, curve)
        model, free, errors, left = _structured(
            recipe, groups[0], groups[1], progress, growing, free
        )
        effects = None if effects is None else EffectSet((*free.effects, *effects.effects))
    everything = [*groups[0], *groups[1]]
    meta: dict[str, Any] = {
        "name": name,
        "kind": kind,
        "clip": CLIP,
        "seed": seed,
        "data": labelling.digest([*raw[0], *raw[1]]),
        "trained_on": sorted(one.name for one in training),
        "validated_on": sorted(one.name for one in validation),
        "constellations": labelling.constellations(everything),
    }
    if model and effects:
        meta["trained_with"] = [effect.name for effect in effects.effects]
    if model:
        learned_from = groups[0] if kind.startswith("paper") else everything
        meta |= {
            "validity": _validity(learned_from, model.validity_features),
            "fade_std": _rms(one.error for one in groups[1]),
        }
        heads = [meta["validity"][name] for name in ("forward_x", "forward_y")]
        if model.sees_attitude and any(
            high - low - 2.0 * SLACK > HEADINGS for low, high, _ in heads
        ):
            meta["largest_yaw_std"] = LARGEST_YAW_STD  # the model needs the yaw
    of_flights = {one.name: (_rms([one.error]), _rms([after])) for one, after in zip(raw[1], left)}
    return Trained(model, effects, errors, meta, of_flights)


def _labels(
    training: Sequence[Flight], validation: Sequence[Flight], effects: EffectSet = EffectSet()
) -> tuple[list[Labels], list[Labels]]:
    first, second = (
        [labelling.labels(flight, effects) for flight in group] for group in (training, validation)
    )
    return first, second


def _paper(
    recipe: Recipe,
    training: list[Labels],
    validation: list[Labels],
    progress: Callable[[str], object],
) -> tuple[network.Paper, LearningCurve, list[np.ndarray]]:
    """Return (Paper, learning curve over epochs, remaining errors of each validation flight)."""
    kind, seed = recipe
    thin, held = (
        labelling.thinned(group, SPACING, np.random.default_rng(seed))
        for group in (training, validation)
    )
    model, errors = network.fit(
        thin,
        held,
        kind == "paper",
        seed,
        lambda epoch, error: progress(f"epoch {epoch}: validation {error:.4f} m"),
    )
    left = [one.error - model.mean(one.samples) for one in validation]
    model.std = _deviation(left, 0.0, validation)
    return model, ("epochs", list(range(1, len(errors[0]) + 1)), *errors), left


def _structured(
    recipe: Recipe,
    training: list[Labels],
    validation: list[Labels],
    progress: Callable[[str], object],
    growing: Sequence[Sequence[int]],
    free: EffectSet,
) -> tuple[structured.Structured | None, EffectSet, LearningCurve, list[np.ndarray]]:
    """Return (Structured, EffectSet, learning curve, remaining errors of validation flights).

    The remaining errors belong to a fit to the training flights. The model is a fit to all flights.

    Parameters
    ----------
    recipe, training, validation, progress
    growing : sequence
        See `_curve_subsets`.
    free : EffectSet
        Linear effects that are fitted together with the maps. For the kind "physics" the maps only
        separate effects from position-dependent errors, and no model is returned.
    """
    seed, alone = recipe.seed, recipe.kind == "physics"
    thin = [
        labelling.thinned(group, SPACING, np.random.default_rng(seed))
        for group in (training, validation)
    ]

    def remaining(one: Labels) -> np.ndarray:
        return one.error - fitted.bias(one.samples) - (0.0 if alone else model.mean(one.samples))

    curve: list[tuple[int, float, float]] = []
    for some in growing:
        model, fitted = fit_structured([thin[0][k] for k in some], seed, free)
        fit_error, error = (
            _rms(map(remaining, group)) for group in ([thin[0][k] for k in some], thin[1])
        )
        curve.append((len(some), fit_error, error))
        progress(
            f"{len(some)} of {len(training)} flights: training {fit_error:.4f} m, validation "
            f"{error:.4f} m"
        )
    left = [remaining(one) for one in validation]
    explained = np.concatenate([model.variance(one.samples) for one in validation])
    whole, fitted = fit_structured([*thin[0], *thin[1]], seed, free)
    whole.floor = _deviation(left, explained, validation)
    return None if alone else whole, fitted, _over_flights(curve), left


def _over_flights(curve: Sequence[tuple[int, float, float]]) -> LearningCurve:
    """Return the learning curve of (number of flights, training RMS, validation RMS in m)."""
    counts, training, validation = zip(*curve)
    return "training flights", list(counts), list(training), list(validation)


def fit_structured(
    some: Sequence[Labels],
    seed: int,
    free: EffectSet = EffectSet(),
) -> tuple[structured.Structured, EffectSet]:
    """Fit maps and the linear effects `free` together and return (Structured, EffectSet)."""
    model = structured.prepare(some, seed)
    parts = [model.design(one.samples, one.error, one.sample_weight) for one in some]
    fields = ("phi", "a", "b", "dense", "y", "sample_weight")
    phi, a, b, dense, y, sample_weight = (
        np.concatenate([getattr(part, name) for part in parts]) for name in fields
    )
    more = np.concatenate([physics.regressors(free, one.samples) for one in some])
    design = structured.Design(phi, a, b, np.concatenate([dense, more], axis=1), y, sample_weight)
    posterior = structured.fit(
        design, len(model.site_ids), structured.NOISE, physics.prior_stds(free)
    )
    model.set_posterior(posterior)
    own = model.link_columns
    return model, physics.with_values(
        free, posterior.dense[own:], posterior.dense_covariance[own:, own:]
    )


def _evaluate_effects(
    found: physics.Physics,
    training: list[Labels],
    validation: list[Labels],
    growing: Sequence[Sequence[int]],
) -> tuple[LearningCurve, list[np.ndarray]]:
    """Return (learning curve, remaining errors of validation flights) of the effects.

    `found` counts the training flights first.
    """
    curve: list[tuple[int, float, float]] = []
    for some in growing:
        effects = found.fitted_to(some)
        groups = [training[k] for k in some], validation
        left_of_fit, left = (
            [one.error - effects.bias(one.samples) for one in group] for group in groups
        )
        curve.append((len(some), _rms(left_of_fit), _rms(left)))
    return _over_flights(curve), left


def _curve_subsets(count: int, seed: int, curve: bool) -> list[list[int]]:
    """Return growing subsets of `count` flights in random order. The last one holds all of them."""
    order = np.random.default_rng(seed).permutation(count).tolist()
    if not curve:
        return [order]
    return [
        order[:n]
        for n in sorted({int(round(n)) for n in np.geomspace(1, count, min(count, POINTS))})
    ]


def _deviation(
    left: Sequence[np.ndarray], explained: np.ndarray | float, validation: Sequence[Labels]
) -> float:
    """Return the standard deviation of remaining errors, m.

    The variance `explained` by the maps, m^2, and white noise are subtracted.
    """
    variance = (
        np.mean(np.concatenate(left) ** 2 - explained) - labelling.white_noise(validation) ** 2
    )
    return float(np.sqrt(max(variance, SMALLEST_STD**2)))


def _rms(parts: Iterable[np.ndarray]) -> float:
    parts = list(parts)
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else float("nan")


def _validity(learned_from: Sequence[Labels], features: Sequence[str]) -> dict[str, list[float]]:
    """Return {feature: [lowest, highest, margin]} of labels."""
    limits = {}
    for names, more in ((_ATTITUDE, SLACK), (features, 0.0)):
        if not names:
            continue
        table = np.concatenate([columns(one.samples, names) for one in learned_from])
        for name, low, high in zip(names, table.min(axis=0) - more, table.max(axis=0) + more):
            limits[name] = [round(float(low), 3), round(float(high), 3), MARGINS[name[0]]]
    return limits


def save(result: Trained, folder: Path) -> tuple[Path | None, Path | None]:
    """Write model.onnx and effects.yaml as far as they exist, and return their paths or None.

    Files of an earlier training are removed.
    """
    model, effects = folder / "model.onnx", folder / "effects.yaml"
    made = result.onnx()
    for path, content in ((model, made), (effects, result.effects)):
        if content is None:
            path.unlink(missing_ok=True)  # else a file of an earlier training would stay
    if made is not None:
        write_bytes(model, made.SerializeToString(deterministic=True))
    if result.effects is not None:
        result.effects.to_yaml(effects)
    return (model if made is not None else None), (effects if result.effects is not None else None)


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
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
