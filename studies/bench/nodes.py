# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the live nodes in real time, for one tag and for several: CPU, memory, latency, losses,
time to ready.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
import json
import os
import re
import time
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_tools.live.session import (
    DiagnosticsListener,
    Processes,
    accounts,
    own_domain,
    session,
    variables,
    wait,
)

from .figures import Figure
from .flights import among, make_flight
from .source import Source, latencies
from .usage import cpu_seconds, memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rclpy.node import Node

    from uwb_tdoa_bias.common.flight import Flight

    Starts = dict[str, tuple[str, Sequence[str]]]  # {title: (executable, arguments)}

PACKAGES = {
    "bias_node": "uwb_tdoa_bias",
    "ekf_node": "uwb_tdoa_ekf",
    "localization_node": "uwb_tdoa_ekf",
}
NODES = "bias_node", "ekf_node"
# published once for all tags, so that the source stays the same
SHARED = ("imu/data", "uwb/tdoa", "uwb/anchors")
BLOCK = 3.0  # s over which CPU and latencies are taken: their median and quartiles are of blocks
# s; the very first start compiles the filter
READY_LIMIT, MATCH_LIMIT, SETTLE_LIMIT = (300.0, 60.0, 60.0)
# Tags, Hz, Hz
FLEETS = (
    (1, 1000.0, 400.0),
    (2, 1000.0, 400.0),
    (4, 1000.0, 400.0),
    (8, 1000.0, 400.0),
    (30, 100.0, 100.0),
    (60, 100.0, 40.0),
)
INSTALLED = 8, 1000, 10_000  # anchors; the tag hears 8
TARGET_CPU, TARGET_LATENCY, TARGET_READY = 25.0, 10.0, 0.5  # % of one core, ms, s
TARGET_LATENCY_OF_FLEET = 30.0  # ms
TARGET_START = 3.0  # s, of a node among many anchors
SECTION = "both nodes live at 1 kHz IMU + 400 Hz TDOA, default parameters and QoS"


@dataclass
class NodeFigures:
    """Measurements of running nodes.

    ready : {title: s from its start}
    first : s from the anchors to the first odometry. This includes half a second before the first
        measurement.
    memory : {title: bytes}
    cpu : {title: share of one core in each block}
    latency : one (n,) array of ms per block
    lost, late : numbers of messages
    source_late : (k,) ms, delay of each message of the source
    source_cpu : share of one core in each block
    """

    ready: dict[str, float] = field(default_factory=dict)
    first: float = np.nan
    memory: dict[str, int] = field(default_factory=dict)
    cpu: dict[str, np.ndarray] = field(default_factory=dict)
    latency: list[np.ndarray] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=dict)
    late: int = 0
    source_late: np.ndarray = field(default_factory=lambda: np.empty(0))
    source_cpu: np.ndarray = field(default_factory=lambda: np.empty(0))


def measure(
    progress: Callable[[str], object], folder: Path, quick: bool = False
) -> Iterator[Figure]:
    """Generator of Figures for one tag. progress(text); folder : for the output of the nodes."""
    progress("nodes, first start")
    first, ready, seconds = start(folder), [], 6.0 if quick else 30.0
    yield Figure.of(
        SECTION, "ready after its first start in this run, ekf_node", "s", first["ekf_node"]
    )
    for _ in range(0 if quick else 4):
        progress("nodes, start")
        ready.append(start(folder))
    progress(f"nodes, {seconds:g} s live")
    flight = make_flight(seconds)
    live = fly(flight, folder, [""], pairs([""]))
    ready.append(live.ready)
    for name in NODES:
        yield Figure.of(
            SECTION,
            f"ready after its start, {name}",
            "s",
            [one[name] for one in ready],
            TARGET_READY,
        )
    yield from _figures(SECTION, live)
    progress(f"localization_node, {seconds:g} s live")
    together = fly(flight, folder, [""], pool([""], 1))
    yield from _figures(f"{SECTION}, in one process", together, TARGET_CPU, TARGET_LATENCY)
    if not quick:
        progress(f"nodes, 64 anchors, {seconds:g} s live")
        yield from _figures(
            f"{SECTION}, 64 anchors", fly(make_flight(seconds, 64), folder, [""], pairs([""]))
        )


def measure_tags(
    progress: Callable[[str], object], folder: Path, quick: bool = False
) -> Iterator[Figure]:
    """Generator of Figures for several tags that all hear the same streams, in a localization_node
    for each core.
    """
    seconds, cores = 10.0 if quick else 20.0, len(os.sched_getaffinity(0))
    progress("tags, first start")
    start(folder)  # whoever compiles the filter keeps the memory that took
    for tags, imu_rate, tdoa_rate in FLEETS[3:5] if quick else FLEETS:
        progress(f"{tags} tags, {seconds:g} s live")
        spaces = [f"/tag{k + 1}" for k in range(tags)]
        starts = pool(spaces, min(cores, tags))
        section = (
            f"{tags} tag{'s' * (tags > 1)} at {imu_rate:g} Hz IMU + {tdoa_rate:g} Hz TDOA, "
            f"{len(starts)} localization_node"
        )
        flight = make_flight(seconds, tdoa_rate=tdoa_rate, imu_rate=imu_rate)
        yield from _figures(
            section, fly(flight, folder, spaces, starts), None, TARGET_LATENCY_OF_FLEET
        )


