"""Values in words, for advice and reports."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from .base import Effect

SIGNIFICANT = 2.0  # standard deviations; a smaller value is not told by the data
LARGEST = 3  # values that a sentence names


def significant(effect: Effect) -> dict[str, float]:
    """{parameter: value} of those values of an Effect that the data tell, the largest first in standard deviations;
    values without a standard deviation, or with none but 0, were set, not estimated, and come last."""
    known = {key: value for key, value in effect.values.items() if not _is_vague(value, effect.std.get(key))}
    return dict(sorted(known.items(), key=lambda item: -abs(item[1]) / (effect.std.get(item[0]) or math.inf)))


def _is_vague(value: float, std: float | None) -> bool:
    return std is not None and abs(value) < SIGNIFICANT * std


def rounded(value: float, std: float | None = None) -> str:
    """A number to the first digit of its standard deviation, or to three digits without one."""
    if not std:
        return f"{value:.3g}"
    return f"{value:.{_decimals(std)}f}"


def measured(value: float, std: float | None = None, unit: str = "") -> str:
    """ "0.31 ± 0.01 m" """
    number = f"{rounded(value, std)} ± {rounded(std, std)}" if std else rounded(value)
    return f"{number} {unit}".strip()


def size(effect: Effect, key: str, unit: str | None = None, factor: float = 1.0) -> str:
    """Magnitude of a parameter of an Effect with its standard deviation, times `factor`, in `unit`."""
    unit = effect.unit if unit is None else unit
    return measured(abs(effect.values[key]) * factor, effect.std.get(key, 0.0) * abs(factor), unit)


def directed(effect: Effect, key: str, above: str, below: str, unit: str | None = None, factor: float = 1.0) -> str:
    """The `size` of a significant parameter of an Effect, and which way it is off: "12.0 ± 0.3 ms late"; "" if the data do not tell it."""
    if key not in significant(effect):
        return ""
    return f"{size(effect, key, unit, factor)} {above if effect.values[key] > 0.0 else below}"


def listed(words: Iterable[str], last: str = "and") -> str:
    """ "a, b and c" """
    words = list(words)
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def counted(words: Iterable[str], noun: str) -> str:
    """ "anchor 3", "anchors 3 and 5" """
    words = list(words)
    return f"{noun}{'s' if len(words) > 1 else ''} {listed(words)}"


def _decimals(std: float) -> int:
    return max(0, -math.floor(math.log10(std)))
