# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters and log of a node.

Parameters have a text, unit and range; unknown ones are refused or reported. The log has a limit that
no peer can exceed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
import sys
import time
from types import CodeType
from typing import Any, ClassVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile
from rclpy.service import Service
import yaml
from yaml import MappingNode

from ..common.errors import InputError, line_of

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
