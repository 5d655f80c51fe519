import math
from types import SimpleNamespace

import pytest
from uwb_tdoa_ekf.monitoring.status import LOST, RUNNING, STARTING, WAITING, Status, status_of, yaw_in_words

STARTS, RUNS = SimpleNamespace(running=False, lost=None), SimpleNamespace(running=True, lost=None)
IS_LOST = SimpleNamespace(running=False, lost="the tag is lost")
KNOWN, UNKNOWN = math.radians(6.0), math.radians(100.0)


@pytest.mark.parametrize(
    ("estimator", "yaw_std", "age", "status", "yaw_known", "why"),
    [
        (None, math.nan, math.inf, WAITING, False, "no anchors yet"), (STARTS, math.nan, math.inf, WAITING, False, "no TDOAs"),
        (STARTS, math.nan, 0.1, STARTING, False, "start position"), (RUNS, UNKNOWN, 0.1, RUNNING, False, "yaw is not known"),
        (RUNS, KNOWN, 0.1, RUNNING, True, ""), (RUNS, KNOWN, 1.5, RUNNING, True, "IMU alone"),
        (RUNS, UNKNOWN, 1.5, RUNNING, False, "IMU alone"), (IS_LOST, math.nan, 40.0, LOST, False, "the tag is lost"),
        (IS_LOST, math.nan, 0.1, LOST, False, "the tag is lost"), (RUNS, math.nan, 0.1, RUNNING, False, "yaw is not known"),
    ],
)  # fmt: skip
def test_what_may_be_flown_by(estimator, yaw_std, age, status, yaw_known, why):
    found = status_of(estimator, yaw_std, age)
    assert found == Status(status, yaw_known, found.why) and found.lost == (status == LOST)
    assert why in found.why and bool(found.why) == bool(why)


def test_the_yaw_in_words():
    assert yaw_in_words(KNOWN) == "known: +-6 degrees" and yaw_in_words(UNKNOWN) == "not known yet: +-100 degrees"
    assert yaw_in_words(math.nan) == "unknown: there is no odometry"


def test_the_numbers_are_those_of_the_message():
    message = pytest.importorskip("uwb_tdoa_msgs.msg").EstimatorStatus
    assert (WAITING, STARTING, RUNNING, LOST) == (
        message.STATUS_WAITING, message.STATUS_STARTING, message.STATUS_RUNNING, message.STATUS_LOST,
    )  # fmt: skip
