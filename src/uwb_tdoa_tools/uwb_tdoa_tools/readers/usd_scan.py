"""Going through the events of a micro-SD log, compiled."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled


@compiled
def scan(
    raw: np.ndarray, start: int, end: int, size_of_id: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Offsets and ids of the events in raw[start:end], and where the scan had to stop (-1: it ended
    at `end`).

    size_of_id : (65536,) bytes of a whole event (id, stamp, payload), -1 where no type has the id.
    """
    smallest = 6  # id and version 1 stamp, no payload
    room = max((end - start) // smallest, 0)
    offsets = np.empty(room, dtype=np.int64)
    ids = np.empty(room, dtype=np.uint16)
    count = 0
    at = start
    while at < end:
        if at + 2 > end:
            return offsets[:count], ids[:count], at
        number = raw[at] | (np.int64(raw[at + 1]) << 8)
        size = size_of_id[number]
        if size < 0 or at + size > end:
            return offsets[:count], ids[:count], at
        offsets[count] = at
        ids[count] = number
        count += 1
        at += size
    return offsets[:count], ids[:count], -1
