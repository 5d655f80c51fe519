# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Provide estimates: the own filter as the nodes run it, or a peer.

A peer is a filter in a shared library that the user has built (docs/notebook/speed.md). It exports, in C:

    typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
    int32_t tdoa_peer_version(void);                                           // VERSION
    void tdoa_peer_start(const double *anchors, int32_t count, const double *p, const double *q);
    void tdoa_peer_run(const tdoa_peer_event *events, int32_t count);
    void tdoa_peer_position(double *p);

An event with a < 0 is an inertial sample (s, rad/s, m/s^2). Every other event is a TDOA d = |p - b| -
|p - a|, m, of the anchors in rows a and b of `anchors` (count, 3), m. The filter starts at rest at p,
m, with the attitude q, x y z w, body to world. `fly --peer` needs one more function. It returns the
state in m, m/s in the world frame, and x y z w:

    void tdoa_peer_state(double *p, double *v, double *q);

If no place is given, p is NaN at the start. A given place is accurate to 0.1 m. The attitude q is
level, and its yaw is accurate to 0.1 rad.

A peer's TDOAs can be corrected by exported C, as on a vehicle. `export --c FOLDER` writes uwb_bias.h
and uwb_bias.c. They are compiled here, together with a loop over the events of the peer. Each TDOA is
corrected at the newest state of the peer.
"""

from __future__ import annotations

import ctypes
from functools import cache
import math
from pathlib import Path
import shutil
import subprocess
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import new_folder_until_exit, temporary_folder, write_text
from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_bias.common.text import printable
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import Model
from uwb_tdoa_bias.effects import EffectSet, StreamCorrector
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.results import Odometry, concatenated, poses_of

from .mission import Pose
from .simulator import Streams

FILES = "uwb_bias.h", "uwb_bias.c"
FLAGS = "-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"
READS_RATES = "#define UWB_BIAS_READS_RATES 1"  # a line of uwb_bias.h
LOOP = """
#include <stdint.h>
#include "uwb_bias.h"

typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } event;
typedef struct { double first, last; int32_t previous, count; } past;

