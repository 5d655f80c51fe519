"""How runs of the filter are called, and their figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..result import Diagnosis

CM = 100.0  # in a metre


def labels(diagnosis: Diagnosis) -> list[str]:
    """A name for each judged run: of its flight, with its time if a flight was judged in parts."""
    runs = [run["flight"] for run in diagnosis.before["runs"]]
    if len(set(runs)) == len(runs):
        return runs
    return [
        f"{score.name}, {score.first:.0f} to {score.last:.0f} s"
        for score in diagnosis.before["scores"]
    ]
