"""Parameters of a node: each with text, unit and range; what a node does not know is refused or said."""

from dataclasses import dataclass
from difflib import get_close_matches

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)

from .errors import InputError
from .safe_yaml import read_yaml

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
        names = _names(read_yaml(file))
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


def _names(content):
    """Names of all parameters in a parameter file, of whatever node."""
    if not isinstance(content, dict):
        return set()
    found = set()
    for key, value in content.items():
        found |= _flat(value) if key == "ros__parameters" else _names(value)
    return found


def _flat(parameters, prefix=""):
    if not isinstance(parameters, dict):
        return {prefix.rstrip(".")}
    return set().union(*(_flat(value, f"{prefix}{name}.") for name, value in parameters.items()), set())
