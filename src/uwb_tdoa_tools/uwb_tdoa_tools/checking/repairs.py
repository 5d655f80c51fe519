"""Faults of the numbers that can be undone: as effects, for effects.yaml."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects.anchor import AnchorIds
from uwb_tdoa_bias.effects.pair import PairSign

from . import pair_rules
from .known_path import KnownPath

if TYPE_CHECKING:
    from uwb_tdoa_bias.effects import LabelEffect
    from uwb_tdoa_bias.foundation.flight import Flight

SOURCE = "numbers"


def repairs(flight: Flight) -> tuple[LabelEffect, ...]:
    """(LabelEffect, ...) that undo wrong ids and signs of a Flight, in the order in which they are
    undone; () without ground truth or TDOAs.
    """
    return (
        ()
        if flight.truth is None or len(flight.truth) < 2 or not len(flight.tdoa)
        else repairs_of(KnownPath(flight))
    )


def repairs_of(path: KnownPath) -> tuple[LabelEffect, ...]:
    """The same of a KnownPath. Where most signs are wrong, nothing is said of ids."""
    out: list[LabelEffect] = []
    signs = pair_rules.contrary(path)
    table = (
        {}
        if len(signs) >= pair_rules.MOST * max(len(path.pairs), 1)
        else pair_rules.renamed(path)[0]
    )
    if table:
        out.append(AnchorIds({str(wrong): right for wrong, right in table.items()}, source=SOURCE))
        signs = pair_rules.contrary(path.without(out[0]))
    if signs:
        out.append(PairSign({f"{a}-{b}": -1.0 for a, b in signs}, source=SOURCE))
    return tuple(out)
