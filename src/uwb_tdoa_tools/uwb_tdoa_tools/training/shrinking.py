# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scale a correction to the share that cross-validation over flights supports.

The flights are split into FOLDS. For each fold a model is trained on the other flights, and the filter
runs with several shares of its prediction. Folds hold whole flights, since samples of one flight are
correlated. Effects are applied whole, and are those found in all flights. Their values are fitted without
the fold. `models.find_effects` has already validated them on excluded flights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EffectSet

from ..parallel import MapFunction
from ..scoring.evaluation import evaluate
from ..scoring.pooling import SHARES, Errors, Shrinkage, best_share
from . import models
from .models import Recipe

FOLDS = 5


def cross_validated(
    recipe: Recipe,
    flights: Sequence[Flight],
    found: models.Physics | None = None,
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
    known = [found and models.Physics(found.fitted_to(others)) for others in rest]
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


def train(
    recipe: Recipe,
    training: Sequence[Flight],
    validation: Sequence[Flight],
    name: str,
    progress: Callable[[str], object] = lambda text: None,
    map_function: MapFunction = map,
) -> tuple[models.Trained, Shrinkage]:
    """Train with `models.train` and set the share that cross-validation supports.

    Returns
    -------
    tuple of Trained and Shrinkage
    """
    flights = [*training, *validation]
    found = None
    if recipe.kind == "physics":
        progress("looking for effects")
        found = models.find_effects(flights)
    trained = models.train(recipe, training, validation, name, progress, found)
    shrinkage = cross_validated(recipe, flights, found, progress, map_function)
    if trained.model:
        trained = replace(trained, meta={**trained.meta, "share": shrinkage.share})
    return trained, shrinkage


def _left_out(
    recipe: Recipe,
    flights: Sequence[Flight],
    fold: tuple[list[int], list[int], models.Physics | None],
) -> Errors:
    """Return the Errors of the flights of a fold by share.

    `fold` holds the numbers of the excluded flights, of the other flights, and their Physics or None.
    """
    left_out, others, known = fold
    some = [flights[k] for k in others]
    trained = models.train(recipe, some[:-1] or some, some[-1:], recipe.kind, found=known)
    with temporary_folder() as folder:
        model, _ = models.save(trained, folder)
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
