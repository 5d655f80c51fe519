"""Several flights: whether a finding is the same in all, differs, grows from one to the next, or
belongs to one alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from .regression.scan import Scan
from .regression.select import select
from .regression.table import table_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..parallel import MapFunction
    from .channels import ChannelResiduals
    from .channels.views import CovariateView
    from .regression.select import Search, Selection
    from .regression.table import RegressionTable
    from .regression.terms import Candidate

DETERMINED = 0.25  # standard deviation of a share, below which the flight determines it
SURE = 4.0  # standard deviations
# share by which flights may differ and count as the same: models are never right to less
ALIKE = 0.3
GROWN = 0.5  # share by which the last flight must be beyond the first, to call it growing

ALL, ALONE, GROWS, DIFFERS = "all", "alone", "grows", "differs"


@dataclass(frozen=True)
class Share:
    """How much of a finding a flight shows. flight : its name; share, std : 1 is what all flights
    together show; std is infinite where it shows nothing.
    """

    flight: str
    share: float
    std: float

    @classmethod
    def fitted(cls, flight: str, power: float, score: float) -> Share:
        """Of a fit of one factor. power, score : second and first derivative of the log-likelihood
        by it, at 0.
        """
        return (
            cls(flight, float(score / power), float(power**-0.5))
            if power > 0.0
            else cls(flight, 0.0, np.inf)
        )

    @property
    def determined(self) -> bool:
        """Whether the flight determines it."""
        return self.std < DETERMINED


def shares(selection: Selection, candidate: Candidate, names: Sequence[str]) -> tuple[Share, ...]:
    """(Share, ...) of a chosen Candidate, one for each flight of its RegressionTable, which has
    `names`: a fit of one factor to the rows of each.
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


def course(several: Sequence[Share]) -> str | None:
    """ALL, ALONE, GROWS or DIFFERS of (Share, ...) in the order of the flights; None where fewer
    than two determine it.
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
    order = np.arange(len(determined)) - 0.5 * (len(determined) - 1)
    steps = np.diff(share) * np.sign(share[-1] - share[0])
    slope, sure = order @ share / (order @ order), np.sqrt(order**2 @ std**2) / (order @ order)
    rising = (steps > -2.0 * np.hypot(std[1:], std[:-1])).all()
    if (
        len(determined) > 2
        and rising
        and abs(slope) > SURE * sure
        and abs(share[-1] - share[0]) > GROWN
    ):
        return GROWS
    return DIFFERS


def in_words(several: Sequence[Share]) -> str:
    """A sentence on (Share, ...); "" where flights do not determine it."""
    kind, determined = course(several), [each for each in several if each.determined]
    if kind is None:
        return ""
    if kind == ALL:
        return f"The same in all {len(determined)} flights that show it."
    if kind == ALONE:
        return f"Belongs to {max(determined, key=lambda each: abs(each.share)).flight} alone."
    listed = ", ".join(f"{each.share:.1f} in {each.flight}" for each in determined)
    return f"{'Grows' if kind == GROWS else 'Differs'} from flight to flight: {listed} of it."


def of_one(
    remaining: list[ChannelResiduals],
    inflation: np.ndarray,
    views: Callable[[RegressionTable], dict[str, list[CovariateView]]],
    search: Search,
    map_function: MapFunction = map,
) -> list[tuple[int, Selection]]:
    """[(flight, Selection)] of what each flight alone shows of its own, of [{channel:
    ChannelResidual}] that a model of all leaves.

    inflation : of the fit of all; views(table) -> {channel: [CovariateView]}; search : as `select`
        takes it;
    map_function : as of `attribute`. What another flight shows too is not of one alone.
    """
    out = []
    for number, selection in enumerate(
        map_function(partial(_selection, inflation, views, search), remaining)
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
    views: Callable[[RegressionTable], dict[str, list[CovariateView]]],
    search: Search,
    residuals: ChannelResiduals,
) -> Selection | None:
    """Selection of what the residuals of a flight show; None if that is nothing."""
    table = table_of([residuals])
    selection = select(table, [], inflation, search, Scan(table, views(table)))
    return selection if selection.chosen else None


def _elsewhere(
    selection: Selection, candidate: Candidate, remaining: list[ChannelResiduals], number: int
) -> bool:
    """Whether another flight shows a good part of a Candidate that was found in flight `number`."""
    fit = selection.fit
    for other in remaining[:number] + remaining[number + 1 :]:
        table = table_of([other]).with_terms(candidate.terms)
        part = table.matrix(candidate.columns) @ fit.values(candidate.columns)
        information = 1.0 / (fit.scale**2 * fit.inflation)[table.group]
        (share,) = _shares(part, table.y, information, table.flight, ("",))
        if share.determined and share.share > ALIKE:
            return True
    return False
