"""Values in words, for advice and reports."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

ROUNDED = 0.1  # share by which a standard deviation may be rounded
LARGEST = 3  # values that a sentence names


def rounded(value: float, std: float | None = None) -> str:
    """A number to the first digit of its standard deviation, or to the second where the first is
    off by more than ROUNDED; to three digits without one.
    """
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
    decimals = -math.floor(math.log10(std))
    return max(0, decimals + (abs(round(std, decimals) - std) > ROUNDED * std))
