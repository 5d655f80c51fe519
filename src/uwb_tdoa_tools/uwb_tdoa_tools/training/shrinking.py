# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scale a correction to the share that cross-validation over flights supports.

The flights are split into FOLDS. For each fold a model is trained on the other flights, and the filter
runs with several shares of its prediction. Folds hold whole flights, since samples of one flight are
correlated. The effects are those found in all flights. Their values are fitted without the fold.
`physics.find_effects` has already validated them on excluded flights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EffectSet

from ..parallel import MapFunction
from ..scoring.evaluation import evaluate
from ..scoring.gains import SHARES, Shrinkage, best_share
from . import models, physics
from .models import Recipe

FOLDS = 5


def cross_validated(
    recipe: Recipe,
    flights: Sequence[Flight],
    uncorrected_errors: Mapping[str, float],
    found: physics.Physics | None = None,
    progress: Callable[[str], object] = lambda text: None,
    map_function: MapFunction = map,
) -> Shrinkage:
    """Return the Shrinkage of a recipe on flights.

    Parameters
    ----------
    recipe : Recipe
    flights : sequence of Flight
    uncorrected_errors : mapping
        See `uncorrected`.
    found : Physics, optional
        Effects of these flights in this order, for kinds with effects.
    progress : callable
        Called with lines of text.
    map_function : callable
        Like `map`. It may use other processes.
    """
    order = np.random.default_rng(recipe.seed).permutation(len(flights))
    errors: dict[str, dict[float | None, float]] = {}
    folds = [order[k :: min(FOLDS, len(flights))].tolist() for k in range(min(FOLDS, len(flights)))]
    rest = [[k for k in range(len(flights)) if k not in fold] for fold in folds]
    known = [found and physics.Physics(found.fitted_to(others)) for others in rest]
    for result in map_function(
        partial(_left_out, recipe, flights, uncorrected_errors), list(zip(folds, rest, known))
    ):
        of_fold = {name: dict(pairs) for name, pairs in result.items()}
        for name, of in of_fold.items():
            progress(f"{name} left out: {of[None]:.3f} m without, {of[1.0]:.3f} m with all")
        errors |= of_fold
    return Shrinkage(best_share(errors), errors)


def uncorrected(flights: Sequence[Flight], map_function: MapFunction = map) -> dict[str, float]:
    """Return the 3D RMSE of the filter without correction, m, by flight name."""
    return {flight.name: error for error, flight in zip(map_function(_error, flights), flights)}


def errors_by_share(
    flight: Flight,
    uncorrected_errors: Mapping[str, float],
    effects: EffectSet | None,
    network: Network | None,
    shares: Sequence[float] = SHARES,
) -> dict[float | None, float]:
    """Return the 3D RMSE of the filter, m, by share of the network.

    The key None means no correction. Without a network the only share is 1.
    """
    out: dict[float | None, float] = {None: uncorrected_errors[flight.name]}
    if network is None:
        return out | {1.0: _error(flight, effects)}
    for share in shares:
        network.share = share
        out[share] = _error(flight, effects, network)
    return out


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
    if recipe.kind.startswith("physics"):
        progress("looking for effects")
        found = physics.find_effects(flights)
    trained = models.train(recipe, training, validation, name, progress, found)
    uncorrected_errors = uncorrected(flights, map_function)
    shrinkage = cross_validated(recipe, flights, uncorrected_errors, found, progress, map_function)
    if trained.model:
        trained = replace(trained, meta={**trained.meta, "share": shrinkage.share})
    return trained, shrinkage


def _left_out(
    recipe: Recipe,
    flights: Sequence[Flight],
    uncorrected_errors: Mapping[str, float],
    fold: tuple[list[int], list[int], physics.Physics | None],
) -> dict[str, list[tuple[float | None, float]]]:
    """Return {flight: [(share, 3D RMSE in m), ...]} of a fold, for JSON.

    `fold` holds the numbers of the excluded flights, of the other flights, and their Physics or None.
    """
    left_out, others, known = fold
    with temporary_folder() as folder:
        some = [flights[k] for k in others]
        trained = models.train(
            recipe, some[:-1] or some, some[-1:], recipe.kind, found=known, curve=False
        )
        model, _ = models.save(trained, folder)
        network = Network(model) if model else None
    errors = {
        flights[k].name: errors_by_share(flights[k], uncorrected_errors, trained.effects, network)
        for k in left_out
    }
    return {name: list(of_flight.items()) for name, of_flight in errors.items()}


def _error(
    flight: Flight, effects: EffectSet | None = None, network: Network | None = None
) -> float:
    return evaluate(flight.without(*SENSOR_NAMES), None, effects, network)[0].row()["rmse_3d"]
