# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""/diagnostics of ekf_node, and the flyable volume in them."""

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from collections import Counter  # noqa: E402
from types import SimpleNamespace  # noqa: E402

import numpy as np  # noqa: E402

from uwb_tdoa_bias.common.anchors import (
    Anchors,  # noqa: E402
    FlyableVolume,  # noqa: E402
)
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.monitoring import health  # noqa: E402
from uwb_tdoa_ekf.monitoring.finding import Finding  # noqa: E402
from uwb_tdoa_ekf.monitoring.health import ERROR, OK, WARN  # noqa: E402
from uwb_tdoa_ekf.monitoring.status import flyability  # noqa: E402

# --- health ---
# The node looks at its counts five times a second. Here, each report is a look, once a second.
STARTING, RUNNING = (
    SimpleNamespace(running=False, lost=None),
    SimpleNamespace(running=True, side_unknown=None),
)


class Judge(health.Health):
    """Health with time.monotonic under the control of the test."""

    def __init__(self, monkeypatch, config=FilterConfig(), volume=None):
        self.wall = 1000.0
        monkeypatch.setattr("time.monotonic", lambda: self.wall)
        super().__init__(config, 0.25, volume, lambda: self.wall)

    def second(self, estimator, imu=1000, tdoa=400, wrong=(None, (), ()), **counts):
        """Let one second pass with the given numbers of messages; return (level, text, values).

        wrong : (refused input, wiring, findings).
        """
        self.wall += 1.0
        self.received.update(imu=imu, tdoa=tdoa)
        return self.report(wrong[0], estimator, Counter(counts), *wrong[1:])


@pytest.fixture
def judge(monkeypatch):
    return Judge(monkeypatch)


LOST = SimpleNamespace(running=False, lost="the tag is lost")
NO_SIDE = SimpleNamespace(running=True, side_unknown="set tag_side to below or above")


def test_a_dead_sensor_is_named_beside_wrong_wiring(judge):
    wiring = ("2 publish on odometry",)
    for heard in range(1, 8):
        judge.received["height"] = 25 * min(heard, 3)
        level, text, _ = judge.second(NO_SIDE, wrong=(None, wiring, ()), used=400)
    assert level == WARN and wiring[0] in text and "no messages on height any more" in text


@pytest.mark.parametrize(
    ("estimator", "options", "level", "words"),
    [
        (None, {}, ERROR, "uwb/anchors"),
        (STARTING, {"wrong": ("anchor 3 is nowhere", (), ())}, ERROR, "anchor 3 is nowhere"),
        (RUNNING, {"tdoa": 0}, ERROR, "uwb/tdoa_corrected"),
        (RUNNING, {"imu": 0}, ERROR, "imu/data"),
        (LOST, {}, WARN, "the tag is lost"),
        (NO_SIDE, {"used": 400}, WARN, "set tag_side to below or above"),
        (RUNNING, {"used": 400}, OK, "running"),
    ],
)
def test_says_what_is_missing(judge, estimator, options, level, words):
    said = judge.second(estimator, **options)
    assert said[0] == level and words in said[1]
    assert said[2]["state"] == ("lost" if estimator is LOST else said[2]["state"])


def test_bias_node_that_runs_and_waits_is_not_to_be_started(judge):
    assert "start bias_node" in judge.second(STARTING, tdoa=0)[1]
    judge.corrects = True
    level, text, _ = judge.second(STARTING, tdoa=0)
    assert level == ERROR and "though bias_node runs" in text and "start" not in text


def test_without_use_of_an_imu_none_is_missing(monkeypatch):
    judge = Judge(monkeypatch, FilterConfig(use_imu=False))
    assert judge.second(RUNNING, imu=0)[0] == OK


def test_a_start_that_takes_long_is_a_warning(judge):
    levels = [judge.second(STARTING)[0] for _ in range(8)]
    assert levels == [OK] * 6 + [WARN] * 2
    judge.second(STARTING, tdoa=0)  # without data no start is possible
    assert judge.second(STARTING)[0] == OK


