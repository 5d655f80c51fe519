"""Let what is played keep in step with what comes of it."""

import struct
import time

from rclpy.qos import QoSProfile, ReliabilityPolicy

from uwb_tdoa_bias.foundation.errors import InputError

from .session import message_class

LEAD = 2_000_000_000  # ns of stamps that may be played ahead
LOOK_PERIOD = LEAD // 20  # ns of stamps between two looks at a topic that is in step or silent
SILENCE = 5.0  # s after which a topic is not waited for any more, until it speaks again
POLL_PERIOD = 0.005  # s


class Follower:
    """Watches a topic whose messages have a header, and says when to wait for it."""

    def __init__(self, node, topic):
        """Raises InputError if nobody publishes the topic, or its messages have no header."""
        topic = node.resolve_topic_name(topic)
        types = dict(node.get_topic_names_and_types()).get(topic)
        if not types or not node.count_publishers(topic):
            raise InputError(f"--follow: nobody publishes {topic}; start the node that does first.")
        if not is_stamped(cls := message_class(types[0])):
            raise InputError(f"--follow: messages on {topic} are {types[0]}: not installed, or without a header.")
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscription = node.create_subscription(cls, topic, lambda _: None, qos, raw=True)  # taken, never spun
        self._newest = self._looked = None
        self._silent = False

    def wait(self, stamp, stop):
        """Wait while the topic is more than LEAD behind a message stamped so, ns, which is about to be played.

        Returns how long that took, s; stop : true once the wait shall end.
        """
        if self._newest is None:
            self._newest = self._looked = stamp
        in_step = self._silent or stamp - self._newest <= LEAD
        if in_step and 0 <= stamp - self._looked <= LOOK_PERIOD:
            return 0.0
        self._looked = stamp
        began = heard = time.monotonic()
        while not stop:
            if self._take():
                heard, self._silent = time.monotonic(), False
            if stamp - self._newest <= LEAD or self._silent:
                break
            self._silent = time.monotonic() - heard > SILENCE
            time.sleep(POLL_PERIOD)
        return time.monotonic() - began

    def _take(self):
        """Take what has come; returns whether anything has."""
        any_new = False
        with self._subscription.handle:
            while (taken := self._subscription.handle.take_message(self._subscription.msg_type, True)) is not None:
                self._newest, any_new = stamp_of(taken[0]), True
        return any_new


def is_stamped(cls):
    """Whether messages of a class, or None, begin with a header."""
    return cls is not None and next(iter(cls.get_fields_and_field_types().values()), None) == "std_msgs/Header"


def stamp_of(data):
    """Stamp, ns, of a message that begins with a header, from its serialised bytes (CDR)."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds
