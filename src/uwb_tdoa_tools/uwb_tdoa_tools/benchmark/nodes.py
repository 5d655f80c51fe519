"""The nodes live, in real time: CPU, memory, latency, losses, time to ready; for one tag and for several."""

import json
import re
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ..live.run import accounts
from ..live.processes import Diagnostics, Processes, own_domain, variables, wait
from ..live.session import session
from .figures import Figure
from .flights import make_flight
from .source import Source, latencies
from .usage import cpu_seconds, memory

NODES = {"bias_node": "uwb_tdoa_bias", "ekf_node": "uwb_tdoa_ekf"}
SHARED = ("imu/data", "uwb/tdoa", "uwb/anchors")  # published once for all tags, so that the source stays the same
BLOCK = 3.0  # s over which CPU and latencies are taken: their median and quartiles are of blocks
READY_LIMIT, MATCH_LIMIT, SETTLE_LIMIT = 300.0, 60.0, 60.0  # s; the very first start compiles the filter
TAGS = (1, 2, 4, 8)
TARGET_CPU, TARGET_LATENCY, TARGET_READY = 60.0, 15.0, 3.0  # % of one core, ms, s
READY = re.compile(r"^\[INFO\] \[([0-9.]+)\] \[\S+\]: ready", re.MULTILINE)
SECTION = "both nodes live at 1 kHz IMU + 400 Hz TDOA, default parameters and QoS"


@dataclass
class Measured:
    """ready : {title: s from its start}; memory : {title: bytes}; cpu : {title: share of one core in each block};
    latency : one (n,) array of ms per block; lost, late : messages; source_late : (k,) ms, each message of the source;
    source_cpu : share of one core in each block."""

    ready: dict = field(default_factory=dict)
    memory: dict = field(default_factory=dict)
    cpu: dict = field(default_factory=dict)
    latency: list = field(default_factory=list)
    lost: dict = field(default_factory=dict)
    late: int = 0
    source_late: np.ndarray = field(default_factory=lambda: np.empty(0))
    source_cpu: list = field(default_factory=list)


def measure(progress, folder, quick=False):
    """Generator of Figures for one tag. progress(text); folder : for the output of the nodes."""
    progress("nodes, first start")
    first, ready, seconds = start(folder), [], 6.0 if quick else 30.0
    yield Figure.of(SECTION, "ready after its first start in this run, ekf_node", "s", first["ekf_node"])
    for _ in range(0 if quick else 4):
        progress("nodes, start")
        ready.append(start(folder))
    progress(f"nodes, {seconds:g} s live")
    live = fly(make_flight(seconds), folder, [""])
    ready.append(live.ready)
    for name in NODES:
        yield Figure.of(SECTION, f"ready after its start, {name}", "s", [one[name] for one in ready], TARGET_READY)
    yield from _figures(SECTION, live, TARGET_CPU, TARGET_LATENCY)
    if not quick:
        progress(f"nodes, 64 anchors, {seconds:g} s live")
        yield from _figures(f"{SECTION}, 64 anchors", fly(make_flight(seconds, 64), folder, [""]))


def measure_tags(progress, folder, quick=False):
    """Generator of Figures for 1, 2, 4 and 8 tags that all hear the same streams."""
    seconds = 10.0 if quick else 20.0
    flight = make_flight(seconds)
    progress("tags, first start")
    start(folder)  # whoever compiles the filter keeps the memory that took
    for tags in TAGS:
        progress(f"{tags} tags, {seconds:g} s live")
        spaces = [f"/tag{k + 1}" for k in range(tags)]
        section = f"{tags} tag{'s' * (tags > 1)}, as many pairs of nodes in namespaces"
        yield from _figures(section, fly(flight, folder, spaces))


def start(folder):
    """{node: s from its start until it says that it is ready}, one after the other."""
    with _surroundings(folder) as (node, processes):
        return {name: _start(processes, node, name, "") for name in NODES}


