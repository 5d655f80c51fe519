# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pieces of `study bench`, and one quick run of the real thing."""

from dataclasses import replace
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from test_flying_estimates import CC, built, exported

from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.effects.anchor import AnchorDelay

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")
from studies.__main__ import main  # noqa: E402
from studies.bench import core, nodes, peer, recordings, source, suite, usage  # noqa: E402
from studies.bench.figures import Figure  # noqa: E402
from studies.bench.flights import TDOA_RATE, among, make_flight  # noqa: E402
from uwb_tdoa_tools.flying.estimates import (
    CompiledCorrection,
    Peer,  # noqa: E402
)
from uwb_tdoa_tools.flying.world import HALL  # noqa: E402

OTHERS = 0.2  # share of the CPU time used by others, above which real-time playback is not judged


def test_a_figure_is_the_median_and_the_quartiles_of_what_is_known():
    figure = Figure.of("core", "prediction", "us", [1.0, 2.0, np.nan, 3.0, 4.0, 100.0], target=3.0)
    assert (figure.low, figure.median, figure.high, figure.count) == (2.0, 3.0, 4.0, 5)
    assert figure.met is True
    assert Figure.of("core", "prediction", "us", 3.1, target=3.0).met is False
    assert Figure.of("core", "prediction", "us", 3.1).met is None
    assert (
        Figure.of("core", "prediction", "us", np.nan, target=3.0).met is False
    )  # not known is not met


def test_a_flight_of_the_rates_it_is_measured_at():
    flight = make_flight(4.0, anchors=16)
    assert len(flight.anchors) == 16
    assert len(flight.imu) == pytest.approx(4000, abs=1)
    assert len(flight.tdoa) == pytest.approx(4.0 * TDOA_RATE, rel=0.02)
    assert flight.truth.t[-1] < flight.imu.t[0] + 4.0
    assert (np.diff(flight.tdoa.t) >= 0.0).all()


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
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        process.stdout.readline()
        assert usage.cpu_seconds(process.pid) == pytest.approx(0.5, abs=0.1)
        assert 50e6 < usage.memory(process.pid) < 150e6
        process.stdin.write(b"\n")


def test_what_others_use():
    before = usage.used_by_all()
    until = time.process_time() + 0.3
    while time.process_time() < until:
        pass
    shares = usage.used_by_others(before)
    assert set(shares) == {"others", "stolen"} and all(
        0.0 <= share <= 1.0 for share in shares.values()
    )
    ours = usage.used_by_all()[3] - before[3]
    assert ours == pytest.approx(0.3, abs=0.05)
    assert shares["others"] + shares["stolen"] <= 1.0 - 0.8 * ours / (
        usage.used_by_all()[0] - before[0]
    )


@pytest.mark.parametrize("sensor", core.NOISES)
def test_an_sensor_is_measured_beside_the_rest(sensor):
    microseconds = core.per_sensor(sensor, 15)
    assert (
        len(microseconds) == 15 and np.isfinite(microseconds).all()
    )  # a difference: on a loaded machine below 0 at times


@pytest.mark.parametrize("anchors", core.ANCHORS)
def test_the_core_is_measured_per_event(anchors):
    prediction, update = core.per_event(anchors, "innovation", 1, 2)
    assert prediction.shape == update.shape == (2,)
    assert (prediction > 0.0).all() and np.isfinite(
        update
    ).all()  # a difference: on a loaded machine below 0 at times


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
    assert (
        main(
            [
                "bench",
                "--quick",
                "--only",
                *only,
                "--json",
                str(report),
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 0
    )
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


@pytest.mark.skipif(CC is None, reason="no C compiler (cc)")
def test_a_library_gets_the_events_of_a_flight_in_their_order(tmp_path):
    flight, other = make_flight(4.0, start_in_air=True, multipath=False), Peer(built(tmp_path))
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
    other.start(flight.anchors, p, q)
    assert other.run(both) > 0.0
    np.testing.assert_array_equal(other.position(), p)
    other.run(both[::-1].copy())  # events in reverse order are an error
    assert np.isnan(other.position()).all()


@pytest.mark.skipif(CC is None, reason="no C compiler (cc)")
def test_both_are_measured_and_their_ratio(tmp_path):
    _, figures = suite.measure((), tmp_path / "out", True, None, Peer(built(tmp_path)))
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


# A peer whose height is its last TDOA.
HEIGHT = """
#include <stdint.h>
typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } tdoa_peer_event;
static double z;
int32_t tdoa_peer_version(void) { return VERSION; }
void tdoa_peer_start(const double *a, int32_t n, const double *p, const double *q) { z = p[2]; }
void tdoa_peer_run(const tdoa_peer_event *e, int32_t n) {
  for (; n--; e++) if (e->a >= 0) z = e->d;
}
void tdoa_peer_position(double *p) { p[0] = p[1] = 0; p[2] = z; }
void tdoa_peer_state(double *p, double *v, double *q) {
  for (int k = 0; k < 3; k++) p[k] = v[k] = q[k] = 0;
  q[3] = 1;
}
"""


@pytest.mark.skipif(CC is None, reason="no C compiler (cc)")
def test_the_errors_of_a_peer_are_given_with_and_without_a_correction(tmp_path):
    """The peer is 0.5 m off, which the correction takes out of every TDOA."""
    t, n = np.arange(0.0, 5.0, 0.002), 2500
    level = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    truth = Truth(t, np.tile([0.0, 0.0, 2.0], (n, 1)), level)
    a, b = HALL.anchors.ids[:2]
    tdoa = Tdoas(t, np.full(n, a), np.full(n, b), np.full(n, 2.5))
    imu = Imu(t, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)))
    flight = Flight("still", HALL.anchors, tdoa, imu, truth)
    correction = CompiledCorrection(exported(tmp_path / "c", AnchorDelay({str(b): 0.5})))
    library = str(built(tmp_path, HEIGHT))
    figures = {one.name: one.median for one in peer.errors([flight], library, correction)}
    assert figures["still, as it is"] == pytest.approx(0.5, abs=1e-6)
    assert figures["still, corrected"] == pytest.approx(0.0, abs=1e-6)
    assert figures["mean, as it is"] == figures["still, as it is"]
    assert figures["corrected, over as it is: the worst"] == pytest.approx(0.0, abs=1e-5)
    alone = [one.name for one in peer.errors([flight], library, None)]
    assert alone == ["still, as it is", "mean, as it is", "mean after 4 s, as it is"]
    better = replace(flight, tdoa=replace(tdoa, d=np.where(t < peer.START, 2.5, 2.1)))
    *_, whole, after = (one.median for one in peer.errors([better], library, None))
    assert whole > 0.4 and after == pytest.approx(0.1, abs=0.02)
