# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run a bag through both nodes, as processes, over ROS topics, and record their output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import json
from pathlib import Path
import shutil
from typing import Any

from rclpy.node import Node

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.results import VERDICTS

from ..bags.files import open_bag
from .processes import DiagnosticsListener, Processes, own_domain, wait
from .record import recorded_odometry
from .session import session

INPUTS = ("/uwb/anchors", "/uwb/tdoa", "/imu/data")
# Matches that must exist before the first message: topic -> (publishers, subscriptions)
MATCHED = {
    "/imu/data": (0, 1),
    "/uwb/tdoa": (0, 1),
    "/uwb/anchors": (0, 2),
    "/uwb/tdoa_corrected": (1, 1),
    "/odometry": (1, 2),
}
# A replay can wait, a robot cannot: here no link may lose a message, and the replay waits for a
# stream that falls behind.
# s of stamps; hold: see config/bias_node.yaml
PATIENCE = {"bias_node": {"hold": 9.975}, "ekf_node": {"lag": 10.0}}
RELIABLE = {
    "bias_node": (
        "/uwb/tdoa.subscription",
        "/odometry.subscription",
        "/uwb/tdoa_corrected.publisher",
    ),
    "ekf_node": (
        "/imu/data.subscription",
        "/uwb/tdoa_corrected.subscription",
        *(f"/{of.topics[0][0]}.subscription" for of in SENSORS.values()),
        "/odometry.publisher",
    ),
}
DEPTH = 1_000_000  # messages that may wait in a subscription
READY_LIMIT = 60.0  # s without progress; the first start compiles the filter, which is progress
MATCH_LIMIT = 300.0  # s; a slow machine takes long to find the nodes
SETTLE_LIMIT = 60.0  # s without a change of the counters, while the nodes work off a fast replay


@dataclass(frozen=True)
class LiveRun:
    """Result of `run_live`.

    Attributes
    ----------
    recorded : Path
        Bag with `odometry`.
    bias, ekf : dict
        {key: text}, the last diagnostics of each node.
    """

    recorded: Path
    bias: dict[str, str]
    ekf: dict[str, str]


def run_live(
    bag: str | Path,
    folder: str | Path,
    rate: float = 1.0,
    bias_parameters: dict[str, Any] | None = None,
    ekf_parameters: dict[str, Any] | None = None,
    say: Callable[[str], object] = print,
) -> LiveRun:
    """Replay a bag through bias_node and ekf_node, and record their odometry.

    The nodes run in a ROS domain without other users, on this machine only.

    Parameters
    ----------
    bag : path
        The bag to replay.
    folder : path
        Where `recorded_bag` and the output of the processes (`*.log`) go.
    rate : float
        Times as fast as recorded.
    bias_parameters, ekf_parameters : dict or None
        {name: value} for the nodes.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    LiveRun

    Raises
    ------
    LiveError
        If a process fails or makes no progress.
    KeyboardInterrupt
        After a signal.
    """
    with open_bag(bag) as reader:
        present = {connection.topic for connection in reader.connections}
        total = sum(
            connection.msgcount
            for connection in reader.connections
            if connection.topic == "/uwb/tdoa"
        )
    inputs = [topic for topic in INPUTS if topic in present]
    recorded = Path(folder) / "recorded_bag"
    if recorded.exists():
        shutil.rmtree(recorded)
    with (
        own_domain(),
        session("demo", []) as (node, stop),
        recorded_odometry(node, recorded),
        Processes(folder, stop) as processes,
    ):
        diagnostics = DiagnosticsListener(node)
        processes.start("uwb_tdoa_bias", "bias_node", *_parameters("bias_node", bias_parameters))
        processes.start("uwb_tdoa_ekf", "ekf_node", *_parameters("ekf_node", ekf_parameters))
        say("starting the nodes")
        wait(
            READY_LIMIT,
            "the nodes to find each other",
            processes,
            node,
            lambda: _is_ready(node, diagnostics),
            say,
        )
        say(f"replaying {bag} at rate {rate:g}")
        options = (
            "--rate",
            rate,
            "--follow",
            "odometry",
            "--wait-matched",
            MATCH_LIMIT,
            "--wait-topics",
            *inputs,
        )
        replay = processes.start("uwb_tdoa_tools", "replay", bag, *options, may_end_with=(0, 1))
        wait(
            None,
            "the end of the replay",
            processes,
            node,
            lambda: replay.poll() is not None,
            lambda _: say(_played(diagnostics, total)),
        )
        diagnostics.forget()
        wait(
            SETTLE_LIMIT,
            "the nodes to finish",
            processes,
            node,
            diagnostics.is_settled,
            say,
            diagnostics.counts,
        )
        for name in ("ekf_node", "bias_node"):
            processes.stop(name)
    return LiveRun(recorded, diagnostics.newest("bias_node"), diagnostics.newest("ekf_node"))


def accounts(
    bias: dict[str, str], ekf: dict[str, str], flight: Flight, recorded: int
) -> dict[str, int]:
    """Count the messages of a replayed Flight by outcome, from the last diagnostics of both nodes.

    Parameters
    ----------
    recorded : int
        Number of recorded odometries.

    Returns
    -------
    dict
        {verdict: TDOAs, "waiting": TDOAs, "lost": TDOAs, "early": TDOAs corrected before their pose
        was there, "imu_late": samples, "imu_lost": samples, "sensors_late": values of the other
        sensors, "odometry_lost": messages}.
    """
    counts = {name: int(ekf[name]) for name in (*VERDICTS.values(), "waiting")}
    counts["waiting"] += int(bias["waiting"])  # for poses, which end with the first of the streams
    counts["lost"] = len(flight.tdoa) - sum(counts.values())
    samples = 0 if flight.imu is None else len(flight.imu)
    return counts | {
        "early": int(bias["released before their pose"]),
        "imu_late": int(ekf["imu_late"]),
        "imu_lost": samples - int(ekf["IMU samples received"]),
        "sensors_late": sum(int(ekf.get(f"{name}_late", 0)) for name in SENSORS),
        "odometry_lost": int(ekf["odometry published"]) - recorded,
    }


def _parameters(name: str, values: dict[str, Any] | None) -> list[str]:
    """Return command-line arguments for the parameters of a node. JSON is also YAML."""
    values = PATIENCE[name] | (values or {})
    for end in RELIABLE[name]:
        values |= {
            f"qos_overrides.{end}.reliability": "reliable",
            f"qos_overrides.{end}.depth": DEPTH,
        }
    return [
        "--ros-args",
        *(part for key, value in values.items() for part in ("-p", f"{key}:={json.dumps(value)}")),
    ]


def _played(diagnostics: DiagnosticsListener, total: int) -> str:
    """State in words how many TDOAs of the bag bias_node has received."""
    received = int(diagnostics.newest("bias_node").get("received", 0))
    return f"{100.0 * received / max(total, 1):.0f} % of the flight is through"


def _is_ready(node: Node, diagnostics: DiagnosticsListener) -> bool:
    found = diagnostics.newest("ekf_node").get("publishers of uwb/tdoa_corrected", "0") != "0"
    return (
        found
        and bool(diagnostics.newest("bias_node"))
        and all(
            node.count_publishers(topic) >= publishers
            and node.count_subscribers(topic) >= subscriptions
            for topic, (publishers, subscriptions) in MATCHED.items()
        )
    )
