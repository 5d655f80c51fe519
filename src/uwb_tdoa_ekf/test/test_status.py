# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`status`: whether the estimate is safe for flight, and the fate of the measurements."""

from collections import Counter
import math
from types import SimpleNamespace

from flights import fly
from hypothesis import given, strategies as st
import numpy as np
import pytest

from uwb_tdoa_ekf.monitoring.finding import ERROR, WARNING, Finding
from uwb_tdoa_ekf.monitoring.health import off_the_clock
from uwb_tdoa_ekf.monitoring.status import (
    FAULT,
    LOST,
    RUNNING,
    STARTING,
    WAITING,
    Status,
    Use,
    status_of,
    with_fault_covariance,
    yaw_in_words,
)
from uwb_tdoa_ekf.offline import run_offline

# --- status ---
STARTS = SimpleNamespace(
    running=False, lost=None, without_imu=None, yaw_doubts=0, unsure=None, restarted=None
)
RUNS = SimpleNamespace(running=True, lost=None, without_imu=None, yaw_doubts=0, unsure=None)
IS_LOST = SimpleNamespace(
    running=False, lost="the tag is lost", without_imu=None, yaw_doubts=0, unsure=None
)
KNOWN, UNKNOWN = math.radians(6.0), math.radians(100.0)
LEFT_OUT = Finding(
    "imu_left_out", ERROR, "what the accelerometer reads is not gravity", "1 m/s^2", "in m/s^2", 1.0
)
GOES_WITHOUT = SimpleNamespace(
    running=True, lost=None, without_imu=LEFT_OUT, yaw_doubts=0, unsure=None
)
UNSURE = SimpleNamespace(
    running=True, lost=None, without_imu=None, yaw_doubts=0, unsure="TDOAs agree on another place"
)
DOUBTS = SimpleNamespace(running=True, lost=None, without_imu=None, yaw_doubts=1, unsure=None)


def found(rule, severity=ERROR, value=1.0):
    return Finding(rule, severity, f"cause of {rule}", "evidence", "remedy", value)


def used(
    seconds=8.0, running=True, tdoa="used", imu=True, received=True, silent=0.0, velocity=False
):
    """Return a Use that looked five times a second for some seconds.

    silent : time without messages at the end, in s.
    """
    use, counts, arrived = Use(0.25), Counter(), Counter()
    for k in range(int(5 * seconds)):
        if k < 5 * (seconds - silent):
            arrived["tdoa"] += 80 if received else 0
            counts[tdoa] += 80 if received else 0
            counts["imu_used"] += 200 if imu else 0
            counts["velocity_used"] += 10 if velocity else 0
        use.update(1000.0 + 0.2 * k, arrived, counts, running)
    return use


NEVER = used(received=False, imu=False)


@pytest.mark.parametrize(
    ("estimator", "yaw_std", "use", "status", "yaw_known", "why"),
    [
        (None, math.nan, NEVER, WAITING, False, "no anchors yet"),
        (STARTS, math.nan, NEVER, WAITING, False, "no TDOAs"),
        (STARTS, math.nan, used(running=False, tdoa="startup"), STARTING, False, "start position"),
        (RUNS, UNKNOWN, used(), RUNNING, False, "yaw is not known"),
        (RUNS, KNOWN, used(), RUNNING, True, ""),
        (RUNS, KNOWN, used(received=False), RUNNING, True, "IMU alone"),
        (
            RUNS,
            KNOWN,
            used(received=False, imu=False),
            RUNNING,
            True,
            "on as the tag moved last, without the IMU",
        ),
        (RUNS, UNKNOWN, used(received=False), RUNNING, False, "IMU alone"),
        (
            RUNS,
            KNOWN,
            used(received=False, velocity=True),
            RUNNING,
            True,
            "by the IMU and the velocities alone",
        ),
        (
            RUNS,
            KNOWN,
            used(received=False, imu=False, velocity=True),
            RUNNING,
            True,
            "by the velocities alone",
        ),
        (
            GOES_WITHOUT,
            KNOWN,
            used(received=False, velocity=True),
            RUNNING,
            True,
            "by the velocities alone",
        ),
        (RUNS, UNKNOWN, used(imu=False), RUNNING, False, "neither an IMU nor velocities"),
        (
            RUNS,
            UNKNOWN,
            used(imu=False, velocity=True),
            RUNNING,
            False,
            "is once the tag has moved",
        ),
        (UNSURE, KNOWN, used(), RUNNING, True, "another place"),
        (UNSURE, KNOWN, used(tdoa="rejected"), RUNNING, True, "another place"),
        (RUNS, KNOWN, used(tdoa="late"), RUNNING, True, "-p lag"),
        (RUNS, KNOWN, used(tdoa="invalid"), RUNNING, True, "are invalid"),
        (RUNS, KNOWN, used(tdoa="rejected"), RUNNING, True, "contradict the filter"),
        (IS_LOST, math.nan, NEVER, LOST, False, "the tag is lost"),
        (IS_LOST, math.nan, used(), LOST, False, "the tag is lost"),
        (RUNS, math.nan, used(), RUNNING, False, "yaw is not known"),
        (DOUBTS, UNKNOWN, used(), RUNNING, False, "the yaw was wrong"),
        (DOUBTS, KNOWN, used(), RUNNING, True, ""),
        (
            GOES_WITHOUT,
            UNKNOWN,
            used(imu=False),
            RUNNING,
            False,
            "goes without the IMU: what the accelerometer reads",
        ),
    ],
)
def test_what_may_be_flown_by(estimator, yaw_std, use, status, yaw_known, why):
    said = status_of(estimator, yaw_std, 0.01, use)
    assert said == Status(status, yaw_known, said.why) and said.lost == (status == LOST)
    assert why in said.why and bool(said.why) == bool(why)


