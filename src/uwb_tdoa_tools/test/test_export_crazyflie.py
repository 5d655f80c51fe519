# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The out-of-tree build for a Crazyflie, compiled against stand-ins of the firmware's headers."""

import subprocess

import c_programs as c
from c_programs import ANCHORS, GCC, cases, chosen
import numpy as np
from programs import run
import pytest
from scipy.spatial.transform import Rotation
import yaml

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.exporting import c_code
from uwb_tdoa_tools.exporting.c_code import vehicle_code, write_crazyflie
from uwb_tdoa_tools.exporting.tracing import trace
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.skipif(GCC is None, reason="no C compiler (gcc)")
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
UPDATES = """
#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
float got;
void kalmanCoreUpdateWithTdoa(kalmanCoreData_t *this, tdoaMeasurement_t *tdoa,
                              const uint32_t nowMs, void *state) {
    (void)this; (void)nowMs; (void)state;
    got = tdoa->distanceDiff;
}
void kalmanCoreRobustUpdateWithTdoa(kalmanCoreData_t *this, tdoaMeasurement_t *tdoa, void *state) {
    (void)this; (void)state;
    got = -tdoa->distanceDiff;
}
"""
ESTIMATOR = """
#include <stdio.h>
#include "kalman_core.h"
#include "estimator_kalman.h"
#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
extern float got;
static uint64_t now;
uint64_t usecTimestamp(void) { return now; }
int main(void) {
    kalmanCoreData_t core;
    tdoaMeasurement_t tdoa = {0};
    float state[16]; /* s; position, w x y z, velocity in the body; d; then a and b */
    int a, b, robust = 0;
    while (scanf("%f %f %f %f %f %f %f %f %f %f %f %f %d %d", state, state + 1, state + 2,
                 state + 3, state + 4, state + 5, state + 6, state + 7, state + 8, state + 9,
                 state + 10, state + 11, &a, &b) == 14) {
        now = 1000000 + (uint64_t)(1e6f * state[0]);
        for (int k = 0; k < 3; k++) {
            core.S[KC_STATE_X + k] = state[1 + k];
            core.S[KC_STATE_PX + k] = state[8 + k];
        }
        for (int k = 0; k < 4; k++) core.q[k] = state[4 + k];
        const float w = core.q[0], x = core.q[1], y = core.q[2], z = core.q[3];
        const float R[3][3] = {
            {1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
            {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
            {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)}};
        for (int i = 0; i < 9; i++) core.R[i / 3][i % 3] = R[i / 3][i % 3];
        tdoa.distanceDiff = state[11];
        tdoa.stdDev = 0.15f;
        tdoa.anchorIds[0] = (uint8_t)a;
        tdoa.anchorIds[1] = (uint8_t)b;
        robust = !robust;
        if (robust) kalmanCoreRobustUpdateWithTdoa(&core, &tdoa, 0);
        else kalmanCoreUpdateWithTdoa(&core, &tdoa, 0, 0);
        printf("%.9g %.9g\\n", (double)(robust ? -got : got), (double)tdoa.stdDev);
    }
    return 0;
}
"""


def extra_flags(makefile, folder):
    """Return the flags that the Makefile of a build adds to the firmware flags."""
    (line,) = (line for line in makefile.splitlines() if line.startswith("EXTRA_CFLAGS"))
    return line.partition("+=")[2].replace("$(PWD)", str(folder)).split()


def build(folder, names, stddev):
    """Compile the build with the stand-ins in a folder, and return the program."""
    made = c_code.firmware_files(vehicle_code(ANCHORS, chosen(*names)).files, ANCHORS, stddev)
    made |= {f"firmware/{name}": text for name, text in FIRMWARE.items()}
    made |= {"firmware/src/updates.c": UPDATES, "firmware/src/estimator_kalman.c": ESTIMATOR}
    for name, text in made.items():
        path = folder / "app" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    flags = [flag for flag in c.FIRMWARE if flag != "-mfp16-format=ieee"]
    # same order as Kbuild: flags of the firmware, then EXTRA_CFLAGS
    include = ["-Ifirmware", *extra_flags(made["Makefile"], folder / "app")]
    sources = ["src/uwb_bias.c", "src/uwb_bias_firmware.c"]
    sources += ["firmware/src/updates.c", "firmware/src/estimator_kalman.c"]
    command = [GCC, *flags, *include, *sources, "-lm", "-o", "estimator"]
    run(*command, cwd=folder / "app", check=True)
    return folder / "app" / "estimator"


