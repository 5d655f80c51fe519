# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A peer estimator: a tiny library compiled here. It returns its start as the estimate."""

import ctypes
import shutil
import subprocess

from documented import ROOT
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.anchor import AnchorClockDrift, AnchorDelay
from uwb_tdoa_tools.exporting.vehicle import vehicle_code
from uwb_tdoa_tools.flying import estimates
from uwb_tdoa_tools.flying.mission import Circles
from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.flying.world import HALL

CC = shutil.which("cc")
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler (cc)")
SOURCE = """
#include <math.h>
#include <stdint.h>
typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
static const double *anchors; static double p[3], sum; static int32_t rows, wrong;
int32_t tdoa_peer_version(void) { return VERSION; }
void tdoa_peer_start(const double *where, int32_t count, const double *at, const double *q) {
  anchors = where; rows = count; wrong = 0; sum = q[3];
  for (int k = 0; k < 3; k++) p[k] = at[k];
}
static double far(int32_t row) {
  double s = 0; for (int k = 0; k < 3; k++) s += pow(anchors[3 * row + k] - p[k], 2);
  return sqrt(s);
}
void tdoa_peer_run(const tdoa_peer_event *e, int32_t count) {
  for (double last = e->t; count--; last = e++->t) {
    wrong += e->t < last || e->a >= rows || e->b >= rows;
    if (e->a < 0) sum += e->gyro[0] + e->accel[2]; else sum += far(e->b) - far(e->a) - e->d;
  }
}
void tdoa_peer_position(double *out) { for (int k = 0; k < 3; k++) out[k] = wrong ? NAN : p[k]; }
"""
STATE = """
void tdoa_peer_state(double *at, double *v, double *q) {
  for (int k = 0; k < 3; k++) { at[k] = wrong ? NAN : p[k]; v[k] = q[k] = 0; }
  q[3] = 1;
}
"""


def built(folder, source=SOURCE, version=estimates.VERSION):
    """Compile a library and return its path."""
    (folder / "peer.c").write_text(source.replace("VERSION", str(version)))
    subprocess.run(
        [CC, "-O2", "-shared", "-fPIC", "-o", folder / "libpeer.so", folder / "peer.c", "-lm"],
        check=True,
    )
    return folder / "libpeer.so"


def test_it_is_flown_by_and_judged_like_ours(tmp_path):
    """The estimate stays on the floor while the vehicle climbs, so the vehicle climbs further."""
    library = built(tmp_path, SOURCE + STATE)
    flown = fly(
        Task(HALL, seed=2, given="place", peer=str(library), path=Circles(turns=1, turn_time=4.0))
    )
    place = flown.odometry.p[0]
    assert np.linalg.norm(place - flown.states[0, :3]) < 0.5 and (flown.odometry.p == place).all()
    verdict = verdict_of(flown)
    assert (
        verdict["why"] == "flew into the ceiling"
        or "wall" in verdict["why"]
        or verdict["why"] == "tipped over"
    )
    assert verdict["armed_deviations"] is None and verdict["phases"]["before"]["nees"] is None
    assert verdict["phases"]["before"]["rmse"] == pytest.approx(
        np.linalg.norm(place - flown.states[0, :3]), abs=1e-6
    )


def test_one_that_nobody_told_where_it_is_has_no_place(tmp_path):
    flown = fly(
        Task(
            HALL,
            seed=2,
            peer=str(built(tmp_path, SOURCE + STATE)),
            path=Circles(turns=1, turn_time=4.0),
        )
    )
    assert (
        verdict_of(flown)["why"] == "refused to arm"
    )  # the start is NaN, and the estimate stays at its start


def test_one_whose_estimate_becomes_no_number_in_flight_is_lost_and_ends_nothing(tmp_path):
    ends = STATE.replace("{\n  for", "{\n  static int calls;\n  wrong |= ++calls > 450;\n  for", 1)
    flown = fly(
        Task(
            HALL,
            seed=2,
            given="place",
            peer=str(built(tmp_path, SOURCE + ends)),
            path=Circles(turns=1, turn_time=4.0),
        )
    )
    assert (
        verdict_of(flown)["reported_lost"] is not None
        and not verdict_of(flown)["landed"]
        and np.isnan(flown.odometry.p[-1]).all()
    )


def test_what_a_library_remembers_of_one_flight_is_not_in_the_next(tmp_path):
    counting = (
        "void tdoa_peer_state(double *at, double *v, double *q) { static int calls; at[0] = "
        "++calls; }"
    )
    library = built(tmp_path, SOURCE + counting)
    first, second = estimates.Peer(library, own=True), estimates.Peer(library, own=True)
    assert [one.state()[0][0] for one in (first, first, second)] == [1.0, 2.0, 1.0]


def test_one_that_does_not_tell_its_state_cannot_be_flown_by(tmp_path):
    with pytest.raises(
        InputError, match="does not export tdoa_peer_state; add it as docs/notebook/speed.md shows"
    ):
        fly(Task(HALL, seed=2, peer=str(built(tmp_path))))


def test_libraries_that_are_none(tmp_path):
    with pytest.raises(
        InputError, match="nowhere.so cannot be loaded as a shared library .*; build it anew"
    ):
        estimates.Peer(tmp_path / "nowhere.so")
    (tmp_path / "text.so").write_text("no library")
    with pytest.raises(InputError, match="text.so cannot be loaded"):
        estimates.Peer(tmp_path / "text.so")
    with pytest.raises(InputError, match="is of version 7 of the interface, this is 1"):
        estimates.Peer(built(tmp_path, version=7))
    (tmp_path / "less").mkdir()
    with pytest.raises(InputError, match="does not export tdoa_peer_position; add it"):
        estimates.Peer(built(tmp_path / "less", SOURCE.replace("tdoa_peer_position", "position")))


