"""What every tool that estimates says of a flight before it does: a survey that cannot be right."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from .check import check, different_surveys
from .ordered import OrderedRecording
from .recording import of_flight
from .tdoa_rules import gained
from .watch import BEFORE_TRUTH

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from uwb_tdoa_bias.foundation.flight import Flight

SHORTEST = 10.0  # s; of shorter flights nothing is said


def survey_remarks(flight: Flight) -> Iterator[str]:
    """Sentences about the survey of a Flight: anchors that it lacks, and positions that cannot be
    right, by what moving the anchors explains (see SurveyFit). Raises InputError where no TDOA is
    between two anchors that it has.
    """
    tdoa, anchors = flight.tdoa, flight.anchors
    known = (anchors.index(tdoa.a) >= 0) & (anchors.index(tdoa.b) >= 0)
    heard = np.unique([tdoa.a, tdoa.b])
    lacking = heard[anchors.index(heard) < 0].tolist()
    if len(tdoa) and not known.any():
        raise InputError(
            f"{flight.name}: the tag hears anchors {_listed(heard)}, the survey has "
            f"{_listed(anchors.ids)}, and no "
            "TDOA is between two that it has; give the survey of that room."
        )
    if lacking:
        share = 100.0 * np.mean(~known)
        yield (
            f"the survey has no anchor {_listed(lacking)}: {share:.0f} % of the TDOAs are not "
            "used; survey it, too."
        )
    if not (len(tdoa) and np.ptp(tdoa.t) > SHORTEST):
        return
    recording = of_flight(flight)
    if gained(OrderedRecording.of(recording).survey_fit) is not None:
        causes = [
            f"{one.cause}: {one.evidence}; {one.remedy}."
            for one in check(recording).findings
            if one.rule in BEFORE_TRUTH
        ]
        yield from causes or [
            (
                "the survey does not fit the TDOAs: of another room, or anchors have been moved; "
                "`check` says more."
            )
        ]


def _listed(ids: Iterable[int]) -> str:
    return ", ".join(map(str, ids))


def remarks_on(flights: Sequence[Flight]) -> Iterator[str]:
    """Sentences on the surveys of Flights, each by itself and beside one another."""
    for flight in flights:
        yield from (f"{flight.name}: {remark}" for remark in survey_remarks(flight))
    yield from (
        f"{finding.cause}: {finding.evidence}; {finding.remedy}."
        for finding in different_surveys(flights)
    )
