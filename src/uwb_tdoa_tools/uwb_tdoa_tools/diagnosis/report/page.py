"""The report: one page of HTML that holds everything itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .anchors import fitted
from .curves import errors_over_time
from .details import details, phases, terms
from .entries import entries
from .maps import maps
from .markup import page, paragraphs, section
from .sections import head, not_told, to_do, worth
from .verdict import faults_in_words, truth_in_words, verdict

if TYPE_CHECKING:
    from ..diagnose import Diagnosis


def html(diagnosis: Diagnosis) -> str:
    """The page of a Diagnosis: verdict, what to do, what each effect is worth, map, errors, what could not be told, and
    folded details."""
    found = entries(diagnosis)
    names = ", ".join(flight.name for flight in diagnosis.flights)
    parts = [
        head(diagnosis, verdict(diagnosis)),
        section("What is wrong with the numbers", paragraphs(faults_in_words(diagnosis))) if diagnosis.numbers else "",
        section("What is wrong with the ground truth", paragraphs(truth_in_words(diagnosis))) if diagnosis.of_truth else "",
        to_do(diagnosis, found),
        fitted(diagnosis),
        worth(diagnosis, found),
        section("Where in the room", maps(diagnosis)),
        section("When in the flight", errors_over_time(diagnosis)),
        section("From the floor to the floor", phases(diagnosis)),
        not_told(diagnosis),
        section(
            "Details",
            paragraphs([f"Fitted to {names}, beside {diagnosis.reference.words}."], "note"),
            *details(diagnosis),
        ),
    ]
    return page(f"Diagnosis of {names}", [*parts, terms("".join(parts))])
