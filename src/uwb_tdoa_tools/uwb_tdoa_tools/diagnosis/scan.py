"""The undeclared: is there structure against anything that can be measured?"""

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.covariates import CATEGORIES, OF_ARRIVAL, OF_IMU, OF_TDOA

from .select import Candidate

UNNAMED = 6.0  # price of having no name: of equals, a declared effect is preferred
PIECES = 4  # of a curve, between quantiles of the covariate
MAPS = ("x", "y", "height", "range")
OF_POSE = ("x", "y", "height", "speed", "climb_rate", "acceleration")  # of TDOAs and inertial samples alike


def terms(found):
    """SmoothTerms without values for everything that is worth a look in these FlightResiduals."""
    tdoa = [one.tdoa for one in found]
    out = []
    for name in (*OF_TDOA, *(f"extra.{key}" for key in sorted(found[0].tdoa.samples.extra))):
        values = [_of_tdoa(name, part) for part in tdoa]
        knots = None if any(v is None for v in values) else _knots(np.concatenate(values), name)
        if knots is not None:
            out.append(SmoothTerm(covariate=name, form="common", knots=knots))
            if name not in CATEGORIES and not name.startswith("extra."):
                out.append(SmoothTerm(covariate=name, form="anchor", knots=knots))
    for name, function in OF_ARRIVAL.items():
        values = [_of_arrival(function, part) for part in tdoa]
        knots = _knots(np.concatenate(values), name)
        if knots is not None:
            out += [SmoothTerm(covariate=name, form=form, knots=knots) for form in ("arrival", "anchor")]
    for sensor in ("gyro", "accel"):
        parts = [getattr(one, sensor) for one in found if getattr(one, sensor) is not None]
        for name in (*OF_IMU, *OF_POSE) if parts else ():
            knots = _knots(np.concatenate([of_imu(name, part) for part in parts]), name)
            if knots is not None:
                out += [SmoothTerm(channel=f"{sensor}.{axis}", covariate=name, knots=knots) for axis in "xyz"]
    return out


def candidates(found, table, wanted):
    """A Candidate for each of the SmoothTerms `wanted`; adds its columns to the Table of these FlightResiduals."""
    anchors, out = found[0].tdoa.samples.anchors, []
    for term in wanted:
        names = tuple((label(term), key) for key in term.keys(anchors))
        if names[0] not in table.columns:
            values = _columns(found, table, term, anchors)
            table.columns.update({name: values[:, k] for k, name in enumerate(names)})
        out.append(Candidate("smooth_term", names, extra=UNNAMED, terms=(term,)))
        if term.form == "anchor":
            own = {}
            for name in names:
                own.setdefault(name[1].partition(".")[0], []).append(name)
            out += [Candidate("smooth_term", tuple(mine), extra=UNNAMED, terms=(term,)) for mine in own.values()]
    return out


def label(term):
    """Name of a SmoothTerm among the columns of a Table."""
    return f"smooth_term#{term.channel}/{term.covariate}/{term.form}"


def anchor_maps(smooth, chosen):
    """One Candidate of all of MAPS together, functions of each anchor, out of the Candidates `smooth`: structure
    that is spread over several covariates, each too weak alone. None if all are chosen already."""
    taken = {term.covariate for one in chosen for term in one.terms if term.form == "anchor"}
    parts, seen = [], set(taken)
    for one in smooth:  # the first of a covariate is that of all anchors
        term = one.terms[0]
        if term.form == "anchor" and term.covariate in MAPS and term.covariate not in seen:
            seen.add(term.covariate)
            parts.append(one)
    if not parts:
        return None
    return Candidate("smooth_term", sum((p.columns for p in parts), ()), terms=sum((p.terms for p in parts), ()))


def of_imu(name, residual):
    """Covariate `name` of an ImuResidual: (n,)."""
    if residual.is_accel and name.startswith("force"):  # the measured one shares its noise with the residual
        return residual.true[:, "xyz".index(name[-1])] if name != "force" else np.linalg.norm(residual.true, axis=1)
    return residual.covariates[:, OF_IMU.index(name)] if name in OF_IMU else OF_TDOA[name](residual.samples)


def _columns(found, table, term, anchors):
    keys = term.keys(anchors)
    out = np.zeros((len(table.y), len(keys)))
    for number, one in enumerate(found):
        if term.channel == "tdoa":
            rows = (table.flight == number) & (table.channel == 0)
            out[rows] = table.cells[number].means(term.regressors(one.tdoa.samples, keys))
            continue
        sensor, axis = term.channel.split(".")
        residual = getattr(one, sensor)
        if residual is not None:
            channel = ("tdoa", "gyro", "accel").index(sensor)
            rows = (table.flight == number) & (table.channel == channel) & (table.series == "xyz".index(axis))
            out[rows] = term.basis(of_imu(term.covariate, residual))
    return out


def _of_tdoa(name, part):
    if name in OF_TDOA:
        values = OF_TDOA[name](part.samples)
    else:
        values = part.samples.extra.get(name.removeprefix("extra."))
    return None if values is None else values[part.airborne]


def _of_arrival(function, part):
    samples = part.samples
    both = function(samples, np.concatenate([samples.a, samples.b]))
    return both[np.concatenate([part.airborne, part.airborne])]


def _knots(values, name):
    """Quantiles of a covariate, or its names; None if it hardly varies."""
    values = values[np.isfinite(values)]
    if len(values) < 100:
        return None
    if name in CATEGORIES:
        names = np.unique(values[values >= 0])
        return tuple(names.tolist()) if 2 <= len(names) <= 64 else None
    low, high = np.quantile(values, [0.005, 0.995])
    if high - low < 1e-3 * max(abs(low), abs(high), 1e-3):
        return None
    knots = np.quantile(values, np.linspace(0.005, 0.995, PIECES + 1))
    if np.min(np.diff(knots)) < 0.02 * (high - low):  # crowded: even pieces instead
        knots = np.linspace(low, high, PIECES + 1)
    return tuple(float(f"{knot:.6g}") for knot in knots)
