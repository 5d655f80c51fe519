"""The streams of a node, taken together: being woken up costs more than a message."""

import time

import numpy as np

from . import ros
from .stamps import LARGEST_STEP_BACK

PERIOD = 0.002  # s from one time that a node takes what has arrived to the next


class Streams:
    """Subscriptions of a node, none of which has a callback of its own: the first message wakes the node up, which then takes
    what has arrived on all of them."""

    def __init__(self, node, epoch, on_taken, catch_up=lambda: None):
        """epoch : ros.Epoch; catch_up() is called before anything is taken, on_taken() when everything was given to those
        that take it."""
        self.inputs = {}  # ros.StreamInput by topic, in the order in which they are taken
        self._node, self._epoch, self._on_taken, self._catch_up = node, epoch, on_taken, catch_up
        self._streams, self._next = [], -np.inf

    def add(self, wire, topic, take):
        """Subscribe. wire : Wire; take(frame, t, rows, arrival) gets successive messages of one frame: their stamps (n,) s,
        rows (n,) of the Wire, and when they arrived, (n,) s since 1970."""
        stream = _Stream(wire, take)
        stream.input = ros.StreamInput(
            self._node, wire.kind, topic, lambda data: self._on_message(stream, data), raw=True
        )
        self.inputs[topic] = stream.input
        self._streams.append(stream)

    def _on_message(self, stream, data):
        stream.keep(data, time.time_ns())
        left = self._next - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        self._next = time.monotonic() + PERIOD
        self._catch_up()
        parts = []
        for stream in self._streams:
            if stream.heard:  # what has never come is not asked for
                stream.input.drain(stream.keep)
                parts += stream.parts(self._epoch)
        if any(stream.fell for stream in self._streams):  # then it matters which stream was first
            parts = sorted((piece for part in parts for piece in _pieces(part)), key=lambda piece: piece[-1][0])
        for take, *part in parts:
            take(*part)
        self._on_taken()


class _Stream:
    """What has arrived on one of them. heard : anything at all; fell : the stamps of what was taken last have fallen back."""

    def __init__(self, wire, take):
        self.input, self.heard, self.fell = None, False, False
        self._wire, self._take, self._newest = wire, take, -np.inf
        self._messages, self._arrivals = [], []

    def keep(self, data, arrival):
        self.heard = True
        self._messages.append(data)
        self._arrivals.append(arrival)

    def parts(self, epoch):
        """What was kept, as [(take, frame, stamps, rows, arrivals)]."""
        self.fell = False
        if not self._messages:
            return []
        # when the first came only the executor knows, but before the second
        parts, first, arrivals = [], 0, 1e-9 * np.minimum.accumulate(self._arrivals[::-1])[::-1]
        for frame, rows in self._wire.read(self._messages):
            t = epoch.seconds_of(rows["sec"], rows["nanosec"])
            parts.append((self._take, frame, t, rows, arrivals[first : first + len(rows)]))
            first += len(rows)
            before = np.maximum.accumulate(np.concatenate([[self._newest], t]))[:-1]
            self.fell = self.fell or bool((t < before - LARGEST_STEP_BACK).any())
            self._newest = t[-1]
        self._messages, self._arrivals = [], []
        return parts


def _pieces(part):
    """The messages of a part one by one."""
    take, frame, *columns = part
    return [(take, frame, *(column[k : k + 1] for column in columns)) for k in range(len(columns[0]))]