def test_a_yaw_that_is_known_is_known_to_who_hears_status():
    """The deviation is a numpy number.

    A comparison gives a numpy boolean, and the bytes of a message would hold false.
    """
    serialization = pytest.importorskip("rclpy.serialization")
    messages = pytest.importorskip("uwb_tdoa_msgs.msg")
    from uwb_tdoa_ekf.outputs import StatusOutput, Time

    sent = []
    node = SimpleNamespace(create_publisher=lambda *_: SimpleNamespace(publish=sent.append))
    said = status_of(RUNS, np.float64(KNOWN), 0.01, used())
    StatusOutput(node).publish(said, np.float64(KNOWN), np.float64(0.1), Time(), "map")
    heard = serialization.deserialize_message(
        serialization.serialize_message(sent[0]), messages.EstimatorStatus
    )
    assert heard.yaw_known and heard.status == RUNNING


@pytest.mark.parametrize("behind, said", [(3.0, "3.0 s behind"), (-2.0, "2.0 s ahead")])
def test_an_odometry_of_another_time_than_now_is_not_to_be_flown_by(behind, said):
    status = status_of(RUNS, KNOWN, 0.01, used(), off_the_clock=off_the_clock(behind))
    assert status.status == RUNNING and said in status.why


@pytest.mark.parametrize("behind", [None, 0.2, 1e9])
def test_a_recording_of_another_day_is_not_old(behind):
    assert off_the_clock(behind) is None


def test_without_odometry_nothing_goes_by_the_imu_alone():
    said = status_of(RUNS, KNOWN, 10.0, used(silent=2.0))
    assert said.status == WAITING and "no odometry" in said.why and "alone" not in said.why


@pytest.mark.parametrize("estimator", [STARTS, RUNS])
@pytest.mark.parametrize(
    "rule",
    [
        "tdoa_sign",
        "tdoa_large",
        "tdoa_one_sign",
        "two_tags",
        "ids_unknown",
        "ids_exchanged",
        "survey_unit",
        "stamps_unit",
    ],
)
def test_a_finding_that_makes_the_position_wrong_ends_running_and_is_why(rule, estimator):
    said = status_of(estimator, KNOWN, 0.01, used(), [found("gap", WARNING), found(rule)])
    assert said == Status(FAULT, False, found(rule).sentence) and not said.lost


@pytest.mark.parametrize(
    "rule", ["imu_force_unit", "imu_rate_unit", "imu_turned", "imu_silent", "stamps_apart"]
)
def test_a_fault_of_the_imu_counts_while_the_filter_uses_it(rule):
    assert status_of(RUNS, KNOWN, 0.01, used(), [found(rule)]).status == FAULT
    for estimator, use in ((GOES_WITHOUT, used()), (RUNS, used(imu=False))):
        said = status_of(estimator, KNOWN, 0.01, use, [found(rule)])
        # /diagnostics reports the same.
        assert said == Status(RUNNING, True, found(rule).sentence)


def test_what_does_not_make_the_position_wrong_does_not_end_running():
    for harmless in (
        found("tdoa_sign", WARNING),
        found("ids_unknown", value=0.2),
        found("tdoa_twice"),
        found("surveys_differ", WARNING),
    ):
        assert status_of(RUNS, KNOWN, 0.01, used(), [harmless]).status == RUNNING


