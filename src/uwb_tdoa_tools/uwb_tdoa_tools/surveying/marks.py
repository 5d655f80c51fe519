"""Marks: places measured beforehand where the tag stood or passed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.safe_yaml import read_yaml

from ..diagnosis.constraints import Mark

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from uwb_tdoa_bias.foundation.flight import Flight

KEYS = ("flight", "from", "to", "position", "std")
EXAMPLE = "{flight: monday, from: 12.0, to: 14.0, position: [1.0, -2.0, 0.5], std: 0.05}"


def read_marks(path: str | Path, flights: Sequence[Flight]) -> list[Mark]:
    """[Mark] of a YAML file, for Flights. Raises InputError for one that is not as EXAMPLE, or of
    no or too short a flight.

    `from` and `to`: s since the first TDOA of the flight, or its first range where it has no TDOAs;
    position: m, of the tag, on average between them.
    """
    content = read_yaml(path)
    entries = content.get("marks") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected a list 'marks', each as {EXAMPLE}.")
    lengths = {flight.name: flight.end - flight.start for flight in flights}
    return [
        _mark(f"{path}: mark {number}", entry, lengths)
        for number, entry in enumerate(entries, start=1)
    ]


def _mark(where: str, entry: Any, lengths: Mapping[str, float]) -> Mark:
    if not isinstance(entry, dict) or set(entry) != set(KEYS):
        raise InputError(f"{where}: must be as {EXAMPLE}.")
    flight, first, last, position, std = (entry[key] for key in KEYS)
    if not isinstance(flight, str) or flight not in lengths:
        raise InputError(f"{where}: there is no flight {flight!r}; given are {', '.join(lengths)}.")
    try:
        first, last, std, position = (
            float(first),
            float(last),
            float(std),
            tuple(map(float, position)),
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}; write it as {EXAMPLE}.") from error
    if not 0.0 <= first < last <= lengths[flight]:
        raise InputError(
            f"{where}: from {first:g} to {last:g} s must lie, one after the other, in the "
            f"{lengths[flight]:.1f} s of {flight}."
        )
    if (
        len(position) != 3
        or not all(abs(value) < 1e6 for value in position)
        or not 0.0 < std < 10.0
    ):
        raise InputError(
            f"{where}: position {list(position)} +- {std:g} must be three coordinates and a "
            "std above 0, in m."
        )
    return Mark(flight, first, last, position, std)
