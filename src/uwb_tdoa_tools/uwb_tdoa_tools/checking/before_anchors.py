# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Stop commands that estimate anchors while ids, signs or units are wrong.

These mistakes look like misplaced anchors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .. import cli
from ..parallel import Progress
from . import report
from .check import check
from .recording import read_recording
from .watch import EXCHANGED, FIRST

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..estimate import FlightEstimator
    from ..readers.inputs import Reading


def nothing_comes_first(
    command: str, reading: Reading, paths: Sequence[str], estimator: FlightEstimator
) -> bool:
    """Return whether `check` finds no mistake of ids, signs, units or the scale of the survey.

    Such mistakes (`watch.FIRST` and ids exchanged on the way) are printed. The caller must stop.

    command : name of the command, for its messages; reading : how recordings are read
    paths : files and folders to read; raises InputError
    """
    found = []
    with Progress(command) as progress:
        for path, survey in progress.over(reading.find(paths), "checking recordings"):
            recording = read_recording(reading, path, survey)
            findings = check(recording, others=(), estimator=estimator).findings
            found += [finding for finding in findings if finding.rule in (*FIRST, EXCHANGED)]
    for finding in found:
        cli.show(*report.lines(finding))
    if found:
        cli.say(
            command,
            "stopped, and nothing is written: ids, signs, units and scale first, as said above; then "
            "anchors.",
        )
    return not found
