# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import sys

import pytest

rclpy = pytest.importorskip("rclpy")

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability  # noqa: E402

from uwb_tdoa_tools.live.session import message_class, publisher_qos, recorded_qos, subscription_qos  # noqa: E402

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
LATCHED, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE


def qos(reliability=RELIABLE, durability=VOLATILE, depth=5):
    return QoSProfile(depth=depth, reliability=reliability, durability=durability)


@pytest.mark.parametrize(
    "profile, expected",
    [
        (qos(), (QosReliability.RELIABLE, QosDurability.VOLATILE, 5)),
        (
            qos(BEST_EFFORT, LATCHED, 7),
            (QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, 7),
        ),
    ],
)
def test_recorded_qos_equals_the_qos_of_the_publisher(profile, expected):
    recorded = recorded_qos(profile)
    assert (recorded.reliability, recorded.durability, recorded.depth) == expected
    assert recorded.history == QosHistory.KEEP_LAST
    assert recorded.liveliness in (QosLiveliness.SYSTEM_DEFAULT, QosLiveliness.AUTOMATIC)


def test_numbers_of_the_policies_are_those_of_rosbags():
    for ours, theirs in (
        (ReliabilityPolicy, QosReliability),
        (DurabilityPolicy, QosDurability),
        (HistoryPolicy, QosHistory),
    ):
        assert {policy.name: int(policy) for policy in ours if int(policy) < 5} == {
            policy.name: policy.value for policy in theirs
        }


@pytest.mark.parametrize(
    "recorded, messages, durability, depth",
    [
        ([], 50, VOLATILE, None),
        ([qos(BEST_EFFORT)], 50, VOLATILE, None),
        ([qos(durability=LATCHED, depth=1)], 3, LATCHED, 1),
        ([qos(durability=LATCHED, depth=1), qos(durability=LATCHED, depth=2)], 50, LATCHED, 3),
    ],
)
def test_replay_serves_every_subscription(recorded, messages, durability, depth):
    profile = publisher_qos([recorded_qos(each) for each in recorded], messages)
    assert profile.reliability == RELIABLE and profile.durability == durability
    if depth is None:
        assert profile.history == HistoryPolicy.KEEP_ALL
    else:
        assert (profile.history, profile.depth) == (HistoryPolicy.KEEP_LAST, depth)


@pytest.mark.parametrize("messages, depth", [(4, 4), (0, 1)])
def test_a_latched_topic_of_unknown_depth_keeps_its_messages(messages, depth):
    unknown = recorded_qos(qos(durability=LATCHED))._replace(history=QosHistory.UNKNOWN, depth=0)
    assert publisher_qos([unknown], messages).depth == depth


@pytest.mark.parametrize(
    "offered, reliability, durability",
    [
        ([qos()], RELIABLE, VOLATILE),
        ([qos(BEST_EFFORT)], BEST_EFFORT, VOLATILE),
        ([qos(), qos(BEST_EFFORT)], BEST_EFFORT, VOLATILE),
        ([qos(durability=LATCHED)], RELIABLE, LATCHED),
        ([qos(durability=LATCHED), qos()], RELIABLE, VOLATILE),
    ],
)
def test_a_recorder_requests_what_all_publishers_offer(offered, reliability, durability):
    profile = subscription_qos(offered)
    assert (profile.reliability, profile.durability) == (reliability, durability)
    assert profile.depth >= 1000


def test_types_of_installed_packages_are_found():
    from sensor_msgs.msg import Imu

    assert message_class("sensor_msgs/msg/Imu") is Imu
    assert message_class("sensor_msgs/msg/Nothing") is None
    assert message_class("nothing_msgs/msg/Nothing") is None


def test_unknown_packages_are_not_imported(tmp_path, monkeypatch):
    """A publisher chooses the name of its type, and an import runs code."""
    (tmp_path / "evil_msgs").mkdir()
    (tmp_path / "evil_msgs" / "__init__.py").write_text("")
    (tmp_path / "evil_msgs" / "msg.py").write_text("class Nice: pass")
    monkeypatch.syspath_prepend(tmp_path)
    for name in (
        "evil_msgs/msg/Nice",
        "evil_msgs/Nice",
        "antigravity/msg/Nice",
        "sensor_msgs/msg/__doc__/x",
        "sensor_msgs",
        "",
        "../x/msg/Y",
    ):
        assert message_class(name) is None
    assert "evil_msgs" not in sys.modules and "antigravity" not in sys.modules
    assert message_class("evil_msgs/msg/Nice", ["evil_msgs"]).__name__ == "Nice"