@pytest.mark.parametrize("name", ["late", "invalid"])
def test_most_tdoas_lost_for_one_reason_is_a_warning(judge, name):
    for k in range(3):
        assert judge.second(RUNNING, used=400 * (k + 1))[:2] == (OK, "running")
    assert judge.second(RUNNING, used=1400, **{name: 199})[0] == OK
    level, text, _ = judge.second(RUNNING, used=1500, **{name: 1500})
    assert level == WARN and name in text and "load" not in text
    for _ in range(2):
        last = judge.second(RUNNING, used=9500, **{name: 1500})
    assert last[0] == OK  # the old counts have no effect any longer


def test_most_tdoas_rejected_for_seconds_is_a_warning(judge):
    said = [
        judge.second(RUNNING, used=400 * min(k, 10) + 1, rejected=400 * max(k - 10, 0))[:2]
        for k in range(20)
    ]
    assert [level for level, _ in said[:11]] == [OK] * 11
    assert said[-1][0] == WARN and "contradict" in said[-1][1]


def test_rates_and_age(judge):
    values = judge.second(STARTING)[2]
    assert (values["state"], values["age of last odometry"]) == ("starting", "none yet")
    judge.last_odometry = judge.wall
    values = judge.second(RUNNING, imu=500, tdoa=20)[2]
    assert values == {
        "state": "running",
        "age of last odometry": "1.000 s",
        "odometry behind the clock": "unknown",
        "IMU rate": "500.0 Hz",
        "TDOA rate": "20.0 Hz",
        "wrong with the streams": "nothing",
    }


@pytest.mark.parametrize(
    ("behind", "level", "words", "value"),
    [
        (-0.5, OK, "running", "-0.500 s"),
        (0.9, OK, "running", "0.900 s"),
        (1.1, WARN, "too slow", "1.100 s"),
        (59.0, WARN, "too slow", "59.000 s"),
        (3600.0, OK, "running", "not comparable: the stamps are of another time"),
        (-9.5, WARN, "9.5 s ahead of the clock", "-9.500 s"),
    ],
)
def test_odometry_that_is_behind_or_ahead_of_the_clock_is_a_warning(
    judge, behind, level, words, value
):
    judge.behind = behind
    said, text, values = judge.second(RUNNING, used=400)
    assert said == level and words in text
    assert values["odometry behind the clock"].startswith(value)
    for k in range(3):
        text = judge.second(RUNNING, used=400, invalid=400 * (k + 1))[1]
    assert "invalid" in text  # the more important trouble comes first


def test_a_tag_outside_of_the_flyable_volume_is_a_warning(monkeypatch):
    judge = Judge(monkeypatch, volume=volume())
    running = SimpleNamespace(running=True, anchors=ANCHORS, side_unknown=None)
    assert judge.second(running)[0] == OK  # no odometry yet
    judge.last_position = np.array([0.5, 0.5, 0.5]), COVARIANCE
    level, text, values = judge.second(running)
    assert (level, text, values["flyable"], values["efficiency"]) == (OK, "running", "yes", "0.25")
    judge.last_position = np.array([1.5, 0.5, 0.5]), COVARIANCE
    level, text, values = judge.second(running)
    assert level == WARN and "outside of the flyable volume" in text and values["flyable"] == "no"
    for k in range(3):
        # The more important trouble comes first.
        level, text, values = judge.second(running, used=1, invalid=99 * (k + 1))
    assert level == WARN and "invalid" in text and values["flyable"] == "no"


