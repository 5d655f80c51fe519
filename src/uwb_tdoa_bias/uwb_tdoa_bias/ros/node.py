# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node whose streams and /clock no executor serves, and the process that serves it until Ctrl-C.

Its parameters have a text, unit and range; unknown ones are refused or reported. Its status is on
/diagnostics and in the log, including paused simulated time. The log has a limit that no peer can exceed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
import gc
import math
from pathlib import Path
import re
import signal
import sys
import time
from types import CodeType, FrameType
from typing import Any, ClassVar, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
import rclpy
from rclpy.clock import Clock as SteadyClock, ClockType, ROSClock
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock
import yaml
from yaml import MappingNode

from ..common.errors import InputError, line_of
from ..common.executable import interrupt
from .cdr import Message, decode

KINDS = {
    float: "a number with a decimal point, e.g. 1.0",
    int: "a whole number",
    bool: "true or false",
    list: "a list",
}
QOS = "qos_overrides."
SAY_AGAIN = 10.0  # s between warnings of the same kind
MOST_QUOTED = 100  # characters quoted from another node
# Entries of a request, which take 0.1 ms each, and waiting requests. Streams wait for all of them.
MOST_ASKED, MOST_REQUESTS = (100, 20)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node.

    Attributes
    ----------
    default : its value and type
    text : unit and meaning, as in the parameter file
    low, high : range of a number
    choices : permitted texts
    constraint : further limits, in words
    settable : whether it can change while the node runs
    """

    default: Any
    text: str
    low: float = None  # type: ignore[assignment]  # set for numbers
    high: float = None  # type: ignore[assignment]  # as low
    choices: tuple[str, ...] = ()
    constraint: str = ""
    settable: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Return the ParameterDescriptor for ROS."""
        constraint = f"one of {', '.join(self.choices)}" if self.choices else self.constraint
        out = ParameterDescriptor(
            description=self.text, read_only=not self.settable, additional_constraints=constraint
        )
        if isinstance(self.default, float):
            out.floating_point_range = [
                FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
            ]
        elif isinstance(self.default, int) and not isinstance(self.default, bool):
            out.integer_range = [
                IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)
            ]
        return out


FROZEN = Parameter(
    False,
    (
        "refuse over ROS, once started, other parameters, anchors, static transforms and poses, "
        "and a reset (docs/security.md)"
    ),
)


class ParameterNode(Node):
    """A Node with checked parameters.

    It accepts a read-only parameter that is set to its present value. Hence `ros2 param load` can
    load everything that `ros2 param dump` wrote. If its parameter FROZEN is true, it refuses all
    changes. Requests for parameters that rclpy cannot read do not end it.

    Attributes
    ----------
    refused : number of refusals because the node is frozen
    frozen : whether it is
    """

    refused, _refused_before, _refusal = 0, 0, ""
    _log: Log | None = None
    NAME: ClassVar[str]  # of the executable

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._warned: dict[
            str, float
        ] = {}  # {kind: s of time.monotonic() of the next permitted warning}
        super().__init__(*arguments, **options)

    def get_logger(self) -> Log:
        """Return the Log of the node."""
        if self._log is None:
            self._log = Log(super().get_logger())
        return self._log

    def warn_at_times(self, kind: str, text: str) -> None:
        """Log a warning, unless one of its kind was logged less than SAY_AGAIN s ago.

        The first word of the kind has a limit of its own in the Log.

        The throttle of rclpy takes 0.5 ms per call, more than most messages take.
        """
        now = time.monotonic()
        if now >= self._warned.get(kind, now):
            self._warned[kind] = now + SAY_AGAIN
            self.get_logger().warning(text, kind.split()[0])

    @property
    def frozen(self) -> bool:
        """Whether the settings of the start are final."""
        return self.has_parameter("frozen") and self.get_parameter("frozen").value

    def refuse(self, what: str) -> str:
        """Count and log a refusal because the node is frozen, and return the sentence.

        what : the refused change, and who asked for it
        """
        self.refused += 1
        self._refusal = (
            f"{what}: refused, because this node is frozen; start it with frozen:=false to allow it"
        )
        self.warn_at_times("frozen", self._refusal)
        return self._refusal

    def refused_lately(self) -> str | None:
        """Return the sentence of the last refusal since the last call, or None."""
        new, self._refused_before = self.refused - self._refused_before, self.refused
        return self._refusal if new else None

    def create_service(
        self, srv_type: type, srv_name: str, callback: Callable[[Any, Any], Any], **options: Any
    ) -> Service:
        """Make a service as rclpy does.

        rclpy makes the parameter services by this method. They raise exceptions for unreadable requests,
        which end the node, and queue 1000 requests. Here such requests, and those of more than
        MOST_ASKED entries, are logged, and the client gets the response as it is, possibly empty.
        MOST_REQUESTS are queued.
        """
        if not srv_type.__module__.startswith("rcl_interfaces."):
            return super().create_service(srv_type, srv_name, callback, **options)

        options["qos_profile"] = QoSProfile(depth=MOST_REQUESTS)

        @wraps(callback)
        def guarded(request: Any, response: Any) -> Any:
            try:  # each type of request has one of these fields
                fields = ("parameters", "names", "prefixes")
                entries = sum(len(getattr(request, field, ())) for field in fields)
                if entries > MOST_ASKED:
                    raise InputError(
                        f"it has {entries} parameters, names or prefixes; at most {MOST_ASKED} "
                        "are read."
                    )
                return callback(request, response)
            except Exception as error:
                text = (
                    f"{srv_name}: a request is not, or only partly, carried out: "
                    f"{error!r:.{MOST_QUOTED}}"
                )
                self.warn_at_times(srv_name, text)
                return response

        return super().create_service(srv_type, srv_name, guarded, **options)

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set parameters as rclpy does; the parameter services call this."""
        others = [each for each in parameter_list if not self._is_so_for_good(each)]
        if not others and parameter_list:
            return SetParametersResult(successful=True)
        if others and self.frozen:
            return SetParametersResult(
                successful=False,
                reason=self.refuse(f"parameter {others[0].name!r:.{MOST_QUOTED}}"),
            )
        unknown = [each.name for each in others if not self.has_parameter(each.name)]
        if unknown:  # rclpy would name no parameter: it reports an empty list
            return SetParametersResult(successful=False, reason=self._unknown(unknown[0]))
        return super().set_parameters_atomically(others)

    def _unknown(self, name: str) -> str:
        """Return a sentence on an unknown parameter, with the most similar name."""
        near = get_close_matches(name, self._parameters, n=1, cutoff=0.5)
        return f"{self.get_name()} has no parameter {name!r:.{MOST_QUOTED}}; " + (
            f"set {near[0]}." if near else "see `ros2 param list`."
        )

    def _is_so_for_good(self, parameter: RosParameter) -> bool:
        name = parameter.name
        return (
            self.has_parameter(name)
            and (self.frozen or self.describe_parameter(name).read_only)
            and self.get_parameter(name).get_parameter_value() == parameter.get_parameter_value()
        )


def declare(node: ParameterNode, name: str, parameter: Parameter) -> Any:
    """Declare a Parameter, and return its value; raise InputError."""
    kind = KINDS.get(type(parameter.default), "text")
    try:
        value = node.declare_parameter(name, parameter.default, parameter.descriptor()).value
    except (InvalidParameterTypeException, ParameterUninitializedException) as error:
        if parameter.choices:
            kind = f"one of {', '.join(parameter.choices)}"
        raise InputError(f"{name}: {str(error).rsplit(':', 1)[0]}; give {kind}.") from error
    except InvalidParameterValueException as error:
        given = node._parameter_overrides[name].value
        raise InputError(
            f"{name}: {given!r} must be from {parameter.low:g} to {parameter.high:g}."
        ) from error
    if parameter.choices and value not in parameter.choices:
        raise InputError(f"{name}: {value!r} is not one of {', '.join(parameter.choices)}.")
    return value


def declare_all(node: ParameterNode, parameters: dict[str, Parameter]) -> dict[str, Any]:
    """Declare {name: Parameter}, and return {name: value}."""
    return {name: declare(node, name, parameter) for name, parameter in parameters.items()}


def refuse_unknown(node: ParameterNode, others: Collection[str] = ()) -> None:
    """Raise InputError for a given parameter that the node does not have.

    Call it after the node has declared its parameters. others : names for other nodes
    """
    for name in sorted(node._parameter_overrides):
        if name.startswith(QOS) or name in others or node.has_parameter(name):
            continue
        near = get_close_matches(name, {*node._parameters, *others}, n=1, cutoff=0.5)
        remedy = f"write {near[0]}" if near else "leave it out"
        raise InputError(
            f"{name}: {node.get_name()} has no such parameter; {remedy} "
            f"(config/{node.NAME}.yaml has all)."
        )


def say_unused(nodes: Sequence[Node], files: Iterable[str]) -> None:
    """Log which QoS overrides and which given parameter files have no effect.

    Call it when the nodes of a process have all topics. files : paths
    """
    given = {name for node in nodes for name in node._parameter_overrides}
    logger = nodes[0].get_logger()
    for file in files:
        names = _names(file)
        if names and not names & given:
            logger.warning(
                f"{file}: none of its parameters is for "
                f"{nodes[0].get_fully_qualified_name()}: they are not used; begin it "
                "with '/**:', or with the name of this node"
            )
    for name in sorted(given):
        if name.startswith(QOS) and not any(node.has_parameter(name) for node in nodes):
            logger.warning(
                f"{name}: changes nothing, because this node has no such topic or policy"
            )


def files_of(arguments: Sequence[str]) -> list[str]:
    """Return the paths after --params-file in the arguments of a process."""
    return [file for word, file in zip(arguments, arguments[1:]) if word == "--params-file"]


def _names(file: str) -> set[str]:
    """Return the names of all parameters in a parameter file, of any node.

    rcl has validated the file. Values and their tags are ignored, since launch_ros gives lists the
    tag !!python/tuple.
    """
    if not Path(file).is_file():  # rcl has already emptied a pipe
        return set()
    try:
        with open(file, "rb") as opened:
            return set(_below_nodes(yaml.compose(opened, Loader=yaml.SafeLoader)))
    except (OSError, yaml.YAMLError):
        return set()


def _below_nodes(part: MappingNode) -> Iterator[str]:
    """Yield the names below each ros__parameters in a part of a file, as yaml.compose gives it."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        yield from _flat(value) if key.value == "ros__parameters" else _below_nodes(value)


