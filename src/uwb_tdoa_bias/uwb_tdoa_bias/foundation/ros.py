"""The life of a node: what it takes from an executor, what it takes itself, and how a process ends."""

from __future__ import annotations

import argparse
from functools import wraps
import gc
import signal
import sys
from typing import Any, TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from .errors import InputError
from .executable import interrupt
from .ros_cdr import decode
from .ros_parameters import ParameterNode
from .ros_spinning import Spinner
from .ros_topics import unserved, waiting

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from types import FrameType
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription
    from rclpy.timer import Timer


class StreamNode(ParameterNode):
    """A node whose streams and /clock are not served by an executor (see Spinner). members : nodes that live and end with it;
    spinner : the Spinner that serves it, once there is one; ready : what it says on the log when it begins to be served;
    on_failure(error) : is called with what a callback raises, instead of raising it."""

    members: Sequence[StreamNode] = ()
    spinner: Spinner | None = None
    ready: str = ""
    on_failure: Callable[[Exception], None] | None = None

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[..., None], qos_profile: QoSProfile | int, **options: Any
    ) -> Subscription:
        """Of rclpy."""
        callback = callback if callback is unserved else self._contained(callback)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def create_timer(  # type: ignore[override]  # its further arguments are handed on by their names
        self, timer_period_sec: float, callback: Callable[[], None], **options: Any
    ) -> Timer:
        """Of rclpy."""
        return super().create_timer(timer_period_sec, self._contained(callback), **options)

    def say_ready(self) -> None:
        """Say on the log that it is served from now on, and ends in good order."""
        if self.ready:
            self.get_logger().info(self.ready)

    def _contained(self, callback: Callable[..., None]) -> Callable[..., None]:
        @wraps(callback)
        def call(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                if self.on_failure is None:
                    raise
                self.on_failure(error)

        return call

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Those that an executor serves."""
        yield from (one for one in super().subscriptions if one.msg_type is not Clock and one.callback is not unserved)

    def take_clock(self) -> None:
        """Set the clock of the node to the newest of /clock."""
        for clock in [one for one in super().subscriptions if one.msg_type is Clock]:
            newest = None
            for newest, _ in waiting(clock):
                pass
            if newest is None:
                continue
            try:
                clock.callback(decode(newest, Clock))
            except (ValueError, OverflowError) as error:  # no time at all, or before 1970
                self.warn_at_times("/clock", f"/clock: passed over: {error}")


def run(node_class: type[StreamNode], description: str | None, argv: Sequence[str] | None = None) -> int:
    """Live as a node until SIGINT or SIGTERM. Returns the exit code: 0, 2 for bad usage or an InputError, or 128 and the
    number of a signal that came before the node was ready.

    node_class(arguments) makes the StreamNode, in an initialised rclpy, of the arguments of the process; it has the executable's
    NAME, and may have `members` and `turns`, ros_streams.RoundRobin. description : for --help.
    """
    name = node_class.NAME
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    parser = argparse.ArgumentParser(
        prog=name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    interruptible = True
    stop: Future = Future()  # of the number of a signal

    # rclpy's own handler would end the context while a callback still publishes
    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.done():
            stop.set_result(number)
        if interruptible:
            interrupt(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    nodes: list[StreamNode] = []
    spinner: Spinner | None = None
    try:
        _init(parser, arguments)
        node = node_class(arguments)
        nodes = [node, *node.members]
        spinner = Spinner(nodes, getattr(node, "turns", None))
        gc.collect()
        gc.freeze()  # what numba holds is never garbage, and searching it takes a tenth of a second
        gc.enable()
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        for each in reversed(nodes):  # from here on a signal ends it in good order
            each.say_ready()
        spinner.spin(stop)
    except SystemExit as ended:  # argparse has said it already
        return ended.code or 0  # type: ignore[return-value]  # argparse ends with a number
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + stop.result()
    except ExternalShutdownException:
        pass
    finally:
        interruptible = False
        if spinner is not None:
            spinner.close()
        for each in nodes:
            each.destroy_node()
        rclpy.try_shutdown()
    return 0


def _init(parser: argparse.ArgumentParser, arguments: list[str]) -> None:
    try:
        parser.parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (implementation.RCLError, implementation.RCLInvalidROSArgsError, implementation.UnknownROSArgsError) as error:
        raise InputError(f"--ros-args: {error}.") from error
