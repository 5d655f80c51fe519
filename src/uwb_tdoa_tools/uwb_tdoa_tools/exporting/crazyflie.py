# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a correction as an out-of-tree build of the Crazyflie firmware.

The build uses EXTRA_CFLAGS, as docs/development/oot.md of the firmware describes. Kbuild puts these
flags after those of the firmware, so `-I` cannot replace a header. `-iquote` can: the compiler
searches it before all `-I`. The firmware's own Kalman filter stays as it is, with its logs and
parameters. It gets each TDOA after the correction at its own newest state.

The documented hook for estimators does not suffice. The Kalman filter takes TDOAs from the queue of
all measurements in its own task, where an out-of-tree estimator cannot change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import subprocess
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig

from ..scoring.evaluation import require_truth
from ..scoring.metrics import position_at, rms, scored_phase

LARGEST_ID = 255  # of an anchor in the firmware
MORE = 1.1  # error of one flight with a correction over that without it, above which it is worse
# stddev over tdoa_std, and the least stddev, m. The firmware takes each TDOA as independent, and their errors are
# correlated. Set on six flights of 0425: with 0.25 m the robust filter is lost on one of them, 0.62 m costs 4 %.
WIDER, LEAST = 1.6, 0.4
STOCK = 0.15  # m, tdoa2.stddev and tdoa3.stddev of the firmware

MAKEFILE = """\
# make CRAZYFLIE_BASE=/path/to/crazyflie-firmware
CRAZYFLIE_BASE ?= ../crazyflie-firmware
OOT_CONFIG := $(PWD)/config
EXTRA_CFLAGS += -I$(PWD)/src -iquote $(PWD)/overrides

include $(CRAZYFLIE_BASE)/tools/make/oot.mk
"""

CONFIG = "CONFIG_ESTIMATOR_KALMAN_ENABLE=y\nCONFIG_ESTIMATOR_KALMAN=y\n"

KBUILD = "obj-y += src/\n"
SOURCES = "obj-y += uwb_bias.o\nobj-y += uwb_bias_firmware.o\n"

OVERRIDE = """\
/* In place of the firmware's header of this name: its Kalman filter gets corrected TDOAs. */
#pragma once
#include_next "estimator_kalman.h"

#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
#include "uwb_bias_firmware.h"

#define kalmanCoreUpdateWithTdoa(core, tdoa, ...) \\
    kalmanCoreUpdateWithTdoa(core, uwbBiasCorrected(core, tdoa), __VA_ARGS__)
#define kalmanCoreRobustUpdateWithTdoa(core, tdoa, ...) \\
    kalmanCoreRobustUpdateWithTdoa(core, uwbBiasCorrected(core, tdoa), __VA_ARGS__)
"""

HEADER = """\
/* The correction between the Loco Positioning deck and the Kalman filter of the firmware. */
#pragma once
#include "kalman_core.h"

/* Subtract the bias of a TDOA at the state of the filter, set its standard deviation, and return it.
   A TDOA with an unknown anchor, or at a state that is not finite, keeps its difference. */
tdoaMeasurement_t *uwbBiasCorrected(const kalmanCoreData_t *core, tdoaMeasurement_t *tdoa);
"""

SOURCE = """\
#include "uwb_bias_firmware.h"

#include <math.h>

#include "log.h"
#include "param.h"
#include "usec_time.h"
#include "uwb_bias.h"

#if UWB_BIAS_READS_RATES
#error "The filter of the firmware gives no acceleration and no rate: export other effects."
#endif

uint8_t uwbBiasEnable = 1;
static float stddev = STDDEV; /* m, measured; 0 for that of tdoa2.stddev or tdoa3.stddev */
static float bias, std;
static uint32_t corrected, refused;

/* Return the state of the filter in the units and frames of uwb_bias.h. */
static uwb_bias_state state_of(const kalmanCoreData_t *core) {
    uwb_bias_state state = {0};
    for (int k = 0; k < 3; k++) {
        state.position[k] = core->S[KC_STATE_X + k];
        state.attitude[k] = core->q[1 + k]; /* the firmware keeps w first */
        for (int i = 0; i < 3; i++) {
            state.velocity[k] += core->R[k][i] * core->S[KC_STATE_PX + i]; /* body to world */
        }
    }
    state.attitude[3] = core->q[0];
    return state;
}

tdoaMeasurement_t *uwbBiasCorrected(const kalmanCoreData_t *core, tdoaMeasurement_t *tdoa) {
    static uint64_t first, last; /* us */
    static float previous = -1.0f;
    const uint64_t now = usecTimestamp();
    if (!first) {
        first = last = now;
    }
    uwb_bias_state state = state_of(core);
    state.time = (float)(now - first) * 1e-6f;
    state.interval = (float)(now - last) * 1e-6f;
    state.previous_anchor = previous;
    last = now;
    previous = (float)tdoa->anchorIds[1];
    const int wrong = uwb_bias(tdoa->anchorIds[0], tdoa->anchorIds[1], &state, &bias, &std);
    if (wrong) {
        refused++;
    }
    if (uwbBiasEnable) {
        const float noise = stddev > 0.0f ? stddev : tdoa->stdDev;
        tdoa->stdDev = sqrtf(noise * noise + std * std);
        tdoa->distanceDiff -= bias; /* both are 0 if it is wrong */
        corrected += !wrong;
    }
    return tdoa;
}

PARAM_GROUP_START(uwbBias)
PARAM_ADD(PARAM_UINT8, enable, &uwbBiasEnable)
PARAM_ADD(PARAM_FLOAT, stddev, &stddev)
PARAM_GROUP_STOP(uwbBias)

LOG_GROUP_START(uwbBias)
LOG_ADD(LOG_FLOAT, bias, &bias)
LOG_ADD(LOG_FLOAT, std, &std)
LOG_ADD(LOG_UINT32, corrected, &corrected)
LOG_ADD(LOG_UINT32, refused, &refused)
LOG_GROUP_STOP(uwbBias)
"""

