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

import yaml

from uwb_tdoa_bias.common.anchors import Anchors

LARGEST_ID = 255  # of an anchor in the firmware

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

/* Subtract the bias of a TDOA at the state of the filter, and return the TDOA.
   A TDOA with an unknown anchor, or at a state that is not finite, stays as it is. */
tdoaMeasurement_t *uwbBiasCorrected(const kalmanCoreData_t *core, tdoaMeasurement_t *tdoa);
"""

SOURCE = """\
#include "uwb_bias_firmware.h"

#include "log.h"
#include "param.h"
#include "usec_time.h"
#include "uwb_bias.h"

#if UWB_BIAS_READS_RATES
#error "The filter of the firmware gives no acceleration and no rate: export other effects."
#endif

static uint8_t enable = 1;
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
    if (uwb_bias(tdoa->anchorIds[0], tdoa->anchorIds[1], &state, &bias, &std)) {
        refused++;
    } else if (enable) {
        tdoa->distanceDiff -= bias;
        corrected++;
    }
    return tdoa;
}

PARAM_GROUP_START(uwbBias)
PARAM_ADD(PARAM_UINT8, enable, &enable)
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

Before you fly: the C of the correction was tested in emulation. This build was not flown.
"""


def client_yaml(anchors: Anchors) -> str:
    """Return the anchor file of the Crazyflie client: {id: {x, y, z}}, m."""
    content = {
        int(i): dict(zip("xyz", map(float, position)))
        for i, position in zip(anchors.ids, anchors.positions)
    }
    return yaml.safe_dump(content, sort_keys=True)


def files(code: dict[str, str], anchors: Anchors) -> dict[str, str]:
    """Return {path: text} of the build. code : {name: text} of the C of the correction."""
    return {
        "Makefile": MAKEFILE,
        "Kbuild": KBUILD,
        "config": CONFIG,
        "README.md": README,
        "anchors.yaml": client_yaml(anchors),
        "overrides/estimator_kalman.h": OVERRIDE,
        "src/Kbuild": SOURCES,
        **{f"src/{name}": text for name, text in code.items()},
        "src/uwb_bias_firmware.h": HEADER,
        "src/uwb_bias_firmware.c": SOURCE,
    }
