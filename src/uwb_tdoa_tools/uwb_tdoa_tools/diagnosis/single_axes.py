# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Search functions of single axes of a sensor, each with the noise of its own axis.

The common search gives all axes of a sensor the median of their correlations. Where two axes err
for seconds, a clear error of the third one counts too little to be found. This search comes after
the common one, in what that one leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects import RADIO

from .channels import ChannelResiduals
from .channels.views import CovariateView
from .findings import Refused
from .refinement import cross_validated
from .regression.fit import Fit, fit, measure_inflation
from .regression.scan import Scan, line_over
from .regression.select import Selection, criterion_of, select, with_rivals
from .regression.table import RegressionTable, table_of
from .regression.terms import Candidate, columns_of

MOST = 4  # largest number of functions of an axis


def functions_of_axes(
    remaining: Sequence[ChannelResiduals],
    refused: list[Refused],
    progress: Callable[[], object] = lambda: None,
) -> list[Selection]:
    """Return a Selection of functions for each channel of which single axes show some.

    Only functions that nodes can correct are searched.

    remaining : [{channel: ChannelResidual}], one per flight, under the model so far
    refused : functions that do not improve hold-out rows are appended
    """
    out = []
    for name in dict.fromkeys(name for flight in remaining for name in flight):
        if name in RADIO:
            continue
        table = table_of([{name: flight[name]} for flight in remaining if name in flight])
        of_axes: dict[str, list[CovariateView]] = {}
        for view in table.views()[name]:
            if line_over(view).usable:
                of_axes.setdefault(view.channel, []).append(view)
        chosen: list[Candidate] = []
        for views in of_axes.values():
            table = _searched(table, Scan(table, {name: views}), chosen)
            progress()
        if not chosen:
            continue
        inflation = _fit_with_own_noise(table, chosen).inflation
        found = cross_validated(select(table, [], inflation, start=chosen), refused)
        if found.chosen:
            scan = Scan(table, {name: [view for views in of_axes.values() for view in views]})
            out.append(with_rivals(found, [], scan, progress))
    return out


def beside(selection: Selection, functions: Sequence[Selection]) -> Selection:
    """Return a Selection with functions of single axes, and with the noise that they leave."""
    table, inflation = selection.table, selection.fit.inflation.copy()
    for found in functions:
        table = table.with_terms([term for one in found.chosen for term in one.terms])
        groups = np.unique(found.table.group)
        inflation[groups] = found.fit.inflation[groups]
    chosen, loss, rivals = (
        sum((getattr(one, name) for one in (selection, *functions)), ())
        for name in ("chosen", "loss", "rivals")
    )
    model = fit(table, columns_of(chosen), inflation)
    return Selection(table, chosen, model, loss, rivals)


def _searched(table: RegressionTable, scan: Scan, chosen: list[Candidate]) -> RegressionTable:
    """Append the functions of one axis to `chosen`, and return the table with their columns.

    A function must pay its price with the noise that it leaves. Beside the right one an error that
    lasts does not count as correlated noise.

    scan : Scan of the axis
    """
    for _ in range(MOST):
        model = _fit_with_own_noise(table, chosen)
        independent = replace(model, inflation=np.ones_like(model.inflation))
        best, worth = None, 0.0
        for one in scan(table, independent, chosen):
            wider = table.with_terms(one.terms)
            left = _fit_with_own_noise(wider, [*chosen, one]).inflation
            without = fit(table, columns_of(chosen), left, covariance=False)
            criterion = criterion_of(wider, chosen, without, one, 0, scan.even)
            if criterion > worth:
                best, worth = one, criterion
        if best is None:
            break
        chosen.append(best)
        table = table.with_terms(best.terms)
    return table


def _fit_with_own_noise(table: RegressionTable, chosen: Sequence[Candidate]) -> Fit:
    """Return the Fit of some Candidates, with the variance inflation of each axis by itself."""
    columns = columns_of(chosen)
    model = fit(table, columns, covariance=False)
    own = measure_inflation(table, model.residual, model.weight, model.scale, columns)
    return replace(model, inflation=own)
