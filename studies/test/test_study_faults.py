# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of faults over topics: what its changes do to events, how it judges, and one fault
played to real nodes.
"""

from dataclasses import replace
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from nav_msgs.msg import Odometry  # noqa: E402

from studies.__main__ import main  # noqa: E402
from studies.faults import flown, judge  # noqa: E402
from studies.faults.catalogue import FAULTS, STREAMS, Fault  # noqa: E402
from studies.faults.events import Scene, events_of, part_of  # noqa: E402
from studies.faults.flown import BEGIN, FaultyFilter  # noqa: E402
from studies.faults.play import Heard, message_of  # noqa: E402
from uwb_tdoa_bias.common.flight import Imu, Tdoas, Truth  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402
from uwb_tdoa_tools.flying.trial import Task, Trial  # noqa: E402
from uwb_tdoa_tools.flying.vehicle import world_of
from uwb_tdoa_tools.simulation import SimulationConfig, simulate  # noqa: E402

TRUTH = Truth(
    np.array([0.0, 100.0]),
    np.array([[0.0, 0.0, 1.0], [100.0, 0.0, 1.0]]),
    np.array([[0.0, 0.0, 0.0, 1.0]] * 2),
)


@pytest.fixture(scope="module")
def part():
    return part_of(
        simulate(
            SimulationConfig(
                seed=1, duration=60.0, protocol="tdoa3", imu_rate=400.0, truth_rate=100.0
            )
        ),
        40.0,
    )


@pytest.fixture(scope="module")
def few(part):
    """Every twentieth event of all streams: a tenth of a second and more apart."""
    anchors, *rest = events_of(part, STREAMS)
    return [anchors, *rest[::20]]


@pytest.fixture(scope="module")
def texts(few):
    """Return {id of an event: its text} of a few events. Texts of all take most of the time."""
    return {id(event): str(event) for event in few}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_changes_something_while_it_lasts_and_nothing_before(part, few, texts, name):
    fault = FAULTS[name]
    kept = list(texts.values())
    after = fault.change(few, Scene(fault.begin, fault.end, part.truth))
    assert [str(event) for event in few] == kept  # what it was given stays
    assert [event.at for event in after] == sorted(event.at for event in after)
    told = [texts.get(id(event)) or str(event) for event in after]
    assert (told != kept) == (not name.startswith("nothing") and not fault.parameters)
    assert sum(e.at < fault.begin for e in after if e.stream in STREAMS) == sum(
        e.at < fault.begin for e in few if e.stream in STREAMS
    )
    assert fault.seconds < 40.0
    for event in {event.stream: event for event in after}.values():
        if event.stream not in ("kill", "start", "reset", "parameter", "busy"):
            message_of(event)


def heard(
    error=0.0,
    std=0.1,
    yaw=0.0,
    why="",
    status=EstimatorStatus.STATUS_RUNNING,
    shift=0.0,
    until=20.0,
):
    """Heard of a tag that is `error` m off from 4 s on, and what it says."""
    begin, out = 4.0, Heard(begin=1000.0)
    for t in np.arange(0.0, until, 0.02).tolist():
        message = Odometry()
        stamp = 1000.0 + t + (shift if t >= begin else 0.0)
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), int(stamp % 1.0 * 1e9)
        message.pose.pose.position.x, message.pose.pose.position.z = (
            t + (error if t >= begin else 0.0),
            1.0,
        )
        angle = yaw if t >= begin else 0.0
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = (
            math.sin(angle / 2.0),
            math.cos(angle / 2.0),
        )
        message.pose.covariance = np.diag([std**2 / 3.0] * 3 + [0.01] * 3).ravel()
        out.odometry.append((t, message))
    for t in range(20):
        out.status.append((float(t), SimpleNamespace(status=status, why=why if t >= begin else "")))
    return out


FAULT = Fault("", begin=4.0, lasts=6.0, after=10.0)


def verdict(fault=FAULT, **kinds):
    return judge.judged("tdoa: x", fault, heard(**kinds), Scene(fault.begin, fault.end, TRUTH))[
        "verdict"
    ]


def test_wrong_and_certain_is_missed_unless_it_is_said():
    assert verdict() == "ok" and verdict(error=0.9, std=0.01, until=20.0) == "ok"
    lasting = replace(FAULT, lasts=16.0, after=0.0)
    assert verdict(lasting, error=1.5) == "MISS: wrong and certain"
    assert verdict(lasting, error=1.5, std=0.6) == "ok"  # three stated deviations cover it
    assert verdict(lasting, error=1.5, why="a reason") == "ok"
    assert verdict(lasting, error=1.5, status=EstimatorStatus.STATUS_LOST) == "ok"
    assert verdict(lasting, yaw=1.5) == "MISS: yaw wrong and certain"
    assert verdict(error=1.5, why="a reason") == "MISS: not recovered"


def test_odometry_that_stops_is_wrong_once_the_tag_has_gone_on():
    row = judge.judged("velocity: x", FAULT, heard(until=12.0), Scene(4.0, 10.0, TRUTH))
    assert row["gap"] == pytest.approx(8.0, abs=0.1) and row["recovered"] == math.inf
    assert row["verdict"] == "MISS: wrong and certain, not recovered, a sensor disturbs"


def test_stamps_of_another_clock_are_judged_by_arrival():
    assert verdict(shift=5.0) == "ok" and verdict(shift=-5.0) == "ok"
    assert (
        verdict(replace(FAULT, lasts=16.0, after=0.0), shift=0.9, std=0.01) == "ok"
    )  # below 1 s the stamp counts: 0.9 m off


@pytest.mark.slow
def test_one_fault_over_topics(tmp_path, capsys, monkeypatch):
    name, file = "tdoa: silent 1 s", tmp_path / "rows.json"
    monkeypatch.setitem(FAULTS, name, replace(FAULTS[name], begin=8.0, after=6.0))
    options = ["--data", str(tmp_path), "--json", str(file)]
    assert main(["faults", "--only", f"^{name}$", *options]) == 0
    (row,) = json.loads(file.read_text())
    assert row["rmse"] < 0.5 and row["wrong"] == 0.0 and row["verdict"] == "ok"
    assert "1 of 1 ok" in capsys.readouterr().out


def taken(name, t):
    """The streams of a tenth of a second from t, s, on: as they are, and as a filter with a fault
    takes them.
    """
    times, rng = t + np.arange(20) / 200.0, np.random.default_rng(0)
    ids = rng.integers(0, 4, 20), rng.integers(4, 8, 20)
    imu = Imu(times, np.zeros((20, 3)), np.tile([0.0, 0.0, 9.81], (20, 1)))
    streams = {"imu": imu, "tdoa": Tdoas(times, *ids, rng.normal(size=20))}
    source = FaultyFilter(Trial(Task(world_of("hall"), 1)).source, flown.FAULTS[name])
    source._now = t
    return streams, {stream: source._changed(stream, part) for stream, part in streams.items()}


@pytest.mark.parametrize(
    "name",
    [name for name, fault in flown.FAULTS.items() if name != "nothing" and not fault.sensors],
)
def test_a_fault_in_the_loop_changes_its_stream_while_it_lasts_and_no_other(name):
    (before, same), (during_, changed) = taken(name, BEGIN - 0.5), taken(name, BEGIN + 0.1)
    for stream in ("imu", "tdoa"):
        assert same[stream] is before[stream]
        kept = changed[stream] is during_[stream]
        assert kept == (stream != flown.FAULTS[name].stream)


@pytest.mark.slow
def test_a_vehicle_sinks_where_the_status_says_so():
    sinks = flown.flown(("tdoa: two ids exchanged", 5002))
    assert not sinks["landed"] and sinks["safe"]
    assert BEGIN < sinks["reported_lost"] < BEGIN + 2.0
    assert "two anchors are exchanged" in sinks["said"]
