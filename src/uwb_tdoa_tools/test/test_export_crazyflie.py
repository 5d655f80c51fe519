# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The out-of-tree build for a Crazyflie, compiled against stand-ins of the firmware's headers."""

import subprocess

import c_programs as c
from c_programs import ANCHORS, GCC, cases, chosen
from firmware_headers import FIRMWARE
import numpy as np
from programs import run
import pytest
from scipy.spatial.transform import Rotation
import yaml

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_tools.exporting import c_code
from uwb_tdoa_tools.exporting.c_code import vehicle_code

pytestmark = pytest.mark.skipif(GCC is None, reason="no C compiler (gcc)")
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
