# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filters of the Crazyflie firmware with a build, compiled against stand-ins of its sources."""

from c_programs import GCC
from firmware_headers import FIRMWARE
import numpy as np
import pytest

from studies.firmware_filter import FirmwareFilter, events_of, in_words
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.exporting.c_code import stddev_of, write_crazyflie
from uwb_tdoa_tools.exporting.tracing import trace
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.skipif(GCC is None, reason="no C compiler (gcc)")

# A checkout of stand-ins. Its filter states the corrected TDOA, its deviation, and its own kind.
CHECKOUT = {
    "modules/interface/kalman_core/kalman_core.h": """
#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef union { struct { float x, y, z; }; float axis[3]; } Axis3f;
typedef struct { float x, y, z; } point_t;
typedef struct {
    point_t anchorPositions[2]; uint8_t anchorIds[2]; float distanceDiff, stdDev;
} tdoaMeasurement_t;
enum { KC_STATE_X, KC_STATE_Y, KC_STATE_Z, KC_STATE_PX };
typedef struct { float S[9], q[4], R[3][3]; int predictions; } kalmanCoreData_t;
typedef struct {
    float initialX, initialY, initialZ, initialYaw, stdDevInitialPosition_xy,
        stdDevInitialPosition_z, stdDevInitialVelocity, stdDevInitialAttitude_rollpitch,
        stdDevInitialAttitude_yaw;
} kalmanCoreParams_t;
void kalmanCoreDefaultParams(kalmanCoreParams_t *params);
void kalmanCoreInit(kalmanCoreData_t *core, const kalmanCoreParams_t *params, uint32_t ms);
void kalmanCorePredict(kalmanCoreData_t *core, const kalmanCoreParams_t *params, Axis3f *force,
                       Axis3f *rate, uint32_t ms, bool flies);
void kalmanCoreAddProcessNoise(kalmanCoreData_t *core, const kalmanCoreParams_t *p, uint32_t ms);
void kalmanCoreFinalize(kalmanCoreData_t *core);
""",
    "modules/interface/outlierfilter/outlierFilterTdoa.h": """
#pragma once
typedef struct { int unused; } OutlierFilterTdoaState_t;
void outlierFilterTdoaReset(OutlierFilterTdoaState_t *state);
""",
    "modules/src/kalman_core/kalman_core.c": """
#include <string.h>
#include "kalman_core.h"
void kalmanCoreDefaultParams(kalmanCoreParams_t *params) { memset(params, 0, sizeof *params); }
void kalmanCoreInit(kalmanCoreData_t *core, const kalmanCoreParams_t *params, uint32_t ms) {
    memset(core, 0, sizeof *core);
    core->q[0] = 1;
}
void kalmanCorePredict(kalmanCoreData_t *core, const kalmanCoreParams_t *params, Axis3f *force,
                       Axis3f *rate, uint32_t ms, bool flies) { core->predictions++; }
void kalmanCoreAddProcessNoise(kalmanCoreData_t *core, const kalmanCoreParams_t *p, uint32_t ms) {}
void kalmanCoreFinalize(kalmanCoreData_t *core) {}
""",
    "modules/src/kalman_core/mm_tdoa.c": """
#include "mm_tdoa.h"
void kalmanCoreUpdateWithTdoa(kalmanCoreData_t *core, tdoaMeasurement_t *tdoa,
                              const uint32_t nowMs, void *state) {
    core->S[0] = tdoa->distanceDiff, core->S[1] = tdoa->stdDev;
    core->S[2] = core->predictions;
}
""",
    "modules/src/kalman_core/mm_tdoa_robust.c": """
#include "mm_tdoa_robust.h"
void kalmanCoreRobustUpdateWithTdoa(kalmanCoreData_t *core, tdoaMeasurement_t *tdoa, void *state) {
    core->S[0] = tdoa->anchorPositions[0].x, core->S[1] = tdoa->anchorIds[1];
}
""",
    "modules/src/outlierfilter/outlierFilterTdoa.c": """
#include "outlierFilterTdoa.h"
void outlierFilterTdoaReset(OutlierFilterTdoaState_t *state) {}
""",
    "modules/src/outlierfilter/outlierFilterTdoaSteps.c": "",
    "modules/interface/estimator/estimator_kalman.h": "#pragma once\n",
} | {
    f"modules/interface/kalman_core/{name}": FIRMWARE[name]
    for name in ("mm_tdoa.h", "mm_tdoa_robust.h", "log.h", "param.h", "usec_time.h")
}


def test_flights_are_played_to_the_filter_of_a_checkout(tmp_path):
    """It gets events in order, raw or corrected, and starts anew for each flight."""
    build, firmware, folder = tmp_path / "app", tmp_path / "firmware", tmp_path / "made"
    config = FilterConfig(tdoa_std=0.25)
    flight = simulate(SimulationConfig(seed=1, duration=16.0))
    held = EffectSet((EFFECTS["anchor_delay"]({"1": 0.3}), EFFECTS["noise_level"]({"0-1": 0.3})))
    write_crazyflie(build, trace(flight.anchors, held), stddev_of(config))
    for name, text in CHECKOUT.items():
        (firmware / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        (firmware / "src" / name).write_text(text)
    folder.mkdir()
    made = FirmwareFilter(build, firmware, folder)
    t, raw = made.estimate(flight, False, False, 0.15)
    tdoa = flight.tdoa
    rows = np.searchsorted(tdoa.t, t)
    np.testing.assert_allclose(raw[:, 0], tdoa.d[rows], atol=1e-6)
    np.testing.assert_allclose(raw[:, 1], 0.15, atol=1e-6)
    assert raw[-1, 2] == pytest.approx(100.0 * (t[-1] - t[0]), abs=3.0)
    _, corrected = made.estimate(flight, False, True, 0.15)
    delay = 0.3 * ((tdoa.b[rows] == 1) * 1.0 - (tdoa.a[rows] == 1))
    np.testing.assert_allclose(raw[:, 0] - corrected[:, 0], delay, atol=1e-5)
    noisy = np.minimum(tdoa.a, tdoa.b)[rows] + np.maximum(tdoa.a, tdoa.b)[rows] * 10 == 10
    np.testing.assert_allclose(corrected[:, 1], np.where(noisy, 0.5, 0.4), atol=1e-5)
    _, robust = made.estimate(flight, True, True, 0.15)
    places = flight.anchors.positions[flight.anchors.index(tdoa.a[rows])]
    np.testing.assert_allclose(robust[:, 0], places[:, 0], atol=1e-5)
    np.testing.assert_array_equal(robust[:, 1], tdoa.b[rows])


def test_what_cannot_be_compiled_or_played_is_named(tmp_path):
    with pytest.raises(InputError, match="none cannot be compiled .* give a checkout"):
        FirmwareFilter(tmp_path, tmp_path / "none", tmp_path)
    flight = simulate(SimulationConfig(seed=1, duration=16.0))
    with pytest.raises(InputError, match="has no inertial samples"):
        events_of(flight.without("imu"))


def test_a_correction_that_makes_a_filter_worse_is_named():
    better, worse = np.array([[0.4, 0.3, 0.2], [0.4, 0.3, 0.32]]), np.array([[0.4, 0.3, 0.34]])
    errors = {"standard": better, "robust": worse, "lost": np.array([[np.nan, 0.3, np.nan]])}
    text = in_words(errors, ["one", "two"], 0.5)
    assert "standard filter worse" not in text and "robust filter worse" in text
    assert "lost filter worse: fly it with uwbBias.enable 0 and tdoa2.stddev 0.500." in text
    assert "0.260" in text  # the mean with the build
