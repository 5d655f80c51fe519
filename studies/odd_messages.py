# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""odd-messages: send messages to nodes that no driver should send.

The study sends --count messages on each topic that a node takes, changed at random. Numbers are
NaN, huge, tiny or negative, ids and stamps are random, and names are long. As bytes, messages are
cut off, longer, without their last 8 bytes, with flipped bits, in another encoding, or noise. Valid
messages come in between.

No node may end, and its memory must not grow. Every message of a stream must be received or counted
as unreadable. On other topics, every unreadable message must be counted.

Then the study sends as many requests with odd values to every service of each node, including
parameter services. Each must be answered. Nodes that count no messages get odd messages meanwhile.
"""

from collections import Counter
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import re
import tempfile
import time

from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
)
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import FluidPressure, Imu, Range
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from studies.bench import nodes
from studies.bench.nodes import READY_LIMIT, ready_at, surroundings
from studies.bench.usage import memory
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import Failure
from uwb_tdoa_bias.ros.anchors import anchors_to_message
from uwb_tdoa_bias.ros.cdr import Unreadable, decode
from uwb_tdoa_bias.ros.frames import read_transforms
from uwb_tdoa_msgs.msg import AnchorArray, EstimatorStatus, Tdoa, TdoaCorrected
from uwb_tdoa_msgs.srv import GoTo, Land, Takeoff
from uwb_tdoa_tools.live.processes import DiagnosticsListener, LiveError, wait
from uwb_tdoa_tools.live.session import answer_of

RCLError = rclpy_implementation.RCLError
CORPUS = Path(__file__).parent / "fuzzing" / "corpus"
ALIGNED = 4  # bytes; the middleware fills up to that, so that other lengths arrive longer
# bytes; after an empty message Fast DDS delivers nothing more of a reliable publisher, to whomever
SHORTEST = 4
PATIENCE = 60.0  # s
LATCHED = "uwb/anchors", "/tf_static", "status"
EXTREME = np.nan, np.inf, -np.inf, 1e308, -1e308, 1e150, 1e16, 1e-320, 0.0, -1.0
STREAMS = {  # of each node: topic, type, and what counts those that could be read
    "ekf_node": {
        "imu/data": (Imu, "IMU samples received"),
        "uwb/tdoa_corrected": (TdoaCorrected, "TDOAs received"),
        "height": (Range, "height_received"),
        "pressure": (FluidPressure, "pressure_received"),
        "velocity": (TwistWithCovarianceStamped, "velocity_received"),
        "velocity/odometry": (Odometry, "velocity_received"),
    },
    "bias_node": {"uwb/tdoa": (Tdoa, "received"), "odometry": (Odometry, "poses")},
    "debias_node": {"odometry": (Odometry, "received")},
    "autopilot_node": {"odometry": (Odometry, "received")},
}
SINGLE = {
    "ekf_node": {
        "uwb/anchors": AnchorArray,
        "/tf_static": TFMessage,
        "/tf": TFMessage,
        "initialpose": PoseWithCovarianceStamped,
    },
    "bias_node": {"uwb/anchors": AnchorArray, "/tf_static": TFMessage},
    "debias_node": {},
    "autopilot_node": {"status": EstimatorStatus},
}
# topics, beside requests
UNCOUNTED = {"vehicle_node": {"odometry": Odometry, "status": EstimatorStatus}}
PACKAGES = nodes.PACKAGES | {
    "debias_node": "uwb_tdoa_ekf",
    "anchors_node": "uwb_tdoa_bias",
    "autopilot_node": "uwb_tdoa_tools",
    "vehicle_node": "uwb_tdoa_tools",
}
OF_PARAMETERS = {
    "set_parameters": SetParameters,
    "set_parameters_atomically": SetParametersAtomically,
    "get_parameters": GetParameters,
    "get_parameter_types": GetParameterTypes,
    "describe_parameters": DescribeParameters,
    "list_parameters": ListParameters,
}
SERVICES = {
    "ekf_node": {"ekf_node/reset": Trigger},
    "bias_node": {},
    "debias_node": {},
    "anchors_node": {},
    "autopilot_node": {},
    "vehicle_node": {"takeoff": Takeoff, "go_to": GoTo, "land": Land},
}
NAMES = (
    "use_sim_time",
    "frozen",
    "tdoa_std",
    "anchors_file",
    "map",
    "marker_size",
    "seed",
    "",
    "nothing",
    "x" * 5000,
    "\x1b[2J",
)
ANCHORS = Anchors.from_positions(
    [[0, 0, 0], [8, 0, 1], [0, 8, 2], [8, 8, 0], [0, 0, 3], [8, 0, 3], [0, 8, 3], [8, 8, 3]]
)


@dataclass
class Account:
    """Numbers of messages by topic, and the memory of a node.

    sent : all topics
    received : messages of streams
    unreadable : counted by the node
    expected : unreadable messages on topics that are no streams
    memory : bytes after each tenth
    log : bytes
    """

    sent: dict
    received: dict
    unreadable: dict
    expected: dict
    memory: list
    log: int


def changed(data, rng, step=1):
    """A message as bytes, changed at random, or unchanged. step : its length becomes a multiple of
    so many bytes.
    """
    data += bytes(-len(data) % step)
    out, kind = bytearray(data), rng.random()
    if kind < 0.15:
        return data
    if kind < 0.3:
        return bytes(out[: max(SHORTEST, step * rng.integers(len(out) // step))])
    if kind < 0.35:
        return bytes(out[:-8])
    if kind < 0.45:
        return bytes(out) + rng.bytes(step * rng.integers(1, 64 // step))
    if kind < 0.55:
        out[:4] = (
            rng.bytes(4) if rng.random() < 0.3 else bytes([0, rng.integers(12), 0, rng.integers(4)])
        )
    elif kind < 0.6:
        return rng.bytes(max(SHORTEST, step * rng.integers(400 // step)))
    else:
        for place in rng.integers(4, len(out), size=rng.integers(1, 8)):
            out[place] ^= 1 << rng.integers(8)
    return bytes(out)


def odd(message, rng):
    """The same message with some values that are odd, but that its type may have."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        parts = [
            part
            for part in (value if isinstance(value, list) else [value])
            if hasattr(part, "get_fields_and_field_types")
        ]
        for part in parts:
            odd(part, rng)
        if parts or rng.random() > 0.2:
            continue
        if kind == "string":
            setattr(message, name, "x" * int(rng.choice([0, 1, 200, 5000])))
        elif isinstance(value, float):
            setattr(
                message,
                name,
                float(
                    np.clip(
                        rng.choice(EXTREME),
                        *([-3e38, 3e38] if kind == "float" else [-np.inf, np.inf]),
                    )
                ),
            )
        elif isinstance(value, int) and not isinstance(value, bool):
            signed, bits = not kind.startswith("u"), int("".join(filter(str.isdigit, kind)) or 8)
            low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
            setattr(
                message,
                name,
                (low, high, int(rng.integers(low, min(high, 2**63 - 1))))[rng.integers(3)],
            )
        elif isinstance(value, np.ndarray) and len(value):
            value[rng.integers(len(value), size=3)] = rng.choice(EXTREME, size=3)
    return message


