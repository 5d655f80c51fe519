import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from geometry_msgs.msg import TwistWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry, Path  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from sensor_msgs.msg import FluidPressure, Imu, Range  # noqa: E402
from uwb_tdoa_bias.foundation import ros_wire  # noqa: E402
from uwb_tdoa_bias.foundation.ros_wire import Wire  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa, TdoaCorrected, TdoaResidual  # noqa: E402

POSE = "pose.pose.position", "pose.pose.orientation", "pose.covariance"


@pytest.fixture(params=["bytes", "objects"])
def way(request, monkeypatch):
    """Both ways of reading and writing: by the definition, and by message objects where that does not fit."""
    if request.param == "objects":
        monkeypatch.setattr(Wire, "_agrees", lambda self: False)
    return request.param


def corrected(k, frame="base_link", model="none"):
    message = TdoaCorrected(anchor_a=k, anchor_b=k + 1, raw=0.5 * k, bias=0.1, bias_std=0.2, corrected=-k / 3, status=2)
    message.model, message.header.frame_id = model, frame
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000 + k, 999_999_999 - k
    return message


def test_the_definition_fits_the_types_of_our_topics():
    for kind, *fields in (
        (Imu, "angular_velocity", "linear_acceleration_covariance"), (Tdoa, "distance_difference"), (TdoaCorrected, "raw"),
        (TdoaResidual, "innovation", "verdict"), (Odometry, *POSE, "twist.covariance"), (Range, "range", "max_range"),
        (FluidPressure, "fluid_pressure"), (TwistWithCovarianceStamped, "twist.twist.linear", "twist.covariance"),
        (Path,),
    ):  # fmt: skip
        assert Wire(kind, *fields).fits, kind


def test_messages_are_read_in_order_in_runs_of_one_frame(way):
    frames = ["tag", "tag", "gat", "longer", "longer", ""]
    messages = [corrected(k, frame, model="x" * (k % 2)) for k, frame in enumerate(frames)]
    wire = Wire(TdoaCorrected, "corrected", "anchor_b", "status")
    parts = wire.read([serialize_message(message) for message in messages])
    assert [frame for frame, rows in parts for _ in rows] == frames
    rows = np.concatenate([rows[["sec", "nanosec", "corrected", "anchor_b", "status"]] for _, rows in parts])
    assert rows["corrected"].tolist() == [message.corrected for message in messages]
    assert rows["anchor_b"].tolist() == [message.anchor_b for message in messages]
    assert rows["sec"].tolist() == [message.header.stamp.sec for message in messages]
    assert rows["nanosec"].tolist() == [message.header.stamp.nanosec for message in messages]
    assert set(rows["status"].tolist()) == {2}


def test_vectors_and_arrays_are_columns(way):
    message = Odometry(child_frame_id="body")
    message.pose.pose.position.y, message.pose.pose.orientation.x = 2.0, 0.5
    message.pose.covariance = np.arange(36.0)
    ((frame, rows),) = Wire(Odometry, *POSE).read([serialize_message(message)])
    assert rows["pose.pose.position"].tolist() == [[0.0, 2.0, 0.0]]
    assert rows["pose.pose.orientation"].tolist() == [[0.5, 0.0, 0.0, 1.0]]
    assert rows["pose.covariance"].tolist() == [list(range(36))]


def test_what_is_written_is_what_an_object_would_be(way):
    wire = Wire(TdoaCorrected, "corrected", "anchor_b", "anchor_a", "raw")  # not in the order of the definition
    template = wire.template(corrected(7, model="effects"))
    wanted = [corrected(k, model="effects") for k in (7, 8, 300)]
    rows = template.rows(3)
    for name in ("anchor_a", "anchor_b", "raw", "corrected"):
        rows[name] = [getattr(message, name) for message in wanted]
    rows["sec"], rows["nanosec"] = zip(*((m.header.stamp.sec, m.header.stamp.nanosec) for m in wanted))
    for made, message in zip(template.messages(rows), wanted):
        if way == "bytes":
            assert isinstance(made, bytes)
            made = deserialize_message(made, TdoaCorrected)
        assert made == message


def test_a_middleware_that_serializes_otherwise_is_noticed(monkeypatch):
    monkeypatch.setattr(ros_wire, "serialize_message", lambda message: b"\0\0" + serialize_message(message)[2:])
    assert not Wire(Tdoa, "distance_difference").fits
    monkeypatch.setattr(ros_wire, "serialize_message", lambda message: serialize_message(message)[:4] + b"\0" * 90)
    assert not Wire(Tdoa, "distance_difference").fits
