"""The share of a correction that cross-validation over flights supports, and the gain that can be
expected of it.

The flights are dealt to FOLDS; for each, a model is trained on the others, and the filter judges it
there with several shares of its prediction. Whole flights: samples of one are too alike. The
effects are those that were found in all flights, with values fitted to the others alone:
`physics.find` has judged them on flights left out already.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.foundation.files import temporary_folder
from uwb_tdoa_bias.foundation.flight import AIDS

from ..scoring.evaluation import evaluate
from ..scoring.gains import SHARES, Shrinkage, best_share
from . import models, physics

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight

    from ..parallel import MapFunction
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
    """Shrinkage of the model of a Recipe trained on Flights.

    plain : as `uncorrected` gives; found : Physics of these flights, in this order, for kinds with
        effects;
    map_function(function, folds) : as map, but for the time and the process in which each is done.
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
    """{name: 3D RMSE of the filter, m, from TDOAs and IMU alone} of Flights without any correction.
    map_function : as of `cross_validated`.
    """
    return {flight.name: error for error, flight in zip(map_function(_error, flights), flights)}


def errors_by_share(
    flight: Flight,
    uncorrected_errors: Mapping[str, float],
    effects: EffectSet | None,
    network: Network | None,
    shares: Sequence[float] = SHARES,
) -> dict[float | None, float]:
    """{share: 3D RMSE of the filter on a Flight, m, from TDOAs and IMU alone}, under None without
    any correction, as `plain` says. Without a network there is one share, 1.
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
    """(Trained, Shrinkage): `models.train`, scaled to the share that cross-validation supports.
    map_function : as of `cross_validated`.
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
    """{flight: [(share, 3D RMSE), ...]}, JSON, of a fold: (numbers of the flights left out, of the
    others, Physics fitted to those or None).
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
    return evaluate(flight.without(*AIDS), None, effects, network)[0].row()["rmse_3d"]
