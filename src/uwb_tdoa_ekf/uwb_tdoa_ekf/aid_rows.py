"""Heights, pressures and velocities as the core takes them, and which of them can be measurements."""

import numpy as np

from uwb_tdoa_bias.foundation.pressure import altitude_of

from .core.aids import HEIGHT, PRESSURE, STREAMS, VELOCITY
from .core.memory import AID

LOWEST_PRESSURE, HIGHEST_PRESSURE = 3e4, 1.2e5  # Pa, of air in which something flies or rolls
MAX_SPEED = 100.0  # m/s
UNKNOWN = 1e6  # m/s, standard deviation of a component that is not measured


def height_rows(config, t, distance):
    """(n,) of AID, and (n,) bool: usable. t (n,) s; distance (n,) m; inf or NaN where nothing was in range (REP 117)."""
    rows = _rows(HEIGHT, t)
    rows["value"][:, 0] = distance
    return rows, np.isfinite(distance) & (np.asarray(distance) >= 0.0) & np.isfinite(t)


def pressure_rows(config, t, pressure):
    """The same of pressures (n,) Pa."""
    rows, pressure = _rows(PRESSURE, t), np.asarray(pressure, dtype=float)
    usable = (pressure > LOWEST_PRESSURE) & (pressure < HIGHEST_PRESSURE) & np.isfinite(t)
    rows["value"][usable, 0] = altitude_of(pressure[usable])
    return rows, usable


def velocity_rows(config, t, v, std):
    """The same of velocities v (n, 3) m/s, body frame, with std (n, 3) m/s, inf where not measured."""
    v, std = np.asarray(v, dtype=float), np.asarray(std, dtype=float)
    rows, known = _rows(VELOCITY, t), np.isfinite(std)
    rows["value"], rows["std"] = np.where(known, v, 0.0), np.where(known, std, UNKNOWN)
    sane = np.where(known, (np.abs(v) < MAX_SPEED) & (std > 0.0), True).all(axis=1)
    return rows, sane & known.any(axis=1) & ~np.isnan(std).any(axis=1) & np.isfinite(t)


def rows_of(flight, config):
    """(m,) of AID of a Flight in the order of their stamps; {stream: (places among them, or -1, of each measurement)}."""
    parts, places, n = [np.empty(0, AID)], {}, 0
    for stream in STREAMS:
        part = getattr(flight, stream)
        if part is None or not getattr(config, f"use_{stream}"):
            continue
        columns = [getattr(part, name) for name in part.__dataclass_fields__]
        rows, usable = ROWS[stream](config, *columns)
        places[stream] = np.full(len(rows), -1)
        places[stream][usable] = n + np.arange(usable.sum())
        parts.append(rows[usable])
        n += int(usable.sum())
    rows = np.concatenate(parts)
    order = np.lexsort((rows["kind"], rows["t"]))
    rank = np.empty(n + 1, dtype=np.int64)
    rank[order], rank[n] = np.arange(n), -1
    return rows[order], {stream: rank[place] for stream, place in places.items()}


def _rows(kind, t):
    rows = np.zeros(len(t), AID)
    rows["t"], rows["kind"] = t, kind
    return rows


ROWS = {"height": height_rows, "pressure": pressure_rows, "velocity": velocity_rows}
