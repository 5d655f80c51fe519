"""As much of a correction as flights left out of its training bear out, and the gain that can be expected of it.

The flights are dealt to FOLDS; for each, a model is trained on the others, and the filter judges it there with several shares
of its prediction. Whole flights: samples of one are too alike. The effects are those that were found in all flights, with
values fitted to the others alone: `physics.find` has judged them on flights left out already.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.foundation.flight import AIDS

from ..parallel import in_one_thread
from ..scoring.borne_out import SHARES, BorneOut, choose
from ..scoring.evaluation import evaluate
from . import models, physics, structured

FOLDS = 5


@in_one_thread
def bear_out(kind, flights, plain, seed, options=structured.Options(), found=None, progress=lambda text: None):
    """BorneOut of a kind of model trained on Flights.

    plain : as `uncorrected` gives; found : Physics of these flights, in this order, for kinds with effects.
    """
    order = np.random.default_rng(seed).permutation(len(flights))
    errors = {}
    for fold in (order[k :: min(FOLDS, len(flights))].tolist() for k in range(min(FOLDS, len(flights)))):
        others = [k for k in range(len(flights)) if k not in fold]
        effects, network = _without(kind, flights, others, seed, options, found)
        for flight in (flights[k] for k in fold):
            errors[flight.name] = judged(flight, plain, effects, network)
            progress("{} left out: {:.3f} m without, {:.3f} m with all".format(flight.name, errors[flight.name][None], errors[flight.name][1.0]))
    return BorneOut(choose(errors), errors)


def uncorrected(flights):
    """{name: 3D RMSE of the filter, m, from TDOAs and IMU alone} of Flights without any correction."""
    return {flight.name: _error(flight) for flight in flights}


def judged(flight, plain, effects, network, shares=SHARES):
    """{share: 3D RMSE of the filter on a Flight, m, from TDOAs and IMU alone}, under None without any correction, as `plain`
    says. Without a network there is one share, 1."""
    out = {None: plain[flight.name]}
    for share in shares if network else ():
        network.share = share
        out[share] = _error(flight, effects, network)
    return out if network else {**out, 1.0: _error(flight, effects)}


def train(kind, training, validation, seed, name, options=structured.Options(), progress=lambda text: None):
    """(Trained, BorneOut): `models.train`, and as much of it as is borne out."""
    flights = [*training, *validation]
    found = None
    if kind.startswith("physics"):
        progress("looking for effects")
        found = physics.find(flights)
    trained = models.train(kind, training, validation, seed, name, options, progress, found)
    borne_out = bear_out(kind, flights, uncorrected(flights), seed, options, found, progress)
    if trained.model:
        trained = replace(trained, meta={**trained.meta, "share": borne_out.share})
    return trained, borne_out


def _without(kind, flights, others, seed, options, found):
    """(EffectSet or None, Network or None) trained on the flights with some numbers alone."""
    with TemporaryDirectory() as folder:
        some = [flights[k] for k in others]
        known = replace(found, effects=found.fitted_to(others)) if found else None
        trained = models.train(kind, some[:-1] or some, some[-1:], seed, kind, options, found=known, curve=False)
        model, _ = models.save(trained, Path(folder))
        return trained.effects, Network(model) if model else None


def _error(flight, effects=None, network=None):
    return evaluate(flight.without(*AIDS), None, effects, network)[0].row()["rmse_3d"]
