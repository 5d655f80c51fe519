# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is most needed of the `ros2` command, for those without ROS: `./dev ros2 ...`.

Where ROS 2 is sourced, that one runs.
"""

from collections import deque
import sys
import time

from rcl_interfaces.msg import Parameter
import rclpy
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
import yaml

from uwb_tdoa_bias.common.errors import Failure, printable
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.bags.files import new_bag
from uwb_tdoa_tools.live.session import Recorder, message_class, session, subscription_qos

SETTLED = 1.5  # s without news of the graph after which it is complete
PATIENCE = 15.0  # s for a first topic, node or publisher to be seen, and for a node to answer
WINDOW = 1000  # messages that a rate is averaged over
OF_EVERY_NODE = {"/parameter_events", "/rosout"}

DESCRIPTION = """Topics, nodes, parameters and recording, as the command of ROS 2 has them; for those who have no ROS.

Launch files and the rest need ROS 2. `./dev run uwb_tdoa_tools replay` plays bags without it."""


def parser():
    """Its commands."""
    made = cli.parser(
        "ros2",
        DESCRIPTION,
        "./dev ros2 topic list -t",
        "./dev ros2 topic info -v uwb/tdoa",
        "./dev ros2 topic hz imu/data",
        "./dev ros2 topic echo odometry --once",
        "./dev ros2 bag record -o flown_bag odometry uwb/residual",
        "./dev ros2 node list",
        "./dev ros2 param describe ekf_node tdoa_std",
        "./dev ros2 param set ekf_node tdoa_std 0.3",
    )
    things = made.add_subparsers(dest="thing", required=True, metavar="topic|bag|node|param")

    def commands(thing, text, rows):
        verbs = things.add_parser(thing, help=text).add_subparsers(dest="verb", required=True)
        for name, run, text, *arguments in rows:
            verb = verbs.add_parser(name, help=text)
            verb.set_defaults(run=run)
            for argument, options in arguments:
                verb.add_argument(*argument, **options)

    topic, node, name = ((("topic",), {}), (("node",), {}), (("name",), {}))
    some = ("node",), {"nargs": "?", "help": "of this node; default: of all"}
    types = ("-t", "--show-types"), {"action": "store_true"}
    verbose = ("-v", "--verbose"), {"action": "store_true", "help": "nodes and QoS of both ends"}
    commands(
        "topic",
        "what is published",
        [
            ("list", topic_list, "all topics", types),
            ("info", topic_info, "type, and who publishes and hears it", topic, verbose),
            ("hz", topic_hz, "how often a message comes, each second", topic),
            (
                "echo",
                topic_echo,
                "messages as YAML",
                topic,
                (("--once",), {"action": "store_true", "help": "only one"}),
            ),
        ],
    )
    commands(
        "bag",
        "recordings",
        [
            (
                "record",
                bag_record,
                "messages of topics to a new bag, until Ctrl-C",
                (("topics",), {"nargs": "+", "metavar": "topic"}),
                (("-o", "--output"), {"required": True, "metavar": "BAG", "help": "new folder"}),
            )
        ],
    )
    commands("node", "who is there", [("list", node_list, "all nodes")])
    commands(
        "param",
        "parameters of nodes",
        [
            ("list", param_list, "names", some),
            ("get", param_get, "a value", node, name),
            ("set", param_set, "another value, as in YAML", node, name, (("value",), {})),
            ("describe", param_describe, "text, unit and range", node, name),
        ],
    )
    return made


def show(text):
    """Print a line that holds what others have named or written: a terminal shows all of it, and
    obeys nothing.
    """
    print(printable(text), flush=True)


# --- topics ---


def topic_list(node, stop, args):
    for topic, types in _settled(
        node.get_topic_names_and_types, lambda topics: {*dict(topics)} - OF_EVERY_NODE, stop
    ):
        show(f"{topic} [{', '.join(types)}]" if args.show_types else topic)


def topic_info(node, stop, args):
    topic = _topic(node, stop, args.topic, needs_publisher=False)
    _settled(
        lambda: (node.count_publishers(topic), node.count_subscribers(topic)),
        lambda counts: counts[0] > 0,
        stop,
    )
    ends = {
        "Publisher": node.get_publishers_info_by_topic,
        "Subscription": node.get_subscriptions_info_by_topic,
    }
    show(f"Type: {', '.join(dict(node.get_topic_names_and_types())[topic])}")
    for kind, infos in ends.items():
        infos = infos(topic)
        show(f"{kind} count: {len(infos)}")
        for info in infos if args.verbose else ():
            qos = info.qos_profile
            name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            show(
                f"  {name} [{info.topic_type}]: {qos.reliability.name.lower()}, "
                f"{qos.durability.name.lower()}"
            )


def topic_hz(node, stop, args):
    stamps, shown = deque(maxlen=WINDOW), time.monotonic()
    _subscribe(node, stop, args.topic, lambda _: stamps.append(time.monotonic()), raw=True)
    while not stop:
        rclpy.spin_once(node, timeout_sec=0.1)
        if time.monotonic() > shown + 1.0:
            shown = time.monotonic()
            show(_rate(list(stamps)))
            while stamps and stamps[0] < shown - 10.0:
                stamps.popleft()


def _rate(stamps):
    steps = [after - before for before, after in zip(stamps, stamps[1:])]
    if not steps:
        return "no new messages"
    return (
        f"average rate: {len(steps) / sum(steps):.3f}  min: {min(steps):.4f}s max: "
        f"{max(steps):.4f}s window: {len(stamps)}"
    )


def topic_echo(node, stop, args):
    received = deque()
    _subscribe(node, stop, args.topic, lambda message: received.append(message))
    while not stop:
        rclpy.spin_once(node, timeout_sec=0.1)
        while received:
            cli.show(
                f"{yaml.safe_dump(_plain(received.popleft()), sort_keys=False, default_flow_style=None)}---"
            )
            if args.once:
                return


def _plain(value):
    """A message as what YAML knows."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else list(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_plain(each) for each in value] if isinstance(value, (list, tuple)) else value


