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

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_bytes, write_filled
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD
from uwb_tdoa_bias.correction.features import ATTITUDE, FEATURES, columns
from uwb_tdoa_bias.effects import EffectSet

from ..choices import MODELS
from . import labels as labelling, network, physics
from .labels import Labels
from .network import Paper

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
    found: physics.Physics | None = None,
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
    if kind not in MODELS:
        raise InputError(f"model: {kind!r} is not known; choose {', '.join(MODELS)}.")
    first, second = (
        [labelling.labels(flight) for flight in group] for group in (training, validation)
    )
    meta: dict[str, Any] = {
        "name": name,
        "kind": kind,
        "clip": CLIP,
        "seed": seed,
        "data": labelling.digest([*first, *second]),
        "trained_on": sorted(one.name for one in training),
        "validated_on": sorted(one.name for one in validation),
        "constellations": labelling.constellations([*first, *second]),
    }
    model: Paper | None = None
    effects: EffectSet | None = None
    if kind == "physics":
        if found is None:
            progress("looking for effects")
            found = physics.find_effects([*training, *validation])
        effects = found.effects
        progress(f"effects: {effects.name}")
        curve, left = _evaluate_effects(found, first, second, seed)
    else:
        model, curve, left = _paper(seed, first, second, progress)
        meta |= _limits(model, first, second)
    errors = {one.name: (_rms([one.error]), _rms([after])) for one, after in zip(second, left)}
    return Trained(model, effects, curve, meta, errors)


def _paper(
    seed: int,
    training: list[Labels],
    validation: list[Labels],
    progress: Callable[[str], object],
) -> tuple[Paper, LearningCurve, list[np.ndarray]]:
    """Return (Paper, learning curve over epochs, remaining errors of each validation flight)."""
    thin, held = (
        labelling.thinned(group, SPACING, np.random.default_rng(seed))
        for group in (training, validation)
    )
    model, errors = network.fit(
        thin, held, seed, lambda epoch, error: progress(f"epoch {epoch}: validation {error:.4f} m")
    )
    if len(model.names) < len(FEATURES):
        progress("an anchor has no orientation: the network does without all of them")
    left = [one.error - model.mean(one.samples) for one in validation]
    variance = _rms(left) ** 2 - labelling.white_noise(validation) ** 2
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
        "fade_std": _rms(one.error for one in validation),
    }
    heads = [validity[name] for name in ("forward_x", "forward_y")]
    if any(high - low - 2.0 * SLACK > HEADINGS for low, high, _ in heads):
        limits["largest_yaw_std"] = LARGEST_YAW_STD  # the model needs the yaw
    return limits


def _evaluate_effects(
    found: physics.Physics, training: list[Labels], validation: list[Labels], seed: int
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
        curve[0].append(_rms(of_fit))
        curve[1].append(_rms(left))
    return ("training flights", counts, *curve), left


def _rms(parts: Iterable[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate([*parts]) ** 2)))


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
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