def whole(kind, k, change=lambda message: message):
    """The k-th valid message, as bytes. change(message) returns the message that is serialized."""
    return serialize_message(change(_message(kind, k)))


def _message(kind, k):
    if kind is AnchorArray:
        return anchors_to_message(ANCHORS)
    message = kind()
    if kind is TFMessage:
        message.transforms = [
            TransformStamped(child_frame_id=child) for child in ("base_link", "imu")
        ]
        for transform in message.transforms:
            transform.header.frame_id = "odom"
            transform.header.stamp.sec = 100 + k // 100
        return message
    message.header.frame_id = "map" if kind is PoseWithCovarianceStamped else "base_link"
    message.header.stamp.sec, message.header.stamp.nanosec = 100 + k // 100, k % 100 * 10_000_000
    if hasattr(message, "anchor_a"):
        message.anchor_a, message.anchor_b = k % 8, (k + 1) % 8
    return message


def ordeal(name, count, folder, seed=1):
    """Account of a node that is sent `count` messages on each topic."""
    with surroundings(folder) as (node, processes):
        diagnostics, log = DiagnosticsListener(node), processes.file(name)
        told = [
            part
            for topic in STREAMS[name]
            for part in ("-p", f"qos_overrides./{topic}.subscription.reliability:=reliable")
        ]
        told += _told(name, folder)
        processes.start(PACKAGES[name], name, "--ros-args", *told)
        wait(
            READY_LIMIT,
            f"{name} to be ready",
            processes,
            node,
            lambda: ready_at(name, log.read_text(errors="replace")),
        )
        publishers = _publishers(node, processes, diagnostics, name)
        out = _send(node, processes, publishers, name, count, np.random.default_rng(seed))

        def said(key):
            return int(diagnostics.newest(name).get(key, -1))

        def is_settled():
            out.unreadable = {topic: said(f"unreadable on {topic}") for topic in publishers}
            out.received = {topic: said(key) for topic, (_, key) in STREAMS[name].items()}
            return not wrong(out)

        until = time.monotonic() + PATIENCE
        while not is_settled() and time.monotonic() < until:
            processes.check()
            rclpy.spin_once(node, timeout_sec=0.1)
        out.memory.append(memory(processes.pid(name)))
        processes.stop(name)
        out.log = log.stat().st_size
        assert not re.search("Traceback", log.read_text(errors="replace")), log
    return out


