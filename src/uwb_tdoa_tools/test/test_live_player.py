# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import threading
from types import SimpleNamespace

import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu

from uwb_tdoa_tools.live import replay
from uwb_tdoa_tools.live.replay import BATCH, BATCHES_AHEAD, Player, read_ahead


@pytest.mark.parametrize("count", [0, 1, BATCH, 3 * BATCH + 7, BATCH * (BATCHES_AHEAD + 5)])
def test_items_come_complete_and_in_order(count):
    assert list(read_ahead(iter(range(count)))) == list(range(count))


def test_an_error_comes_after_the_items_before_it():
    def broken():
        yield from range(10)
        raise ValueError("worn out")

    seen = []
    with pytest.raises(ValueError, match="worn out"):
        for item in read_ahead(broken()):
            seen.append(item)
    assert seen == list(range(10))


def test_closing_early_ends_the_thread():
    before = threading.active_count()
    items = read_ahead(iter(range(10**9)))
    assert next(items) == 0
    items.close()
    assert threading.active_count() == before


def test_measurements_of_a_sensor_are_no_imu_samples_even_in_messages_of_the_same_type(monkeypatch):
    compass = SimpleNamespace(topics=(("compass", "sensor_msgs/msg/Imu"),))
    monkeypatch.setattr(replay, "SENSORS", {"compass": compass})
    qos = QoSProfile(depth=1)
    publishers = {
        topic: SimpleNamespace(topic_name=f"/tag1{topic}", msg_type=Imu, qos_profile=qos)
        for topic in ("/imu/data", "/compass")
    }
    player = Player(None, publishers, 1.0, None, lambda: False)
    player.played.counts.update({"/imu/data": 7, "/compass": 5})
    assert player.count("IMU samples") == 7 and player.count("TDOAs") == 0


def test_the_progress_is_said_while_it_plays(monkeypatch):
    monkeypatch.setattr(replay, "PROGRESS", 0.0)
    told, said = [], []
    qos = QoSProfile(depth=1)
    publisher = SimpleNamespace(
        topic_name="/imu/data", msg_type=Imu, qos_profile=qos, publish=lambda data: None
    )
    player = Player(
        None, {"/imu/data": publisher}, 100.0, None, False, lambda *times: told.append(times)
    )
    connection = SimpleNamespace(topic="/imu/data")
    player.play((connection, stamp, b"") for stamp in (0, 10**9, 2 * 10**9))
    assert [played for played, *_ in told] == [0.0, 1.0, 2.0]
    assert all(0.0 <= waited <= took for _, took, waited in told)
    replay._tell_progress(4.0, "odometry", said.append, 1.0, 3.0, 2.0)
    replay._tell_progress(4.0, None, said.append, 0.0, 3.0, 0.0)
    assert said == [
        "played 1.0 of 4.0 s in 3 s, of which 2 s waiting for odometry, about 9 s left",
        "played 0.0 of 4.0 s in 3 s",
    ]
