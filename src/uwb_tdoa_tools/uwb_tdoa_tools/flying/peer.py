"""Somebody else's filter, in a shared library that the user built (docs/speed.md).

It exports, in C:

    typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
    int32_t tdoa_peer_version(void);                                           // VERSION
    void tdoa_peer_start(const double *anchors, int32_t count, const double *p, const double *q);
    void tdoa_peer_run(const tdoa_peer_event *events, int32_t count);
    void tdoa_peer_position(double *p);

An event with a < 0 is an inertial sample (s, rad/s, m/s^2), every other one a TDOA d = |p - b| - |p
- a|, m, of the anchors in rows a and b of `anchors` (count, 3), m. The filter starts at p, m, with
the attitude q, x y z w, body to world, at rest. To be flown by (`fly --peer`) it exports one more,
which gives all of its state, m, m/s in the world, and x y z w:

    void tdoa_peer_state(double *p, double *v, double *q);

There p is NaN at the start if no place was given, and what is given is right to 0.1 m; q is level,
and its yaw is right to 0.1 rad.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
import shutil
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import temporary_folder

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_bias.foundation.flight import Imu, Tdoas

VERSION = 1
EVENT = np.dtype(
    [
        ("t", float),
        ("gyro", float, 3),
        ("accel", float, 3),
        ("d", float),
        ("a", np.int32),
        ("b", np.int32),
    ]
)
SYMBOLS = ("version", "start", "run", "position")


class Peer:
    """The library at a path. name : of its file.

    Raises InputError if it cannot be loaded, or is not what this module says.
    """

    def __init__(self, path: str | Path, own: bool = False) -> None:
        """own : load a copy, whose static variables are as they are when a program starts, whatever
        was done with the library before.
        """
        self.name = Path(path).name
        try:
            with temporary_folder() as folder:
                library = ctypes.CDLL(
                    str(shutil.copy(path, folder) if own else Path(path).absolute())
                )
        except OSError as error:
            raise InputError(
                f"--peer: {path} cannot be loaded as a shared library ({error}); build it "
                "anew on this machine."
            ) from error
        functions: dict[str, Any] = {
            name: getattr(library, f"tdoa_peer_{name}", None) for name in SYMBOLS
        }
        missing = [f"tdoa_peer_{name}" for name, function in functions.items() if function is None]
        if missing:
            raise InputError(
                f"--peer: {path} does not export {missing[0]}; add it as docs/speed.md shows."
            )
        self._version, self._start, self._run, self._position = functions.values()
        self._state = getattr(library, "tdoa_peer_state", None)
        self._version.restype = ctypes.c_int32
        version = self._version()
        if version != VERSION:
            raise InputError(
                f"--peer: {path} is of version {version} of the interface, this is {VERSION}; "
                "build it for that."
            )

    def start(self, anchors: np.ndarray, p: ArrayLike, q: ArrayLike) -> None:
        """Begin anew at p (3,) m, q (4,) x y z w, among anchors (n, 3) m."""
        self._anchors = np.ascontiguousarray(
            anchors, dtype=float
        )  # for as long as it may look at them
        self._start(
            _pointer(self._anchors),
            ctypes.c_int32(len(anchors)),
            _pointer(np.array(p, float)),
            _pointer(np.array(q, float)),
        )

    def run(self, events: np.ndarray) -> float:
        """s that events (n,) of EVENT take."""
        data, count = _pointer(events), ctypes.c_int32(len(events))
        began = time.perf_counter()
        self._run(data, count)
        return time.perf_counter() - began

    def position(self) -> np.ndarray:
        """(3,) m."""
        out = np.full(3, np.nan)
        self._position(_pointer(out))
        return out

    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(p (3,) m, v (3,) m/s, world, q (4,) x y z w).

        Raises InputError if the library does not tell.
        """
        if self._state is None:
            raise InputError(
                f"--peer: {self.name} does not export tdoa_peer_state; add it as "
                "docs/speed.md shows."
            )
        p, v, q = np.full(3, np.nan), np.full(3, np.nan), np.full(4, np.nan)
        self._state(*map(_pointer, (p, v, q)))
        return p, v, q


def events(imu: Imu, tdoa: Tdoas, anchors: Anchors) -> tuple[np.ndarray, np.ndarray]:
    """(inertial samples, TDOAs) between known Anchors: two arrays of EVENT."""
    samples: np.ndarray = np.zeros(len(imu), EVENT)
    ranges: np.ndarray = np.zeros(len(tdoa), EVENT)
    samples["t"], samples["gyro"], samples["accel"], samples["a"] = imu.t, imu.gyro, imu.accel, -1
    ranges["t"], ranges["a"], ranges["b"], ranges["d"] = (
        tdoa.t,
        anchors.index(tdoa.a),
        anchors.index(tdoa.b),
        tdoa.d,
    )
    return samples, ranges


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