NAMES = (*c.COMMON, "antenna_pattern", "spline over climb rate", "interval", "previous anchor")


@pytest.mark.parametrize("stddev, noise", [(0.4, 0.4), (0.0, 0.15)])
def test_the_filter_of_the_firmware_gets_corrected_tdoas_and_their_noise(tmp_path, stddev, noise):
    program, some = build(tmp_path, NAMES, stddev), cases(200)
    some = some[(some["a"] < 256) & (some["b"] < 256)]
    some["state"]["time"] = np.round(np.cumsum(np.full(len(some), 0.004)) - 0.004, 6)
    state, n = some["state"], len(some)
    state["acceleration"] = state["rate"] = 0.0  # the filter estimates none
    state["interval"][0], state["interval"][1:] = 0.0, np.diff(state["time"])
    state["previous_anchor"][0], state["previous_anchor"][1:] = -1, some["b"][:-1]
    q = state["attitude"].astype(float)
    body = Rotation.from_quat(q).inv().apply(state["velocity"])
    d = np.full(n, 0.25)
    columns = [state["time"], *state["position"].T, *q[:, [3, 0, 1, 2]].T, *body.T, d]
    columns += [some["a"], some["b"]]
    lines = "".join(
        " ".join(f"{one:.9g}" if k < 12 else f"{int(one)}" for k, one in enumerate(row)) + "\n"
        for row in zip(*columns)
    )
    out = run(program, input=lines, check=True).stdout
    got, std = np.array(out.split(), dtype=float).reshape(-1, 2).T
    expected = Corrector(ANCHORS, chosen(*NAMES)).prediction(c.samples_of(some))
    np.testing.assert_allclose(0.25 - got, expected.bias, atol=2e-5)
    np.testing.assert_allclose(std, np.hypot(noise, expected.std), atol=2e-5)
    assert expected.std.max() > 0.1


def test_what_the_filter_does_not_estimate_is_refused_by_the_compiler(tmp_path):
    with pytest.raises(subprocess.CalledProcessError) as failed:
        build(tmp_path, ["turning"], 0.4)
    assert "gives no acceleration and no rate" in failed.value.stderr


def test_the_client_gets_the_anchors_of_the_correction():
    content = yaml.safe_load(c_code.client_yaml(ANCHORS))
    assert list(content) == ANCHORS.ids.tolist()
    for i, position in zip(ANCHORS.ids, ANCHORS.positions):
        assert [content[i][axis] for axis in "xyz"] == position.tolist()


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
    write_crazyflie(build, trace(flight.anchors, held), c_code.stddev_of(config))
    for name, text in CHECKOUT.items():
        (firmware / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        (firmware / "src" / name).write_text(text)
    folder.mkdir()
    made = c_code.FirmwareFilter(build, firmware, folder)
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
        c_code.FirmwareFilter(tmp_path, tmp_path / "none", tmp_path)
    flight = simulate(SimulationConfig(seed=1, duration=16.0))
    with pytest.raises(InputError, match="has no inertial samples"):
        c_code.events_of(flight.without("imu"))


def test_a_correction_that_makes_a_filter_worse_is_named():
    better, worse = np.array([[0.4, 0.3, 0.2], [0.4, 0.3, 0.32]]), np.array([[0.4, 0.3, 0.34]])
    errors = {"standard": better, "robust": worse, "lost": np.array([[np.nan, 0.3, np.nan]])}
    text = c_code.in_words(errors, ["one", "two"], 0.5)
    assert "standard filter worse" not in text and "robust filter worse" in text
    assert "lost filter worse: fly it with uwbBias.enable 0 and tdoa2.stddev 0.500." in text
    assert "0.260" in text  # the mean with the build
