# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2 messages, to read and write bags without a ROS installation."""

from __future__ import annotations

from functools import lru_cache
import os
from pathlib import Path

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.limits import DEFINITION_BYTES
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


def check_type(path: str | Path, connection: Connection) -> None:
    """Raise InputError unless the type of a topic is known in the recorded version."""
    store = typestore()
    add_type(store, connection.msgtype)
    recorded = _recorded_hash(path, connection)
    if recorded and recorded != store.hash_rihs01(connection.msgtype):
        raise InputError(
            f"{path}: {connection.topic} was recorded with another version of "
            f"{connection.msgtype}; use the version of "
            "this software that recorded it."
        )


def _recorded_hash(path: str | Path, connection: Connection) -> str:
    """Return the hash of the recorded type of a topic; empty if the bag does not contain it.

    Raises InputError.
    """
    recorded = connection.digest
    if (
        not recorded and connection.msgdef.format == MessageDefinitionFormat.MSG
    ):  # a data file without metadata.yaml
        if len(connection.msgdef.data) > DEFINITION_BYTES:
            raise InputError(
                f"{path}: the definition of {connection.msgtype} in the bag has more than "
                f"{DEFINITION_BYTES} bytes; record it again."
            )
        try:
            recorded = _hash_of(connection.msgdef.data, connection.msgtype)
        except Exception as error:  # rosbags raises whatever its parsers run into
            raise InputError(
                f"{path}: the definition of {connection.msgtype} in the bag cannot be read "
                f"({error!r}); record it again."
            ) from error
    return recorded


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
