"""Differences of the distances to two anchors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import Samples, SmoothTerm
from uwb_tdoa_bias.effects.covariates import CATEGORIES, EXTRA, OF_ARRIVAL, OF_TDOA

from . import pairs
from .base import Channel
from .extra import extra_names
from .knots import knots_of
from .radio import RadioResidual, are_many, compared, covariate_at, of_arrivals
from .views import views_of_pairs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .base import Comparison, Figures
    from .views import CovariateView

QUICK = ("interval", *CATEGORIES)  # covariates that change from one TDOA to the next


class TdoaResidual(RadioResidual):
    """Residuals of TDOAs."""

    label = "TDOA [m]"

    def place_in_room(self, series: int) -> str:
        return "-".join(
            str(self.samples.anchors.ids[row]) for row in divmod(series, len(self.samples.anchors))
        )


class Tdoa(Channel[TdoaResidual]):
    """Differences of the distances to two anchors."""

    name = "tdoa"
    unit = "m"
    needs = "TDOAs"
    negligible = 0.004
    maps = ("x", "y", "height", "range")

    def residual(self, comparison: Comparison) -> TdoaResidual | None:
        return compared(comparison, Samples, TdoaResidual)

    def smooth_terms(self, residuals: Sequence[TdoaResidual]) -> list[SmoothTerm]:
        out, many = [], are_many(residuals)
        for name in (*OF_TDOA, *extra_names([part.samples for part in residuals])):
            if knots := knots_of(name, residuals):
                out.append(SmoothTerm(covariate=name, form="common", knots=knots))
                if name not in CATEGORIES and not name.startswith(EXTRA) and not many:
                    out.append(SmoothTerm(covariate=name, form="anchor", knots=knots))
        for name in OF_ARRIVAL:
            if knots := knots_of(name, residuals):
                out += [
                    SmoothTerm(covariate=name, form=form, knots=knots)
                    for form in ("arrival", "anchor")[: 1 if many else 2]
                ]
        return out

    def views(self, residuals: Sequence[TdoaResidual]) -> list[CovariateView]:
        if any(part.innovations is not None for part in residuals):
            return []  # what the path follows is not left in them
        cells, many = [part.cells for part in residuals], are_many(residuals)
        ends = [
            np.stack([part.samples.anchors.ids[rows] for rows in part.arrivals(part.cells.pair)])
            for part in residuals
        ]
        of_tdoa, of_arrival, quick = {}, {}, {}
        for name in (*OF_TDOA, *extra_names([part.samples for part in residuals])):
            if many and name in CATEGORIES:
                continue
            known = [
                v for v in (covariate_at(name, part.samples) for part in residuals) if v is not None
            ]
            if len(known) < len(residuals):
                continue
            if name in QUICK:
                quick[name] = np.concatenate([v[cell.chosen] for cell, v in zip(cells, known)])
            else:
                of_tdoa[name] = np.concatenate([cell.mean(v) for cell, v in zip(cells, known)])
        for name, function in OF_ARRIVAL.items():
            both = [of_arrivals(function, part.samples) for part in residuals]
            means = [[cell.mean(v) for v in values] for cell, values in zip(cells, both)]
            of_arrival[name] = np.concatenate(means, axis=1)
        a, b = np.concatenate(ends, axis=1)
        slow = views_of_pairs(a, b, of_tdoa, of_arrival, many=many)
        first = np.cumsum([0, *(len(cell.size) for cell in cells)])
        cell = np.concatenate([part.group + start for part, start in zip(cells, first)])
        return slow + views_of_pairs(a[cell], b[cell], quick, {}, cell, many)

    def health(self, residuals: Sequence[TdoaResidual]) -> Figures:
        return pairs.health(residuals)
