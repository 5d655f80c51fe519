# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The blind bank: put effects of the grammar into flights, diagnose them, and judge the result.

An effect is put into two flights. One is diagnosed. The other shows whether the effect is named
rightly, and removed. Measured flights are corrected first, by a diagnosis of other flights of the
same day.
"""

from dataclasses import replace
from functools import cache

from known_effects import clean_flight
import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import Effect, EffectSet
from uwb_tdoa_bias.effects.base import SensorFunction
from uwb_tdoa_bias.effects.samples import OF_STATE, STATES
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.cli import as_json
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.scoring.metrics import Score

from . import grammar, measured
from .bank import share
from .claims import claims, truth_of

LEAST_COST = 0.02  # m of 3D RMSE that an effect costs in both flights
GROW, GROWTHS = 1.7, 3  # an effect that costs less is made larger, so often
# first seeds: of the cases used in development, and of the reported cases
DEVELOPED_ON, DRAWN_ONCE = (0, 1_000_000)
# {split of `measured`: places of its judged flights, in groups of one protocol}: each flight is
# judged on the next.
GROUPS = {
    "0425 a": ((0, 1, 2), (3, 4)),
    "0425 b": ((0, 1, 2), (3, 4)),
    "0426 a": ((0, 1, 2), (3, 4)),
    "0426 b": ((0, 1), (2, 3)),
    "const1": ((1, 2),),
    "const3": ((0, 1),),
    "const4 trial 1": ((0, 1),),
    "const4 trial 3": ((0, 1),),
}
LOOKED_AT = ("0425 a", "0426 a", "const1", "const4 trial 1")  # while this was developed


class Measured:
    """Measured flights, with effects diagnosed from other flights of their day and installation."""

    def __init__(self, data, out, splits=tuple(GROUPS)):
        """data, out : Paths. The known effects are read from the output of `measured` in `out`. If
        it is missing, `measured` is run first.
        """
        self._data, self._out, self._splits = data, out, splits
        for split in splits:
            if not self._known(split).exists():
                measured.run(data, split, out)

    def _known(self, split):
        return self._out / measured.folder_of(split) / "effects.yaml"

    def flights(self, rng):
        """([Flight, Flight], EffectSet, name of the split)."""
        split = self._splits[rng.integers(len(self._splits))]
        flights, groups = _judged(self._data, split), GROUPS[split]
        group = groups[rng.integers(len(groups))]
        first = int(rng.integers(len(group)))
        chosen = [flights[group[(first + k) % len(group)]] for k in range(2)]
        return chosen, EffectSet.from_yaml(self._known(split)), split


@cache
def _judged(data, split):
    return measured.load(data, measured.SPLITS[split][1])


class Simulated:
    """Simulated flights without any other effect."""

    def flights(self, rng):
        """As those of Measured."""
        seed = int(rng.integers(1000, 100000))
        other = seed + 20 * int(rng.integers(1, 50))
        return [clean_flight(one) for one in (seed, other)], EffectSet(), "simulated"


def rmse(flight, effects):
    """3D RMSE of the filter, m; infinite without any estimate."""
    run = run_offline(flight, None, Corrector(flight.anchors, effects))
    score = Score(flight.name, run.odometry, flight.truth, run.residuals)
    return score.row()["rmse_3d"] if len(score.t) else np.inf


def case(source, seed):
    """(Undeclared, two flights with it, the same without, base, where) of a seed.

    None if the effect costs too little even when it is enlarged.
    """
    flights, base, where = source.flights(np.random.default_rng([seed, 7]))
    effect = grammar.draw(seed, flights[0])
    before = [rmse(flight, base) for flight in flights]
    for _ in range(1 + GROWTHS):
        flown = [effect.inject(flight) for flight in flights]
        if all(rmse(one, base) - none >= LEAST_COST for one, none in zip(flown, before)):
            return effect, flown, flights, base, where
        effect = replace(effect, size=effect.size * GROW)
    return None


class Told(Effect):
    """An Undeclared that is known exactly. The correction uses the poses that a node has."""

    name = "told"
    needs_motion = True
    uses_attitude = True

    def __init__(self, undeclared):
        super().__init__()
        self.undeclared = undeclared

    @property
    def jacobian_states(self):
        return STATES.get(self.undeclared.covariate, ()) if self.undeclared.stream == "tdoa" else ()

    def bias(self, samples):
        return (
            self.undeclared.bias(samples)
            if self.undeclared.stream == "tdoa"
            else np.zeros(len(samples))
        )

    def sensor_functions(self):
        effect, (low, high) = self.undeclared, self.undeclared.limits
        if effect.stream == "tdoa" or effect.covariate not in OF_STATE:
            return ()
        beyond = 0.25 * (high - low)  # where the course of an Undeclared ends
        return (
            SensorFunction.of(
                effect.course,
                f"{effect.stream}.{'xyz'[effect.who[0]]}",
                effect.covariate,
                (low - beyond, high + beyond),
            ),
        )


def told(effect, flown, plain, base):
    """3D RMSE, m, of a Flight `flown` with an Undeclared that is known exactly. plain : the error
    without it. Of an inertial sensor nodes know what it read and when, and where the filter is.
    """
    if effect.stream == "tdoa" or effect.covariate in OF_STATE:
        return rmse(flown, EffectSet((*base.effects, Told(effect))))
    return rmse(flown, base) if effect.covariate in grammar.OF_POSE[1:] else plain


# {(where, flight, judge): ([Claim], m of the judging flight's error)} of this process: seeds share
# flights
_told_as_they_are = {}


def _as_they_are(flight, judge, base, where):
    """Claims about an unchanged flight, and 3D RMSE, m, of `judge` with its effects."""
    key = where, flight.name, judge.name
    if key not in _told_as_they_are:
        result = diagnose([flight], base=base)
        _told_as_they_are[key] = claims(result.findings), rmse(judge, result.effects)
    return _told_as_they_are[key]


def run(source, seed):
    """dict of the case of a seed; None if it costs too little."""
    drawn = case(source, seed)
    return None if drawn is None else {"seed": seed, **_judge(*drawn)}


def _judge(effect, flown, flights, base, where):
    """dict of a case. The first flight is diagnosed, and the second one judges."""
    result = diagnose(flown[:1], base=base)
    plain, before, after = (
        rmse(flights[1], base),
        rmse(flown[1], base),
        rmse(flown[1], result.effects),
    )
    known, plain_after = _as_they_are(*flights, base, where)
    said, true = claims(result.findings), truth_of(effect, flown[0])
    new = [
        claim
        for claim in said
        if not any(claim.names(one) and claim.depends_as(one) for one in known)
    ]
    place, among_new = (
        next((k for k, claim in enumerate(some) if claim.names(true)), None) for some in (said, new)
    )
    return as_json(
        {
            "where": where,
            "flight": flown[0].name,
            "effect": effect.name,
            "stream": effect.stream,
            "subset": effect.subset,
            "covariate": effect.covariate,
            "shape": effect.shape,
            "said": [claim.text for claim in said],
            "first": _first(said),
            "first_new": _first(new),
            "place": place,
            "among_new": among_new,
            "covariate_right": place is not None and said[place].depends_as(true),
            "shape_right": place is not None and said[place].shape == true.shape,
            "rmse": [
                value if np.isfinite(value) else None
                for value in (plain, before, after, plain_after)
            ],
            "removed": float(1.0 - (after - plain) / (before - plain)),
            "removed_if_told": float(
                1.0 - (told(effect, flown[1], plain, base) - plain) / (before - plain)
            ),
        }
    )


def _first(said):
    return (
        None
        if not said
        else [said[0].stream, said[0].subset, (*said[0].covariates, "")[0], said[0].shape]
    )


def false_alarms(number, first=DEVELOPED_ON):
    """Yields a dict of the claims about each simulated flight without any effect."""
    for seed in range(first, first + number):
        findings = attribute([clean_flight(1000 + seed)], GroundTruth()).findings()
        yield {"seed": seed, "said": [claim.text for claim in claims(findings)]}


def figures(results):
    """Figures of the cases that cost enough."""
    removable = [r for r in results if r["removed_if_told"] >= 0.5]
    mean = {
        "cases": len(results),
        "channel right, of the first": share(
            bool(r["first"]) and r["first"][0] == r["stream"] for r in results
        ),
        "channel and subset right and first": share(r["place"] == 0 for r in results),
        "the same, first of what is not said of the flight as it is": share(
            r["among_new"] == 0 for r in results
        ),
        "named at any place": share(r["place"] is not None for r in results),
        "covariate right": share(r["covariate_right"] for r in results),
        "shape right": share(r["shape_right"] for r in results),
        "half of the excess error removed": share(_half(r) for r in results),
        "the same, where that is so if the effect is known exactly": share(map(_half, removable)),
        "of these": len(removable),
    }
    for key in ("stream", "subset", "where"):
        mean[f"first, by {key}"] = {
            name: (
                f"{sum(r['place'] == 0 for r in results if r[key] == name)} of "
                f"{sum(r[key] == name for r in results)}"
            )
            for name in sorted({r[key] for r in results})
        }
    return mean


def _half(result):
    return result["removed"] is not None and result["removed"] >= 0.5
