# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Inject declared effects into flights."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS

from ..bags.bag import check_output, write_bag

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects.base import Effect

    from ..readers.inputs import Reading

# anchors in the name of a parameter: 3, 3-5, 3.x
_ANCHORS = re.compile(r"(\d+)(?:-(\d+))?(?:\..+)?")


def parse_effect(name: str, values: Sequence[str]) -> Effect:
    """Parse the values "KEY=NUMBER", "KEY:NUMBER" or "NUMBER" of an Effect.

    Raises InputError.
    """
    if name not in EFFECTS:
        raise InputError(f"--effect: {name!r} is not known; choose {', '.join(EFFECTS)}.")
    kind = EFFECTS[name]
    parameters: dict[str, Any] = {}  # the Effect converts the texts
    for text in ",".join(values).split(","):
        key, found, number = text.replace(":", "=").strip().rpartition("=")
        key = key.strip() if found else kind.example
        if key in parameters:
            raise InputError(f"--value: {name}: {key} is given twice.")
        parameters[key] = number
    return kind(parameters, source="injected")


def inject(
    effect: Effect,
    recording: str | Path,
    reading: Reading,
    out: str | Path,
    seed: int = 0,
    storage: str = "mcap",
    force: bool = False,
) -> str:
    """Write the flight with an Effect as a bag. Return the name of the flight.

    Parameters
    ----------
    reading : how the recording is read.
    seed : of random effects.

    Raises InputError.
    """
    check_output(out, force)  # before the work, not after it
    flight = reading.one(recording)
    _check_anchors(effect, flight)
    write_bag(effect.inject(flight, np.random.default_rng(seed)), out, storage, force)
    return flight.name


def _check_anchors(effect: Effect, flight: Flight) -> None:
    """Raise InputError if the Effect has a parameter of an unknown anchor."""
    for key in effect.values if "tdoa" in effect.channels else ():
        named = _ANCHORS.fullmatch(key)
        for anchor in filter(None, named.groups() if named else ()):
            if flight.anchors.row(int(anchor)) < 0:
                known = ", ".join(map(str, flight.anchors.ids))
                raise InputError(
                    f"--value: {effect.name}: {key}: {flight.name} has no anchor {anchor}; it "
                    f"has {known}."
                )


def catalogue() -> str:
    """List all effects with parameter, unit and physics, as text."""
    lines = [
        f"{name:20s} e.g. {e.example}=NUMBER ({e.unit}): {e.physics}" for name, e in EFFECTS.items()
    ]
    return "\n".join(lines)
