# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the Kalman filters of the Crazyflie firmware over flights, with a build of `export --crazyflie`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import subprocess
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_tools.scoring.evaluation import require_truth
from uwb_tdoa_tools.scoring.metrics import position_at, rms, scored_phase

MORE = 1.1  # error of one flight with a correction over that without it, above which it is worse
STOCK = 0.15  # m, tdoa2.stddev and tdoa3.stddev of the firmware

# Of a checkout of the firmware: what is compiled, and where its headers are
CORE = (
    "kalman_core/kalman_core.c",
    "kalman_core/mm_tdoa.c",
    "kalman_core/mm_tdoa_robust.c",
    "outlierfilter/outlierFilterTdoa.c",
    "outlierfilter/outlierFilterTdoaSteps.c",
)
HEADERS = (
    *("modules/interface", "modules/interface/estimator", "modules/interface/kalman_core"),
    *("modules/interface/outlierfilter", "hal/interface", "config", "drivers/interface"),
    *("platform/interface", "utils/interface", "utils/interface/lighthouse"),
)
FLAGS = ("-O2", "-w", "-DUNIT_TEST_MODE", "-fno-strict-aliasing")
REPLAY = Path(__file__).with_name("firmware")
# As `event` in replay.c. An id below 0 means an inertial sample.
EVENT = np.dtype(
    [
        *(("t", float), ("gyro", float, 3), ("accel", float, 3), ("d", float)),
        *(("a", float, 3), ("b", float, 3), ("id_a", np.int32), ("id_b", np.int32)),
    ]
)


class FirmwareFilter:
    """The Kalman filter of the firmware with a build, compiled for this computer."""

    def __init__(self, build: Path, firmware: Path, folder: Path) -> None:
        """Compile the filter; raise InputError.

        build : as `export --crazyflie` writes it; firmware : a checkout; folder : for the program
        """
        (folder / "autoconf.h").touch()  # without options of Kconfig
        sources: list[str | Path] = [REPLAY / "replay.c", *(build / "src").glob("*.c")]
        sources += [firmware / "src/modules/src" / name for name in CORE]
        include = [REPLAY, folder, build / "src", *(firmware / "src" / name for name in HEADERS)]
        self._program = folder / "replay"
        command: list[str | Path] = [
            "cc",
            *FLAGS,
            "-iquote",
            build / "overrides",
            *(f"-I{one}" for one in include),
        ]
        try:
            subprocess.run(
                [*command, *sources, "-lm", "-o", self._program], check=True, capture_output=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            why = (getattr(error, "stderr", b"").decode() or str(error)).splitlines()[0]
            raise InputError(
                f"--firmware: {firmware} cannot be compiled ({why}); give a checkout of "
                "crazyflie-firmware, and install a C compiler."
            ) from error

    def estimate(
        self, flight: Flight, robust: bool, corrected: bool, stddev: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps (n,), s, and positions (n, 3), m, after each TDOA of a Flight.

        The filter starts at rest on the floor, at the true position and yaw.

        robust : kalman.robustTdoa; corrected : uwbBias.enable; stddev : m, tdoa2.stddev
        """
        require_truth(flight)
        truth, events = flight.known_truth, events_of(flight)
        yaw = Rotation.from_quat(truth.q[0]).as_euler("ZYX")[0]
        events = events[events["t"] >= truth.t[0]]
        done = subprocess.run(
            [self._program, str(int(robust)), str(int(corrected)), str(stddev)],
            input=np.array([*truth.p[0], yaw]).tobytes() + events.tobytes(),
            capture_output=True,
            check=True,
        )
        out = np.frombuffer(done.stdout).reshape(-1, 4)
        return out[:, 0], out[:, 1:]

    def error(self, flight: Flight, *way: Any) -> float:
        """Return the 3D RMSE of `estimate` in the air, m; NaN if the estimate is not finite."""
        t, p = self.estimate(flight, *way)
        _, first, last = scored_phase(flight.known_truth)
        in_air = (t >= first) & (t <= last)
        return rms(np.linalg.norm(p - position_at(t, flight.known_truth), axis=1)[in_air])


def comparison(
    build: Path, firmware: Path, flights: Sequence[Flight], stddev: float
) -> dict[str, np.ndarray]:
    """Return {filter: 3D RMSE in the air, m, (flights, 3)} of both filters of the firmware.

    The columns are STOCK alone, stddev alone, and the build.
    """
    ways = (False, STOCK), (False, stddev), (True, STOCK)
    with temporary_folder() as folder:
        program = FirmwareFilter(build, firmware, folder)
        return {
            name: np.array([[program.error(one, robust, *way) for way in ways] for one in flights])
            for name, robust in (("standard", False), ("robust", True))
        }


def in_words(errors: dict[str, np.ndarray], names: Sequence[str], stddev: float) -> str:
    """Return lines on the errors of `comparison` on flights with some names."""
    ways = f"stddev {STOCK} m", f"stddev {stddev:.2f} m", "build"
    lines = [f"{'3D RMSE in the air, m':32s} {'':8s}" + "".join(f"{way:>15s}" for way in ways)]
    for kind, rows in errors.items():
        for name, row in zip((*names, "mean"), (*rows, rows.mean(axis=0))):
            lines.append(f"{name:32s} {kind:8s}" + "".join(f"{one:15.3f}" for one in row))
        alone, corrected = rows[:, 1], rows[:, 2]
        if not (corrected <= alone * MORE).all() or not corrected.mean() <= alone.mean():
            lines.append(
                f"The correction makes the {kind} filter worse: fly it with uwbBias.enable 0 and "
                f"tdoa2.stddev {stddev:.3f}."
            )
    return "\n".join(lines)


def events_of(flight: Flight) -> np.ndarray:
    """Return inertial samples and TDOAs of a Flight in the order of time, (n,) of EVENT."""
    imu, tdoa, anchors = flight.imu, flight.tdoa, flight.anchors
    if imu is None:
        raise InputError(f"{flight.name}: has no inertial samples, and the firmware needs them.")
    samples, out = np.zeros(len(imu), EVENT), np.zeros(len(tdoa), EVENT)
    samples["t"], samples["gyro"], samples["accel"], samples["id_a"] = *vars(imu).values(), -1
    out["t"], out["d"], out["id_a"], out["id_b"] = tdoa.t, tdoa.d, tdoa.a, tdoa.b
    rows = anchors.index(tdoa.a), anchors.index(tdoa.b)
    out["a"], out["b"] = (anchors.positions[row] for row in rows)
    known = (np.minimum(*rows) >= 0) & np.isfinite(tdoa.d)
    both = np.concatenate([samples, out[known]])
    return both[np.argsort(both["t"], kind="stable")]
