"""Replay a bag over ROS topics, for those who have no `ros2 bag play`."""

import argparse
import itertools
import sys
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..bags.files import messages, open_bag
from ..live.follow import Follower, is_stamped, stamp_of
from ..live.read_ahead import read_ahead
from ..live.session import message_class, own_arguments, publisher_qos, session

RCLError = rclpy_implementation.RCLError
DESCRIPTION = """Replay a bag over ROS topics with its own timing, like `ros2 bag play`.

Every topic is published with the durability it was recorded with, and always reliably, which serves best-effort
subscriptions too: a reliable subscription gets every message at any rate (the replay waits for it when it must), a
best-effort one gets what it keeps up with. With --follow, nothing is played more than 2 s ahead of what comes of it: a
slow computer then takes longer, and gets the same. Ends when every reliable subscription has everything, and tells what was
published and how late. Topics can be moved with ROS arguments, as in the last example.
"""
SETTLE = 0.2  # s from the last match to the first message: a subscription learns of a match a little later than we do
ACKNOWLEDGE_LIMIT = 30.0  # s; longer than the 20 s after which DDS forgets a subscription that died
LARGEST_CATCH_UP = 0.1  # s: a longer delay shifts all that follows, instead of a burst that a subscription cannot take
LONGEST_SLEEP = 0.05  # s: how soon a signal is seen


def main(argv=None):
    arguments = sys.argv[1:] if argv is None else argv
    parser = cli.parser(
        "replay",
        DESCRIPTION,
        "replay flight.bag",
        "replay flight.bag --rate 4 --clock",
        "replay flight.bag --rate 10 --follow odometry",
        "replay flight.bag --wait-matched 30 --wait-topics imu/data uwb/tdoa",
        "replay flight.bag --ros-args -r /uwb/tdoa:=/tag1/uwb/tdoa -r /imu/data:=/tag1/imu/data",
    )
    parser.add_argument("bag", help="bag directory, or its .mcap or .db3 file")
    parser.add_argument("-r", "--rate", type=_positive, default=1.0, help="times as fast as recorded (default 1)")
    parser.add_argument("-l", "--loop", action="store_true", help="start again at the end, until stopped")
    parser.add_argument(
        "--clock",
        type=_positive,
        nargs="?",
        const=40.0,
        metavar="HZ",
        help="publish the bag's time on /clock (default 40 Hz)",
    )
    parser.add_argument(
        "--wait-matched", type=_positive, default=2.0, metavar="SECONDS",
        help="wait at most this long until somebody subscribes to every topic, then start (default 2)",
    )  # fmt: skip
    parser.add_argument(
        "--wait-topics", nargs="+", default=[], metavar="TOPIC",
        help="wait for these topics only, and fail if nobody subscribes to one of them in time",
    )  # fmt: skip
    parser.add_argument("--follow", metavar="TOPIC", help="wait whenever the stamps on this topic fall 2 s behind")
    return cli.run(lambda args: replay(args, arguments), parser, own_arguments("replay", arguments))


@dataclass
class Played:
    """What was published.

    counts : messages by topic; behind : s, the latest that a message was; stretched : s, by how much the time of the
    replay was stretched, so that a stall was not followed by a burst that nobody can take; waited : s, for --follow.
    """

    counts: Counter = field(default_factory=Counter)
    behind: float = 0.0
    stretched: float = 0.0
    waited: float = 0.0


def replay(args, ros_arguments):
    """Replay as the parsed arguments say; returns the exit code. Raises InputError."""
    with open_bag(args.bag) as reader, session("replay", ros_arguments) as (node, stop):
        publishers = _publishers(node, args.bag, reader)
        connections = [connection for connection in reader.connections if connection.topic in publishers]
        count = sum(connection.msgcount for connection in connections)
        if not count:
            raise InputError(f"{args.bag}: has no message to replay.")
        clock = node.create_publisher(Clock, "/clock", QoSProfile(depth=10)) if args.clock else None
        _wait_matched(publishers, args.wait_matched, args.wait_topics, stop)
        follower = Follower(node, args.follow) if args.follow else None
        length = (reader.end_time - reader.start_time) / 1e9
        _say(f"playing {count} messages, {length:.1f} s at rate {args.rate:g}")
        played = Played()
        began = time.perf_counter()
        while not stop:
            with closing(read_ahead(messages(args.bag, reader, connections))) as recorded:
                _play(recorded, publishers, args.rate, clock, args.clock, follower, played, stop)
            if not args.loop:
                break
        took = time.perf_counter() - began
        acknowledged = _wait_acknowledged(publishers.values(), stop)
    for topic, count in sorted(played.counts.items()):
        print(f"{topic}: {count} messages")
    print(
        f"{sum(played.counts.values())} messages in {took:.2f} s, at most {1e3 * played.behind:.1f} ms late, "
        f"stretched by {1e3 * played.stretched:.1f} ms"
        + (f", waited {played.waited:.2f} s for {args.follow}" if follower else "")
    )
    if stop:
        _say("stopped")
        return 0 if args.loop else 128 + stop.signal
    if not acknowledged:
        _say(f"not every subscription acknowledged every message within {ACKNOWLEDGE_LIMIT:g} s")
        return 1
    return 0


