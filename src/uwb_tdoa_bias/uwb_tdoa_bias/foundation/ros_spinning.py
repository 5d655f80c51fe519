"""How everything of the graph that concerns a process is served: in the order of its arrival, by one executor."""

import time

from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation

try:  # not in rclpy before 7.1.4; a message costs a quarter
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = None

LONGEST_SLEEP = 0.2  # s, until a process to which nothing comes sees a signal
QUIET = 0.05  # s without a message of a stream, after which it is waited for, and not looked for each millisecond
LONGEST_SERVICE = 0.05  # s; only with a SingleThreadedExecutor
CLOCK_PERIOD = 0.02  # s from one look at /clock to the next, while anything else comes


class Spinner:
    """The life of the nodes of a process. Everything that comes, messages, requests, timers, goes through one executor of rclpy in
    the order in which it came, and nothing can be passed over: each time around, a mark is put at the end of its queue, and it is
    run until the mark comes. A stream's callback only keeps the bytes. What has come is then computed together, in a turn: a call
    of the filter for each message would cost more than the message. Then the process rests as long as the turn took, at
    least a millisecond; where no stream has said anything for a while it sleeps in the executor, which anything wakes. /clock
    alone, which may come a thousand times a second for each of many nodes, is left where it is, and its newest is taken. (The SingleThreadedExecutor takes
    four times as much for a message; `docs/measured.md` has what was measured.)

    longest_wait : s, the longest that anything has waited since this was set to 0.0.
    """

    def __init__(self, nodes, turns=None):
        """nodes : StreamNodes; turns : ros_streams.Turns."""
        self.longest_wait = 0.0
        self._nodes, self._turns = nodes, turns
        self._executor = SingleThreadedExecutor() if EventsExecutor is None else EventsExecutor()
        self._clock_due, self._served = 0.0, time.monotonic()
        for node in nodes:
            self._executor.add_node(node)

    def spin(self, stop):
        """Live until the future `stop` is done, or the context ends."""
        last = -QUIET  # when anything was taken in a turn
        while not stop.done() and self._nodes[0].context.ok():
            self._guarded(self._serve)
            rest = self._turns.take() if self._turns is not None else None
            now = time.monotonic()
            if rest is not None:
                last = now
            if now < last + QUIET:
                time.sleep(rest or self._turns.PERIOD)
            else:
                self._guarded(self._executor.spin_once, timeout_sec=LONGEST_SLEEP)
                self._served = time.monotonic()

    def close(self):
        """Leave the nodes."""
        for node in self._nodes:
            self._executor.remove_node(node)
        self._executor.shutdown()

    def _serve(self):
        """Everything that has come so far."""
        if EventsExecutor is None:
            self._serve_each()
        else:
            mark = self._executor.create_task(_nothing)  # tasks wait in the same queue as everything else
            while not mark.done():
                self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        self.longest_wait, self._served = max(self.longest_wait, now - self._served), now
        if now >= self._clock_due:
            self._clock_due = now + CLOCK_PERIOD
            for node in self._nodes:
                node.take_clock()

    def _serve_each(self):
        """With the SingleThreadedExecutor, which has no queue: one of everything that waits, until nothing does, or for a while."""
        until, found = time.monotonic() + LONGEST_SERVICE, True
        while found and time.monotonic() < until:
            found = False
            try:
                while True:
                    handler, *_ = self._executor.wait_for_ready_callbacks(timeout_sec=0.0)
                    found = True
                    handler()
                    handler.result()
            except TimeoutException:
                pass

    def _guarded(self, serve, **arguments):
        """Requests to services are decoded by rclpy, which raises what cannot be."""
        try:
            serve(**arguments)
        except implementation.RCLError as error:
            self._nodes[0].get_logger().warning(f"passed over what could not be taken: {error}", throttle_duration_sec=10.0)


def _nothing():
    """What a mark does."""