README = """\
# Corrected TDOAs for a Crazyflie

This folder is an out-of-tree build of the Crazyflie firmware. It corrects each TDOA of the Loco
Positioning deck before the Kalman filter uses it. The filter itself stays as it is.

1. Load `anchors.yaml` in the client (Loco Positioning tab) and write it to the anchors. The
   correction belongs to these positions and ids.
2. Build. `overrides/` replaces one header of the firmware. Its flags and headers were checked with
   the firmware of August 2026 (2a18fc29). The whole firmware was not linked.

       git clone --recursive https://github.com/bitcraze/crazyflie-firmware
       make CRAZYFLIE_BASE=$PWD/crazyflie-firmware

3. Write it to the vehicle: `make CRAZYFLIE_BASE=$PWD/crazyflie-firmware cload`
4. Log `uwbBias.corrected`: it rises with each TDOA. If `uwbBias.refused` rises, the id of an anchor
   is not in `anchors.yaml`. If both stay at 0, the firmware did not use `overrides/`: run
   `make clean` and build again.
5. Fly with and without the correction: the parameter `uwbBias.enable` is 1 or 0.

The correction sets the standard deviation of each TDOA, too: the root of stddev^2 + std^2. `std` is
that of the correction at this place. `stddev` is {stddev:.3f} m: 1.6
times tdoa_std of ekf_node.yaml, and at least 0.4 m. The parameter `uwbBias.stddev` changes it; with 0 it is that
of the firmware (`tdoa2.stddev` or `tdoa3.stddev`, 0.15 m). Without a correction, set `tdoa2.stddev`
or `tdoa3.stddev` to {stddev:.3f}.

Fly with `kalman.robustTdoa` 1 only if stddev is 0.3 m or more. This filter weighs each TDOA by its
own standard deviation alone. With a small one it rejects most TDOAs once it is half a metre off, and
does not come back. Then restart it with `kalman.robustTdoa` 0: it does not forget a state that is not
a number.

Before you fly: the C of the correction was tested in emulation. This build was not flown.
"""


def client_yaml(anchors: Anchors) -> str:
    """Return the anchor file of the Crazyflie client: {id: {x, y, z}}, m."""
    content = {
        int(i): dict(zip("xyz", map(float, position)))
        for i, position in zip(anchors.ids, anchors.positions)
    }
    return yaml.safe_dump(content, sort_keys=True)


def stddev_of(config: FilterConfig) -> float:
    """Return the standard deviation of a TDOA for the filters of the firmware, m."""
    return max(WIDER * config.tdoa_std, LEAST)


def files(code: dict[str, str], anchors: Anchors, stddev: float) -> dict[str, str]:
    """Return {path: text} of the build.

    code : {name: text} of the C of the correction; stddev : m, of a TDOA
    """
    return {
        "Makefile": MAKEFILE,
        "Kbuild": KBUILD,
        "config": CONFIG,
        "README.md": README.format(stddev=stddev),
        "anchors.yaml": client_yaml(anchors),
        "overrides/estimator_kalman.h": OVERRIDE,
        "src/Kbuild": SOURCES,
        **{f"src/{name}": text for name, text in code.items()},
        "src/uwb_bias_firmware.h": HEADER,
        "src/uwb_bias_firmware.c": SOURCE.replace("STDDEV", f"{stddev:.3f}f"),
    }


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

        build : as `files` describes it; firmware : a checkout; folder : for the program
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
