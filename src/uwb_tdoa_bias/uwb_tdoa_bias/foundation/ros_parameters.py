"""Parameters of a node: each with text, unit and range; what a node does not know is refused or said."""

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
import yaml

from .errors import InputError

KINDS = {float: "a number with a decimal point, e.g. 1.0", int: "a whole number", bool: "true or false", list: "a list"}
QOS = "qos_overrides."


@dataclass(frozen=True)
class Parameter:
    """default : its value and type; text : unit and meaning, as in the parameter file; low, high : its range, for a number;
    choices : the texts that it may be; constraint : in words, what cannot be said by these; settable : in flight."""

    default: object
    text: str
    low: float = None
    high: float = None
    choices: tuple = ()
    constraint: str = ""
    settable: bool = False

    def descriptor(self):
        """ParameterDescriptor for ROS."""
        constraint = f"one of {', '.join(self.choices)}" if self.choices else self.constraint
        out = ParameterDescriptor(
            description=self.text, read_only=not self.settable, additional_constraints=constraint
        )
        if isinstance(self.default, float):
            out.floating_point_range = [FloatingPointRange(from_value=float(self.low), to_value=float(self.high))]
        elif isinstance(self.default, int) and not isinstance(self.default, bool):
            out.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)]
        return out


class ParameterNode(Node):
    """A Node that takes a read-only parameter which is set to what it is: `ros2 param load` sets all that `ros2 param dump` wrote."""

    def set_parameters_atomically(self, parameter_list):
        """Of rclpy; what the parameter services of the node call."""
        others = [each for each in parameter_list if not self._is_so_for_good(each)]
        return super().set_parameters_atomically(others) if others or not parameter_list else SetParametersResult(successful=True)

    def _is_so_for_good(self, parameter):
        name = parameter.name
        return (
            self.has_parameter(name)
            and self.describe_parameter(name).read_only
            and self.get_parameter(name).get_parameter_value() == parameter.get_parameter_value()
        )


def declare(node, name, parameter):
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
        raise InputError(f"{name}: {given!r} must be from {parameter.low:g} to {parameter.high:g}.") from error
    if parameter.choices and value not in parameter.choices:
        raise InputError(f"{name}: {value!r} is not one of {', '.join(parameter.choices)}.")
    return value


def declare_all(node, parameters):
    """Declare {name: Parameter}; returns {name: value}."""
    return {name: declare(node, name, parameter) for name, parameter in parameters.items()}


def refuse_unknown(node, others=()):
    """Raise InputError for a parameter that was given and that the node, which has declared its own, does not have.
    others : names that are for somebody else, or old ones that were taken."""
    for name in sorted(node._parameter_overrides):
        if name.startswith(QOS) or name in others or node.has_parameter(name):
            continue
        near = get_close_matches(name, {*node._parameters, *others}, n=1, cutoff=0.5)
        remedy = f"write {near[0]}" if near else "leave it out"
        raise InputError(f"{name}: {node.get_name()} has no such parameter; {remedy} (config/{node.NAME}.yaml has all).")


def say_unused(nodes, files):
    """Say which QoS overrides, and which of the parameter files given, change nothing. To be called when the nodes of a
    process have all of their topics. files : their paths."""
    given, logger = {name for node in nodes for name in node._parameter_overrides}, nodes[0].get_logger()
    for file in files:
        names = _names(file)
        if names and not names & given:
            logger.warning(
                f"{file}: none of its parameters is for {nodes[0].get_fully_qualified_name()}: they are not used; begin it "
                "with '/**:', or with the name of this node"
            )
    for name in sorted(given):
        if name.startswith(QOS) and not any(node.has_parameter(name) for node in nodes):
            logger.warning(f"{name}: changes nothing, because this node has no such topic or policy")


def files_of(arguments):
    """Paths after --params-file in the arguments of a process."""
    return [file for word, file in zip(arguments, arguments[1:]) if word == "--params-file"]


def _names(file):
    """Names of all parameters in a parameter file, of whatever node. rcl has read it before and judges it: here no value is looked
    at, nor the tag of one (launch_ros gives lists the tag !!python/tuple)."""
    if not Path(file).is_file():  # a pipe, which rcl has emptied
        return set()
    try:
        with open(file, "rb") as opened:
            return set(_below_nodes(yaml.compose(opened, Loader=yaml.SafeLoader)))
    except (OSError, yaml.YAMLError):
        return set()


def _below_nodes(part):
    """Yields the names below each ros__parameters in a part of a file, as yaml.compose gives it."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        yield from _flat(value) if key.value == "ros__parameters" else _below_nodes(value)


def _flat(part, prefix=""):
    """Yields the names in a mapping of parameters, whose mappings are prefixes."""
    for key, value in part.value if isinstance(part, yaml.MappingNode) else ():
        name = f"{prefix}{key.value}"
        if isinstance(value, yaml.MappingNode):
            yield from _flat(value, f"{name}.")
        else:
            yield name
