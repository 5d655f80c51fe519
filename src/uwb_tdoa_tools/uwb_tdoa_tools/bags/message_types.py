# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2 messages, to read and write bags without a ROS installation."""

from __future__ import annotations

from functools import lru_cache
import os
from pathlib import Path
import re

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Nodetype,
)
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.limits import DEFINITION_BYTES
from uwb_tdoa_bias.common.safe_yaml import parse_yaml
from uwb_tdoa_bias.common.sensors import SENSORS

OUR_PACKAGE = "uwb_tdoa_msgs"
OUR_TYPES = (
    "Tdoa",
    "TdoaCorrected",
    "TdoaResidual",
    "Anchor",
    "AnchorArray",
    "EstimatorStatus",
    *(
        of.message.rpartition("/")[2]
        for of in SENSORS.values()
        if of.message.startswith(OUR_PACKAGE)
    ),
)
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
# where folders of message packages are besides installed ones: in a wheel, and in the sources
_OURS = Path(__file__).parent, Path(__file__).resolve().parents[3]


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of uwb_tdoa_msgs; `add_type` adds others."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in OUR_TYPES:
        add_type(store, f"{OUR_PACKAGE}/msg/{name}")
    return store


def add_type(store: Typestore, msgtype: str) -> None:
    """Add a type like "pkg/msg/Name" and its parts to a store, from installed .msg files."""
    if msgtype in store.fielddefs:
        return
    types = get_types_from_msg(_definition(msgtype), msgtype)
    store.register(types)
    for _, fields in types.values():
        for _, field in fields:
            while field[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                field = field[1][0]
            if field[0] == Nodetype.NAME:
                add_type(store, field[1])


def recorded_topic(
    topic: str, msgtype: str, encoding: str, definition: str, qos: str
) -> Connection | None:
    """Return a topic of a bag, without id and count; None if the names are none.

    Parameters
    ----------
    topic, msgtype : str
    encoding, definition : str
        "ros2msg" or "ros2idl", and the text that defines the type. May be empty.
    qos : str
        Offered QoS, YAML.
    """
    if not re.fullmatch(r"[/\w]+", topic) or not re.fullmatch(r"\w+/\w+/\w+", msgtype):
        return None
    kind = _FORMATS.get(encoding) if definition else None
    described = MessageDefinition(kind or MessageDefinitionFormat.NONE, definition)
    try:
        offered = parse_qos(parse_yaml(qos, topic))
    except Exception:  # rosbags raises whatever its parsers run into
        offered = []
    return Connection(
        0, topic, msgtype, described, "", 0, ConnectionExtRosbag2("cdr", offered), None
    )


def check_type(path: str | Path, connection: Connection) -> None:
    """Raise InputError unless the type of a topic is known in the recorded version.

    A definition that is missing, or that cannot be read, states no version.
    """
    store, definition = typestore(), connection.msgdef
    add_type(store, connection.msgtype)
    if definition.format != MessageDefinitionFormat.MSG or len(definition.data) > DEFINITION_BYTES:
        return
    try:
        recorded = _hash_of(definition.data, connection.msgtype)
    except Exception:  # rosbags raises whatever its parsers run into
        return
    if recorded != store.hash_rihs01(connection.msgtype):
        raise InputError(
            f"{path}: {connection.topic} was recorded with another version of "
            f"{connection.msgtype}; use the version of "
            "this software that recorded it."
        )


@lru_cache(maxsize=64)
def _hash_of(definition: str, msgtype: str) -> str:
    """Return the hash of a type from its definition in a bag."""
    of_bag = get_typestore(Stores.EMPTY)
    of_bag.register(get_types_from_msg(definition, msgtype))
    return of_bag.hash_rihs01(msgtype)


def _definition(msgtype: str) -> str:
    package, _, name = msgtype.split("/")
    prefixes = [
        Path(prefix) / "share"
        for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        if prefix
    ]
    for share in [*prefixes, *_OURS]:
        file = share / package / "msg" / f"{name}.msg"
        if file.is_file():
            return file.read_text(encoding="utf-8")
    raise InputError(
        f"{msgtype}: its definition is not installed; build and source the workspace that has "
        f"{package}."
    )
