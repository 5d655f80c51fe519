# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""TracedCorrection, the graph of all that a Corrector does, and what had to be left out of it."""

from __future__ import annotations

from dataclasses import dataclass
import json
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.text import written_by
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.exported import INPUTS, KIND, OUTPUTS
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import Effect, EffectSet

from .left_out import LeftOut, left_out
from .tracing import nodes_of, samples_of

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.correction.model import Model

    from .graph import Node

FARTHEST = 500.0  # m from the origin: single precision resolves 0.03 mm there


@dataclass(frozen=True)
class TracedCorrection:
    """The graph of a correction.

    Attributes
    ----------
    anchors : Anchors
    effects : EffectSet of the effects in the graph
    network : Network in the graph, or None
    outputs : {name: Node} of "bias" () m, "std" () m, "status" () and "slope" (6,)
    left_out : tuple of LeftOut
    """

    anchors: Anchors
    effects: EffectSet
    network: Network | None
    outputs: dict[str, Node]
    left_out: tuple[LeftOut, ...]

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
PROVENANCE = ("name", "kind", "data", "trained_on", "validated_on", "trained_with")


def trace(
    anchors: Anchors, effects: EffectSet | None, network: Model | None = None
) -> TracedCorrection:
    """Return the TracedCorrection of some Anchors; raise InputError.

    The output `bias` needs neither the copies of the samples that `slope` and `std` are made of:
    a printer that prints `bias` alone prints a small graph.
    """
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
    bias, std, status, slope, _ = (nodes_of(samples, values) for values in found)
    outputs = {"bias": bias, "std": std, "status": status, "slope": slope}
    return TracedCorrection(anchors, held, network, outputs, tuple(omitted))


def is_traceable(effect: Effect) -> bool:
    """Return whether a Corrector corrects an effect, or widens the noise by it, from its inputs."""
    kind = type(effect)
    acts = kind.bias is not Effect.bias or kind.noise_std is not Effect.noise_std
    usable = effect.usable and not effect.is_hypothesis
    return acts and usable and "tdoa" in effect.channels