def test_the_odometry_of_a_fault_states_that_it_may_be_anywhere():
    odometry = run_offline(fly(0, 3.0)).odometry
    wide = with_fault_covariance(odometry, np.array([8.0, 9.0, 4.0]))
    added = wide.covariance - odometry.covariance
    assert np.allclose(added[:, :3, :3], np.diag([64.0, 81.0, 16.0])) and np.allclose(
        added[:, 3:6, 3:6], 4.0 * np.eye(3)
    )
    # The yaw alone is unknown.
    assert np.allclose(np.trace(added[:, 6:, 6:], axis1=1, axis2=2), math.pi**2)
    assert (wide.p == odometry.p).all() and (np.linalg.eigvalsh(wide.covariance) > -1e-9).all()


def test_the_yaw_in_words():
    assert (
        yaw_in_words(KNOWN) == "known: +-6 degrees"
        and yaw_in_words(UNKNOWN) == "not known yet: +-100 degrees"
    )
    assert yaw_in_words(math.nan) == "unknown: there is no odometry"


def test_the_numbers_are_those_of_the_message():
    message = pytest.importorskip("uwb_tdoa_msgs.msg").EstimatorStatus
    assert (WAITING, STARTING, RUNNING, LOST, FAULT) == (
        message.STATUS_WAITING,
        message.STATUS_STARTING,
        message.STATUS_RUNNING,
        message.STATUS_LOST,
        message.STATUS_FAULT,
    )


# --- use ---
LOOK = 0.2  # s


class Looked:
    """A Use that looks five times a second."""

    def __init__(self):
        self.use, self.now, self.received, self.counts = Use(0.25), 50.0, Counter(), Counter()

    def go(self, seconds, running=True, rate=400, imu=1000, **shares):
        """Let time pass with this rate of TDOAs and these shares of their verdicts.

        Returns [(s, trouble)].
        """
        said = []
        for k in range(round(seconds / LOOK)):
            self.now += LOOK
            self.received["tdoa"] += round(LOOK * rate)
            self.counts["imu_used"] += round(LOOK * imu)
            for name, share in shares.items():
                self.counts[name] += round(LOOK * rate * share)
            self.use.update(self.now, self.received, self.counts, running)
            said.append(((k + 1) * LOOK, self.use.why_unused))
        return said

    def first(self, seconds, **shares):
        """Return (seconds until the first trouble, trouble)."""
        return next(
            ((at, words) for at, words in self.go(seconds, **shares) if words), (float("inf"), "")
        )


@pytest.mark.parametrize(
    ("reason", "words"),
    [("late", "-p lag"), ("invalid", "of ids that"), ("rejected", "contradict")],
)
def test_tdoas_of_which_none_is_used_are_named_within_two_seconds(reason, words):
    looked = Looked()
    assert not any(said for _, said in looked.go(10.0, used=1.0))
    at, said = looked.first(3.0, **{reason: 1.0})
    assert at <= 2.0 and words in said
    assert looked.use.age("tdoa") >= 0.9 and looked.use.age("arrival") < 0.3
    assert looked.go(4.5, used=1.0)[-1][1] is None


def test_a_start_and_a_landing_do_not_contradict():
    """The rates come from measured flights on the floor.

    The filter rejects 85 % for 3 s after the start and for 2 s after landing.
    """
    looked = Looked()
    assert not any(said for _, said in looked.go(3.0, rejected=0.85, used=0.15))
    assert not any(said for _, said in looked.go(20.0, rejected=0.03, used=0.97))
    assert not any(said for _, said in looked.go(2.0, rejected=0.85, used=0.15))


def test_most_that_contradict_for_long_are_named():
    looked = Looked()
    looked.go(10.0, used=1.0)
    at, said = looked.first(6.0, rejected=0.7, used=0.3)
    assert at <= 4.0 and "contradict" in said and looked.use.contradicted


def test_silence_has_an_age():
    looked = Looked()
    assert looked.use.age("tdoa") == looked.use.age("imu") == float("inf")
    looked.go(2.0, used=1.0)
    looked.go(3.0, rate=0, imu=0)
    assert (
        looked.use.age("tdoa") == pytest.approx(3.0) == looked.use.age("imu")
        and not looked.use.lately("imu")
        and looked.use.why_unused is None
    )


@pytest.mark.slow
@given(st.lists(st.tuples(*[st.integers(0, 50)] * 4), min_size=20, max_size=60))
def test_shares_are_shares_whatever_comes(steps):
    use, counts, received, now = Use(0.25), Counter(), Counter(), 0.0
    for step in steps:
        now += LOOK
        counts.update(dict(zip(("used", "late", "invalid", "rejected"), step)))
        received["tdoa"] += sum(step)
        use.update(now, received, counts, True)
        shares = use._shares(1.5)
        assert all(0.0 <= share <= 1.0 for share in shares.values()) and (
            not shares or sum(shares.values()) == pytest.approx(1.0)
        )
