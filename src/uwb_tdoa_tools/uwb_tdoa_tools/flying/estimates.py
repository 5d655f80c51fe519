"""Who tells the controller where it is: our filter, as the nodes run it, or somebody else's, built
as a shared library.
"""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
import shutil
import time
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, StreamCorrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import temporary_folder
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.frames import poses_of
from uwb_tdoa_ekf.results import Odometry, concatenated

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.correction.network import Network
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_bias.foundation.flight import Imu, Tdoas
    from uwb_tdoa_ekf.core.config import FilterConfig

    from .mission import Pose
    from .simulator import SensorReadings


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


pass


NO_ODOMETRY = Odometry(
    np.empty(0),
    np.empty((0, 3)),
    np.empty((0, 3)),
    np.empty((0, 4)),
    np.empty((0, 3)),
    np.empty((0, 3)),
    np.empty((0, 9, 9)),
    np.empty((0, 3, 3)),
)


class EstimateSource(Protocol):
    """Who tells where a vehicle is. why : what keeps it from being flown by, in words, "" for
    nothing.
    """

    @property
    def why(self) -> str: ...

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Tell that it is at p (3,) m at t, s, to so many m, and points along yaw, to as many rad;
        NaN: nobody knows.
        """

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived."""

    @property
    def pose(self) -> Pose | None:
        """The newest estimate."""

    @property
    def deviation(self) -> float:
        """Largest standard deviation of a coordinate of it, m; inf without one."""

    @property
    def odometry(self) -> Odometry:
        """All that came out."""


class OwnFilter:
    """`Corrector` and `Estimator`, as in bias_node and ekf_node, behind the calls that a flight
    needs: an EstimateSource. estimator : Estimator; newest : Odometry, the last that came out, or
    None.
    """

    why = ""

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig,
        effects: EffectSet | None = None,
        network: Network | None = None,
    ) -> None:
        """anchors : Anchors; config : FilterConfig; effects : EffectSet, and network : Network, to
        correct what was measured with, or None.
        """
        effects = effects or EffectSet()
        self._anchors, self._streams, self._corrector = (
            anchors,
            StreamCorrector(effects.effects),
            Corrector(anchors, effects, network),
        )
        self.estimator = Estimator(anchors, config, effects=effects)
        self._parts = [NO_ODOMETRY]
        self.newest: Odometry | None = None

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Tell that it is at p (3,) m at t, s, to so many m, and points along yaw, to as many rad;
        NaN: nobody knows.
        """
        self.estimator.set_pose(t, p, std**2 * np.eye(3), yaw, std)

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived: SensorReadings."""
        for name, part in measured.streams.items():
            if len(part.t):
                self._add(name, self._streams.correct(name, part))
        odometry, _ = self.estimator.advance()
        if len(odometry):
            self._parts.append(odometry)
            self.newest = odometry
            if not self._corrector.idle:
                self._corrector.add_pose(*poses_of(odometry))

    def _add(self, name: str, part: Any) -> None:
        """Give the filter a part of a stream that is corrected, but for the bias of TDOAs."""
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
    def pose(self) -> Pose | None:
        """(t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        if self.newest is None:
            return None
        return self.newest.t[-1], self.newest.p[-1], self.newest.v[-1], self.newest.q[-1]

    @property
    def deviation(self) -> float:
        """Largest standard deviation of a coordinate of the newest estimate, m; inf without one."""
        if self.newest is None:
            return math.inf
        P = self.newest.covariance[-1]
        return math.sqrt(max(P[0, 0], P[1, 1], P[2, 2]))

    @property
    def odometry(self) -> Odometry:
        """Odometry, all that came out."""
        return concatenated(self._parts)


class PeerFilter:
    """A Peer behind the same calls.

    It gets place and yaw at the start, knows no effects, and says nothing of its covariance.
    """

    deviation = 0.0  # m; nobody knows
    why = ""

    def __init__(
        self, library: str | Path, anchors: Anchors, yaw: float, place: np.ndarray | None = None
    ) -> None:
        """library : path; anchors : Anchors; yaw : rad; place : (3,) m, or None.

        Raises InputError.
        """
        self._peer, self._anchors = Peer(library, own=True), anchors
        q = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
        self._peer.start(anchors.positions, np.full(3, np.nan) if place is None else place, q)
        self._states: list[Pose] = []
        self._newest: Pose | None = None

    def take(self, measured: SensorReadings) -> None:
        """Take what arrived: SensorReadings, of which other sensors are passed over."""
        both = np.concatenate(events(measured.imu, measured.tdoa, self._anchors))
        if len(both):
            self._peer.run(both[np.argsort(both["t"], kind="stable")])
            self._states.append((float(both["t"].max()), *self._peer.state()))
            if all(np.isfinite(part).all() for part in self._states[-1]):
                self._newest = self._states[-1]

    @property
    def pose(self) -> Pose | None:
        """(t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate that is one, or None."""
        return self._newest

    @property
    def odometry(self) -> Odometry:
        """Odometry, all that came out; covariances NaN."""
        if not self._states:
            return NO_ODOMETRY
        t, p, v, q = map(np.array, zip(*self._states))
        return Odometry(
            t,
            p,
            v,
            q,
            np.zeros(p.shape),
            np.zeros(p.shape),
            np.full((len(t), 9, 9), np.nan),
            np.zeros((len(t), 3, 3)),
        )
