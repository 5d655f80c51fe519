"""Record ROS topics to a bag, for those who have no `ros2 bag record`."""

import sys
import time

from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..bags.files import STORAGES, new_bag
from ..bags.message_types import add_type, typestore
from ..live.session import message_class, own_arguments, recorded_qos, session, subscription_qos

DESCRIPTION = """Record ROS topics to a bag, like `ros2 bag record`, until SIGINT (Ctrl-C) or SIGTERM.

Topics are found as they appear; each is subscribed to with the strongest QoS that all its publishers offer. Messages
are stored as they come, with the time of their arrival. The bag appears when the recording ends.
"""
DISCOVERY_PERIOD = 0.1  # s between two looks for new topics
POLL_PERIOD = 0.005  # s between two looks for messages; the subscriptions hold what comes in between


def main(argv=None):
    arguments = sys.argv[1:] if argv is None else argv
    parser = cli.parser(
        "record",
        DESCRIPTION,
        "record -o run.bag odometry uwb/residual",
        "record -o everything.bag -a",
    )
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help="topics to record")
    parser.add_argument("-a", "--all", action="store_true", help="record all topics, except hidden ones")
    parser.add_argument("-o", "--output", required=True, metavar="BAG", help="the bag to write, a new directory")
    parser.add_argument("-s", "--storage", choices=STORAGES, default="mcap", help="default: mcap")
    return cli.run(lambda args: record(args, arguments), parser, own_arguments("record", arguments))


def record(args, ros_arguments):
    """Record as the parsed arguments say; returns the exit code. Raises InputError."""
    if bool(args.topics) == args.all:
        raise InputError("topics: name the topics to record, or give --all for all of them, not both.")
    try:
        recorder, failure = _record(args, ros_arguments)
    except NothingRecorded as nothing:
        _say(f"no message came on {nothing}; there is no bag")
        return 1
    for topic, count in sorted(recorder.counts.items()):
        print(f"{topic}: {count} messages")
    print(f"{sum(recorder.counts.values())} messages -> {args.output}")
    if failure is not None:
        raise failure
    if missing := sorted(recorder.missing()):
        _say(f"no message came on {', '.join(missing)}")
        return 1
    return 0


class NothingRecorded(Exception):
    """Ends a recording without a bag."""


def _record(args, ros_arguments):
    """The Recorder when it has ended, and the error that ended it, or None."""
    with session("record", ros_arguments) as (node, stop), new_bag(args.output, args.storage) as writer:
        wanted = {node.resolve_topic_name(topic) for topic in args.topics} if args.topics else None
        recorder = Recorder(node, writer, wanted)
        _say(f"waiting for {', '.join(sorted(wanted)) if wanted else 'all topics'}")
        try:
            with tqdm(unit=" messages", disable=None) as progress:
                look_again = 0.0
                while not stop:
                    if time.monotonic() >= look_again:
                        recorder.discover()
                        look_again = time.monotonic() + DISCOVERY_PERIOD
                    progress.update(recorder.take())
                    time.sleep(POLL_PERIOD)
                progress.update(recorder.take())
        except Exception as error:  # what was recorded is worth keeping whatever happened
            failure = error
        else:
            failure = None
        if not any(recorder.counts.values()) and failure is None:
            raise NothingRecorded(", ".join(sorted(wanted)) if wanted else "any topic")
    return recorder, failure


class Recorder:
    """Subscriptions, and the connections of the bag that they write to.

    wanted : set of absolute topic names, or None for all. counts : {topic: messages recorded so far}.
    """

    def __init__(self, node, writer, wanted):
        self.counts = {}
        self._node, self._writer, self._wanted = node, writer, wanted
        self._pairs = []  # (subscription, connection)
        self._refused = set()

    def discover(self):
        """Subscribe to wanted topics that have a publisher by now."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self.counts or topic in self._refused or not self._is_wanted(topic):
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                self._subscribe(topic, types[0], [publisher.qos_profile for publisher in publishers])

    def take(self):
        """Move all messages that have arrived to the bag; returns how many."""
        taken = 0
        for subscription, connection in self._pairs:
            with subscription.handle:
                while (message := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                    data, information = message
                    stamp = information["received_timestamp"] or time.time_ns()
                    self._writer.write(connection, stamp, data)
                    self.counts[connection.topic] += 1
                    taken += 1
        return taken

    def missing(self):
        """Topics that were asked for by name and brought nothing."""
        return {topic for topic in self._wanted or () if not self.counts.get(topic)}

    def _is_wanted(self, topic):
        if self._wanted is not None:
            return topic in self._wanted
        return not any(part.startswith("_") for part in topic.split("/"))

    def _subscribe(self, topic, msgtype, offered):
        cls = message_class(msgtype)
        try:
            if cls is None:
                raise InputError(f"{msgtype} is not installed; build and source the workspace that has it.")
            add_type(typestore(), msgtype)
        except InputError as error:
            if self._wanted is not None:
                raise
            _say(f"leaving out {topic}: {error}")
            self._refused.add(topic)
            return
        connection = self._writer.add_connection(
            topic, msgtype, typestore=typestore(), offered_qos_profiles=[recorded_qos(qos) for qos in offered]
        )
        qos = subscription_qos(offered)
        # Never spun, so the callback never runs: messages are taken from the subscription as bytes, many at a time.
        subscription = self._node.create_subscription(cls, topic, lambda _: None, qos, raw=True)
        self._pairs.append((subscription, connection))
        self.counts[topic] = 0
        _say(f"recording {topic} ({msgtype}, {qos.reliability.name.lower()})")


def _say(sentence):
    print(f"record: {sentence}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
