"""The life of a process whose node, or nodes, talk ROS."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from .errors import InputError
from .executable import interrupt
from .foreign_text import line_of
from .ros_spinning import Spinner

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from .ros_node import StreamNode


def run(
    node_class: type[StreamNode], description: str | None, argv: Sequence[str] | None = None
) -> int:
    """Live as a node until SIGINT or SIGTERM. Returns the exit code: 0, 2 for bad usage or an
    InputError, or 128 and the number of a signal that came before the node was ready.

    node_class(arguments) makes the StreamNode, in an initialised rclpy, of the arguments of the
    process; it has the executable's NAME, and may have `members` and `turns`,
    ros_streams.RoundRobin. description : for --help.
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
        print(f"{name}: error: {line_of(error)}", file=sys.stderr)
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
    except (
        implementation.RCLError,
        implementation.RCLInvalidROSArgsError,
        implementation.UnknownROSArgsError,
    ) as error:
        raise InputError(f"--ros-args: {error}.") from error
