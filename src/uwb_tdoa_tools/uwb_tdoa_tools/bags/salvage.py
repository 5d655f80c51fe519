# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Copy the readable messages of a cut or damaged bag to another bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
import sqlite3
import struct

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from uwb_tdoa_bias.common.errors import InputError

from . import integrity, mcap
from .mcap import Damaged
from .message_types import check_type, typestore

MESSAGES = "messages"
LATEST = 2**63  # ns
NO_HASH = "RIHS01_" + 64 * "0"  # of a type that is not installed; rosbags wants one
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}


def salvage(path: str | Path, out: str | Path) -> list[str]:
    """Write the readable messages of a bag to a new bag.

    Parameters
    ----------
    path : str or Path
        Bag directory or data file, with or without metadata.yaml.
    out : str or Path

    Returns
    -------
    list of str
        Sentences about missing messages.

    Raises
    ------
    InputError
        If no message can be read.
    """
    path = Path(path)
    remarks: list[str] = []
    connections: dict[tuple[str, str], Connection] = {}
    files = [path] if path.is_file() else _files(path, remarks)
    with Writer(out, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as writer:
        for file in files:
            count, lost, damage = _copy(path, file, writer, connections)
            if lost:
                remarks.append(
                    f"{file.name}: {' and '.join(f'{n} {what}' for what, n in lost.items())} "
                    "cannot be read: left out."
                )
            if damage:
                remarks.append(
                    f"{file.name} is cut or damaged ({damage}): read up to there, {count} messages."
                )
        if not connections:
            raise InputError(
                f"{path}: holds no message that can be read; copy it again, or record it again."
            )
    return remarks


def _files(path: Path, remarks: list[str]) -> list[Path]:
    try:
        return [
            file for file in integrity.data_files(path, integrity.metadata(path)) if file.is_file()
        ]
    except (Damaged, InputError) as error:
        remarks.append(f"metadata.yaml is of no use ({error}): read without it.")
        return sorted([*path.glob("*.mcap"), *path.glob("*.db3")])


def _copy(
    path: Path, file: Path, writer: Writer, connections: dict[tuple[str, str], Connection]
) -> tuple[int, Counter[str], str | None]:
    """Copy the messages of a data file.

    Parameters
    ----------
    path, file, writer
    connections : dict
        Connection of the writer by (topic, type).

    Returns
    -------
    tuple
        Number of messages, {unreadable part: count}, and the damage at the end or None.
    """
    count = 0
    lost: Counter[str] = Counter()
    try:
        for connection, stamp, data in as_written(file, lost):
            key = connection.topic, connection.msgtype
            if key not in connections:
                connections[key] = _added(path, connection, writer)
            writer.write(connections[key], stamp, data)
            count += 1
    except Damaged as damage:
        return count, lost, str(damage)
    return count, lost, None


def as_written(file: Path, lost: Counter[str]) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield (connection, stamp in ns, bytes) of a data file in the order of writing.

    `lost` counts unreadable parts.

    Raises
    ------
    Damaged
        At the end of the readable part.
    """
    return (_from_mcap if integrity.is_mcap(file) else _from_sqlite)(file, lost)


def _added(path: Path, connection: Connection, writer: Writer) -> Connection:
    """Add a topic to the new bag; those of others keep their definition. Raises InputError."""
    try:
        check_type(path, connection)
    except InputError:
        if connection.msgtype in typestore().fielddefs:
            raise  # the installed type has another version
        return writer.add_connection(
            connection.topic, connection.msgtype, msgdef=connection.msgdef.data, rihs01=NO_HASH
        )
    return writer.add_connection(connection.topic, connection.msgtype, typestore=typestore())


def _from_mcap(file: Path, lost: Counter[str]) -> Iterator[tuple[Connection, int, bytes]]:
    schemas, channels = {}, {}
    for kind, content in mcap.intact_records(file):
        if kind == mcap.CHUNK:
            lost["chunks"] += 1
            continue
        try:
            if kind == mcap.SCHEMA:
                (number,), texts = struct.unpack_from("<H", content), _texts(content, 2, 3)
                schemas[number] = texts
            elif kind == mcap.CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                channels[number] = _channel(number, *_texts(content, 4, 1), *schemas[schema])
            else:
                number, _, stamp = struct.unpack_from("<HIQ", content)
                if stamp >= LATEST:
                    raise KeyError
                message = channels[number], stamp, content[22:]
        except (struct.error, KeyError, UnicodeDecodeError, Damaged):
            lost[MESSAGES if kind == mcap.MESSAGE else "descriptions of topics"] += 1
            continue
        if kind == mcap.MESSAGE:
            yield message


def _from_sqlite(file: Path, lost: Counter[str]) -> Iterator[tuple[Connection, int, bytes]]:
    connection, topics = integrity.open_sqlite(file), {}
    try:
        definitions = _definitions(connection)
        for number, topic, msgtype in connection.execute("SELECT id, name, type FROM topics"):
            topics[number] = _channel(
                number, str(topic), str(msgtype), *definitions.get(msgtype, ("", ""))
            )
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise integrity.as_damaged(error) from error
    finally:
        connection.close()
    for _, topic, stamp, data in integrity.sqlite_messages(file):
        if (
            topic not in topics
            or type(stamp) is not int
            or type(data) is not bytes
            or not 0 <= stamp < LATEST
        ):
            lost[MESSAGES] += 1
            continue
        yield topics[topic], stamp, data


def _definitions(connection: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Return {type: (encoding, text)}. rosbag2 writes them since ROS 2 Iron."""
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    try:
        return {
            msgtype: (str(encoding), str(text))
            for msgtype, encoding, text in connection.execute(query)
        }
    except sqlite3.OperationalError:  # no such table
        return {}


def _texts(content: bytes, at: int, count: int) -> list[str]:
    """Return texts, each stored after its length.

    Raises
    ------
    Damaged
        If a text is cut.
    """
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, at)
        if length > len(content) - at - 4:
            raise Damaged("a text in it is cut")
        found.append(content[at + 4 : at + 4 + length].decode())
        at += 4 + length
    return found


def _channel(number: int, topic: str, msgtype: str, encoding: str, definition: str) -> Connection:
    described = MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), definition)
    return Connection(
        number, topic, msgtype, described, "", 0, ConnectionExtRosbag2("cdr", []), None
    )
