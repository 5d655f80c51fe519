"""Parameters of a node: each with text, unit and range; what a node does not know is refused or
said.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
import time
from typing import TYPE_CHECKING, Any, ClassVar

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
from rclpy.node import Node
from rclpy.qos import QoSProfile
import yaml

from ..common.errors import InputError
from .log import Log

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from rclpy.parameter import Parameter as RosParameter
    from rclpy.service import Service
    from yaml import MappingNode

KINDS = {
    float: "a number with a decimal point, e.g. 1.0",
    int: "a whole number",
    bool: "true or false",
    list: "a list",
}
QOS = "qos_overrides."
SAY_AGAIN = 10.0  # s from one warning to the next of the same kind
LONGEST_NAME = 100  # letters of what a stranger wrote, in a sentence
# parameters in a request, 0.1 ms each, and requests that wait: streams wait for all of them
MOST_ASKED, MOST_REQUESTS = (100, 20)


@dataclass(frozen=True)
class Parameter:
    """default : its value and type; text : unit and meaning, as in the parameter file; low, high :
    its range, for a number;
    choices : the texts that it may be; constraint : in words, what cannot be said by these;
        settable : in flight.
    """

    default: Any
    text: str
    low: float = None  # type: ignore[assignment]  # numbers have both
    high: float = None  # type: ignore[assignment]  # as low
    choices: tuple[str, ...] = ()
    constraint: str = ""
    settable: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """ParameterDescriptor for ROS."""
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
    """A Node that takes a read-only parameter which is set to what it is: `ros2 param load` sets
    all that `ros2 param dump` wrote. One with the parameter FROZEN that is true takes no other.
    What asks for parameters in a way that rclpy cannot read ends nothing.

    refused : how often something was refused because the node is frozen; frozen : whether it is.
    """

    refused, _refused_before, _refusal = 0, 0, ""
    _log: Log | None = None
    NAME: ClassVar[str]  # of the executable

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._warned: dict[
            str, float
        ] = {}  # {kind: s of time.monotonic() from which on it may be said again}
        super().__init__(*arguments, **options)

    def get_logger(self) -> Log:
        """Of rclpy; a Log."""
        if self._log is None:
            self._log = Log(super().get_logger())
        return self._log

    def warn_at_times(self, kind: str, text: str) -> None:
        """Log a warning, unless one of this kind was logged less than SAY_AGAIN ago. (rclpy's own
        throttle takes half a millisecond to find out, which is more than most messages take.)
        """
        now = time.monotonic()
        if now >= self._warned.get(kind, now):
            self._warned[kind] = now + SAY_AGAIN
            self.get_logger().warning(text)

    @property
    def frozen(self) -> bool:
        """Whether nobody may change what was given at the start."""
        return self.has_parameter("frozen") and self.get_parameter("frozen").value

    def refuse(self, what: str) -> str:
        """Count and say that something is refused because the node is frozen; returns the sentence.
        what : it, and who asked for it.
        """
        self.refused += 1
        self._refusal = (
            f"{what}: refused, because this node is frozen; start it with frozen:=false to allow it"
        )
        self.warn_at_times("frozen", self._refusal)
        return self._refusal

    def refused_lately(self) -> str | None:
        """The sentence of the last that was refused since this was asked last, or None."""
        new, self._refused_before = self.refused - self._refused_before, self.refused
        return self._refusal if new else None

    def create_service(
        self, srv_type: type, srv_name: str, callback: Callable[[Any, Any], Any], **options: Any
    ) -> Service:
        """Of rclpy, which makes those of the parameters by it; they raise what they cannot read,
        and take 1000 requests at a time.
        """
        if not srv_type.__module__.startswith("rcl_interfaces."):
            return super().create_service(srv_type, srv_name, callback, **options)

        options["qos_profile"] = QoSProfile(depth=MOST_REQUESTS)

        @wraps(callback)
        def answer(request: Any, response: Any) -> Any:
            try:
                asked = sum(
                    len(getattr(request, several, ()))
                    for several in ("parameters", "names", "prefixes")
                )
                if asked > MOST_ASKED:
                    raise InputError(
                        f"it has {asked} parameters, names or prefixes; at most {MOST_ASKED} "
                        "are read."
                    )
                return callback(request, response)
            except Exception as error:
                text = (
                    f"{srv_name}: a request cannot be read and changes nothing more: "
                    f"{error!r:.{LONGEST_NAME}}"
                )
                self.warn_at_times(srv_name, text)
                return response

        return super().create_service(srv_type, srv_name, answer, **options)

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Of rclpy; what the parameter services of the node call."""
        others = [each for each in parameter_list if not self._is_so_for_good(each)]
        if not others and parameter_list:
            return SetParametersResult(successful=True)
        if others and self.frozen:
            return SetParametersResult(
                successful=False,
                reason=self.refuse(f"parameter {others[0].name!r:.{LONGEST_NAME}}"),
            )
        unknown = [each.name for each in others if not self.has_parameter(each.name)]
        if unknown:  # rclpy says of which only [], for lack of a copy
            return SetParametersResult(successful=False, reason=self._unknown(unknown[0]))
        return super().set_parameters_atomically(others)

    def _unknown(self, name: str) -> str:
        """That there is no such parameter, and which one was probably meant."""
        near = get_close_matches(name, self._parameters, n=1, cutoff=0.5)
        return f"{self.get_name()} has no parameter {name!r:.{LONGEST_NAME}}; " + (
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
    """Declare a Parameter and return its value; raises InputError."""
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
    """Declare {name: Parameter}; returns {name: value}."""
    return {name: declare(node, name, parameter) for name, parameter in parameters.items()}


def refuse_unknown(node: ParameterNode, others: Collection[str] = ()) -> None:
    """Raise InputError for a parameter that was given and that the node, which has declared its
    own, does not have.
    others : names that are for somebody else.
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
    """Say which QoS overrides, and which of the parameter files given, change nothing. To be called
    when the nodes of a process have all of their topics. files : their paths.
    """
    given, logger = (
        {name for node in nodes for name in node._parameter_overrides},
        nodes[0].get_logger(),
    )
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
    """Paths after --params-file in the arguments of a process."""
    return [file for word, file in zip(arguments, arguments[1:]) if word == "--params-file"]


def _names(file: str) -> set[str]:
    """Names of all parameters in a parameter file, of whatever node. rcl has read it before and
    validates it: here no value is looked at, nor the tag of one (launch_ros gives lists the tag
    !!python/tuple).
    """
    if not Path(file).is_file():  # a pipe, which rcl has emptied
        return set()
    try:
        with open(file, "rb") as opened:
            return set(_below_nodes(yaml.compose(opened, Loader=yaml.SafeLoader)))
    except (OSError, yaml.YAMLError):
        return set()


def _below_nodes(part: MappingNode) -> Iterator[str]:
    """Yields the names below each ros__parameters in a part of a file, as yaml.compose gives it."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        yield from _flat(value) if key.value == "ros__parameters" else _below_nodes(value)


def _flat(part: MappingNode, prefix: str = "") -> Iterator[str]:
    """Yields the names in a mapping of parameters, whose mappings are prefixes."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        name = f"{prefix}{key.value}"
        if isinstance(value, yaml.MappingNode):
            yield from _flat(value, f"{name}.")
        else:
            yield name