def _flat(part: MappingNode, prefix: str = "") -> Iterator[str]:
    """Yield the names in a mapping of parameters; nested mappings are prefixes."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        name = f"{prefix}{key.value}"
        if isinstance(value, yaml.MappingNode):
            yield from _flat(value, f"{name}.")
        else:
            yield name


# Lines that one statement of the program may write at once, and s until it may write one more.
BURST, REFILL = (200, 10.0)


class Log:
    """A logger of rclpy with printable lines of bounded length, and a limit per statement and kind.

    Each statement of the program writes BURST lines of a kind at once, then one per REFILL seconds. A
    peer that triggers one statement often cannot hide the others.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        # {(statement, kind): (lines left, s of the last line, lines left out since)}
        self._left: dict[tuple[CodeType, int, str], tuple[float, float, int]] = {}

    def info(self, text: str) -> None:
        """Log as rclpy does; each severity needs its own line of code there."""
        if line := self._line(text):
            self._logger.info(line)

    def warning(self, text: str, kind: str = "") -> None:
        """Log as rclpy does."""
        if line := self._line(text, kind):
            self._logger.warning(line)

    def error(self, text: str) -> None:
        """Log as rclpy does."""
        if line := self._line(text):
            self._logger.error(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def _line(self, text: str, kind: str = "") -> str | None:
        """Return the line to write for a text, or None."""
        frame, now = sys._getframe(2), time.monotonic()
        key = frame.f_code, frame.f_lineno, kind
        left, when, hidden = self._left.get(key, (BURST, now, 0))
        left = min(BURST, left + (now - when) / REFILL)
        self._left[key] = (left, now, hidden + 1) if left < 1.0 else (left - 1.0, now, 0)
        if left < 1.0:
            return None
        return line_of(text) + (f" ({hidden} such lines were left out before)" if hidden else "")


Events = TypeVar("Events", SubscriptionEventCallbacks, PublisherEventCallbacks)


def unserved(_: Any) -> None:
    """Mark a subscription that no executor serves; a callback without effect."""


def waiting(subscription: Subscription) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Take and yield (bytes, information) of each message at an unserved subscription."""
    kind, take = subscription.msg_type, subscription.handle.take_message
    while (taken := take(kind, True)) is not None:
        yield taken


class StreamNode(ParameterNode):
    """A node whose streams and /clock no executor serves (see Spinner).

    Attributes
    ----------
    members : nodes that start and end with it
    spinner : the Spinner that serves it, once there is one
    ready : the log line at the start of service
    on_failure : callable of an exception; called with exceptions of callbacks, instead of raising them
    """

    members: Sequence[StreamNode] = ()
    spinner: Spinner | None = None
    ready: str = ""
    on_failure: Callable[[Exception], None] | None = None

    def create_subscription(
        self,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Message], None],
        qos_profile: QoSProfile | int,
        **options: Any,
    ) -> Subscription:
        """Subscribe as rclpy does."""
        callback = callback if callback is unserved else self._contained(callback)
        options["event_callbacks"] = self._with_few_warnings(
            topic, options.get("event_callbacks") or SubscriptionEventCallbacks()
        )
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """Make a publisher as rclpy does."""
        options["event_callbacks"] = self._with_few_warnings(
            topic, options.get("event_callbacks") or PublisherEventCallbacks()
        )
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _with_few_warnings(self, topic: str, events: Events) -> Events:
        """Return event callbacks that limit the warnings on peers with another QoS or type.

        rclpy would write one line per peer.
        """
        for event in ("incompatible_qos", "incompatible_type"):
            if getattr(events, event) is None:
                text = (
                    f"{topic}: a peer has an {event.replace('_', ' ')}, so its messages, or ours, "
                    "do not arrive; correct the peer"
                )
                setattr(events, event, self._warning(f"{topic} {event}", text))
        return events

    def _warning(self, kind: str, text: str) -> Callable[[Any], None]:
        return lambda _: self.warn_at_times(kind, text)

    def create_timer(  # type: ignore[override]  # options are passed by name
        self, timer_period_sec: float, callback: Callable[[], None], **options: Any
    ) -> Timer:
        """Make a timer as rclpy does."""
        return super().create_timer(timer_period_sec, self._contained(callback), **options)

    def say_ready(self) -> None:
        """Log that the node is served, and that signals now end it in good order."""
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
        """Subscriptions that an executor serves."""
        yield from (
            one
            for one in super().subscriptions
            if one.msg_type is not Clock and one.callback is not unserved
        )

    def take_clock(self) -> None:
        """Set the clock of the node to the newest time on /clock."""
        for clock in [one for one in super().subscriptions if one.msg_type is Clock]:
            newest = None
            for newest, _ in waiting(clock):
                pass
            if newest is None:
                continue
            try:
                clock.callback(decode(newest, Clock))
            except (ValueError, OverflowError) as error:  # an invalid time, or before 1970
                self.warn_at_times("/clock", f"/clock: passed over: {error}")


try:  # since rclpy 7.1.4; a message takes a quarter of the time
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = None  # type: ignore[assignment]  # None marks an older rclpy

LONGEST_SLEEP = 0.2  # s, until a process without streams reacts to a signal
# s without a message of a stream, after which the process checks streams each LOOK s instead of
# each millisecond.
QUIET, LOOK = (1.0, 0.05)
SERVED = 0.005  # s between services of the graph while streams have messages
LONGEST_SERVICE = 0.05  # s; only with a SingleThreadedExecutor
PERIOD = 0.001  # s, smallest rest after a turn
# s. After a turn the process rests as long as the turn took, at most so long: then a busy process
# takes more messages per turn.
LONGEST_REST = 0.01


class StreamPoller:
    """Lets nodes take their arrived messages, one node after the other.

    `run` calls the `turns` of a node, which is a StreamPoller.
    """

    PERIOD = PERIOD

    def __init__(self, takes: Collection[Callable[[], bool]]) -> None:
        """Set functions as `Streams.take`: each returns whether messages arrived, or still wait."""
        self._takes = takes

    def take(self) -> float | None:
        """Run one turn, and return the rest after it, s; None if nothing arrived."""
        began = time.monotonic()
        if not any([take() for take in self._takes]):
            return None
        return min(max(time.monotonic() - began, PERIOD), LONGEST_REST)


class Spinner:
    """Serves the nodes of a process.

    Messages of streams, /clock and /tf may come 1000 times per second. They wait in the middleware
    until a turn takes and computes them together. A callback for each message would cost a fifth more
    in all. A call of the filter for each would cost even more. After a turn the process rests as long
    as the turn took, at least 1 ms.

    Every SERVED s an executor of rclpy serves the rest of the graph in the order of arrival: requests,
    timers, transforms. A mark at the end of its queue ensures completeness: the executor runs until
    it reaches the mark. While no stream has messages, the process sleeps in the executor.
    `docs/notebook/measured.md` has the measurements.

    longest_wait : s, longest wait of any request since this was set to 0.0
    """

    def __init__(self, nodes: list[StreamNode], turns: StreamPoller | None = None) -> None:
        """Start to serve nodes; `nodes` is a list that stays up to date."""
        self.longest_wait = 0.0
        self._nodes, self._turns = nodes, turns
        self._executor = SingleThreadedExecutor() if EventsExecutor is None else EventsExecutor()
        self._served = time.monotonic()
        for node in nodes:
            self._serve_node(node)

    def replace(self, gone: Iterable[StreamNode], new: Iterable[StreamNode]) -> None:
        """Stop serving some nodes, and serve others."""
        for node in gone:
            self._executor.remove_node(node)
            self._nodes.remove(node)
        for node in new:
            self._nodes.append(node)
            self._serve_node(node)

    def _serve_node(self, node: StreamNode) -> None:
        node.spinner = self
        self._executor.add_node(node)

    def spin(self, stop: Future) -> None:
        """Serve the nodes until the future `stop` is done, or the context ends."""
        # taken : s, time of the last turn with messages
        taken, sleep, quiet = (-math.inf, LONGEST_SLEEP if self._turns is None else LOOK, True)
        while not stop.done() and self._nodes[0].context.ok():
            if quiet or time.monotonic() >= self._served + SERVED:
                self._guarded(self._serve)
            rest, now = self._turns.take() if self._turns is not None else None, time.monotonic()
            taken = taken if rest is None else now
            quiet = now >= taken + QUIET
            if quiet:
                self._guarded(self._executor.spin_once, timeout_sec=sleep)
                self._served = time.monotonic()
            else:
                time.sleep(rest or self._turns.PERIOD)  # type: ignore[union-attr]  # not None: without turns the process is quiet

    def close(self) -> None:
        """Stop serving the nodes."""
        for node in self._nodes:
            self._executor.remove_node(node)
        self._executor.shutdown()

    def _serve(self) -> None:
        """Serve everything that arrived so far."""
        if EventsExecutor is None:
            self._serve_each()
        else:
            # Tasks wait in the same queue as everything else.
            mark = self._executor.create_task(_nothing)
            while not mark.done():
                self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        self.longest_wait, self._served = max(self.longest_wait, now - self._served), now
        for node in self._nodes:
            node.take_clock()

    def _serve_each(self) -> None:
        """Serve one waiting item at a time until none waits, at most LONGEST_SERVICE s.

        For the SingleThreadedExecutor, which has no queue for a mark.
        """
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

    def _guarded(self, serve: Callable[..., None], **arguments: Any) -> None:
        """Call `serve`, and log requests that rclpy cannot decode."""
        try:
            serve(**arguments)
        except implementation.RCLError as error:
            self._nodes[0].warn_at_times("request", f"passed over what could not be taken: {error}")


def _nothing() -> None:
    """Do nothing: the task of a mark."""


def run(
    node_class: type[StreamNode],
    description: str | None,
    argv: Sequence[str] | None = None,
    **given: Any,
) -> int:
    """Run a node until SIGINT or SIGTERM, and return the exit code.

    The code is 0, or 2 for bad usage or an InputError. It is 128 plus the signal's number if the
    signal came before the node was ready.

    Parameters
    ----------
    node_class : callable of `given` -> StreamNode, in an initialised rclpy. It has the executable's
        NAME, and may have `members` and `turns`, a StreamPoller.
    description : for --help
    argv : arguments, default: sys.argv[1:]
    """
    name = node_class.NAME
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    parser = argparse.ArgumentParser(
        prog=name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    interruptible = True
    stop: Future = Future()  # holds the number of the signal

    # rclpy's own handler would end the context while a callback still publishes
    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.done():
            stop.set_result(number)
        if interruptible:
            interrupt(number, frame, compiling=True)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    nodes: list[StreamNode] = []
    spinner: Spinner | None = None
    try:
        _init(parser, arguments)
        node = node_class(**given)
        nodes = [node, *node.members]
        say_unused(nodes, files_of(arguments))
        spinner = Spinner(nodes, getattr(node, "turns", None))
        gc.collect()
        gc.freeze()  # numba's objects are never garbage; searching them takes 0.1 s
        gc.enable()
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        for each in reversed(nodes):  # from here on, signals end the node in good order
            each.say_ready()
        spinner.spin(stop)
    except SystemExit as ended:  # argparse has printed the error or the help
        return ended.code or 0  # type: ignore[return-value]  # argparse exits with a number
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
        raise InputError(refusal(error)) from error


def refusal(error: Exception) -> str:
    """Return a sentence on why rclpy did not start: its arguments, or the folder of its log."""
    if "log directory" in str(error):
        reason = str(error).partition(", at ")[0]
        return f"{reason}; name a folder that you can write to: export ROS_LOG_DIR=/tmp/ros-log"
    return f"--ros-args: {error}."


BEHIND = 0.5  # s, longest wait of a request without a warning
AGAIN = 30.0  # s until a sentence may be logged again
# Match each number as a whole. A pattern with backtracking at each digit takes 8 s for 20 000 digits.
NUMBER = re.compile(
    r"([-+]?)\d+(\.\d+)?(?=(\s*(?:%|s\b|ms\b|m\b|Hz|messages|samples|TDOAs|times))?)"
)
# s between reports, and number of checks per report for urgent changes.
REPORT_PERIOD, LOOKS = (1.0, 5)
# s without a new time on /clock; longest period of a running clock, s.
PAUSED, SLOWEST_CLOCK = (0.5, 2.0)
DIAGNOSTICS_QOS = QoSProfile(depth=10)

Report = tuple[bytes, str, dict[str, Any]]  # level of a DiagnosticStatus, text, values


class Diagnostics:
    """Publishes one status on /diagnostics each second of the wall clock.

    It publishes at once if simulated time stops or continues. A LogFilter decides
    which statuses it logs.

    Parameters
    ----------
    report : callable of () -> (level, text, {key: value}), level: DiagnosticStatus.OK, WARN or ERROR
    look : callable of (), called LOOKS times per second
    """

    def __init__(
        self,
        node: StreamNode,
        report: Callable[[], Report],
        look: Callable[[], None] = lambda: None,
    ) -> None:
        self._node, self._report, self._look = node, report, look
        self._log_filter = LogFilter()
        self._clock, self._looks = SimulatedClock(node), 0
        self._clock_status: tuple[bytes, str] | None = None
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS_QOS)
        node.create_timer(
            REPORT_PERIOD / LOOKS,
            self._on_timer,
            clock=SteadyClock(clock_type=ClockType.STEADY_TIME),
        )

    def _on_timer(self) -> None:
        before, self._clock_status = self._clock_status, self._clock.status()
        self._looks += 1
        if self._looks % LOOKS == 0 or before != self._clock_status:
            self.publish()
        self._look()

    @property
    def paused(self) -> bool:
        """Whether simulated time stands still."""
        return self._clock_status is not None

    def publish(self) -> None:
        """Publish the status now."""
        level, text, values = self._report()
        spinner = self._node.spinner
        if spinner is not None:
            late = spinner.longest_wait
            spinner.longest_wait = 0.0  # one value per process: the first node reports it
            values |= {"longest wait of a request": f"{late:.3f} s"}
            if late > BEHIND and level == DiagnosticStatus.OK:
                level = DiagnosticStatus.WARN
                text = f"this node answers up to {late:.1f} s late: check the load of this machine"
        values |= {
            "frozen": "yes" if self._node.frozen else "no",
            "refused because frozen": self._node.refused,
        }
        refused = self._node.refused_lately()
        if refused and level == DiagnosticStatus.OK:
            level, text = DiagnosticStatus.WARN, refused
        level, text = self._clock_status or (level, text)
        if self._log_filter.should_log(text, time.monotonic()):
            logger = self._node.get_logger()
            if level == DiagnosticStatus.OK:
                logger.info(text)
            else:  # separate line: rclpy allows one severity per line
                logger.warning(text)
        name = self._node.get_fully_qualified_name()
        entries = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = DiagnosticStatus(
            level=level, name=name, message=text, hardware_id=name, values=entries
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class LogFilter:
    """Decides which sentences are worth a line in the log.

    Sentences that differ only in measured numbers are of one kind; ids of anchors are no measured
    numbers. A sentence is logged if its kind differs from that of the last logged one, and was not
    logged within AGAIN seconds. Sentences that are not logged do not count.
    """

    def __init__(self) -> None:
        self._last_logged: str | None = None
        self._logged_at: dict[str, float] = {}  # {kind: s}, within AGAIN

    def should_log(self, text: str, now: float) -> bool:
        """Return whether to log a text now, and count it as logged; now : s."""
        kind = NUMBER.sub(_unless_id, text)
        if kind == self._last_logged or now - self._logged_at.get(kind, -math.inf) < AGAIN:
            return False
        recent = {other: at for other, at in self._logged_at.items() if now - at < AGAIN}
        self._logged_at = recent | {kind: now}
        self._last_logged = kind
        return True


def _unless_id(number: re.Match[str]) -> str:
    """Return "#" for a measured number: one with a sign, a decimal point or a unit.

    The id of an anchor has none of these, and stays.
    """
    return "#" if any(number.groups()) else number[0]


class SimulatedClock:
    """Detects whether simulated time of a node stands still; asked a few times per second."""

    def __init__(self, node: Node, now: Callable[[], float] = time.monotonic) -> None:
        self._node, self._now = node, now
        self._time: int | None = None  # last time, ns
        self._since, self._period = now(), 0.0  # s: time of the last change; recent period

    def status(self) -> tuple[bytes, str] | None:
        """Return (level, text) while simulated time stands still, else None."""
        clock: ROSClock = self._node.get_clock()  # type: ignore[assignment]  # nodes have this class of clock
        now = self._now()
        if not clock.ros_time_is_active:
            self._time = None
            return None
        time_of_it = clock.now().nanoseconds
        if time_of_it == 0:
            remedy = "play the bag with --clock, or set use_sim_time to false"
            return (
                DiagnosticStatus.WARN,
                f"use_sim_time is set, and nobody publishes /clock: {remedy}",
            )
        if time_of_it != self._time:
            took = now - self._since
            if self._time is not None and took < SLOWEST_CLOCK:
                self._period = max(took, 0.5 * self._period)
            self._time, self._since = time_of_it, now
        stands = now - self._since > max(PAUSED, 2.0 * self._period)
        return (DiagnosticStatus.OK, "paused: /clock stands still") if stands else None


class Elapsed:
    """Call it for the time since the start, s, by the clock of a node; it never goes back.

    Ages by it are right in a simulation at any speed.
    """

    def __init__(self, node: Node) -> None:
        self._clock: ROSClock = node.get_clock()  # type: ignore[assignment]  # nodes have this class
        self._seconds, self._last = 0.0, 0.0

    def __call__(self) -> float:
        now = time.monotonic()
        if self._clock.ros_time_is_active:
            now = self._clock.now().nanoseconds * 1e-9
        if self._last:  # simulated time is 0 before its first message
            self._seconds += max(now - self._last, 0.0)
        self._last = now
        return self._seconds


class Rate:
    """Rate of events per second of the wall clock."""

    def __init__(self) -> None:
        self._count, self._since = 0, time.monotonic()

    def of(self, count: int) -> float:
        """Return the rate since the last call, Hz; count : running total."""
        now = time.monotonic()
        rate = (count - self._count) / max(now - self._since, 1e-3)
        self._count, self._since = count, now
        return rate