def fly(flight, folder, namespaces):
    """Measured of a flight in real time through the nodes of each namespace ("" or "/name")."""
    out = Measured()
    with _surroundings(folder) as (node, processes):
        diagnostics, source = Diagnostics(node), Source(node, namespaces)
        for space in namespaces:
            for name in NODES:
                out.ready[_title(space, name)] = _start(processes, node, name, space)
        matched = partial(_matched, node, source, diagnostics, out.ready)
        wait(MATCH_LIMIT, "all to find each other", processes, node, matched)
        samples = []

        def sample():
            used = {title: cpu_seconds(processes.pid(title)) for title in out.ready}
            samples.append((time.time_ns(), used, time.process_time()))

        sent, stamps, late = source.play(flight, BLOCK, sample)
        out.memory = {title: memory(processes.pid(title)) for title in out.ready}
        diagnostics.forget()
        wait(SETTLE_LIMIT, "the nodes to finish", processes, node, lambda: source.take() or diagnostics.is_settled())
        for title in out.ready:
            processes.stop(title)
    times = np.array([t for t, _, _ in samples])
    took = 1e-9 * np.diff(times)
    out.cpu = {title: np.diff([cpu[title] for _, cpu, _ in samples]) / took for title in out.ready}
    out.source_cpu, out.source_late = np.diff([own for _, _, own in samples]) / took, 1e3 * np.maximum(late, 0.0)
    delay = [latencies(sent, stamps, *np.array(got, dtype=np.int64).reshape(-1, 2).T) for got in source.received]
    block = np.searchsorted(times, sent, side="right") - 1
    out.latency = [1e3 * np.concatenate([d[block == k] for d in delay]) for k in range(len(took))]
    _count(out, flight, namespaces, diagnostics, source)
    return out


@contextmanager
def _surroundings(folder):
    """(node of ours, Processes) in a domain of their own, whose logs READY understands."""
    form = "[{severity}] [{time}] [{name}]: {message}"
    logs = {"RCUTILS_CONSOLE_OUTPUT_FORMAT": form, "RCUTILS_COLORIZED_OUTPUT": "0"}
    with own_domain(), variables(logs), session("bench", []) as (node, stop), Processes(folder, stop) as processes:
        yield node, processes


def _start(processes, node, name, space):
    """Start a node and wait until it is ready; returns the s that took, by the clock of its log."""
    title, arguments = _title(space, name), []
    if space:
        remaps = [f"__ns:={space}", *(f"{topic}:=/{topic}" for topic in SHARED)]
        arguments = ["--ros-args", *(part for remap in remaps for part in ("-r", remap))]
        if name == "ekf_node":
            arguments += ["-p", f"body_frame:={json.dumps(space.strip('/'))}"]
    began = time.time()
    processes.start(NODES[name], name, *arguments, title=title)
    said = []

    def is_ready():
        said[:] = READY.findall(processes.file(title).read_text(errors="replace"))
        return said

    wait(READY_LIMIT, f"{title} to be ready", processes, node, is_ready)
    return float(said[0]) - began


def _title(space, name):
    return f"{space}/{name}".strip("/")


def _matched(node, source, diagnostics, titles):
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


def _count(out, flight, namespaces, diagnostics, source):
    """Fill in what was lost between the processes, and what came too late to be used."""
    out.lost = dict.fromkeys(("TDOAs", "IMU samples", "odometry"), 0)
    for space, received in zip(namespaces, source.received):
        ekf = diagnostics.newest(_title(space, "ekf_node"))
        became = accounts(ekf, flight)
        out.lost["TDOAs"] += became["lost"]
        out.lost["IMU samples"] += became["imu_lost"]
        out.lost["odometry"] += int(ekf["odometry published"]) - len(received)
        out.late += became["late"] + became["imu_late"]


def _figures(section, measured, target_cpu=None, target_latency=None):
    """Figures of a Measured. CPU and latency: medians and quartiles of blocks; memory: of nodes."""
    for name in NODES:
        titles = [title for title in measured.cpu if title.endswith(name)]
        of = f"{name}s" if len(titles) > 1 else name
        yield Figure.of(section, f"CPU, {of}", "% of a core", 100.0 * sum(measured.cpu[title] for title in titles))
        yield Figure.of(section, f"resident memory, each {name}", "MB", [1e-6 * measured.memory[t] for t in titles])
    yield Figure.of(section, "CPU, all nodes", "% of a core", 100.0 * sum(measured.cpu.values()), target_cpu)
    for percent, target in ((50, None), (99, target_latency)):
        values = [np.percentile(block, percent) for block in map(_known, measured.latency) if len(block)]
        yield Figure.of(section, f"latency p{percent}, TDOA published to odometry arrived", "ms", values, target)
    everything = _known(np.concatenate(measured.latency))
    yield Figure.of(section, "latency, the longest", "ms", everything.max() if len(everything) else np.nan)
    for name, count in measured.lost.items():
        yield Figure.of(section, f"lost, {name}", "messages", count)
    yield Figure.of(section, "too late to be used", "messages", measured.late)
    yield Figure.of(section, "this process: CPU of source and listener", "% of a core", 100.0 * measured.source_cpu)
    late = np.percentile(measured.source_late, 99)
    yield Figure.of(section, "this process: p99 of how late it published", "ms", late)


def _known(values):
    return values[np.isfinite(values)]
