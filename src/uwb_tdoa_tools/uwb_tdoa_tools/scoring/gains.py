"""How an error changes, in words that have no sign to mistake: it falls, or rises, by so many per
cent.
"""

from __future__ import annotations

SAME = 0.005  # of the error: what rounds to no per cent


def gain(before: float, after: float) -> float:
    """Return the share of an error that is gone: above 0 where it falls, below 0 where it rises."""
    return 1.0 - after / before


def change_of(before: float, after: float) -> str:
    """Return how an error changes: "falls by 13 %", "rises by 20 %" or "stays"."""
    return by(gain(before, after))


def by(gained: float) -> str:
    """Return the same of a `gain`."""
    return (
        "stays"
        if abs(gained) < SAME
        else f"{'falls' if gained > 0.0 else 'rises'} by {100.0 * abs(gained):.0f} %"
    )