def _publishers(node, bag, reader):
    """{topic: publisher} of all topics whose type is installed."""
    publishers = {}
    by_topic = itertools.groupby(sorted(reader.connections, key=lambda c: c.topic), key=lambda c: c.topic)
    for topic, connections in by_topic:
        connections = list(connections)
        cls = message_class(connections[0].msgtype)
        if cls is None:
            _say(f"leaving out {topic}: its type {connections[0].msgtype} is not installed")
            continue
        recorded = [qos for connection in connections for qos in connection.ext.offered_qos_profiles]
        qos = publisher_qos(recorded, sum(connection.msgcount for connection in connections))
        publishers[topic] = node.create_publisher(cls, topic, qos)
    if not publishers:
        raise InputError(f"{bag}: has no topic of an installed type; build and source the workspace first.")
    return publishers


def _wait_matched(publishers, limit, topics, stop):
    """Return when every topic has a subscription, or after `limit` s; InputError if a named one has none then."""
    wanted = [f"/{topic.lstrip('/')}" for topic in topics] or list(publishers)
    if missing := [topic for topic in wanted if topic not in publishers]:
        raise InputError(f"--wait-topics: {missing[0]} is not in the bag; it has {', '.join(publishers)}.")
    _say(f"waiting up to {limit:g} s for subscriptions to {', '.join(wanted)}")
    until = time.monotonic() + limit
    missing = wanted
    while not stop:
        missing = [topic for topic in wanted if not publishers[topic].get_subscription_count()]
        if not missing or time.monotonic() > until:
            break
        time.sleep(0.01)
    if missing and topics and not stop:
        raise InputError(
            f"nobody subscribes to {missing[0]} within {limit:g} s; start the nodes first, or wait longer."
        )
    if missing:
        _say(f"nobody subscribes to {', '.join(missing)}")
    time.sleep(SETTLE)


def _play(recorded, publishers, rate, clock, clock_rate, follower, played, stop):
    """Publish (connection, stamp ns, bytes) in the time between their stamps, divided by the rate."""
    start = began = next_tick = None
    stamped = {topic for topic, publisher in publishers.items() if is_stamped(publisher.msg_type)} if follower else set()
    for connection, stamp, data in recorded:
        if start is None:
            start, began = stamp, time.perf_counter()
            next_tick = began
        due = began + (stamp - start) / (1e9 * rate)
        while not stop:
            now = time.perf_counter()
            if clock is not None and now >= next_tick:
                clock.publish(_clock_message(start + int((min(now, due) - began) * 1e9 * rate)))
                next_tick = max(next_tick + 1.0 / clock_rate, now)
            if now >= due:
                break
            wake = due if clock is None else min(due, next_tick)
            time.sleep(min(max(wake - now, 0.0), LONGEST_SLEEP))
        if stop:
            return
        behind = now - due
        played.behind = max(played.behind, behind)
        if behind > LARGEST_CATCH_UP:
            began += behind - LARGEST_CATCH_UP
            played.stretched += behind - LARGEST_CATCH_UP
        if connection.topic in stamped:
            waited = follower.wait(stamp_of(data), stop)
            played.waited += waited
            began += waited
        if _publish(publishers[connection.topic], data, stop):
            played.counts[connection.topic] += 1


def _publish(publisher, data, stop):
    """Publish, after waiting until reliable subscriptions have acknowledged what the history is full of.

    Returns False if stopped while it waited.
    """
    until = time.monotonic() + ACKNOWLEDGE_LIMIT
    while True:
        try:
            publisher.publish(data)
            return True
        except RCLError as error:  # full for longer than DDS waits by itself, 0.1 s
            if stop:
                return False
            if time.monotonic() > until:
                raise InputError(
                    f"{publisher.topic_name}: a subscription has not acknowledged anything for {ACKNOWLEDGE_LIMIT:g} s "
                    f"({error}); stop it, or let it subscribe best effort."
                ) from error


def _clock_message(nanoseconds):
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 10**9)
    return message


def _wait_acknowledged(publishers, stop):
    """Whether every subscription has everything; waits at most ACKNOWLEDGE_LIMIT, in slices that see a signal."""
    until = time.monotonic() + ACKNOWLEDGE_LIMIT
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
            if stop or time.monotonic() > until:
                return False
    return True


def _positive(text):
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _say(sentence):
    print(f"replay: {sentence}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
