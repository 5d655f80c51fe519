"""What is wrong with the numbers of a flight, before anybody asks which physics explains them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.streams import NOTE, most_severe_first

from . import coverage, inertial_values
from .against_truth import against_truth
from .check import fed
from .recording import of_flight

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.streams import Finding


def numbers(flight: Flight) -> list[Finding]:
    """[Finding] of a Flight, most severe first: of its streams by themselves, and against its
    ground truth if it has one. What several rules name by the same name is reported once.
    """
    streams, imu = fed(of_flight(flight)), flight.imu
    found = streams.findings()
    track = None if flight.truth is None else (flight.truth.t, flight.truth.p)
    found += coverage.missing(
        coverage.CoverageView(flight.anchors, list(streams.tdoa), np.empty((0, 3)), track=track)
    )
    if imu is not None and not any(finding.rule == "imu_clipped" for finding in found):
        found += inertial_values.saturated(flight)
    found = [finding for finding in found if finding.severity != NOTE]
    known = {finding.rule for finding in found}
    return most_severe_first(
        found + [finding for finding in against_truth(flight) if finding.rule not in known]
    )
