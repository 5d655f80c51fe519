"""Values in words, for advice and reports."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

LARGEST = 3  # values that a sentence names


def rounded(value: float, std: float | None = None) -> str:
    """A number to the first digit of its standard deviation, or to three digits without one."""
    if not std:
        return f"{value:.3g}"
    return f"{value:.{_decimals(std)}f}"


def measured(value: float, std: float | None = None, unit: str = "") -> str:
    """ "0.31 ± 0.01 m" """
    number = f"{rounded(value, std)} ± {rounded(std, std)}" if std else rounded(value)
    return f"{number} {unit}".strip()


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
