# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pieces of `study bench`, and one quick run of the real thing."""

import ctypes
import json
import os
import re
import shutil
import subprocess

from documented import ROOT
import numpy as np
from programs import run, start
import pytest

from uwb_tdoa_bias.common.errors import InputError

pytest.importorskip("uwb_tdoa_msgs.msg")
from studies.__main__ import main  # noqa: E402
from studies.bench import core, nodes, peer, recordings, soak, source, suite, usage  # noqa: E402
from studies.bench.figures import Figure  # noqa: E402
from studies.bench.flights import among, make_flight  # noqa: E402
from studies.bench.peer import Peer  # noqa: E402

OTHERS = 0.2  # share of the CPU time used by others, above which real-time playback is not judged

CC = shutil.which("cc")
NEEDS_CC = pytest.mark.skipif(CC is None, reason="no C compiler (cc)")
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
    """Compile a library and return its path."""
    (folder / "peer.c").write_text(source.replace("VERSION", str(version)))
    library = folder / "libpeer.so"
    run(CC, "-O2", "-shared", "-fPIC", "-o", library, folder / "peer.c", "-lm", check=True)
    return library


def test_a_figure_is_the_median_and_the_quartiles_of_what_is_known():
    figure = Figure.of("core", "prediction", "us", [1.0, 2.0, np.nan, 3.0, 4.0, 100.0], target=3.0)
    assert (figure.low, figure.median, figure.high, figure.count) == (2.0, 3.0, 4.0, 5)
    assert figure.met is True
    assert Figure.of("core", "prediction", "us", 3.1, target=3.0).met is False
    assert Figure.of("core", "prediction", "us", 3.1).met is None
    assert (
        Figure.of("core", "prediction", "us", np.nan, target=3.0).met is False
    )  # not known is not met


def test_a_flight_among_more_anchors_hears_its_own():
    flight = make_flight(4.0)
    hall = among(flight, 1000)
    assert len(hall.anchors) == 1000 and hall.tdoa is flight.tdoa
    np.testing.assert_array_equal(hall.anchors.positions[:8], flight.anchors.positions)
    far = np.linalg.norm(hall.anchors.positions[8:, None] - flight.anchors.positions, axis=2)
    assert far.min() > 500.0 and len(np.unique(hall.anchors.positions, axis=0)) == 1000


def test_cpu_time_and_memory_of_a_process():
    code = (
        "import time; a = bytearray(50_000_000)\nwhile time.process_time() < 0.5: "
        "pass\nprint(flush=True); input()"
    )
    with start("-c", code, stdin=subprocess.PIPE) as process:
        process.stdout.readline()
        assert usage.cpu_seconds(process.pid) == pytest.approx(0.5, abs=0.1)
        assert 50e6 < usage.memory(process.pid) < 150e6
        process.stdin.write("\n")


def test_the_core_is_measured_per_event_and_per_sensor():
    """An update is a difference: on a loaded machine below 0 at times."""
    prediction, update = core.per_event(16, "innovation", 1, 2)
    assert prediction.shape == update.shape == (2,) and (prediction > 0.0).all()
    assert np.isfinite([*update, *core.per_sensor("pressure", 2)]).all()


def test_latency_is_that_of_the_first_odometry_that_contains_a_tdoa():
    ms = 1_000_000
    stamps = np.array([0, 10, 12, 20, 30, 90]) * ms
    sent = 1000 * ms + stamps
    # stamps in order of arrival; the third came late
    of = np.array([5, 15, 10, 30]) * ms
    arrivals = 1000 * ms + np.array([8, 18, 19, 37]) * ms
    found = source.latencies(sent, stamps, arrivals, of)
    # before the first arrival: unknown; 10 and 12 are in 15; 20 and 30 in 30; 90 in none
    np.testing.assert_allclose(found, [np.nan, 0.008, 0.006, 0.017, 0.007, np.nan], atol=1e-12)
    assert np.isnan(
        source.latencies(sent, stamps, np.empty(0, np.int64), np.empty(0, np.int64))
    ).all()


