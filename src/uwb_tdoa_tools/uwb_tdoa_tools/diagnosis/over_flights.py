# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare a finding between flights: equal, different, growing, or in one flight only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import stdtr

from ..parallel import MapFunction
from .channels import ChannelResiduals
from .regression.scan import Scan
from .regression.select import Search, Selection, select
from .regression.table import table_of
from .regression.terms import Candidate

DETERMINED = 0.25  # largest standard deviation of a share that a flight determines
SURE = 4.0  # standard deviations of a significant difference
# largest difference of equal shares; no model is more accurate
ALIKE = 0.3
SHOWN = 3.0  # standard deviations of a share that a flight shows
# Prior of the spread of shares between flights: standard deviation, and how many flights it counts
# for.
SPREAD, SPREAD_FLIGHTS = (0.2, 2)
HALF = 0.5  # a correction does harm if a flight has a smaller share of the effect

ALL, ALONE, DIFFERS = "all", "alone", "differs"


@dataclass(frozen=True)
class Share:
    """The amount of a finding in one flight.

    flight : name; share : 1 is the value of the fit to all flights; std : infinite without
        information
    """

    flight: str
    share: float
    std: float

    @classmethod
    def fitted(cls, flight: str, power: float, score: float) -> Share:
        """Return the Share of a fit of one factor.

        power : minus the second derivative of the log-likelihood by the factor; score : the first,
            at 0
        """
        return (
            cls(flight, float(score / power), float(power**-0.5))
            if power > 0.0
            else cls(flight, 0.0, np.inf)
        )

    @property
    def determined(self) -> bool:
        """Return whether the flight determines the share."""
        return self.std < DETERMINED


def shares(selection: Selection, candidate: Candidate, names: Sequence[str]) -> tuple[Share, ...]:
    """Return the Share of a chosen Candidate in each flight: a fit of one factor to its rows.

    names : of the flights of the RegressionTable
    """
    table, model = selection.table, selection.fit
    part = table.matrix(candidate.columns) @ model.values(candidate.columns)
    return _shares(part, model.residual + part, model.information(table), table.flight, names)


def _shares(
    part: np.ndarray,
    y: np.ndarray,
    information: np.ndarray,
    flight: np.ndarray,
    names: Sequence[str],
) -> tuple[Share, ...]:
    out = []
    for number, name in enumerate(names):
        rows = flight == number
        out.append(
            Share.fitted(
                name,
                information[rows] @ part[rows] ** 2,
                information[rows] @ (part[rows] * y[rows]),
            )
        )
    return tuple(out)


def of_one_flight(selection: Selection, candidate: Candidate) -> bool:
    """Return whether only one of two flights shows a chosen Candidate.

    False for another number of flights: of three and more, whole flights are held out.
    """
    if selection.table.flights != 2:
        return False
    several = shares(selection, candidate, ("first", "second"))
    return not all(one.share > max(ALIKE, SHOWN * one.std) for one in several)


def harm(several: Sequence[Share]) -> float:
    """Return the probability that an effect, corrected in full, does harm to another flight.

    It does so if that flight has less than HALF of it. Shares of flights are normal, with unknown
    mean and spread (Gelman et al., Bayesian Data Analysis, section 3.3). 0 if fewer than two
    flights determine a share.
    """
    share = np.array([each.share for each in several if each.determined])
    n = len(share)
    if n < 2:
        return 0.0
    freedom = SPREAD_FLIGHTS + n - 1
    spread = np.sqrt((SPREAD_FLIGHTS * SPREAD**2 + n * np.var(share)) / freedom)
    return float(stdtr(freedom, (HALF - share.mean()) / (spread * np.sqrt(1.0 + 1.0 / n))))


def course(several: Sequence[Share]) -> str | None:
    """Return ALL, ALONE or DIFFERS; None if fewer than two flights determine a share.

    several : Shares in the order of the flights
    """
    determined = [each for each in several if each.determined]
    if len(determined) < 2:
        return None
    share, std = (
        np.array([getattr(each, name) for each in determined]) for name in ("share", "std")
    )
    largest = int(np.argmax(np.abs(share)))
    others = np.arange(len(determined)) != largest
    apart = np.abs(share[largest] - share[others]) > SURE * np.hypot(std[largest], std[others])
    if (np.abs(share[others]) < ALIKE * abs(share[largest])).all() and apart.all():
        return ALONE
    spread = np.maximum(ALIKE, SURE * std)
    if (np.abs(share - np.average(share, weights=std**-2)) < spread).all():
        return ALL
    return DIFFERS


def in_words(several: Sequence[Share]) -> str:
    """Return a sentence on Shares; "" if the flights do not determine them."""
    kind, determined = course(several), [each for each in several if each.determined]
    if kind is None:
        return ""
    if kind == ALL:
        return f"The same in all {len(determined)} flights that show it."
    if kind == ALONE:
        return f"Belongs to {max(determined, key=lambda each: abs(each.share)).flight} alone."
    listed = ", ".join(f"{each.share:.1f} in {each.flight}" for each in determined)
    return f"Differs from flight to flight: {listed} of it."


def of_one(
    remaining: list[ChannelResiduals],
    inflation: np.ndarray,
    search: Search,
    map_function: MapFunction = map,
) -> list[tuple[int, Selection]]:
    """Return [(flight, Selection)]: effects in one flight only, which a common model leaves.

    An effect that another flight shows too is left out.

    remaining : [{channel: ChannelResidual}] under the common model; inflation : of the common fit
    search : as of `select`; map_function : as of `attribute`
    """
    out = []
    for number, selection in enumerate(
        map_function(partial(_selection, inflation, search), remaining)
    ):
        if selection is None:
            continue
        own = [
            candidate
            for candidate in selection.chosen
            if not _elsewhere(selection, candidate, remaining, number)
        ]
        if own:
            out.append((number, selection.only(own)))
    return out


def _selection(
    inflation: np.ndarray,
    search: Search,
    residuals: ChannelResiduals,
) -> Selection | None:
    """Return the Selection for the residuals of one flight; None if it is empty."""
    table = table_of([residuals])
    selection = select(table, [], inflation, search, Scan(table, table.views()))
    return selection if selection.chosen else None


def _elsewhere(
    selection: Selection, candidate: Candidate, remaining: list[ChannelResiduals], number: int
) -> bool:
    """Return whether another flight shows a Candidate of flight `number` too.

    Its determined share there must exceed ALIKE.
    """
    fit = selection.fit
    for other in remaining[:number] + remaining[number + 1 :]:
        table = table_of([other]).with_terms(candidate.terms)
        part = table.matrix(candidate.columns) @ fit.values(candidate.columns)
        information = 1.0 / (fit.scale**2 * fit.inflation)[table.group]
        (share,) = _shares(part, table.y, information, table.flight, ("",))
        if share.determined and share.share > ALIKE:
            return True
    return False
