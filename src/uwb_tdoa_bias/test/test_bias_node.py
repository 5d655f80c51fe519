from pathlib import Path

import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from uwb_tdoa_bias.bias_node import BiasNode  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "bias_node.yaml"


@pytest.fixture
def node():
    rclpy.init()
    node = BiasNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_every_parameter_is_in_the_parameter_file_with_its_default(node):
    (parameters,) = (entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values())
    general = ("qos_overrides.", "use_sim_time", "start_type_description_service")
    declared = {name: p.value for name, p in node.get_parameters_by_prefix("").items() if not name.startswith(general)}
    assert parameters == declared


def test_every_parameter_is_described_and_fixed(node):
    for name in ("effects_file", "model_file", "pose_lag", "hold"):
        descriptor = node.describe_parameter(name)
        assert descriptor.description and descriptor.read_only


def test_an_antenna_that_would_be_too_far_from_the_body_is_said_and_taken_as_the_body(node):
    assert not node._report()[1].startswith("uwb/tdoa:")
    node._frames.frames.set("base_link", "mast", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 3.0))
    node._antenna("mast").heard = 1
    _, text, values = node._report()
    assert text.startswith("uwb/tdoa: the place of 'mast' on 'base_link' in /tf_static is not taken: ") and "z is 3" in text
    assert "lever_arm" not in values["model"]
