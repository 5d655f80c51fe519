# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""fly.launch.py under the real launch, with the nodes that it starts."""

from pathlib import Path
import sys

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.srv", reason="needs the built workspace: ./dev build")
sys.path.append(str(Path(__file__).resolve().parents[2] / "uwb_tdoa_ekf" / "test"))

from real_launch import WHY_NOT, Launch  # noqa: E402

from uwb_tdoa_tools.live.session import own_domain  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))]


@pytest.fixture
def launch(tmp_path):
    """Return launch(*arguments), which gives a Launch of fly.launch.py. It ends with the test."""
    started = []

    def make(*arguments):
        started.append(Launch(tmp_path, "uwb_tdoa_tools", "fly.launch.py", *arguments))
        return started[-1]

    with own_domain():
        yield make
        for each in started:
            each.close()


def test_all_start_and_hear_the_vehicle_and_end_in_good_order(launch):
    launched = launch("simulated_time:=true", "namespace:=tag1", "seed:=3")
    launched.wait("[tag1.ekf_node]: looking for the start position")
    launched.wait("[tag1.bias_node]: passing TDOAs on")
    launched.interrupt()
    assert "has died" not in launched.said, launched.said


def test_a_vehicle_that_refuses_ends_all(launch):
    launched = launch("seed:=moon", "duration:=60")
    assert launched.ended() == 1
    assert "seed: " in launched.said and "give a whole number" in launched.said
    assert "vehicle_node has ended with exit code 2" in launched.said
