"""Distances to anchors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.covariates import OF_ARRIVAL, OF_MOTION, OF_TDOA
from uwb_tdoa_bias.effects.samples import RADIO
from uwb_tdoa_bias.foundation.sensors import COMPARED

from .base import Channel
from .extra import extra_names
from .figures import APART, figures
from .knots import knots_of
from .radio import RadioResidual, are_many, compared, covariate_at, of_arrivals
from .views import views_of_anchors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .base import Comparison, Figures
    from .views import CovariateView

COVARIATES = tuple(
    name for name in OF_TDOA if name not in OF_MOTION
)  # a node corrects them without the past of the motion


class RangeResidual(RadioResidual):
    """Residuals of distances to anchors."""

    label = "range [m]"

    def place_in_room(self, series: int) -> str:
        return str(self.samples.anchors.ids[self.arrivals(np.array(series))[1]])

    def of_floor(self) -> None:
        """Nothing: that anchors are late near the floor is looked for in TDOAs alone."""


class Ranging(Channel[RangeResidual]):
    """The channel of one of the SENSORS that measure distances to anchors."""

    unit: str

    def __init__(self, name: str) -> None:
        self.name = name
        vars(self).update(vars(COMPARED[name]))

    def residual(self, comparison: Comparison) -> RangeResidual | None:
        known = all(comparison.reference.positions_known) or comparison.view.innovations is not None
        if getattr(comparison.flight, self.name) is None or not known:
            return None
        return compared(comparison, RADIO[self.name], RangeResidual)

    def smooth_terms(self, residuals: Sequence[RangeResidual]) -> list[SmoothTerm]:
        out = []
        for name in (*COVARIATES, *extra_names([part.samples for part in residuals]), *OF_ARRIVAL):
            if knots := knots_of(name, residuals):
                forms = ("arrival" if name in OF_ARRIVAL else "common", "anchor")[
                    : 1 if are_many(residuals) else 2
                ]
                out += [
                    SmoothTerm(channel=self.name, covariate=name, form=form, knots=knots)
                    for form in forms
                ]
        return out

    def views(self, residuals: Sequence[RangeResidual]) -> list[CovariateView]:
        if any(part.innovations is not None for part in residuals):
            return []  # what the path follows is not left in them
        cells = [part.cells for part in residuals]
        anchor = np.concatenate(
            [part.samples.anchors.ids[part.arrivals(part.cells.pair)[1]] for part in residuals]
        )
        common, of_each = {}, {}
        for name in (*COVARIATES, *extra_names([part.samples for part in residuals])):
            known = [
                v for v in (covariate_at(name, part.samples) for part in residuals) if v is not None
            ]
            if len(known) == len(residuals):
                common[name] = np.concatenate([cell.mean(v) for cell, v in zip(cells, known)])
        for name, function in OF_ARRIVAL.items():
            of_each[name] = np.concatenate(
                [
                    cell.mean(of_arrivals(function, part.samples)[0])
                    for cell, part in zip(cells, residuals)
                ]
            )
        return views_of_anchors(self.name, anchor, common, of_each, are_many(residuals))

    def health(self, residuals: Sequence[RangeResidual]) -> Figures:
        flown = [part.airborne for part in residuals]
        t = np.concatenate(
            [part.samples.t[air] + APART * k for k, (part, air) in enumerate(zip(residuals, flown))]
        )
        r = np.concatenate([part.residual[air] for part, air in zip(residuals, flown)])
        anchor = np.concatenate(
            [part.samples.anchors.ids[part.samples.b[air]] for part, air in zip(residuals, flown)]
        )
        each = np.unique(anchor).tolist()
        return {
            "axes": [
                {"axis": f"{self.name} {i}", **figures(t[anchor == i], r[anchor == i])}
                for i in each
            ]
        }
