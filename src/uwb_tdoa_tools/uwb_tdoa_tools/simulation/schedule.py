"""Who is heard when: the TDOA2 and TDOA3 schedules of the Loco Positioning System."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

SLOT = 2.0e-3  # s, TDOA2: one packet per slot
SLOT_JITTER = 1.0e-4  # s, standard deviation of a stamp around its slot
PACKET_LOSS = (
    0.025  # TDOA2: share of packets not received; each costs the two pairs that it belongs to
)
TDOA3_DEAD_TIME = 0.5e-3  # s, the shortest time between two measurements
TDOA3_MEAN_WAIT = (
    3.6e-3  # s, mean of the exponential wait on top of it: about 240 measurements per second
)

PROTOCOLS = ("tdoa2", "tdoa3")


@dataclass(frozen=True)
class Schedule:
    """One row per measurement, of the ordered pair (a, b) at the arrival of b's packet.

    t : (n,) s, rising
    a, b : (n,) rows of the anchors
    heard_a, heard_b : (n,) number of the reception that each arrival time was taken from; two
        measurements that share a
        reception share its noise
    sender : (m,) row of the anchor of each reception
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    heard_a: np.ndarray
    heard_b: np.ndarray
    sender: np.ndarray


def make_schedule(
    protocol: str,
    n_anchors: int,
    duration: float,
    rng: np.random.Generator,
    rate: float | None = None,
) -> Schedule:
    """The Schedule of `protocol` ("tdoa2" or "tdoa3") over 0 ... duration, s, for n_anchors (at
    least 2) anchors. rate : TDOAs per second, which losses (tdoa2) or waits (tdoa3) are for;
    default: what these give.
    """
    if protocol == "tdoa2":
        return _tdoa2(
            n_anchors,
            duration,
            rng,
            PACKET_LOSS if rate is None else 1.0 - np.sqrt(min(rate * SLOT, 1.0)),
        )
    return _tdoa3(
        n_anchors,
        duration,
        rng,
        TDOA3_MEAN_WAIT if rate is None else max(1.0 / rate - TDOA3_DEAD_TIME, 0.0),
    )


def among_heard(
    schedule: Schedule,
    heard: Sequence[np.ndarray],
    protocol: str,
    rng: np.random.Generator,
    cells: np.ndarray | None = None,
) -> Schedule:
    """The Schedule among anchors of which the tag hears some. heard : rows of those at each
    measurement, rising, n arrays; cells (N,) : number of the cell of each anchor, whose anchors
    have a clock of their own, so that TDOAs are of two anchors of one cell; None for one clock.
    Where fewer than two are heard there is nothing.

    TDOA2: those that are heard, in cells of one of them, send in turn, in the order of their rows,
    as cells that are out of each other's reach use slots again. TDOA3: any two of those that are
    heard, in cells of one of them. The cell is drawn, by how many are heard.
    """
    rows, pairs, numbers = [], [], []  # of measurements, (a, b) and their receptions
    senders: list[int] = []  # row of the anchor of each reception
    latest: dict[int, int] = {}  # the latest reception of each anchor

    def receive(anchor: int) -> None:
        latest[anchor] = len(senders)
        senders.append(anchor)

    chosen = rng.random((len(heard), 2))
    if cells is not None:
        heard = [
            _of_one_cell(near, cells, draw) for near, draw in zip(heard, rng.random(len(heard)))
        ]
    for row, (near, (first, second)) in enumerate(zip(heard, chosen)):
        if len(near) < 2:
            continue
        if protocol == "tdoa2":
            b = row % len(near)
            a = b - 1
        else:
            b = int(first * len(near))
            a = (b + 1 + int(second * (len(near) - 1))) % len(near)
        a, b = int(near[a]), int(near[b])
        if a not in latest:
            receive(a)
        of_a = latest[a]
        receive(b)
        rows.append(row)
        pairs.append((a, b))
        numbers.append((of_a, latest[b]))
    (rows_a, rows_b), (heard_a, heard_b) = (
        np.array(each, int).reshape(-1, 2).T for each in (pairs, numbers)
    )
    sender = np.array(senders, int)
    return replace(
        schedule,
        t=schedule.t[rows],
        a=rows_a,
        b=rows_b,
        heard_a=heard_a,
        heard_b=heard_b,
        sender=sender,
    )


def _of_one_cell(near: np.ndarray, cells: np.ndarray, draw: float) -> np.ndarray:
    """Those of the rows of anchors, (k,), that are in the cell of one of them, which a number 0 ...
    1 draws.
    """
    return near[cells[near] == cells[near[int(draw * len(near))]]] if len(near) else near


def _tdoa2(n_anchors: int, duration: float, rng: np.random.Generator, loss: float) -> Schedule:
    """A ring: anchors send in turn, and every packet is compared with the one of the slot before."""
    n = max(int(duration / SLOT), 2)
    sender = np.arange(n) % n_anchors
    jitter = np.clip(SLOT_JITTER * rng.standard_normal(n), -0.4 * SLOT, 0.4 * SLOT)
    t = (np.arange(n) + 0.5) * SLOT + jitter
    received = rng.random(n) >= loss
    k = 1 + np.flatnonzero(received[1:] & received[:-1])
    return Schedule(t[k], sender[k - 1], sender[k], k - 1, k, sender)


def _tdoa3(n_anchors: int, duration: float, rng: np.random.Generator, wait: float) -> Schedule:
    """Any order: a packet of a random anchor is compared with the newest packet of a random other
    one.
    """
    n = int(1.3 * duration / (TDOA3_DEAD_TIME + wait)) + 50
    t = np.cumsum(TDOA3_DEAD_TIME + rng.exponential(wait, n))
    b = rng.integers(0, n_anchors, n)
    a = (b + rng.integers(1, n_anchors, n)) % n_anchors
    n = int(np.searchsorted(t, duration))
    t, a, b = t[:n], a[:n], b[:n]
    sender = np.concatenate(
        [np.arange(n_anchors), b]
    )  # everyone was heard once before the first measurement
    heard_b = n_anchors + np.arange(n)
    heard_a = np.empty(n, dtype=np.int64)
    for anchor in range(n_anchors):
        heard = np.flatnonzero(sender == anchor)
        rows = np.flatnonzero(a == anchor)
        heard_a[rows] = heard[np.searchsorted(heard, heard_b[rows]) - 1]
    return Schedule(t, a, b, heard_a, heard_b, sender)