void corrected_run(const event *events, int32_t count, const int32_t *ids, past *known,
                   void (*run)(const event *, int32_t),
                   void (*state)(double *, double *, double *)) {
    for (; count--; events++) {
        event one = *events;
        if (one.a >= 0) {
            double p[3], v[3], q[4];
            uwb_bias_state at = {0};
            float bias, std;
            state(p, v, q);
            for (int k = 0; k < 3; k++) {
                at.position[k] = (float)p[k];
                at.velocity[k] = (float)v[k];
            }
            for (int k = 0; k < 4; k++) at.attitude[k] = (float)q[k];
            if (!known->count++) known->first = known->last = one.t;
            at.time = (float)(one.t - known->first);
            at.interval = (float)(one.t - known->last);
            at.previous_anchor = (float)known->previous;
            if (!uwb_bias(ids[one.a], ids[one.b], &at, &bias, &std)) one.d -= bias;
            known->last = one.t;
            known->previous = ids[one.b];
        }
        run(&one, 1);
    }
}
"""
PAST = np.dtype([("first", float), ("last", float), ("previous", np.int32), ("count", np.int32)])


class CompiledCorrection:
    """A correction in C, for the events of a peer."""

    def __init__(self, folder: str | Path) -> None:
        """Compile a folder that `export --c` wrote; raise InputError."""
        self._run = ctypes.CDLL(str(_library(Path(folder).absolute()))).corrected_run
        self.start(())

    def start(self, ids: ArrayLike) -> None:
        """Forget all TDOAs. ids : (n,) of the anchors, in the order of their rows."""
        self._ids = np.ascontiguousarray(ids, dtype=np.int32)
        self._past = np.zeros(1, PAST)
        self._past["previous"] = -1

    def run(self, events: np.ndarray, run: Any, state: Any) -> None:
        """Give corrected events (n,) of EVENT to a peer, by two functions of its library."""
        arrays = (events, self._ids, self._past)
        data, ids, past = (ctypes.c_void_p(one.ctypes.data) for one in arrays)
        self._run(data, ctypes.c_int32(len(events)), ids, past, run, state)


@cache
def _library(folder: Path) -> Path:
    """Return the compiled library of a folder, once per process; raise InputError."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise InputError("--correction: needs the C compiler cc, which is not installed.")
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"--correction: {folder} holds no {missing[0]}; give a folder that export --c wrote."
        )
    if READS_RATES in (folder / FILES[0]).read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            f"--correction: {folder} reads acceleration or rate, which a peer does not give; "
            "export the other effects alone."
        )
    made = new_folder_until_exit()
    write_text(made / "loop.c", LOOP)
    sources = [str(made / "loop.c"), str(folder / FILES[1])]
    library = made / "libcorrection.so"
    command = [compiler, *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        words = printable(done.stderr.strip().partition("\n")[0])
        raise InputError(
            f"--correction: {folder} cannot be compiled ({words}); write it again by export --c."
        )
    return library


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
    """Call the filter in a shared library.

    Raises
    ------
    InputError
        If the library cannot be loaded or has another interface.
    """

    def __init__(
        self, path: str | Path, own: bool = False, correction: CompiledCorrection | None = None
    ) -> None:
        """Load the library.

        Parameters
        ----------
        path : str or Path
        own : bool
            Load a copy, so that its static variables start with their initial values.
        correction : CompiledCorrection, optional
            Corrects each TDOA at the state of the peer. The library must export its state.
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
                f"--peer: {path} does not export {missing[0]}; add it as docs/notebook/speed.md shows."
            )
        self._version, self._start, self._run, self._position = functions.values()
        self._state: Any = getattr(library, "tdoa_peer_state", None)
        self._version.restype = ctypes.c_int32
        version = self._version()
        if version != VERSION:
            raise InputError(
                f"--peer: {path} is of version {version} of the interface, this is {VERSION}; "
                "build it for that."
            )
        self._correction = correction
        if correction is not None:
            self._require_state()

    def start(self, anchors: Anchors, p: ArrayLike, q: ArrayLike) -> None:
        """Restart at p (3,) m with attitude q (4,) x y z w."""
        # kept: the library may read them later
        self._anchors = np.ascontiguousarray(anchors.positions, dtype=float)
        if self._correction is not None:
            self._correction.start(anchors.ids)
        self._start(
            _pointer(self._anchors),
            ctypes.c_int32(len(anchors)),
            _pointer(np.array(p, float)),
            _pointer(np.array(q, float)),
        )

    def run(self, events: np.ndarray) -> float:
        """Process events (n,) of EVENT and return the duration, s."""
        data, count = _pointer(events), ctypes.c_int32(len(events))
        began = time.perf_counter()
        if self._correction is None:
            self._run(data, count)
        else:
            self._correction.run(events, self._run, self._state)
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
        self._require_state()
        p, v, q = np.full(3, np.nan), np.full(3, np.nan), np.full(4, np.nan)
        self._state(*map(_pointer, (p, v, q)))
        return p, v, q

    def _require_state(self) -> None:
        if self._state is None:
            raise InputError(
                f"--peer: {self.name} does not export tdoa_peer_state; add it as "
                "docs/notebook/speed.md shows."
            )


def events(imu: Imu, tdoa: Tdoas, anchors: Anchors) -> tuple[np.ndarray, np.ndarray]:
    """Return the inertial samples and the TDOAs between known anchors as two arrays of EVENT."""
    a, b = anchors.index(tdoa.a), anchors.index(tdoa.b)
    known = (a >= 0) & (b >= 0)  # an event without an anchor would be an inertial sample
    samples: np.ndarray = np.zeros(len(imu), EVENT)
    ranges: np.ndarray = np.zeros(int(known.sum()), EVENT)
    samples["t"], samples["gyro"], samples["accel"], samples["a"] = imu.t, imu.gyro, imu.accel, -1
    for name, values in (("t", tdoa.t), ("a", a), ("b", b), ("d", tdoa.d)):
        ranges[name] = values[known]
    return samples, ranges


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


_NO_VECTORS = np.empty((0, 3))
NO_ODOMETRY = Odometry(
    np.empty(0),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 4)),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 9, 9)),
    np.empty((0, 3, 3)),
)


class EstimateSource:
    """Provide the estimate that a vehicle flies by."""

    def __init__(self) -> None:
        # (t s, p (3,), v (3,), q (4,), covariance of p (3, 3)) of each estimate
        self._rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Set the position and the yaw at a time.

        Parameters
        ----------
        t : float
            s.
        p : numpy.ndarray
            (3,), m.
        std : float
            Standard deviation of position, m, and yaw, rad.
        yaw : float
            rad, NaN if unknown.
        """
        raise NotImplementedError

    def take(self, streams: Streams) -> None:
        """Process the samples that have arrived."""
        raise NotImplementedError

    @property
    def why(self) -> str:
        """Return the reason for which the estimate cannot be used, or ""."""
        return ""

    @property
    def pose(self) -> Pose | None:
        """Return (t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        return self._rows[-1][:4] if self._rows else None

    @property
    def deviation(self) -> float:
        """Return its largest standard deviation of a coordinate, m, or inf without an estimate."""
        return math.sqrt(self._rows[-1][4].diagonal().max()) if self._rows else math.inf

    @property
    def odometry(self) -> Odometry:
        """Return all estimates, without rates. Only the position has a covariance."""
        if not self._rows:
            return NO_ODOMETRY
        t, p, v, q, of_position = map(np.array, zip(*self._rows))
        covariance = np.zeros((len(t), 9, 9))
        covariance[:, :3, :3] = of_position
        zero = np.zeros(p.shape)
        return Odometry(t, p, v, q, zero, zero, covariance, np.zeros((len(t), 3, 3)))


class OwnFilter(EstimateSource):
    """Run `Corrector` and `Estimator` as bias_node and ekf_node do.

    Attributes
    ----------
    estimator : Estimator
    newest : Odometry or None
        The last output.
    """

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig,
        effects: EffectSet | None = None,
        network: Model | None = None,
    ) -> None:
        """Set up the filter and its corrections.

        Parameters
        ----------
        anchors : Anchors
        config : FilterConfig
        effects : EffectSet, optional
        network : Model, optional
            Corrections of the measurements.
        """
        super().__init__()
        effects = effects or EffectSet()
        self._anchors = anchors
        self._streams = StreamCorrector(effects.effects)
        self._corrector = Corrector(anchors, effects, network)
        self.estimator = Estimator(anchors, config, effects=effects)
        self._parts = [NO_ODOMETRY]
        self.newest: Odometry | None = None

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        self.estimator.set_pose(t, p, std**2 * np.eye(3), yaw, std)

    def take(self, streams: Streams) -> None:
        for name, part in streams.items():
            if len(part.t):
                self._add(name, self._streams.correct(name, part))
        odometry, _ = self.estimator.advance()
        if not len(odometry):
            return
        self._parts.append(odometry)
        self.newest = odometry
        self._rows = [  # the newest alone: _parts hold all
            (
                odometry.t[-1],
                odometry.p[-1],
                odometry.v[-1],
                odometry.q[-1],
                odometry.covariance[-1, :3, :3],
            )
        ]
        if not self._corrector.idle:
            self._corrector.add_pose(*poses_of(odometry))

    def _add(self, name: str, part: Any) -> None:
        """Give a part of one stream to the filter, and correct the bias of TDOAs."""
        if name == "imu":
            self.estimator.add_imu(part.t, part.gyro, part.accel)
        elif name == "tdoa":
            known = self._corrector.correct(
                part.t, self._anchors.index(part.a), self._anchors.index(part.b), part.d
            )
            self.estimator.add_tdoa(
                part.t,
                part.a,
                part.b,
                known.corrected,
                known.std**2 + part.variance,
                known.slope,
                known.state,
            )
        else:
            self.estimator.add(name, part)

    @property
    def odometry(self) -> Odometry:
        """Return all estimates."""
        return concatenated(self._parts)


class PeerFilter(EstimateSource):
    """Run a Peer as an estimate source.

    It gets place and yaw at the start. It gives no covariance.
    """

    deviation = 0.0  # m; a peer gives none

    def __init__(
        self,
        library: str | Path,
        anchors: Anchors,
        yaw: float,
        place: np.ndarray | None = None,
        correction: str | Path | None = None,
    ) -> None:
        """Load and start the peer.

        Parameters
        ----------
        library : str or Path
        anchors : Anchors
        yaw : float
            rad.
        place : numpy.ndarray, optional
            (3,), m.
        correction : str or Path, optional
            Folder of an exported correction of the TDOAs.

        Raises
        ------
        InputError
            If the library or the correction cannot be used.
        """
        super().__init__()
        known = None if correction is None else CompiledCorrection(correction)
        self._peer = Peer(library, own=True, correction=known)
        self._anchors = anchors
        self._finite: Pose | None = None
        q = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
        self._peer.start(anchors, np.full(3, np.nan) if place is None else place, q)

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Do nothing: the peer has its start."""

    def take(self, streams: Streams) -> None:
        """Process the inertial samples and TDOAs that have arrived."""
        both = np.concatenate(events(streams["imu"], streams["tdoa"], self._anchors))
        if not len(both):
            return
        self._peer.run(both[np.argsort(both["t"], kind="stable")])
        state = (float(both["t"].max()), *self._peer.state())
        self._rows.append((*state, np.full((3, 3), np.nan)))
        if all(np.isfinite(part).all() for part in state):
            self._finite = state

    @property
    def pose(self) -> Pose | None:
        """Return (t s, p (3,) m, v (3,) m/s, q (4,)) of the newest finite estimate, or None."""
        return self._finite
