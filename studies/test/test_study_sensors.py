# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of docs/notebook/auxiliary_sensors.md put into simulated flights: ekf_node
names the sensor.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from known_effects import clean_flight  # noqa: E402

from studies import sensors  # noqa: E402
from studies.sensors import FAULTS, ONSET, bounds, of_four, only  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.monitoring.health import OK, WARN, Health  # noqa: E402
from uwb_tdoa_ekf.offline import run_offline  # noqa: E402
from uwb_tdoa_ekf.results import VERDICTS  # noqa: E402
from uwb_tdoa_tools.scoring.metrics import scored_phase  # noqa: E402
from uwb_tdoa_tools.simulation import SimulationConfig, simulate  # noqa: E402

# What the filter copes with is no reason to warn: steps, single wrong ranges, and a barometer that
# drifts.
COPED_WITH = (
    "height: steps of 0.3 to 0.8 m",
    "height: one in five 1 m too long",
    "pressure: drifts 1 m per minute",
)
RUNNING = type("Estimator", (), {"running": True, "anchors": None, "side_unknown": None})


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 40.0, aided=True)


def said(flight, monkeypatch):
    """[(level, text)] of ekf_node's status, second by second of a Flight."""
    run, judge, out = run_offline(flight), Health(FilterConfig(), 0.25), []
    begin, end = flight.imu.t[[0, -1]]
    for now in np.arange(begin + 1.0, end):
        monkeypatch.setattr("time.monotonic", lambda: now)
        judge.received["imu"], judge.received["tdoa"] = (
            int(np.sum(stream.t < now)) for stream in (flight.imu, flight.tdoa)
        )
        counts = Counter()
        for name, outcome in run.sensors.items():
            heard = getattr(flight, name).t < now
            judge.received[name] = int(np.sum(heard))
            counts.update(
                {
                    f"{name}_{word}": int(np.sum(outcome["verdict"][heard] == v))
                    for v, word in VERDICTS.items()
                }
            )
        out.append(judge.report(None, RUNNING, counts)[:2])
    return out


def test_sound_sensors_are_not_complained_of(flight, monkeypatch):
    assert set(said(flight, monkeypatch)) == {(OK, "running")}


@pytest.mark.parametrize("name", [name for name in FAULTS if name not in COPED_WITH])
def test_a_faulty_sensor_is_named(flight, monkeypatch, name):
    sensor, from_start, change = FAULTS[name]
    begin = scored_phase(flight.truth)[1] + (0.0 if from_start else ONSET)
    sound = only(flight, (sensor,))
    told = [
        text
        for level, text in said(
            replace(sound, **{sensor: change(getattr(sound, sensor), begin)}), monkeypatch
        )
        if level == WARN
    ]
    assert told and all(
        text.startswith(f"more than half of the messages on {sensor} ") for text in told
    )


@pytest.mark.parametrize("name", COPED_WITH)
def test_what_the_filter_copes_with_leaves_the_estimate_sound(flight, name):
    sensor, from_start, change = FAULTS[name]
    sound = only(flight, (sensor,))
    begin = scored_phase(flight.truth)[1] + (0.0 if from_start else ONSET)
    run = run_offline(replace(sound, **{sensor: change(getattr(sound, sensor), begin)}))
    inside = (run.odometry.t > begin + 3.0) & (run.odometry.t < scored_phase(flight.truth)[2])
    true = np.interp(run.odometry.t[inside], flight.truth.t, flight.truth.p[:, 2])
    assert np.sqrt(np.mean((run.odometry.p[inside, 2] - true) ** 2)) < 0.05


def test_four_anchors_keep_their_tdoas_and_a_height_makes_their_bound_smaller(flight):
    few = of_four(flight)
    assert few.anchors.ids.tolist() == flight.anchors.ids[:4].tolist()
    assert set(few.tdoa.a) | set(few.tdoa.b) == set(few.anchors.ids.tolist()) and 0 < len(
        few.tdoa
    ) < len(flight.tdoa)
    plain, aided, all_of_them = bounds([few], np.inf), bounds([few], 0.02), bounds([flight], np.inf)
    assert (aided < plain).all() and aided[2] < 0.02 and all_of_them[3] < plain[3]
    assert plain[3] == pytest.approx(np.linalg.norm(plain[:3]))


def test_the_table_of_worth_tells_the_floor_too(capsys, monkeypatch):
    monkeypatch.setattr(sensors, "SETS", ((), ("height",)))
    hop = simulate(
        SimulationConfig(
            seed=1,
            duration=14.0,
            floor_time=1.5,
            imu_rate=200.0,
            truth_rate=50.0,
            height_noise=0.02,
        )
    )
    sensors._worth([hop], FilterConfig(), sensors.SETS)
    head, rule, *rows = capsys.readouterr().out.splitlines()
    assert head.endswith("| at rest before, 2 s | first 3 s | last 3 s | at rest after |")
    assert len({row.count("|") for row in (head, rule, *rows)}) == 1
    for row in rows[:2]:
        assert all(0.0 < float(cell) < 1.0 for cell in row.strip("| ").split(" | ")[-4:])