def test_the_stand_in_for_matrices_inverts_and_multiplies(tmp_path):
    (tmp_path / "inverse.c").write_text(
        '#include "arm_math.h"\n'
        "void product(float *a, float *out, int n) {\n"
        "  float i[256], t[256];\n"
        "  matrix A = {n, n, a}, I = {n, n, i}, T = {n, n, t}, O = {n, n, out};\n"
        "  arm_mat_inverse_f32(&A, &I); arm_mat_trans_f32(&I, &T); arm_mat_trans_f32(&T, &I); "
        "arm_mat_mult_f32(&A, &I, &O);\n"
        "  arm_mat_scale_f32(&O, 2, &O);\n}"
    )
    library = tmp_path / "inverse.so"
    include = f"-I{ROOT / 'docs' / 'peer'}"
    subprocess.run(
        [CC, "-shared", "-fPIC", include, "-o", library, tmp_path / "inverse.c", "-lm"], check=True
    )
    a = np.random.default_rng(1).normal(size=(9, 9)).astype(np.float32)
    out = np.zeros((9, 9), np.float32)
    ctypes.CDLL(str(library)).product(*(ctypes.c_void_p(x.ctypes.data) for x in (a, out)), 9)
    assert np.allclose(out, 2.0 * np.eye(9), atol=1e-4)


RECORDS = """
#include <stdint.h>
typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
static double last; static int32_t samples, tdoas;
int32_t tdoa_peer_version(void) { return VERSION; }
void tdoa_peer_start(const double *a, int32_t n, const double *p, const double *q) {
  (void)a; (void)n; (void)p; (void)q; samples = tdoas = 0;
}
void tdoa_peer_run(const tdoa_peer_event *e, int32_t n) {
  for (; n--; e++) if (e->a < 0) samples++; else { tdoas++; last = e->d; }
}
void tdoa_peer_position(double *out) { out[0] = last; out[1] = samples; out[2] = tdoas; }
"""


def exported(folder, *effects):
    """Return a folder as `export --c` writes it."""
    folder.mkdir()
    code = vehicle_code(HALL.anchors, EffectSet(effects))
    for name, text in code.files.items():
        (folder / name).write_text(text)
    return folder


def test_an_exported_correction_reaches_each_tdoa_of_a_peer(tmp_path):
    ids = HALL.anchors.ids
    effects = AnchorDelay({str(ids[1]): 0.2}), AnchorClockDrift({str(ids[1]): 0.01})
    correction = estimates.CompiledCorrection(exported(tmp_path / "c", *effects))
    other = estimates.Peer(built(tmp_path, RECORDS + STATE_AT), correction=correction)
    t, zeros = np.array([3.0, 5.0, 8.0]), np.zeros((3, 3))
    imu = Imu(t - 0.5, zeros, zeros)
    tdoa = Tdoas(t, np.full(3, ids[0]), np.array([ids[1], 999, ids[1]]), np.full(3, 1.0))
    both = np.concatenate(estimates.events(imu, tdoa, HALL.anchors))
    for _ in range(2):  # a new start forgets the time of the first TDOA
        other.start(HALL.anchors, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        other.run(both[np.argsort(both["t"], kind="stable")])
        last, samples, tdoas = other.position()
        assert (samples, tdoas) == (3, 2)  # TDOAs of an unknown anchor are not passed on
        assert last == pytest.approx(1.0 - 0.2 - 0.01 * 5.0, abs=1e-6)


STATE_AT = """
void tdoa_peer_state(double *p, double *v, double *q) {
  for (int k = 0; k < 3; k++) p[k] = v[k] = q[k] = 0.5;
  q[3] = 0.5;
}
"""


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder, "holds no uwb_bias.h; give a folder that export --c wrote"),
        (
            lambda folder: exported(
                folder / "c", SmoothTerm({"c0": 0.1}, covariate="turning_rate", knots=(0.0, 1.0))
            ),
            "reads acceleration or rate",
        ),
    ],
)
def test_a_folder_that_cannot_correct_a_peer_is_named(tmp_path, make, words):
    with pytest.raises(InputError, match=words):
        estimates.CompiledCorrection(make(tmp_path))


def test_a_correction_that_is_no_c_or_a_peer_without_a_state_is_named(tmp_path):
    folder = exported(tmp_path / "c", AnchorDelay({"0": 0.1}))
    with pytest.raises(InputError, match="does not export tdoa_peer_state"):
        estimates.Peer(built(tmp_path), correction=estimates.CompiledCorrection(folder))
    broken = exported(tmp_path / "broken")
    (broken / "uwb_bias.c").write_text("no C")
    with pytest.raises(InputError, match="cannot be compiled"):
        estimates.CompiledCorrection(broken)


def test_a_vehicle_flies_by_a_corrected_peer(tmp_path):
    folder = exported(tmp_path / "c", AnchorDelay({str(HALL.anchors.ids[0]): 0.1}))
    library = str(built(tmp_path, SOURCE + STATE))
    task = Task(HALL, seed=2, given="place", peer=library, correction=str(folder))
    assert verdict_of(fly(task))["landed"] is False  # the estimate stays at its start
