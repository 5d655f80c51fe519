"""What a node answers while everything flows, with ten times the time that `bench --only graph`
asks for.
"""

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from uwb_tdoa_tools.benchmark import graph, usage  # noqa: E402

LENIENT = 10.0  # times the target: on a loaded machine
OTHERS = 0.5  # of the CPU time, from which on all that can be asked is that there are answers


@pytest.mark.slow  # where others leave it less of a core than it needs, nothing can be asked of it
def test_everything_is_served_beside_streams_a_clock_and_transforms(tmp_path):
    before = usage.used_by_all()
    found = graph.ask(tmp_path, 5.0, clock=200.0, tf=100.0, streams=True)
    times = LENIENT if usage.used_by_others(before)["others"] < OTHERS else np.inf
    target = {name: min(graph.SILENCE, times * limit) for name, limit in graph.TARGETS.items()}
    assert found.answers and max(found.answers) < target["get_parameters p99"]
    assert max(found.poses) < target["initialpose, the longest"]
    assert found.pause < target["a pause told after"]
    assert max(found.periods) < times


def test_a_case_is_described_and_judged():
    assert graph.describe(0.0, 0.0, False, 0) == "the rest of the graph, ekf_node: nothing flows"
    title = graph.describe(200.0, 500.0, True, 2)
    assert title.endswith(
        "/clock at 200 Hz, /tf at 500 Hz, streams at 1 kHz + 400 Hz, 2 busy loops"
    )
    slow = graph.Answers([0.01] * 98 + [3.0] * 2, [0.3, 0.1], [1.0, 1.1], graph.SILENCE, 0.02)
    figures = {figure.name: figure for figure in graph.figures(title, slow, False)}
    assert figures["get_parameters p99"].median == 3.0 and not figures["get_parameters p99"].met
    assert not figures["initialpose, the longest"].met and not figures["a pause told after"].met
    assert not figures[f"CPU, {graph.NODE}"].met and figures[
        "from one report to the next"
    ].median == pytest.approx(1.05)
