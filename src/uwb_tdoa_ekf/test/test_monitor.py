import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_ekf.core.verdicts import INVALID, USED
from uwb_tdoa_ekf.estimator import Odometry, Residuals
from uwb_tdoa_ekf.monitoring.monitor import Monitor

ANCHORS = Anchors.from_positions(np.random.default_rng(0).uniform(-4, 4, (6, 3)), ids=[3, 5, 7, 9, 11, 13])
IDS = ANCHORS.ids


def watch(delays_at, gyro=lambda t: 0.0, noise=0.06, seconds=60, seed=1, moving=True):
    """Alarms at the end of a flight in which the anchors have delays_at(t) (6,) m; 100 TDOAs a second in a ring."""
    rng, monitor, seen = np.random.default_rng(seed), Monitor(ANCHORS), []
    for second in range(seconds):
        t = second + np.arange(100) / 100.0
        a = np.arange(100) % 6
        b = (a + 1) % 6
        delays = np.array([delays_at(x) for x in t])
        rows = np.arange(100)
        innovation = delays[rows, b] - delays[rows, a] + noise * rng.standard_normal(100)
        verdict = np.full(100, USED)
        monitor.add(Residuals(t, IDS[a], IDS[b], innovation, np.full(100, noise**2), np.ones(100), verdict))
        zeros, v = np.zeros((1, 3)), np.array([[1.0 * moving, 0.0, 0.0]])
        bias = np.array([[0.0, 0.0, gyro(t[-1])]])
        monitor.add_odometry(Odometry(t[-1:], zeros, v, np.array([[0, 0, 0, 1.0]]), zeros, bias, np.zeros((1, 9, 9))))
        seen += monitor.alarms
    return seen, monitor.alarms


def only(row, size):
    return size * (np.arange(6) == row)


@pytest.mark.parametrize("seed", range(3))
def test_is_silent_while_nothing_changes(seed):
    steady = np.random.default_rng(seed).normal(0.0, 0.1, 6)  # delays that were there from the start are no change
    seen, _ = watch(lambda t: steady, seed=seed)
    assert seen == []


def test_names_the_anchor_that_becomes_late():
    _, alarms = watch(lambda t: only(2, 0.5 * (t > 30.0)))
    assert len(alarms) == 1 and alarms[0].startswith("anchor 7:") and "NLOS" in alarms[0]


def test_names_the_anchor_that_became_early():
    _, alarms = watch(lambda t: only(4, -0.5 * (t > 30.0)))
    assert alarms[0].startswith("anchor 11:") and "NLOS" not in alarms[0]


def test_tells_a_drift_from_a_step():
    _, alarms = watch(lambda t: only(1, 0.02 * max(t - 20.0, 0.0)))
    slope = float(alarms[0].partition("drifts (")[2].split()[0])
    assert alarms[0].startswith("anchor 5:") and slope == pytest.approx(0.02, rel=0.1)


def test_an_alarm_ends_with_its_cause():
    seen, alarms = watch(lambda t: only(0, 0.5 * (25.0 < t < 35.0)))
    assert seen and all(alarm.startswith("anchor 3:") for alarm in seen) and alarms == []


def test_names_the_axis_whose_bias_moves():
    _, alarms = watch(lambda t: np.zeros(6), gyro=lambda t: 0.05 * (t > 40.0))
    assert alarms == ["gyroscope z: bias moved by +0.050 rad/s since the start of the flight"]


def test_what_happens_on_the_floor_is_not_judged():
    seen, _ = watch(lambda t: only(2, 0.5 * (t > 30.0)), moving=False)
    assert seen == []


def test_what_did_not_reach_the_filter_does_not_count():
    monitor = Monitor(ANCHORS)
    one = np.ones(1)
    monitor.add(Residuals(one, 3 * one, 99 * one, np.nan * one, np.nan * one, 0 * one, np.full(1, INVALID)))
    assert monitor.alarms == []
