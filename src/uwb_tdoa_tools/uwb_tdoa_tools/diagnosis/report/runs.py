# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Names of filter runs in the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..result import Diagnosis

CM = 100.0  # cm per metre


def labels(diagnosis: Diagnosis) -> list[str]:
    """Return one name per judged run: its flight, plus its time if a flight was judged in parts."""
    runs = [run["flight"] for run in diagnosis.before["runs"]]
    if len(set(runs)) == len(runs):
        return runs
    return [
        f"{score.name}, {score.first:.0f} to {score.last:.0f} s"
        for score in diagnosis.before["scores"]
    ]
