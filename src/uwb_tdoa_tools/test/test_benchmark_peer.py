"""Another filter beside ours: a tiny library, compiled here."""

import ctypes
import shutil
import subprocess

from documented import ROOT
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.benchmark import peer, suite
from uwb_tdoa_tools.benchmark.flights import make_flight
from uwb_tdoa_tools.commands import bench

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


def built(folder, source=SOURCE, version=peer.VERSION):
    """Path of a library."""
    (folder / "peer.c").write_text(source.replace("VERSION", str(version)))
    subprocess.run(
        [CC, "-O2", "-shared", "-fPIC", "-o", folder / "libpeer.so", folder / "peer.c", "-lm"],
        check=True,
    )
    return folder / "libpeer.so"


def test_a_library_gets_the_events_of_a_flight_in_their_order(tmp_path):
    flight, other = make_flight(4.0, start_in_air=True, multipath=False), peer.Peer(built(tmp_path))
    samples, both = peer.events_of(flight, flight.imu.t[0] + 1.0, np.inf)
    assert (
        len(samples) == np.sum(flight.imu.t >= flight.imu.t[0] + 1.0) and (samples["a"] == -1).all()
    )
    assert (
        len(both) - len(samples) == pytest.approx(3.0 * 400.0, rel=0.05)
        and (np.diff(both["t"]) >= 0.0).all()
    )
    assert set(both["t"]) == set(samples["t"])  # no prediction for a TDOA alone
    p, q = flight.truth.p[0], flight.truth.q[0]
    other.start(flight.anchors.positions, p, q)
    assert other.run(both) > 0.0
    np.testing.assert_array_equal(other.position(), p)
    other.run(both[::-1].copy())  # it tells that this is nonsense
    assert np.isnan(other.position()).all()


def test_both_are_measured_and_their_ratio(tmp_path):
    _, figures = suite.measure((), tmp_path / "out", True, None, peer.Peer(built(tmp_path)))
    assert {figure.section for figure in figures} == {"compiled core beside libpeer.so, 8 anchors"}
    value = {figure.name: figure.median for figure in figures}
    for name in ("prediction", "robust update", "both"):
        assert np.isfinite(
            [
                value[f"{name}, {whose}"]
                for whose in ("ours", "the other's", "ours over the other's")
            ]
        ).all()
    assert (
        value["the other's position at the end, off by"] > 0.1
    )  # this one stays where it is: how fast it is, is worth nothing


def test_libraries_that_are_none(tmp_path, capsys):
    with pytest.raises(
        InputError, match="nowhere.so cannot be loaded as a shared library .*; build it anew"
    ):
        peer.Peer(tmp_path / "nowhere.so")
    (tmp_path / "text.so").write_text("no library")
    assert (
        bench.main(
            ["--peer", str(tmp_path / "text.so"), "--only", "core", "--out", str(tmp_path / "out")]
        )
        == 2
    )
    assert "text.so cannot be loaded" in capsys.readouterr().err
    with pytest.raises(InputError, match="is of version 7 of the interface, this is 1"):
        peer.Peer(built(tmp_path, version=7))
    (tmp_path / "less").mkdir()
    with pytest.raises(InputError, match="does not export tdoa_peer_position; add it"):
        peer.Peer(built(tmp_path / "less", SOURCE.replace("tdoa_peer_position", "position")))


def test_the_documented_interface_is_the_one_that_is_called():
    page = (ROOT / "docs" / "speed.md").read_text()
    declared = [line for line in peer.__doc__.splitlines() if line.startswith("    ")]
    assert len(declared) == 6 and all(
        line.strip().partition(";  ")[0].split("(")[0] in page for line in declared
    )


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
