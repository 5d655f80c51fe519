# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings whose clock is set, restarts or wraps.

They are read on one continuous time, `check` names the jump, and memory does not grow.
"""

from dataclasses import replace
import os
import resource

from known_effects import sparse_flight
import numpy as np
from programs import python
import pytest
from rosbags.rosbag2 import Writer

from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.bags.bag import read_bag, typestore
from uwb_tdoa_tools.bags.files import PLUGINS
from uwb_tdoa_tools.bags.messages import STREAMS
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import read_recording
from uwb_tdoa_tools.readers.inputs import Reading

WHOLE = sparse_flight(100, 24.0)
SLOW = Imu(*(column[::2] for column in vars(WHOLE.imu).values()))  # 100 Hz
FLIGHT = replace(WHOLE, imu=SLOW)
MIDDLE = 12.0  # s
YEARS = 55 * 365.25 * 86400.0
WRAP = 2**32 * 1e-6
BASE = 1e8  # s; no stamp falls below 0
KINDS = {
    "restart": ("clock_restart", lambda t: np.where(t < MIDDLE, t, t - MIDDLE)),
    "years": ("clock_set", lambda t: np.where(t < MIDDLE, t, t + YEARS)),
    "days": ("clock_set", lambda t: np.where(t < MIDDLE, t, t + 10 * 86400.0)),
    "wrap": ("clock_wrap", lambda t: np.where(t < MIDDLE, t, t - WRAP) + WRAP),
}


def bag(path, clock, arrivals=True, imu=lambda t: t):
    """Write FLIGHT as recorded with a clock(t), the messages in their order.

    arrivals : log times come from a correct clock; otherwise they equal the stamps
    """
    store, rows = typestore(), []
    tdoa, samples = FLIGHT.tdoa, FLIGHT.imu
    for topic, kind, true, messages in (
        (
            "/uwb/tdoa",
            "uwb_tdoa_msgs/msg/Tdoa",
            tdoa.t,
            STREAMS["tdoa"].messages(replace(tdoa, t=BASE + clock(tdoa.t)), "base_link", store),
        ),
        (
            "/imu/data",
            "sensor_msgs/msg/Imu",
            samples.t,
            STREAMS["imu"].messages(
                replace(samples, t=BASE + clock(imu(samples.t))), "base_link", store
            ),
        ),
    ):
        for at, (stamp, message) in zip(true, messages):
            rows.append(
                (
                    at,
                    round(1e9 * (BASE + 1e5 + at)) if arrivals else stamp,
                    topic,
                    kind,
                    store.serialize_cdr(message, kind),
                )
            )
    with Writer(path, version=Writer.VERSION_LATEST, storage_plugin=PLUGINS["mcap"]) as writer:
        connections = {}
        for _, received, topic, kind, data in sorted(rows, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, data)
    return path


@pytest.mark.parametrize("arrivals", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", KINDS)
def test_a_bag_is_read_on_one_time_and_check_names_the_jump(tmp_path, name, arrivals):
    rule, clock = KINDS[name]
    path = bag(tmp_path / "bag", clock, arrivals)
    flight = read_bag(path, anchors=FLIGHT.anchors)
    for stream, true in ((flight.tdoa, FLIGHT.tdoa), (flight.imu, FLIGHT.imu)):
        assert len(stream) == len(true)
        assert np.ptp(stream.t - true.t) < 0.02
    np.testing.assert_array_equal(flight.tdoa.d, FLIGHT.tdoa.d)  # in the original order
    assert len(flight.restarts) == (name == "restart")
    (survey,) = [tmp_path / "anchors.yaml"]
    FLIGHT.anchors.to_yaml(survey)
    report = check(read_recording(Reading(), path, survey))
    assert [finding.rule for finding in report.findings if finding.severity == "error"] == [rule]
    assert report.faulty
    (finding,) = (finding for finding in report.findings if finding.rule == rule)
    assert "at message" in finding.cause and "shifted by" in finding.evidence


def test_the_filter_restarts_with_the_clock():
    restart = float(FLIGHT.tdoa.t[len(FLIGHT.tdoa) // 2])
    run, whole = run_offline(replace(FLIGHT, restarts=(restart,))), run_offline(FLIGHT)
    before = whole.odometry.t < restart
    np.testing.assert_array_equal(run.odometry.p[: before.sum()], whole.odometry.p[before])
    after = run.odometry.t[run.odometry.t >= restart]
    assert after[0] > restart + 0.05  # the filter initializes again
    assert len(run.residuals) == len(FLIGHT.tdoa) and (run.residuals.t == FLIGHT.tdoa.t).all()
    late = run.odometry.t > restart + 6.0
    there = np.searchsorted(whole.odometry.t, run.odometry.t[late])
    assert np.linalg.norm(run.odometry.p[late] - whole.odometry.p[there], axis=1).max() < 0.5


def test_restarts_outside_of_the_flight_change_nothing():
    run, whole = run_offline(replace(FLIGHT, restarts=(-5.0, 1e6))), run_offline(FLIGHT)
    np.testing.assert_array_equal(run.odometry.p, whole.odometry.p)


@pytest.mark.slow
@pytest.mark.parametrize("arrivals", [True, False])
@pytest.mark.parametrize("ahead", [-1e5, -50.0, 10.0, 1e5])
def test_an_imu_of_another_time_is_named(tmp_path, capsys, ahead, arrivals):
    path = bag(tmp_path / "bag", lambda t: t, arrivals=arrivals, imu=lambda t: t + ahead)
    FLIGHT.anchors.to_yaml(tmp_path / "anchors.yaml")
    report = check(read_recording(Reading(), path, tmp_path / "anchors.yaml"))
    (finding,) = (finding for finding in report.findings if finding.rule == "stamps_apart")
    assert finding.severity == "error" and finding.value == pytest.approx(ahead, abs=0.1)
    Reading().read((path, tmp_path / "anchors.yaml"))
    assert "none of its" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sensor_of_another_time_is_named_with_its_count():
    aided = sparse_flight(101, 20.0, aided=True)
    from uwb_tdoa_tools.checking.recording import of_flight

    moved = replace(aided, height=replace(aided.height, t=aided.height.t + 1e4))
    (finding,) = (
        finding for finding in check(of_flight(moved)).findings if finding.rule == "sensor_apart"
    )
    assert (
        finding.severity == "error"
        and str(len(aided.height.t)) in finding.evidence
        and "10000" in finding.cause
    )
    assert not [
        finding for finding in check(of_flight(aided)).findings if finding.rule == "sensor_apart"
    ]


PROGRAM = """
import sys
from dataclasses import replace
import numpy as np
from known_effects import sparse_flight
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import of_flight
flight = sparse_flight(100, 24.0)
for by in map(float, sys.argv[1:]):
    moved = lambda part: replace(part, t=np.where(part.t < 12.0, part.t, part.t + by))
    report = check(of_flight(replace(flight, tdoa=moved(flight.tdoa), imu=moved(flight.imu), truth=moved(flight.truth))))
    assert report.findings, by
"""


@pytest.mark.slow
def test_a_gap_of_any_length_takes_no_more_memory():
    """The streams are not put on a continuous time first, as with a pause of days."""
    from pathlib import Path

    def bound():
        # of addresses: libraries reserve many
        resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))

    there = {
        name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"
    }  # other tests set it
    done = python(
        "-c",
        PROGRAM,
        10 * 86400.0,
        YEARS,
        cwd=Path(__file__).parent,
        env=there,
        preexec_fn=bound,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
