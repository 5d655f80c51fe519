"""As much of a correction as flights left out of its training bear out, and the gain that can be expected of it.

The flights are dealt to FOLDS; for each, a model is trained on the others, and the filter judges it there with several shares
of its prediction. Whole flights: samples of one are too alike. The effects are those that were found in all flights, with
values fitted to the others alone: `physics.find` has judged them on flights left out already.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.foundation.flight import AIDS

from ..parallel import in_one_thread
from ..scoring.evaluation import evaluate
from . import models, physics, structured

SHARES = 0.0, 0.5, 0.75, 1.0
FOLDS = 5


@dataclass(frozen=True)
class BorneOut:
    """What flights left out say. share : of the prediction that is to be taken out; errors : {flight: {share: 3D RMSE of the
    filter, m}}, under None without any correction."""

    share: float
    errors: dict

    @property
    def gains(self):
        """(n,): by how much the error of each flight gets smaller with the share, relative to that without correction."""
        return np.array([1.0 - of[self.share] / of[None] for of in self.errors.values()])

    def as_text(self):
        """One sentence."""
        gains = self.gains
        return (
            f"expected of flights like these: the 3D RMSE falls by {gains.mean():.0%} +- {_spread(gains):.0%} "
            f"(of {len(gains)} flights, each left out; the worst {gains.min():+.0%}), with {self.share:g} of the prediction taken out"
        )

    def as_dict(self):
        """For JSON."""
        gains = self.gains
        errors = {name: {str(share): error for share, error in of.items()} for name, of in self.errors.items()}
        return {"share": self.share, "gain": gains.mean(), "spread": _spread(gains), "worst": gains.min(), "left_out": errors}


@in_one_thread
def bear_out(kind, flights, seed, options=structured.Options(), found=None, progress=lambda text: None):
    """BorneOut of a kind of model trained on Flights.

    found : Physics of these flights, in this order, for kinds with effects.
    """
    order = np.random.default_rng(seed).permutation(len(flights))
    errors = {}
    for fold in (order[k :: min(FOLDS, len(flights))].tolist() for k in range(min(FOLDS, len(flights)))):
        others = [k for k in range(len(flights)) if k not in fold]
        effects, network = _without(kind, flights, others, seed, options, found)
        for flight in (flights[k] for k in fold):
            errors[flight.name] = judged(flight, effects, network)
            progress("{} left out: {:.3f} m without, {:.3f} m with all".format(flight.name, errors[flight.name][None], errors[flight.name][1.0]))
    return BorneOut(choose(errors), errors)


def judged(flight, effects, network):
    """{share: 3D RMSE of the filter on a Flight, m, from TDOAs and IMU alone}, under None without any correction."""
    out = {None: _error(flight)}
    for share in SHARES if network else ():
        network.share = share
        out[share] = _error(flight, effects, network)
    return out if network else {**out, 1.0: _error(flight, effects)}


def choose(errors):
    """The share whose error, relative to that without correction, is smallest a standard deviation above its mean over the
    flights left out. errors : as of BorneOut.

    The mean alone takes all of a model that gains much on three flights and loses a little on the fourth; the flights to come
    are more varied than these.
    """
    ratios = {share: np.array([of[share] / of[None] for of in errors.values()]) for share in SHARES if all(share in of for of in errors.values())}
    return min(ratios, key=lambda share: ratios[share].mean() + _spread(ratios[share]))


def train(kind, training, validation, seed, name, options=structured.Options(), progress=lambda text: None):
    """(Trained, BorneOut): `models.train`, and as much of it as is borne out."""
    flights = [*training, *validation]
    found = None
    if kind.startswith("physics"):
        progress("looking for effects")
        found = physics.find(flights)
    trained = models.train(kind, training, validation, seed, name, options, progress, found)
    borne_out = bear_out(kind, flights, seed, options, found, progress)
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


def _spread(gains):
    return float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