def test_a_sensor_that_stops_is_told_and_so_is_one_that_contradicts(judge):
    counts = Counter(used=1)
    for _ in range(3):
        judge.received["height"] += 25
        counts.update(used=400, height_used=25)
        assert judge.second(RUNNING, **counts)[:2] == (OK, "running")
    said = [judge.second(RUNNING, **counts) for _ in range(3)]
    assert said[-1][0] == WARN and "no messages on height any more" in said[-1][1]
    # For one second, a good sensor may contradict, too.
    for expected in (OK, WARN):
        judge.received["height"] += 25
        counts.update(used=400, height_rejected=25)
        level, text, _ = judge.second(RUNNING, **counts)
        assert level == expected
    assert "more than half of the messages on height" in text


def test_what_is_wrong_with_the_streams_is_said_before_what_comes_of_it(judge):
    units = Finding(
        "imu_force_unit", "error", "the accelerometer is in g", "it is 1.0", "multiply\n  it", 9.81
    )
    slow = Finding("rate", "warning", "imu/data is slow", "20 Hz", "raise it", 20.0)
    publishers = "2 publish on imu/data (/a, /b): stop all but one"

    def said(estimator, wiring=(), findings=(), **counts):
        return judge.second(estimator, wrong=(None, wiring, findings), **counts)

    level, text, values = said(STARTING, [publishers], [units, slow])
    first = "the accelerometer is in g (it is 1.0): multiply it"
    assert (level, text) == (ERROR, f"{first} | {publishers} | imu/data is slow (20 Hz): raise it")
    assert said(STARTING, [publishers, "one", "two"], [units, slow])[1].endswith(
        "| one | and 2 more"
    )
    assert (
        publishers in values["wrong with the streams"]
        and "imu/data is slow" in values["wrong with the streams"]
    )
    assert (values["found imu_force_unit"], values["found rate"]) == ("9.81", "20")
    assert said(RUNNING, [publishers], [slow], used=400)[:2] == (
        WARN,
        f"{publishers} | imu/data is slow (20 Hz): raise it",
    )
    assert said(RUNNING, [], [slow], used=800)[:2] == (WARN, "imu/data is slow (20 Hz): raise it")
    level, text, values = said(RUNNING, used=1200)
    assert (level, text, values["wrong with the streams"]) == (OK, "running", "nothing")


# --- volume ---
ANCHORS = Anchors.from_positions([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3]])
COVARIANCE = np.diag([0.01, 0.03, 0.12])


def volume(planar=False):
    cells = np.ones((2, 1, 1), bool)
    cells[1] = False
    bound = np.array([0.2, np.inf]).reshape(2, 1, 1)
    return FlyableVolume(
        [0, 0, 0], [1, 1, 1], cells, bound, ANCHORS.ids, ANCHORS.positions, planar=planar
    )


@pytest.mark.parametrize(
    ("planar", "claimed", "efficiency"), [(False, "0.400 m", "0.25"), (True, "0.200 m", "1")]
)
def test_the_covariance_is_compared_with_the_bound(planar, claimed, efficiency):
    trouble, values = flyability(volume(planar), ANCHORS, np.array([0.5, 0.5, 0.5]), COVARIANCE)
    assert trouble is None and values == {
        "flyable": "yes",
        "bound of one round": "0.200 m",
        "claimed by the filter": claimed,
        "efficiency": efficiency,
    }


@pytest.mark.parametrize("p", [[1.5, 0.5, 0.5], [0.5, 0.5, 9.0], [np.nan, 0.5, 0.5]])
def test_outside_is_told(p):
    trouble, values = flyability(volume(), ANCHORS, np.array(p), COVARIANCE)
    assert "outside of the flyable volume" in trouble and values == {"flyable": "no"}


def test_a_volume_of_other_anchors_is_told():
    moved = Anchors.from_positions(ANCHORS.positions + 0.5)
    trouble, values = flyability(volume(), moved, np.array([0.5, 0.5, 0.5]), COVARIANCE)
    assert "other anchors" in trouble and values == {"flyable": "unknown"}


def test_without_a_volume_nothing_is_said():
    assert flyability(None, ANCHORS, np.zeros(3), COVARIANCE) == (None, {})