def _publishers(node, processes, diagnostics, name):
    """{topic: publisher} of everything that the node takes, after both ends know of each other."""
    kinds = {topic: kind for topic, (kind, _) in STREAMS[name].items()} | SINGLE[name]
    out = {topic: node.create_publisher(kind, topic, qos(topic)) for topic, kind in kinds.items()}
    wait(
        PATIENCE,
        "it to listen",
        processes,
        node,
        lambda: all(p.get_subscription_count() for p in out.values()),
    )
    found = {f"publishers of {topic}" for topic in STREAMS[name]}
    wait(
        PATIENCE,
        "the node to find us",
        processes,
        node,
        lambda: all(diagnostics.newest(name).get(key) == "1" for key in found),
    )
    return out


def _send(node, processes, publishers, name, count, rng):
    """Account of the sent messages: one on each topic, then a wait for an answer of the node.

    Of the anchors, the middleware keeps only the last message.
    """
    out = Account(dict.fromkeys(publishers, count), {}, {}, dict.fromkeys(SINGLE[name], 0), [], 0)
    client = node.create_client(GetParameters, f"/{name}/get_parameters")
    wait(PATIENCE, "the node to be found", processes, node, client.service_is_ready)
    for k in range(count):
        for topic, publisher in publishers.items():
            kind, single = publisher.msg_type, topic in SINGLE[name]
            data = whole(
                kind,
                k,
                (lambda message: odd(message, rng))
                if rng.random() < 0.5
                else (lambda message: message),
            )
            data = changed(data, rng, ALIGNED if single else 1)
            if single:
                out.expected[topic] += not is_readable(data, kind)
            publisher.publish(data)
        wait(
            PATIENCE,
            "an answer",
            processes,
            node,
            answer_of(partial(client.call_async, GetParameters.Request(names=["use_sim_time"]))),
        )
        if k % max(1, count // 10) == 0:
            out.memory.append(memory(processes.pid(name)))
    return out


def wrong(account):
    """Topics whose messages are not all accounted for: {topic: sentence}."""
    out = {}
    by_counter = {}
    for topic, _received in account.received.items():  # two topics may share a counter
        by_counter.setdefault("velocity" if topic.startswith("velocity") else topic, []).append(
            topic
        )
    for name, topics in by_counter.items():
        sent = sum(account.sent[topic] for topic in topics)
        known = account.received[topics[0]] + sum(account.unreadable[topic] for topic in topics)
        if sent != known:
            out[name] = f"{known} of {sent} are accounted for"
    for topic, expected in account.expected.items():
        if account.unreadable[topic] != expected:
            out[topic] = f"{account.unreadable[topic]} unreadable, {expected} sent"
    return out


def is_readable(data, kind):
    """Whether a message that is no stream can be read."""
    try:
        read_transforms(data) if kind is TFMessage else decode(data, kind)
    except Unreadable:
        return False
    return True


def qos(topic):
    """Reliable; latched where the subscription asks for it."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic in LATCHED else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def _told(name, folder):
    """Parameters that a node needs, as arguments."""
    if name == "anchors_node":
        ANCHORS.to_yaml(Path(folder) / "anchors.yaml")
    return {
        "ekf_node": ["-p", "publish_tf:=odom"],
        "bias_node": ["-p", f"model_file:={CORPUS / 'model' / '0'}"],
        "debias_node": ["-p", f"map:={CORPUS / 'bias_map' / '0'}"],
        "anchors_node": ["-p", f"anchors_file:={Path(folder) / 'anchors.yaml'}"],
        "autopilot_node": ["-p", "rate:=50.0"],
        "vehicle_node": ["-p", "duration:=1800.0"],
    }[name]


def request_ordeal(name, count, folder, seed=1):
    """Send `count` odd requests to every service of a node, and the messages of UNCOUNTED.

    Returns {service: number of answered requests}, and bytes of memory after each tenth. A vehicle
    that falls ends its node, as it should: it is started again.
    """
    answered, used, rng = Counter(), [], np.random.default_rng(seed)
    while (left := count - max(answered.values(), default=0)) > 0:
        with surroundings(folder) as (node, processes):
            processes.start(PACKAGES[name], name, "--ros-args", *_told(name, folder))
            services = {
                f"{name}/{service}": kind for service, kind in OF_PARAMETERS.items()
            } | SERVICES[name]
            clients = {
                service: node.create_client(kind, f"/{service}")
                for service, kind in services.items()
            }
            publishers = {
                topic: node.create_publisher(kind, topic, qos(topic))
                for topic, kind in UNCOUNTED.get(name, {}).items()
            }
            wait(
                READY_LIMIT,
                f"{name} to offer its services",
                processes,
                node,
                lambda: all(c.service_is_ready() for c in clients.values()),
            )
            try:
                for k in range(left):
                    for publisher in publishers.values():
                        message = whole(
                            publisher.msg_type,
                            k,
                            (lambda one: odd(one, rng))
                            if rng.random() < 0.5
                            else (lambda one: one),
                        )
                        publisher.publish(changed(message, rng))
                    for service, client in clients.items():
                        ask = partial(client.call_async, _request(services[service], rng))
                        wait(PATIENCE, f"an answer of {service}", processes, node, answer_of(ask))
                        answered[service] += 1
                    if k % max(1, count // 10) == 0:
                        used.append(memory(processes.pid(name)))
                processes.stop(name)
            except LiveError:
                if "the flight is over" not in processes.file(name).read_text(errors="replace"):
                    raise
            assert not re.search("Traceback", processes.file(name).read_text(errors="replace")), (
                processes.file(name)
            )
    return answered, used


def _request(kind, rng):
    """A request whose values are odd, for some names that there are and some that there are not."""
    out, some = kind.Request(), [str(one) for one in rng.choice(NAMES, size=rng.integers(5))]
    if hasattr(out, "parameters"):
        out.parameters = [Parameter(name=one) for one in some]
        for parameter in out.parameters:
            parameter.value.type = int(rng.integers(12))
            odd(parameter.value, rng)
            parameter.value.double_array_value = [
                float(one) for one in rng.choice(EXTREME, size=rng.integers(4))
            ]
            parameter.value.string_array_value = [
                str(one) for one in rng.choice(NAMES, size=rng.integers(4))
            ]
    elif hasattr(out, "names"):
        out.names = some
    elif hasattr(out, "prefixes"):
        out.prefixes = some
    return odd(out, rng) if rng.random() < 0.8 else out


def clock_ordeal(count, folder, seed=1):
    """Send `count` odd messages on /clock; returns whether ekf_node still answers."""
    rng = np.random.default_rng(seed)
    with surroundings(folder) as (node, processes):
        processes.start(PACKAGES["ekf_node"], "ekf_node", "--ros-args", "-p", "use_sim_time:=true")
        log = processes.file("ekf_node")
        wait(
            READY_LIMIT,
            "ekf_node to be ready",
            processes,
            node,
            lambda: ready_at("ekf_node", log.read_text(errors="replace")),
        )
        publisher = node.create_publisher(Clock, "/clock", 10)
        client = node.create_client(GetParameters, "/ekf_node/get_parameters")
        wait(
            PATIENCE,
            "it to listen",
            processes,
            node,
            lambda: publisher.get_subscription_count() and client.service_is_ready(),
        )
        for _ in range(count):
            try:
                publisher.publish(changed(serialize_message(Clock()), rng))
            except RCLError:  # the middleware sends none that is longer than any Clock
                continue
            time.sleep(0.001)  # the newest is taken 50 times a second
        ask = partial(client.call_async, GetParameters.Request(names=["use_sim_time"]))
        wait(PATIENCE, "ekf_node to answer", processes, node, answer_of(ask))
        processes.stop("ekf_node")
        return "Traceback" not in log.read_text(errors="replace")


def add_options(add):
    """The options of the study."""
    nodes_help = f"of {', '.join(SERVICES)} (default: all)"
    add("count", metavar="COUNT", type=int, help="messages on each topic")
    add("--seed", metavar="N", type=int, default=1, help="of the messages (default %(default)s)")
    add("--only", nargs="+", choices=SERVICES, default=[*SERVICES], metavar="NODE", help=nodes_help)


def run(args):
    """Send the messages, and print the counts. Raises Failure if a node ends or counts wrong."""
    bad = False
    with tempfile.TemporaryDirectory() as folder:
        for name in (name for name in STREAMS if name in args.only):
            began = time.monotonic()
            account = ordeal(name, args.count, Path(folder), args.seed)
            took, total = time.monotonic() - began, sum(account.sent.values())
            print(
                name,
                json.dumps({k: v for k, v in vars(account).items()}),
                wrong(account) or "all accounted for",
            )
            print(
                f"{name}: {total} messages in {took:.0f} s, {total / took:.0f} in a second",
                flush=True,
            )
            bad |= bool(wrong(account))
        for name in args.only:
            began = time.monotonic()
            answered, used = request_ordeal(name, args.count, Path(folder), args.seed)
            print(
                (
                    f"{name}: answered {dict(answered)} in {time.monotonic() - began:.0f} s; "
                    f"memory {used}"
                ),
                flush=True,
            )
        fine = "ekf_node" not in args.only or clock_ordeal(args.count, Path(folder), args.seed)
        print("/clock:", "goes on" if fine else "ended")
    if bad or not fine:
        raise Failure("a node ended, or did not account for every message; see above.")
