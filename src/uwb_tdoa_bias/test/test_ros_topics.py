import pytest

pytest.importorskip("rclpy")

from rclpy.qos import (
    QoSCompatibility,
    QoSPresetProfiles,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)  # noqa: E402

from uwb_tdoa_bias.foundation.ros_topics import OUTPUT_QOS, STREAM_QOS  # noqa: E402


def test_stream_subscriptions_match_every_usual_publisher():
    usual = [
        QoSPresetProfiles.SENSOR_DATA.value,
        QoSPresetProfiles.SYSTEM_DEFAULT.value,
        QoSProfile(depth=10),
    ]
    for publisher in [*usual, STREAM_QOS]:
        assert qos_check_compatible(publisher, STREAM_QOS)[0] != QoSCompatibility.ERROR
    assert STREAM_QOS.reliability == ReliabilityPolicy.BEST_EFFORT


def test_every_usual_subscriber_matches_what_is_published():
    usual = [
        QoSPresetProfiles.SENSOR_DATA.value,
        QoSPresetProfiles.SYSTEM_DEFAULT.value,
        QoSProfile(depth=10),
    ]
    for subscriber in [*usual, STREAM_QOS]:
        assert qos_check_compatible(OUTPUT_QOS, subscriber)[0] != QoSCompatibility.ERROR
    assert OUTPUT_QOS.reliability == ReliabilityPolicy.RELIABLE