def test_ready_is_read_from_the_log():
    log = (
        "[INFO] [17.5] [tag1.ekf_node]: loading\nnot ready\n[INFO] [18.25] [tag1.ekf_node]: ready\n"
    )
    assert nodes.ready_at("ekf_node", log) == ["18.25"]
    assert not nodes.ready_at("ekf_node", log[:-30]) and not nodes.ready_at(
        "localization_node", log
    )


def test_bad_usage(tmp_path, capsys):
    options = ["bench", "--only", "offline", "--model", str(tmp_path / "no.onnx")]
    assert main([*options, "--out", str(tmp_path)]) == 2
    assert "no.onnx does not exist" in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_run_of_the_real_nodes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(recordings, "SECONDS", 10.0)
    report = tmp_path / "bench.json"
    before = dict(os.environ)
    only = ["core", "offline", "nodes", "replay"]
    options = ["--json", str(report), "--out", str(tmp_path / "out")]
    assert main(["bench", "--quick", "--only", *only, *options]) == 0
    assert dict(os.environ) == before
    told = json.loads(report.read_text())
    assert told["machine"]["cores"] >= 1 and 0.0 <= told["machine"]["others"] <= 1.0
    value = {row["name"]: row["median"] for row in told["figures"]}
    assert None not in value.values()
    printed = capsys.readouterr().out
    assert all(name in printed for name in value)
    if (
        told["machine"]["others"] < OTHERS
    ):  # else they may not get the share of a core that 1400 messages a second take
        assert all(value[f"lost, {what}"] == 0 for what in ("TDOAs", "IMU samples")), value
        assert value["latency p50, TDOA published to odometry arrived"] < 1000.0
    # What must hold however slow the machine is
    assert value["lost at rate 4"] == value["too late at rate 4"] == 0
    assert value["latency p50, TDOA published to odometry arrived"] > 0.0
    assert value["ready after its start, ekf_node"] > 0.1 and value["CPU, all nodes"] > 1.0


@pytest.mark.slow
def test_a_short_soak(capsys, monkeypatch):
    monkeypatch.setattr(soak, "LAPS", 1)
    assert main(["soak", "--minutes", "0.1", "--together"]) == 0
    printed = capsys.readouterr().out
    assert " MB" in printed and int(re.search(r"published: (\d+) TDOAs", printed)[1]) > 2000


@NEEDS_CC
def test_both_are_measured_and_their_ratio(tmp_path):
    """The peer stays where it is. NaN would say that its events were not in order."""
    _, figures = suite.measure((), tmp_path / "out", True, None, Peer(built(tmp_path)))
    assert {figure.section for figure in figures} == {"compiled core beside libpeer.so, 8 anchors"}
    value = {figure.name: figure.median for figure in figures}
    for name in ("prediction", "robust update", "both"):
        of = [value[f"{name}, {who}"] for who in ("ours", "the other's", "ours over the other's")]
        assert np.isfinite(of).all()
    assert value["the other's position at the end, off by"] > 0.1


@NEEDS_CC
def test_libraries_that_are_none(tmp_path):
    with pytest.raises(
        InputError, match="nowhere.so cannot be loaded as a shared library .*; build it anew"
    ):
        Peer(tmp_path / "nowhere.so")
    (tmp_path / "text.so").write_text("no library")
    with pytest.raises(InputError, match="text.so cannot be loaded"):
        Peer(tmp_path / "text.so")
    with pytest.raises(InputError, match="is of version 7 of the interface, this is 1"):
        Peer(built(tmp_path, version=7))
    (tmp_path / "less").mkdir()
    with pytest.raises(InputError, match="does not export tdoa_peer_position; add it"):
        Peer(built(tmp_path / "less", SOURCE.replace("tdoa_peer_position", "position")))


@NEEDS_CC
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
    include = f"-I{ROOT / 'studies/firmware'}"
    source = tmp_path / "inverse.c"
    run(CC, "-shared", "-fPIC", include, "-o", library, source, "-lm", check=True)
    a = np.random.default_rng(1).normal(size=(9, 9)).astype(np.float32)
    out = np.zeros((9, 9), np.float32)
    ctypes.CDLL(str(library)).product(*(ctypes.c_void_p(x.ctypes.data) for x in (a, out)), 9)
    assert np.allclose(out, 2.0 * np.eye(9), atol=1e-4)
