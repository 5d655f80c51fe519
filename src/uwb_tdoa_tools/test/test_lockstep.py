# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replays that follow the nodes, on a busy computer.

The nodes have their default parameters and best-effort connections.
"""

from dataclasses import replace
import os
import re
import signal
import threading
import time

import numpy as np
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")

import known_answer  # noqa: E402
import programs  # noqa: E402

from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_ekf.core.memory import USED  # noqa: E402
from uwb_tdoa_tools.bags.bag import read_bag, read_odometry, write_bag  # noqa: E402
from uwb_tdoa_tools.bags.files import new_bag, open_bag  # noqa: E402
from uwb_tdoa_tools.bags.messages import typestore  # noqa: E402
from uwb_tdoa_tools.calibrating import between  # noqa: E402
from uwb_tdoa_tools.live.replay import SILENCE  # noqa: E402
from uwb_tdoa_tools.live.session import (  # noqa: E402
    DiagnosticsListener,
    Processes,
    _parameters,
    own_domain,
    recorded_odometry,
    session,  # noqa: E402
    wait,
)
from uwb_tdoa_tools.readers import read_flight  # noqa: E402
from uwb_tdoa_tools.scoring.evaluation import evaluate  # noqa: E402
from uwb_tdoa_tools.scoring.metrics import Score  # noqa: E402
from uwb_tdoa_tools.simulation import SimulationConfig, simulate  # noqa: E402

pytestmark = pytest.mark.slow

VERDICTS = ("used", "rejected", "late", "invalid", "startup", "waiting")
READY_LIMIT, SETTLE_LIMIT = 180.0, 60.0  # s


@pytest.fixture
def load():
    """Return load(n), which starts n busy processes. They end with the test or load.end()."""
    running = []

    def start(count):
        running.extend(programs.start("-c", "while True: pass") for _ in range(count))

    def end():
        while running:
            process = running.pop()
            process.kill()
            process.wait()

    start.end = end
    yield start
    end()


def replayed(bag, folder, *options, nodes=(), begin=lambda processes: None, end=lambda: None):
    """Replay a bag in step with the odometry of the nodes.

    nodes : {node: arguments}
    begin : callable of (Processes), called when the nodes are ready, before the replay
    end : callable, called after the replay and before the nodes are asked what they received

    Returns (exit code, output, diagnostics {node: {key: text}}, recorded bag).
    """
    model, recorded = known_answer.write(folder), folder / "recorded.bag"
    nodes = {"bias_node": ("--ros-args", "-p", f"model_file:={model}"), **dict(nodes)}
    with (
        own_domain(),
        session("test", []) as (node, stop),
        recorded_odometry(node, recorded),
        Processes(folder, stop) as processes,
    ):
        diagnostics = DiagnosticsListener(node)
        for package, name in (("uwb_tdoa_bias", "bias_node"), ("uwb_tdoa_ekf", "ekf_node")):
            processes.start(package, name, *nodes.get(name, ()))
        wait(
            READY_LIMIT,
            "the nodes",
            processes,
            node,
            lambda: all(map(diagnostics.newest, ("bias_node", "ekf_node"))),
        )
        wait(
            READY_LIMIT,
            "bias_node to listen",
            processes,
            node,
            lambda: node.count_subscribers("/odometry") == 2,
        )
        begin(processes)
        command = ("uwb_tdoa_tools", "replay", bag, "--follow", "odometry", *options)
        replay = processes.start(*command, may_end_with=(0, 1, 2))
        wait(None, None, processes, node, lambda: replay.poll() is not None)
        end()
        diagnostics.forget()
        wait(SETTLE_LIMIT, "the nodes to finish", processes, node, diagnostics.is_settled)
        told = {name: diagnostics.newest(name) for name in ("bias_node", "ekf_node")}
        return replay.returncode, processes.file("replay").read_text(), told, recorded


def assert_equal_to_offline(flight, told, recorded):
    offline, run = evaluate(flight, network=load_network(recorded.with_name("known_answer.onnx")))
    live = Score("live", read_odometry(recorded), flight.truth)
    assert live.row()["rmse_3d"] == pytest.approx(offline.row()["rmse_3d"], abs=1e-3)
    assert told["bias_node"]["released before their pose"] == told["ekf_node"]["late"] == "0"
    verdicts = {name: int(told["ekf_node"][name]) for name in VERDICTS}
    assert told["ekf_node"]["TDOAs received"] == str(len(flight.tdoa))
    assert sum(verdicts.values()) == len(flight.tdoa)
    assert verdicts["invalid"] == run.counts["invalid"]
    return offline


def test_ranges_are_used_as_off_line_and_heights_with_holes_do_not_delay_the_replay(tmp_path):
    """In a gap of the heights, ekf_node waits for a height and holds back all TDOAs."""
    flight = simulate(
        SimulationConfig(seed=3, duration=16.0, imu_rate=200.0, height_noise=0.01, range_noise=0.1)
    )
    heard = (flight.height.t - flight.height.t[0]) % 2.0 > 0.6
    holed = {name: column[heard] for name, column in vars(flight.height).items()}
    write_bag(replace(flight, height=replace(flight.height, **holed)), tmp_path / "flight.bag")
    flight = read_bag(tmp_path / "flight.bag")
    _, said, told, recorded = replayed(tmp_path / "flight.bag", tmp_path, "--rate", 2)
    told_by = told["ekf_node"]
    # the very first height may be late: before it, no height is expected
    assert int(told_by["height_late"]) <= 1, said
    assert_equal_to_offline(flight, told, recorded)
    _, run = evaluate(flight, network=load_network(recorded.with_name("known_answer.onnx")))
    assert told_by["range_received"] == str(len(flight.range)) and told_by["range_late"] == "0"
    used = np.sum(run.sensors["range"]["verdict"] == USED)
    assert abs(int(told_by["range_used"]) - used) <= 2
    assert (tmp_path / "ekf_node.log").read_text().partition("running")[2].count(
        "no TDOAs"
    ) <= 1  # after the end of the replay


def test_a_measured_flight_beside_three_busy_processes(shared_data, tmp_path, load):
    log, survey = shared_data / "flights/0426/0426-traj3", shared_data / "surveys/anchor_0426.txt"
    flight = read_flight(log, survey)
    write_bag(between(flight, -np.inf, flight.imu.t[0] + 16.0), tmp_path / "flight.bag")
    code, said, told, recorded = replayed(
        tmp_path / "flight.bag", tmp_path, "--rate", 4, begin=lambda _: load(3), end=load.end
    )
    assert code == 0, said
    offline = assert_equal_to_offline(read_bag(tmp_path / "flight.bag"), told, recorded)
    assert offline.row()["rmse_3d"] < 0.35


def test_a_node_without_processor_time_is_waited_for(tmp_path):
    """bias_node gets none for 8 s in the middle of the replay. The result is that of the bag.

    The nodes have the parameters of `demo`: reliable connections, which DDS repairs afterwards.
    """
    bag = tmp_path / "flight.bag"
    write_bag(simulate(SimulationConfig(seed=3, duration=8.0, start_in_air=True)), bag)
    stopped = []

    def starve(processes):
        def run():
            log, pid = processes.file("replay"), processes.pid("bias_node")
            while not (log.exists() and "playing" in log.read_text()):
                time.sleep(0.05)
            time.sleep(3.0)
            for number, pause in ((signal.SIGSTOP, 8.0), (signal.SIGCONT, 0.0)):
                os.kill(pid, number)
                stopped.append(number)
                time.sleep(pause)

        threading.Thread(target=run, daemon=True).start()

    nodes = {
        "bias_node": _parameters("bias_node", {"model_file": str(known_answer.write(tmp_path))}),
        "ekf_node": _parameters("ekf_node", None),
    }
    code, said, told, recorded = replayed(bag, tmp_path, nodes=nodes, begin=starve)
    assert code == 0, said
    assert len(stopped) == 2 and float(re.search(r"waited ([\d.]+) s for", said)[1]) > 7.0
    assert_equal_to_offline(read_bag(bag), told, recorded)
    assert told["ekf_node"]["imu_late"] == "0"
    _, run = evaluate(read_bag(bag), network=load_network(tmp_path / "known_answer.onnx"))
    live, offline = read_odometry(recorded), run.odometry
    rows = np.searchsorted(offline.t, live.t)
    np.testing.assert_array_equal(live.t, offline.t[rows])
    np.testing.assert_allclose(live.p, offline.p[rows], atol=1e-6)


def test_nodes_that_do_not_wait_long_enough_are_not_followed(tmp_path):
    write_bag(
        simulate(SimulationConfig(seed=3, duration=8.0, imu_rate=200.0, start_in_air=True)),
        tmp_path / "flight.bag",
    )
    nodes = {"bias_node": ("--ros-args", "-p", "hold:=0.08")}
    code, said, _, _ = replayed(tmp_path / "flight.bag", tmp_path, nodes=nodes)
    assert (
        code == 2
        and (
            "hold is 0.08 s and ekf_node's lag 0.25 s; to be followed they need 0.205 s < hold < "
            "lag"
        )
        in said
    )


def test_a_recording_without_imu_and_with_other_anchors_than_the_nodes_needs_no_parameter(tmp_path):
    flight = simulate(SimulationConfig(seed=3, duration=8.0, start_in_air=True))
    bag, file = tmp_path / "flight.bag", tmp_path / "surveyed.yaml"
    flight.anchors.to_yaml(file)
    moved = flight.anchors.at(flight.anchors.positions + 0.3)
    write_bag(replace(flight, imu=None, anchors=moved), bag)
    given = "-p", f"anchors_file:={file}"
    model = "-p", f"model_file:={tmp_path / 'known_answer.onnx'}"
    nodes = {
        "bias_node": ("--ros-args", *model, *given),
        "ekf_node": ("--ros-args", *given),
    }
    code, said, told, recorded = replayed(bag, tmp_path, "--rate", 0.5, nodes=nodes)
    assert code == 0, said
    before = said.partition("playing")[0]
    assert "has no inertial samples" in before and "Start it with -p use_imu:=false" in before
    assert "leaving out /uwb/anchors: /bias_node, /ekf_node have anchors_file" in before
    assert re.search(r"played [\d.]+ of 8.0 s in \d+ s, of which \d s waiting for odometry", said)
    assert float(re.search(r"waited ([\d.]+) s for odometry", said)[1]) < SILENCE
    assert_equal_to_offline(replace(read_bag(bag), anchors=flight.anchors), told, recorded)
    for name in ("bias_node", "ekf_node"):
        log = (tmp_path / f"{name}.log").read_text()
        assert "other anchors" not in log
        assert "start bias_node" not in log.partition("though bias_node runs")[2]


def delayed(bag, out, count=10, delay=1_000_000_000):
    """Copy a bag. Some TDOAs from the middle are recorded one second after their stamps."""
    with open_bag(bag) as reader, new_bag(out) as writer:
        made = {
            c.topic: writer.add_connection(
                c.topic,
                c.msgtype,
                typestore=typestore(),
                offered_qos_profiles=c.ext.offered_qos_profiles,
            )
            for c in reader.connections
        }
        found = [(stamp, c.topic, data) for c, stamp, data in reader.messages()]
        tdoas = [number for number, (_, topic, _) in enumerate(found) if topic == "/uwb/tdoa"]
        for number in tdoas[len(tdoas) // 2 :][:count]:
            stamp, topic, data = found[number]
            found[number] = stamp + delay, topic, data
        for stamp, topic, data in sorted(found, key=lambda message: message[0]):
            writer.write(made[topic], stamp, data)


def test_late_messages_give_code_1(tmp_path):
    write_bag(
        simulate(SimulationConfig(seed=3, duration=8.0, imu_rate=200.0, start_in_air=True)),
        tmp_path / "flight.bag",
    )
    delayed(tmp_path / "flight.bag", tmp_path / "delayed.bag")
    code, said, told, _ = replayed(tmp_path / "delayed.bag", tmp_path, "--rate", 2)
    assert told["ekf_node"]["late"] == "10"
    assert code == 1 and "10 TDOAs late" in said
