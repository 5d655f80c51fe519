# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for headers of the Crazyflie firmware."""

# Stand-ins for the firmware files that the build needs. This repository does not contain them.
FIRMWARE = {
    "kalman_core.h": """
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef struct { uint32_t timestamp; float x, y, z; } point_t;
typedef struct {
    point_t anchorPositions[2]; uint8_t anchorIds[2]; float distanceDiff, stdDev;
} tdoaMeasurement_t;
typedef enum {
    KC_STATE_X, KC_STATE_Y, KC_STATE_Z, KC_STATE_PX, KC_STATE_PY, KC_STATE_PZ, KC_STATE_D0,
    KC_STATE_D1, KC_STATE_D2, KC_STATE_DIM
} kalmanCoreStateIdx_t;
typedef struct { float S[KC_STATE_DIM], q[4], R[3][3]; } kalmanCoreData_t;
""",
    "mm_tdoa.h": """
#pragma once
#include "kalman_core.h"
void kalmanCoreUpdateWithTdoa(kalmanCoreData_t *this, tdoaMeasurement_t *tdoa,
                              const uint32_t nowMs, void *state);
""",
    "mm_tdoa_robust.h": """
#pragma once
#include "kalman_core.h"
void kalmanCoreRobustUpdateWithTdoa(kalmanCoreData_t *this, tdoaMeasurement_t *tdoa, void *state);
""",
    "estimator_kalman.h": """
#pragma once
void estimatorKalmanInit(void);
""",
    "log.h": """
#pragma once
#define LOG_GROUP_START(NAME) void *log_of_##NAME[] = {
#define LOG_ADD(TYPE, NAME, ADDRESS) ADDRESS,
#define LOG_GROUP_STOP(NAME) 0};
""",
    "param.h": """
#pragma once
#define PARAM_GROUP_START(NAME) void *param_of_##NAME[] = {
#define PARAM_ADD(TYPE, NAME, ADDRESS) ADDRESS,
#define PARAM_GROUP_STOP(NAME) 0};
""",
    "usec_time.h": """
#pragma once
#include <stdint.h>
uint64_t usecTimestamp(void);
""",
}
