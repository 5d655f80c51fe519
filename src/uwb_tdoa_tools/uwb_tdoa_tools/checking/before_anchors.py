"""Ids, signs and units are put right before anchors: wrong ones look like anchors elsewhere."""

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


def ids_are_right(
    command: str, reading: Reading, paths: Sequence[str], estimator: FlightEstimator
) -> bool:
    """Return whether `check` finds none of these mistakes in recordings; show which it finds.

    command : name of the command that stops then; paths : files and folders to read.
    """
    found = []
    with Progress(command) as progress:
        for path, survey in progress.over(reading.find(paths), "checking recordings"):
            findings = check(read_recording(reading, path, survey), (), estimator).findings
            found += [finding for finding in findings if finding.rule in (*FIRST, EXCHANGED)]
    for finding in found:
        cli.show(*report.lines(finding))
    if found:
        cli.say(
            command,
            "stopped, and nothing is written: ids, signs and units first, as said above; then "
            "anchors.",
        )
    return not found
