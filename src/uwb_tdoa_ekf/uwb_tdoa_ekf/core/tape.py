"""A recording of the filter's run, for the smoother."""

from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.foundation.compiled import inlined

from .memory import BEST, TAPED
from .state import propagate

UPDATE, REPLACED = 0.0, 1.0  # kinds of entries


class Tape(NamedTuple):
    """One entry per scalar update, in order.

    t (n,) s; kind (n,): UPDATE, or REPLACED: the state was, and nothing carries over; phi (n, 9, 15): upper rows of the
    transition since the entry before; h (n, 15): Jacobian; gain (n, 15): K; innovation, total (n,): m or m/s, and its
    variance as used; x (n, 16), P (n, 15, 15): after the update; moved (15, 15): transition since the last entry.
    """

    t: np.ndarray
    kind: np.ndarray
    phi: np.ndarray
    h: np.ndarray
    gain: np.ndarray
    innovation: np.ndarray
    total: np.ndarray
    x: np.ndarray
    P: np.ndarray
    moved: np.ndarray


def new_tape(capacity=0):
    """A tape for at most `capacity` entries; 0: nothing is recorded."""
    n = capacity
    shapes = ((n,), (n,), (n, 9, 15), (n, 15), (n, 15), (n,), (n,), (n, 16), (n, 15, 15))
    return Tape(*(np.zeros(shape) for shape in shapes), np.eye(15))


@inlined
def note_prediction(tape, m):
    """After `predict` of the best hypothesis: note its transition."""
    if len(tape.t):
        propagate(tape.moved, m.F, m.R, m.E, m.step)
        tape.moved[:, :] = m.F


@inlined
def note_coast(tape, dt):
    """After `coast`: the same."""
    if len(tape.t):
        tape.moved[:3] += dt * tape.moved[3:6]


@inlined
def note_update(tape, m, t, kind, innovation, total, h, place):
    """After an update of the best hypothesis: h (3,) is the Jacobian from element `place` of the error state on, the
    gain is m.K / total. A full tape takes no more."""
    n = int(m.clock[TAPED])
    if n >= len(tape.t):
        return
    best = int(m.clock[BEST])
    tape.t[n], tape.kind[n], tape.innovation[n], tape.total[n] = t, kind, innovation, total
    for k in range(3):
        tape.h[n, place + k] = h[k]
    for k in range(15):
        tape.gain[n, k] = m.K[k] / total
    tape.phi[n] = tape.moved[:9]
    tape.x[n] = m.x[best]
    tape.P[n] = m.P[best]
    m.clock[TAPED] = n + 1.0
    for i in range(15):
        for j in range(15):
            tape.moved[i, j] = 1.0 if i == j else 0.0
