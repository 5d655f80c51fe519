"""`status`, its odometry and /diagnostics of a real ekf_node while what is measured is wrong: they
agree, and say it in time.
"""

import re
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from faults import ARRIVAL, FAULTS, FLIGHT, D, of_imu, of_tdoa, put  # noqa: E402
from flights import position_at  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rig import make_rig, seconds_of  # noqa: E402, F401
from stream_faults import lanes_of, play  # noqa: E402

from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RUNNING, FAULT, WAITING = (
    EstimatorStatus.STATUS_RUNNING,
    EstimatorStatus.STATUS_FAULT,
    EstimatorStatus.STATUS_WAITING,
)
BEFORE, LONG, AFTER = 8.0, 5.0, 8.0  # s of flight before a fault, of it, and after it
SOON = 4.5  # s within which it is said


def unknown(columns, rng):
    """TDOAs with ids that the survey does not have."""
    t, arrival, a, b, d = columns
    return t, arrival, a + 500, b + 500, d


def silent(imu, tdoa, rng):
    """Neither stream comes."""
    return tuple(c[:0] for c in imu), tuple(c[:0] for c in tdoa)


SIGNS = "all signs change"  # whose end takes a comparison of 12 s
CASES = {  # name: (what it does to the columns of a flight, status, what `why` says)
    SIGNS: (of_tdoa(lambda c, rng: put(c, D, -c[D])), FAULT, "the sign of all TDOAs has changed"),
    "TDOAs in millimetres": (
        of_tdoa(lambda c, rng: put(c, D, 1000.0 * c[D])),
        FAULT,
        "impossibly large",
    ),
    "ids are not in the survey": (of_tdoa(unknown), FAULT, "anchors that the survey does not have"),
    "TDOAs are not finite": (
        of_tdoa(lambda c, rng: put(c, D, np.nan * c[D])),
        RUNNING,
        "are invalid.*by the IMU alone",
    ),
    "TDOAs come 0.6 s late": (
        of_tdoa(lambda c, rng: put(c, ARRIVAL, c[ARRIVAL] + 0.6)),
        None,
        "-p lag",
    ),
    "no TDOA comes": (
        of_tdoa(lambda c, rng: tuple(column[:0] for column in c)),
        RUNNING,
        "no TDOA was used.*by the IMU alone",
    ),
    "neither TDOAs nor IMU come": (silent, WAITING, "there is no odometry"),
    "the IMU is in g": (
        of_imu(lambda c, rng: put(c, 3, c[3] / 9.81)),
        RUNNING,
        "goes without the IMU",
    ),
}


class Heard:
    """What a node says, with the s of the clock."""

    def __init__(self, rig):
        self.statuses, self.rig = [], rig
        rig.node.create_subscription(
            EstimatorStatus, "status", lambda m: self.statuses.append((time.time(), m)), LATCHED
        )

    def at(self, when):
        """The EstimatorStatus that held at s of the clock."""
        return [status for at, status in self.statuses if at <= when][-1]


def tried(lane, heard, names):
    """Fly with each fault in turn: [(name, s until it is said or nan, largest error and its
    deviation since then, m, status in the end, s after the end of the fault until nothing keeps it
    from being flown by)].
    """
    out = []
    for name in names:
        lane.poses.clear()
        play(
            [lane],
            [
                [
                    [
                        (0.0, BEFORE, ()),
                        (BEFORE, BEFORE + LONG, (name,)),
                        (BEFORE + LONG, BEFORE + LONG + AFTER, ()),
                    ]
                ]
            ],
        )
        begin = lane.plan[-1][0]
        low, high, end = begin + BEFORE, begin + BEFORE + LONG, begin + BEFORE + LONG + AFTER
        words = CASES[name][2]
        said = [
            at for at, status in heard.statuses if low < at < end and re.search(words, status.why)
        ]
        first = said[0] - low if said else np.nan
        during = [status for at, status in heard.statuses if low + first <= at < high]
        wrong = []
        for at, pose in lane.poses:
            if low + first + 0.4 < at < high:
                stamp = seconds_of(pose.header.stamp, 0) - begin
                p = pose.pose.pose.position
                error = np.linalg.norm([p.x, p.y, p.z] - position_at(FLIGHT, np.array([stamp]))[0])
                wrong.append(
                    (
                        error,
                        np.sqrt(
                            max(
                                pose.pose.covariance[0],
                                pose.pose.covariance[7],
                                pose.pose.covariance[14],
                            )
                        ),
                    )
                )
        well = [
            at
            for at, status in heard.statuses
            if at > high and status.status == RUNNING and not re.search(words, status.why)
        ]
        out.append(
            (
                name,
                first,
                max(wrong, default=(0.0, 0.0)),
                [s.status for s in during],
                well[0] - high if well else np.nan,
            )
        )
    return out


@pytest.mark.slow
def test_status_odometry_and_diagnostics_agree_while_what_is_measured_is_wrong(
    make_rig, monkeypatch
):  # noqa: F811
    for name, (change, _, words) in CASES.items():
        monkeypatch.setitem(FAULTS, name, (change, words))
    (lane,) = lanes_of(make_rig, 1)
    heard = Heard(lane.rig)
    for name, first, (error, deviation), statuses, well in tried(lane, heard, CASES):
        _, status, words = CASES[name]
        assert first < SOON, (name, first, {s.why for _, s in heard.statuses})
        assert status is None or set(statuses) <= {status}, (name, statuses)
        assert error < max(1.0, 3.0 * deviation), (name, error, deviation)
        assert well < AFTER or name == SIGNS, name
    agree = [
        (status, s) for at, status in lane.heard for t, s in heard.statuses if abs(t - at) < 0.02
    ]
    for diagnostics, status in agree:
        values = {entry.key: entry.value for entry in diagnostics.values}
        if status.status == FAULT:
            assert (
                status.why in values["wrong with the streams"]
                or status.why == values["not to be flown by"]
            )
