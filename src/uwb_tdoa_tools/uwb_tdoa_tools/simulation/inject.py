# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Inject effects into flights: declared ones, and the hidden one of a simulated hall.

No file declares the hidden effect. Its size trades realism for effect: each costs the filter 0.1 to
0.5 m of position, as the systematic errors of measured flights do. The sizes were set on seeds 0 to 2
of each kind, by the error without a correction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
import re
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError, refuse_others
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EFFECTS, Effect, SmoothTerm

from ..bags.bag import check_output, write_bag
from ..readers.inputs import Reading

# anchors in the name of a parameter: 3, 3-5, 3.x
_ANCHORS = re.compile(r"(\d+)(?:-(\d+))?(?:\..+)?")


def parse_effect(name: str, values: Sequence[str]) -> Effect:
    """Parse the values "KEY=NUMBER", "KEY:NUMBER" or "NUMBER" of an Effect.

    Raises InputError.
    """
    refuse_others("--effect", [name], EFFECTS)
    kind = EFFECTS[name]
    parameters: dict[str, Any] = {}  # the Effect converts the texts
    for text in ",".join(values).split(","):
        key, found, number = text.replace(":", "=").strip().rpartition("=")
        key = key.strip() if found else kind.row.example
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
        f"{name:20s} e.g. {e.row.example}=NUMBER ({e.unit}): {e.row.physics}"
        for name, e in EFFECTS.items()
    ]
    return "\n".join(lines)


MIDDLE = 1.0  # m, farthest place of an obstacle from the middle of the hall, along x and y
TURN = np.pi  # rad, half a turn


def hidden_effect(seed: int, anchors: Anchors) -> Effect:
    """Return an Effect, drawn by a seed: its kind of KINDS, its anchors and its size."""
    rng = np.random.default_rng([seed, 51])
    kind = sorted(KINDS)[rng.integers(len(KINDS))]
    return KINDS[kind](rng, anchors)


def _signed(rng: np.random.Generator, least: float, largest: float) -> float:
    """Return a size between two limits, with either sign."""
    return round(float(rng.uniform(least, largest) * rng.choice((-1.0, 1.0))), 4)


def _some(rng: np.random.Generator, anchors: Anchors, count: int) -> list[str]:
    """Return the ids of different anchors."""
    return [str(one) for one in rng.choice(anchors.ids, count, replace=False)]


def _with_sizes(
    name: str,
    keys: Sequence[str],
    least: float,
    largest: float,
    rng: np.random.Generator,
    anchors: Anchors,
) -> Effect:
    """Return the Effect of a name. A size is drawn for each key."""
    return EFFECTS[name]({key: _signed(rng, least, largest) for key in keys})


def _late_anchors(rng: np.random.Generator, anchors: Anchors) -> Effect:
    late = _some(rng, anchors, int(rng.integers(1, 3)))
    return _with_sizes("anchor_delay", late, 0.2, 0.45, rng, anchors)


def _drifting_clock(rng: np.random.Generator, anchors: Anchors) -> Effect:
    return _with_sizes("anchor_clock_drift", _some(rng, anchors, 1), 0.01, 0.015, rng, anchors)


def _moved_anchors(rng: np.random.Generator, anchors: Anchors) -> Effect:
    values = {}
    for one in _some(rng, anchors, 2):
        shift = rng.standard_normal(3)
        shift *= rng.uniform(0.4, 0.7) / np.linalg.norm(shift)
        values.update({f"{one}.{axis}": round(float(part), 4) for axis, part in zip("xyz", shift)})
    return EFFECTS["anchor_position"](values)


def _obstacle(rng: np.random.Generator, anchors: Anchors) -> Effect:
    x, y = (rng.uniform(-MIDDLE, MIDDLE, 2) + anchors.positions[:, :2].mean(axis=0)).round(2)
    place = {"x": float(x), "y": float(y), "z": 1.5, "radius": float(rng.uniform(1.8, 2.2))}
    values = {}
    for one in _some(rng, anchors, 2):
        behind = {"delay": float(rng.uniform(0.3, 0.45)), **place}
        values.update({f"{one}.{part}": round(value, 4) for part, value in behind.items()})
    return EFFECTS["nlos"](values)


def _pairs(rng: np.random.Generator, anchors: Anchors) -> Effect:
    ids = anchors.ids.tolist()
    ring = [f"{first}-{second}" for first, second in zip(ids, [*ids[1:], ids[0]])]
    chosen = rng.choice(ring, 4, replace=False).tolist()
    return _with_sizes("pair_offset", chosen, 0.3, 0.45, rng, anchors)


def _bearing_at_anchor(rng: np.random.Generator, anchors: Anchors) -> Effect:
    (one,) = _some(rng, anchors, 1)
    values = {f"{one}.c0": 0.0, f"{one}.c1": _signed(rng, 0.25, 0.4)}
    values[f"{one}.c2"] = _signed(rng, 0.25, 0.4)
    wave = (-0.5 * TURN, 0.5 * TURN)  # two waves per turn: one would be a moved anchor
    return SmoothTerm(values, covariate="bearing", form="anchor", knots=wave, shape="wave")


def _heading_of_tag(rng: np.random.Generator, anchors: Anchors) -> Effect:
    values = {"c0": 0.0, "c1": _signed(rng, 0.15, 0.25), "c2": _signed(rng, 0.15, 0.25)}
    turn = (-TURN, TURN)
    return SmoothTerm(values, covariate="bearing_in_tag", form="arrival", knots=turn, shape="wave")


KINDS: dict[str, Callable[[np.random.Generator, Anchors], Effect]] = {
    "antennas": partial(_with_sizes, "antenna_pattern", ("tag", "anchor"), 0.5, 0.8),
    "bearing at an anchor": _bearing_at_anchor,
    "distance": partial(_with_sizes, "range_bias", ("quadratic",), 0.01, 0.02),
    "drifting clock": _drifting_clock,
    "heading of the tag": _heading_of_tag,
    "late anchors": _late_anchors,
    "lever arm": partial(_with_sizes, "tag_lever_arm", ("x", "y", "z"), 0.1, 0.2),
    "moved anchors": _moved_anchors,
    "obstacle": _obstacle,
    "pairs": _pairs,
    "received power": partial(_with_sizes, "received_power_bias", ("scale",), 3.0, 5.0),
    "scale": partial(_with_sizes, "range_scale", ("scale",), 0.07, 0.12),
}
