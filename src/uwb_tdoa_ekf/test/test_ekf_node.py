from dataclasses import fields
from pathlib import Path
import re

import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from flights import fly  # noqa: E402

from uwb_tdoa_ekf.core import engine, measurements  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.ekf_node import EkfNode  # noqa: E402
from uwb_tdoa_ekf.estimator import Estimator  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "ekf_node.yaml"


@pytest.fixture
def node():
    rclpy.init()
    node = EkfNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_every_parameter_is_in_the_parameter_file_with_its_default(node):
    (parameters,) = (
        entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values()
    )
    general = ("qos_overrides.", "use_sim_time", "start_type_description_service")
    declared = {
        name: p.value
        for name, p in node.get_parameters_by_prefix("").items()
        if not name.startswith(general)
    }
    assert parameters == declared
    assert {field.name for field in fields(FilterConfig)} < declared.keys()
    assert FilterConfig.from_yaml(CONFIG) == FilterConfig()
    comments = dict(re.findall(r"^    (\w+): .*?  # (.*)$", CONFIG.read_text(), re.MULTILINE))
    assert comments == {name: node.describe_parameter(name).description for name in declared}


@pytest.mark.parametrize("batch", [1, 3, 200])
def test_a_node_that_is_ready_has_nothing_left_to_compile(node, batch):
    before = [set(function.signatures) for function in (engine.run, measurements.usable)]
    flight = fly(duration=1.0)
    estimator = Estimator(flight.anchors)
    for i in range(len(flight.imu)):
        estimator.add_imu(
            flight.imu.t[i].item(), flight.imu.gyro[i].tolist(), flight.imu.accel[i].tolist()
        )
        a, b, d = (column[i].item() for column in (flight.tdoa.a, flight.tdoa.b, flight.tdoa.d))
        estimator.add_tdoa(flight.tdoa.t[i].item(), a, b, d, 0.1)
        if i % batch == 0:
            estimator.advance()
    estimator.finish()
    assert [set(function.signatures) for function in (engine.run, measurements.usable)] == before
