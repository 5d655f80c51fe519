"""Measurements of sensors as the core takes them, and which of them can be measurements."""

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.sensors import SENSORS, Stream

from .core.aids import STREAMS
from .core.memory import AID


def aid_rows(name: str, stream: Stream, anchors: Anchors) -> tuple[np.ndarray, np.ndarray]:
    """(n,) of AID, and (n,) bool: usable; of the Stream of a sensor among Anchors."""
    columns, usable = SENSORS[name].measured(stream)
    rows = np.zeros(len(stream), AID)
    rows["t"], rows["kind"] = stream.t, STREAMS.index(name)
    if "anchor" in columns:
        columns["anchor"] = anchors.index(columns["anchor"])
        usable &= columns["anchor"] >= 0
    for field, values in columns.items():
        target = rows[field]
        target[(slice(None), *map(slice, values.shape[1:]))] = values
    return rows, usable & np.isfinite(stream.t)


def rows_of(flight, config):
    """(m,) of AID of a Flight in the order of their stamps; {stream: (places among them, or -1, of each measurement)}."""
    parts, places, n = [np.empty(0, AID)], {}, 0
    for name in STREAMS:
        stream = getattr(flight, name)
        if stream is None or not getattr(config, f"use_{name}"):
            continue
        rows, usable = aid_rows(name, stream, flight.anchors)
        places[name] = np.full(len(rows), -1)
        places[name][usable] = n + np.arange(usable.sum())
        parts.append(rows[usable])
        n += int(usable.sum())
    rows = np.concatenate(parts)
    order = np.lexsort((rows["kind"], rows["t"]))
    rank = np.empty(n + 1, dtype=np.int64)
    rank[order], rank[n] = np.arange(n), -1
    return rows[order], {name: rank[place] for name, place in places.items()}