def _subscribe(node, stop, name, callback, raw=False):
    topic = _topic(node, stop, name, needs_publisher=True)
    offered = node.get_publishers_info_by_topic(topic)
    kind = message_class(offered[0].topic_type)
    if kind is None:
        raise Failure(f"{topic} is {offered[0].topic_type}, which is not installed here")
    node.create_subscription(
        kind, topic, callback, subscription_qos([info.qos_profile for info in offered]), raw=raw
    )


def _topic(node, stop, name, needs_publisher):
    """The absolute name of a topic, when it is there."""
    topic, until = node.resolve_topic_name(name), time.monotonic() + PATIENCE
    while not stop:
        if node.count_publishers(topic) or not needs_publisher and node.count_subscribers(topic):
            return topic
        if time.monotonic() > until:
            raise Failure(
                f"{topic}: nobody {'publishes' if needs_publisher else 'publishes or hears'} "
                "it; see ros2 topic list"
            )
        rclpy.spin_once(node, timeout_sec=0.05)
    raise KeyboardInterrupt


# --- bags ---


def bag_record(node, stop, args):
    wanted = {node.resolve_topic_name(topic) for topic in args.topics}
    with new_bag(args.output) as writer:
        recorder = Recorder(node, writer, wanted, show)
        show(f"waiting for {', '.join(sorted(wanted))}; Ctrl-C ends the recording")
        recorder.run(lambda: stop)
        if not any(recorder.counts.values()):
            raise Failure("no message came, so no bag is written; see ros2 topic list")
    for topic, count in sorted(recorder.counts.items()):
        show(f"{topic}: {count} messages")
    for topic in sorted(wanted - {*recorder.counts}):
        show(f"{topic}: nobody published it")


# --- nodes and parameters ---


def node_list(node, stop, args):
    for name in _nodes(node, stop):
        show(name)


def param_list(node, stop, args):
    silent = []
    for name in [args.node] if args.node else _nodes(node, stop):
        client = _client(node, stop, name, missing_ok=not args.node)
        if client is None:  # a node without parameters
            continue
        try:
            names = _answer(node, stop, client.list_parameters()).result.names
        except Failure:
            if args.node:
                raise
            silent.append(name)  # the others may answer
            continue
        if not args.node:
            show(f"{name}:")
        for parameter in sorted(names):
            show(parameter if args.node else f"  {parameter}")
    if silent:
        raise Failure(f"{', '.join(silent)}: does not answer")


def param_get(node, stop, args):
    values = _answer(node, stop, _client(node, stop, args.node).get_parameters([args.name])).values
    show(parameter_value_to_python(_the_one(values, args)))


def param_set(node, stop, args):
    parameter = Parameter(name=args.name, value=get_parameter_value(args.value))
    (result,) = _answer(
        node, stop, _client(node, stop, args.node).set_parameters([parameter])
    ).results
    if not result.successful:
        raise Failure(f"{args.name}: not set: {result.reason}")
    show("Set parameter successful")


def param_describe(node, stop, args):
    descriptors = _answer(
        node, stop, _client(node, stop, args.node).describe_parameters([args.name])
    ).descriptors
    found = _the_one(descriptors, args)
    show(f"{found.name}: {found.description}")
    for bounds in (*found.floating_point_range, *found.integer_range):
        show(f"  from {bounds.from_value:g} to {bounds.to_value:g}")
    if found.additional_constraints:
        show(f"  {found.additional_constraints}")
    show("  read only" if found.read_only else "  can be set in flight")


def _the_one(answers, args):
    """The answer about a parameter; a node says nothing of those that it does not have."""
    if not answers or answers[0].type == 0:
        raise Failure(f"{args.node} has no parameter {args.name}; see ros2 param list {args.node}")
    return answers[0]


def _nodes(node, stop):
    """Absolute names of all other nodes."""

    def others():
        names = {
            f"{namespace.rstrip('/')}/{name}"
            for name, namespace in node.get_node_names_and_namespaces()
        }
        return sorted(names - {node.get_fully_qualified_name()})

    return _settled(others, bool, stop)


def _client(node, stop, name, missing_ok=False):
    """Client of the parameters of a node, which is there."""
    client, until = AsyncParameterClient(node, name), time.monotonic() + PATIENCE
    while not client.services_are_ready():
        if stop:
            raise KeyboardInterrupt
        if time.monotonic() > until:
            if missing_ok:
                return None
            raise Failure(f"{name}: no such node, or it has no parameters; see ros2 node list")
        rclpy.spin_once(node, timeout_sec=0.05)
    return client


def _answer(node, stop, future):
    until = time.monotonic() + PATIENCE
    while not future.done():
        if stop:
            raise KeyboardInterrupt
        if time.monotonic() > until:
            raise Failure("the node does not answer")
        rclpy.spin_once(node, timeout_sec=0.05)
    return future.result()


def _settled(look, found, stop):
    """What look() gives when it has not changed for a while; what is not found(it) yet is waited
    for longer.
    """
    seen, changed = look(), time.monotonic()
    while not stop and time.monotonic() < changed + (SETTLED if found(seen) else PATIENCE):
        time.sleep(0.05)
        now = look()
        if now != seen:
            seen, changed = now, time.monotonic()
    return seen


def _run(args):
    with session("ros2", []) as (node, stop):
        args.run(node, stop, args)


if __name__ == "__main__":
    sys.exit(cli.run(_run, parser()))
