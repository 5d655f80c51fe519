# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""TracedCorrection, the expressions of all that a Corrector does, and what had to be left out of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
import json
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.text import written_by
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import INPUTS, KIND, OUTPUTS, Model
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import Effect, EffectSet, LabelEffect, Samples, SmoothTerm
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_bias.effects.effect_set import REACH
from uwb_tdoa_bias.effects.floor import FloorMultipath

from .expressions import Expression
from .tracing import expressions_of, samples_of

FARTHEST = 500.0  # m from the origin: single precision resolves 0.03 mm there
G = 9.81  # m/s^2
# Metres per unit of a parameter, and under which condition. Inertial errors grow with the time t
# that the filter has no TDOA: a force by t^2 / 2, a tilt by g t^2 / 2, a rate by g t^3 / 6.
PER_UNIT = {
    "m": (1.0, ""),
    "s": (1.0, "at 1 m/s"),
    "m/s": (1.0, "after 1 s"),
    "m/s^2": (0.5, "after 1 s without TDOAs"),
    "rad": (0.5 * G, "after 1 s without TDOAs"),
    "rad/s": (G / 6.0, "after 1 s without TDOAs"),
}
# Of a share or an angle what it means depends on the channel
PER_UNIT_OF_CHANNEL = {
    ("tdoa", "1"): (1.0, "for outliers of 1 m"),
    ("height", "1"): (1.0, "at 1 m"),
    ("velocity", "1"): (1.0, "after 1 s at 1 m/s"),
    ("velocity", "rad"): (1.0, "after 1 s at 1 m/s"),
    ("yaw_rate", "1"): (0.5, "after 1 s at 1 m/s and 1 rad/s"),
    ("accel", "1"): (0.5, "after 1 s without TDOAs at 1 m/s^2"),
    ("gyro", "1"): (G / 6.0, "after 1 s without TDOAs at 1 rad/s"),
}
SENSOR_UNITS = {"gyro": "rad/s", "accel": "m/s^2", "velocity": "m/s", "yaw_rate": "rad/s"}


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not in a file.

    label : name in reports; worth : m, size of its error; when : condition of that, or ""
    why : the reason, a clause
    """

    label: str
    worth: float
    when: str
    why: str

    def __str__(self) -> str:
        """Return a sentence."""
        condition = f" {self.when}" if self.when else ""
        return f"{self.label} is left out: {self.why}. It is worth {self.worth:.2g} m{condition}."


def left_out(effect: Effect, anchors: Anchors) -> LeftOut:
    """Return the LeftOut of an effect."""
    if isinstance(effect, LabelEffect):
        between = anchors.positions[:, None] - anchors.positions
        far = float(np.max(np.linalg.norm(between, axis=-1)))
        why = "it changes the ids or the sign of a TDOA before the correction"
        return LeftOut(effect.label, far, "at most, the distance between two anchors", why)
    unit = _unit(effect)
    per_unit, when = PER_UNIT_OF_CHANNEL.get((effect.channels[0], unit)) or PER_UNIT[unit]
    largest = max((abs(_own(effect, key)) for key in effect.values), default=0.0)
    return LeftOut(effect.label, per_unit * largest, when, _why(effect))


def _unit(effect: Effect) -> str:
    if isinstance(effect, SmoothTerm):
        return SENSOR_UNITS.get(effect.channels[0], "m")
    return effect.unit_of(effect.example)


def _own(effect: Effect, key: str) -> float:
    """Return a value if it is a size in the first unit of the effect, else 0."""
    other = effect.is_condition(key) or effect.unit_of(key) != effect.unit_of(effect.example)
    return 0.0 if other else effect.values[key]


def _why(effect: Effect) -> str:
    if effect.is_hypothesis:
        return "the filter weighs it, and nothing corrects it; C holds it as noise near the floor"
    if "tdoa" not in effect.channels:
        return f"it acts on {listed(effect.channels)}, not on TDOAs"
    if effect.stamp_offset("tdoa"):
        return "it changes the stamps of TDOAs before the correction"
    if isinstance(effect, SmoothTerm):
        return f"no vehicle computes {effect.covariate}"
    return effect.why_unusable


class FloorWeight(FloorMultipath):
    """The noise of TDOAs near the floor, for a filter that does not weigh whether an anchor is late.

    Nothing is corrected. Where an anchor may be late, its whole delay counts as noise, at any place.
    The filter may be REACH too high: otherwise its first error would end the weight.
    """

    is_hypothesis = False
    bias = Effect.bias

    def noise_std(self, samples: Samples) -> np.ndarray:
        rows = np.concatenate([samples.a, samples.b])
        delays, _, noises = (values[rows] for values in self.of_each(samples.anchors))
        low = replace(samples, p=samples.p - np.array([0.0, 0.0, REACH]))
        share, _ = self._late(low, rows)
        power: np.ndarray = np.nan_to_num((delays**2 + noises**2) * share)
        of_a, of_b = power.reshape(2, -1)
        return np.sqrt(of_a + of_b)


@dataclass(frozen=True)
class TracedCorrection:
    """The expressions of a correction.

    Attributes
    ----------
    anchors : Anchors
    effects : EffectSet of the recorded effects
    network : recorded Network, or None
    outputs : list of Expression, in the order of OUTPUTS
    floor : FloorWeight of what only C holds
    left_out : tuple of LeftOut
    """

    anchors: Anchors
    effects: EffectSet
    network: Network | None
    outputs: list[Expression]
    left_out: tuple[LeftOut, ...]
    floor: EffectSet

    def meta(self) -> dict[str, Any]:
        """Return the metadata of a file: what goes in, what comes out, and where it is from."""
        network = {} if self.network is None else self.network.meta
        of_effects = self.effects.name if len(self.effects) else ""
        of_network = self.network.name if self.network else ""
        return {
            "kind": KIND,
            "name": "+".join(filter(None, (of_effects, of_network))),
            "inputs": [list(column) for column in INPUTS],
            "outputs": [list(column) for column in OUTPUTS],
            "frame": self.anchors.frame,
            "anchor_ids": self.anchors.ids.tolist(),
            "anchor_positions": self.anchors.positions.tolist(),
            "effects": [effect.label for effect in self.effects],
            "of_effects": of_effects,
            "needs_motion": self.effects.needs_motion,
            "has_slope": len(self.effects.state_dependent) > 0,
            "sources": {effect.label: effect.source for effect in self.effects if effect.source},
            "network": {key: json.loads(network[key]) for key in PROVENANCE if key in network},
            "left_out": [str(one) for one in self.left_out],
            "written_by": written_by(),
        }


# Keys of a network's metadata that say what it was made of
PROVENANCE = ("name", "kind", "data", "trained_on", "validated_on")


def trace(
    anchors: Anchors, effects: EffectSet | None, network: Model | None = None
) -> TracedCorrection:
    """Return the TracedCorrection of some Anchors; raise InputError."""
    far = np.abs(anchors.positions).max(axis=1) > FARTHEST
    if far.any():
        raise InputError(
            f"anchors: anchor {anchors.ids[far][0]} is more than {FARTHEST:g} m from the origin, "
            "where single precision is too coarse; give positions in a frame that begins nearby."
        )
    if network is not None and not isinstance(network, Network):
        raise InputError(
            f"model: {network.name} is an exported correction already; give the network of which "
            "it was made, as train writes it."
        )
    effects = EffectSet() if effects is None else effects
    held = effects.where(is_traceable)
    omitted = [left_out(effect, anchors) for effect in effects if not is_traceable(effect)]
    if not len(held) and network is None:
        raise InputError(
            f"effects: nothing can be exported. {' '.join(map(str, omitted))} Give effects on "
            "TDOAs, or a network."
        )
    samples = samples_of(anchors, held.needs_motion)
    found = Corrector(anchors, held, network).prediction(samples)
    columns = found.bias, found.std, found.slope, found.status
    outputs = [one for values in columns for one in expressions_of(samples, values)]
    floor = tuple(FloorWeight(one.values) for one in effects if isinstance(one, FloorMultipath))
    return TracedCorrection(anchors, held, network, outputs, tuple(omitted), EffectSet(floor))


def is_traceable(effect: Effect) -> bool:
    """Return whether a Corrector corrects an effect, or widens the noise by it, from its inputs."""
    kind = type(effect)
    acts = kind.bias is not Effect.bias or kind.noise_std is not Effect.noise_std
    usable = effect.usable and not effect.is_hypothesis
    return acts and usable and "tdoa" in effect.channels