def measure_hall(
    progress: Callable[[str], object], folder: Path, quick: bool = False
) -> Iterator[Figure]:
    """Generator of Figures for a tag in a localization_node, by the number of installed anchors.

    The tag always hears the same 8.
    """
    progress("hall, first start")
    start(folder)
    flight = make_flight(10.0 if quick else 20.0, tdoa_rate=200.0, imu_rate=100.0)
    for installed in INSTALLED[::2] if quick else INSTALLED:
        progress(f"hall, {installed} anchors live")
        section = (
            f"{installed} anchors installed, 8 heard, 100 Hz IMU + 200 Hz TDOA, localization_node"
        )
        live = fly(among(flight, installed), folder, [""], pool([""], 1))
        (ready,) = live.ready.values()
        yield Figure.of(section, "ready after its start", "s", ready)
        yield Figure.of(section, "from the anchors to the first odometry", "s", live.first)
        yield Figure.of(section, "both together", "s", ready + live.first, TARGET_START)
        yield from _figures(section, live)


def start(folder: Path) -> dict[str, float]:
    """{node: s from its start until it says that it is ready}, one after the other."""
    with surroundings(folder) as (node, processes):
        return {name: _start(processes, node, name, name, []) for name in NODES}


def pairs(namespaces: Sequence[str]) -> Starts:
    """A bias_node and an ekf_node for each namespace: {title: (executable, arguments)}."""
    return {
        _title(space, name): (name, _arguments(space, name))
        for space in namespaces
        for name in NODES
    }


def pool(namespaces: Sequence[str], processes: int) -> Starts:
    """So many localization_nodes, which share the namespaces: {title: (executable, arguments)}."""
    name, shared = (
        "localization_node",
        [part for topic in SHARED for part in ("-r", f"{topic}:=/{topic}")],
    )
    if namespaces == [""]:
        return {name: (name, [])}
    tags = [
        json.dumps([space.strip("/") for space in namespaces[k::processes]])
        for k in range(processes)
    ]
    own = [["-p", f"tags:={each}", "-r", f"__node:={name}_{k + 1}"] for k, each in enumerate(tags)]
    return {
        f"{k + 1}/{name}": (name, ["--ros-args", *arguments, *shared])
        for k, arguments in enumerate(own)
    }


def fly(flight: Flight, folder: Path, namespaces: Sequence[str], starts: Starts) -> NodeFigures:
    """NodeFigures of a flight in real time through the nodes of each namespace ("" or "/name");
    starts : of `pairs` or `pool`.
    """
    out = NodeFigures()
    with surroundings(folder) as (node, processes):
        diagnostics, source = DiagnosticsListener(node), Source(node, namespaces)
        for title, (name, arguments) in starts.items():
            out.ready[title] = _start(processes, node, title, name, arguments)
        titles = [_title(space, name) for space in namespaces for name in NODES]
        matched = partial(_matched, node, source, diagnostics, titles)
        wait(MATCH_LIMIT, "all to find each other", processes, node, matched)
        samples = []

        def sample() -> None:
            used = {title: cpu_seconds(processes.pid(title)) for title in out.ready}
            samples.append((time.time_ns(), used, time.process_time()))

        sent, stamps, late = source.play(flight, BLOCK, sample)
        out.memory = {title: memory(processes.pid(title)) for title in out.ready}
        diagnostics.forget()

        def settled() -> bool:
            source.take()
            return diagnostics.is_settled()

        wait(SETTLE_LIMIT, "the nodes to finish", processes, node, settled)
        for title in out.ready:
            processes.stop(title)
    times = np.array([t for t, _, _ in samples])
    took = 1e-9 * np.diff(times)
    out.cpu = {title: np.diff([cpu[title] for _, cpu, _ in samples]) / took for title in out.ready}
    out.source_cpu, out.source_late = (
        np.diff([own for _, _, own in samples]) / took,
        1e3 * np.maximum(late, 0.0),
    )
    delay = [
        latencies(sent, stamps, *np.array(got, dtype=np.int64).reshape(-1, 2).T)
        for got in source.received
    ]
    block = np.searchsorted(times, sent, side="right") - 1
    arrived = [got[0][0] for got in source.received if got]
    out.first = 1e-9 * (min(arrived) - source.anchors_sent) if arrived else np.nan
    out.latency = [1e3 * np.concatenate([d[block == k] for d in delay]) for k in range(len(took))]
    _count(out, flight, namespaces, diagnostics, source)
    return out


