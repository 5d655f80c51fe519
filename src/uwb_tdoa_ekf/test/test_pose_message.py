import math

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from builtin_interfaces.msg import Time  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402

from uwb_tdoa_bias.foundation.errors import InputError  # noqa: E402
from uwb_tdoa_bias.foundation.ros_stamps import Epoch  # noqa: E402
from uwb_tdoa_ekf.pose_message import pose_from_message  # noqa: E402


def message(variances=(0.25, 0.25, 0.0, 0.0, 0.0, 0.07), frame="map", second=5):
    """As RViz sends it: x, y and yaw, 90 degrees to the left."""
    out = PoseWithCovarianceStamped()
    out.header.frame_id, out.header.stamp.sec = frame, second
    out.pose.pose.position.x, out.pose.pose.position.y, out.pose.pose.position.z = 1.0, 2.0, 0.0
    out.pose.pose.orientation.z = out.pose.pose.orientation.w = math.sqrt(0.5)
    out.pose.covariance = np.diag(variances).ravel()
    return out


def read(content, newest=3.0):
    epoch = Epoch()
    epoch.seconds(Time(sec=2))
    return pose_from_message(content, "map", epoch, newest)


def test_what_has_a_variance_is_told():
    t, p, covariance, yaw, std = read(message())
    assert (t, p[:2].tolist(), yaw, std) == (
        3.0,
        [1.0, 2.0],
        pytest.approx(math.pi / 2),
        pytest.approx(math.sqrt(0.07)),
    )
    assert math.isnan(p[2]) and covariance[0, 0] == 0.25
    _, p, _, yaw, std = read(message((0.25, 0.25, 0.1, 0.0, 0.0, 0.0)))
    assert p[2] == 0.0 and math.isnan(yaw) and math.isnan(std)


def test_without_a_stamp_it_is_of_the_newest_measurement():
    assert read(message(second=0), newest=7.5)[0] == 7.5
    with pytest.raises(InputError, match="no stamp"):
        read(message(second=0), newest=-math.inf)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (message(frame="odom"), "'odom', and the filter's is 'map'"),
        (message((math.nan, 1.0, 1.0, 1.0, 1.0, 1.0)), "not finite"),
        (message((-1.0, 1.0, 1.0, 1.0, 1.0, 1.0)), "negative"),
    ],
)
def test_nonsense_is_refused(content, named):
    with pytest.raises(InputError, match=named):
        read(content)