@contextmanager
def surroundings(folder: str | Path) -> Iterator[tuple[Node, Processes]]:
    """(our node, Processes) in a separate domain. `ready_at` can read the logs of the processes."""
    form = "[{severity}] [{time}] [{name}]: {message}"
    logs = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": form, "RCUTILS_COLORIZED_OUTPUT": "0"}
    with (
        own_domain(),
        variables(logs),
        session("bench", []) as (node, stop),
        Processes(folder, stop) as processes,
    ):
        yield node, processes


def _arguments(space: str, name: str) -> list[str]:
    if not space:
        return []
    remaps = [f"__ns:={space}", *(f"{topic}:=/{topic}" for topic in SHARED)]
    own = ["-p", f"body_frame:={json.dumps(space.strip('/'))}"] if name == "ekf_node" else []
    return ["--ros-args", *(part for remap in remaps for part in ("-r", remap)), *own]


def _start(
    processes: Processes, node: Node, title: str, name: str, arguments: Sequence[str]
) -> float:
    """Start an executable and wait until it is ready; returns the s that took, by the clock of its
    log.
    """
    began = time.time()
    processes.start(PACKAGES[name], name, *arguments, title=title)
    said: list[str] = []

    def is_ready() -> list[str]:
        said[:] = ready_at(name, processes.file(title).read_text(errors="replace"))
        return said

    wait(READY_LIMIT, f"{title} to be ready", processes, node, is_ready)
    return float(said[0]) - began


def ready_at(name: str, log: str) -> list[str]:
    """When an executable said in its log that it is ready: [s since 1970, as text]."""
    return re.findall(rf"^\[INFO\] \[([0-9.]+)\] \[\S*{name}\S*\]: ready", log, re.MULTILINE)


def _title(space: str, name: str) -> str:
    return f"{space}/{name}".strip("/")


def _matched(
    node: Node, source: Source, diagnostics: DiagnosticsListener, titles: Sequence[str]
) -> bool:
    """Whether every node hears what it needs, and we hear every odometry."""
    wanted = {"bias_node": ("uwb/tdoa", "odometry"), "ekf_node": ("imu/data", "uwb/tdoa_corrected")}
    return (
        all(
            diagnostics.newest(title).get(f"publishers of {topic}") == "1"
            for title in titles
            for topic in wanted[title.rpartition("/")[2]]
        )
        and node.count_subscribers("/uwb/anchors") == len(titles)
        and all(subscription.get_publisher_count() == 1 for subscription in source.subscriptions)
        and all(2 * p.get_subscription_count() == len(titles) for p in source.publishers.values())
    )


def _count(
    out: NodeFigures,
    flight: Flight,
    namespaces: Sequence[str],
    diagnostics: DiagnosticsListener,
    source: Source,
) -> None:
    """Fill in how many messages were lost between the processes, and how many were too late."""
    out.lost = dict.fromkeys(("TDOAs", "IMU samples", "odometry"), 0)
    for space, received in zip(namespaces, source.received):
        bias, ekf = (diagnostics.newest(_title(space, name)) for name in ("bias_node", "ekf_node"))
        became = accounts(bias, ekf, flight, len(received))
        out.lost["TDOAs"] += became["lost"]
        out.lost["IMU samples"] += became["imu_lost"]
        out.lost["odometry"] += became["odometry_lost"]
        out.late += became["late"] + became["imu_late"]


def _figures(
    section: str,
    measured: NodeFigures,
    target_cpu: float | None = None,
    target_latency: float | None = None,
) -> Iterator[Figure]:
    """Figures of a NodeFigures.

    CPU and latency: medians and quartiles of blocks; memory: of nodes.
    """
    for name in PACKAGES:
        titles = [title for title in measured.cpu if title.endswith(name)]
        if not titles:
            continue
        of = f"{name}s" if len(titles) > 1 else name
        yield Figure.of(
            section,
            f"CPU, {of}",
            "% of a core",
            100.0 * sum(measured.cpu[title] for title in titles),
        )
        yield Figure.of(
            section,
            f"resident memory, each {name}",
            "MB",
            [1e-6 * measured.memory[t] for t in titles],
        )
    yield Figure.of(
        section, "CPU, all nodes", "% of a core", 100.0 * sum(measured.cpu.values()), target_cpu
    )
    for percent, target in ((50, None), (99, target_latency)):
        values = [
            np.percentile(block, percent) for block in map(_known, measured.latency) if len(block)
        ]
        yield Figure.of(
            section, f"latency p{percent}, TDOA published to odometry arrived", "ms", values, target
        )
    everything = _known(np.concatenate(measured.latency))
    yield Figure.of(
        section, "latency, the longest", "ms", everything.max() if len(everything) else np.nan
    )
    for name, count in measured.lost.items():
        yield Figure.of(section, f"lost, {name}", "messages", count)
    yield Figure.of(section, "too late to be used", "messages", measured.late)
    yield Figure.of(
        section,
        "this process: CPU of source and listener",
        "% of a core",
        100.0 * measured.source_cpu,
    )
    late = np.percentile(measured.source_late, 99)
    yield Figure.of(section, "this process: p99 of how late it published", "ms", late)


def _known(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]
