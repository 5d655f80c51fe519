# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Changes of files: bytes, and by what the files are made of (numbers and lines of text, trees,
protocol buffers, records, tables).
"""

import re
import sqlite3
import struct
import tempfile

import yaml

from uwb_tdoa_tools.bags import mcap

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-320",
    "0",
    "-0",
    "-1",
    "1e400",
    "9" * 400,
    "0x10",
    "65536",
    "4294967296",
    "18446744073709551616",
    "",
    " ",
    "true",
    "~",
    "1_0",
    "\u0661",
    "1.7976931348623157e308",
    "2147483648",
    "x" * 5000,
    "$\\frac$",
    "\x1b[2J",
    "<b>",
    "{",
    "[[[[",
    "&a",
    "*a",
    "!!int",
)
VALUES = (
    None,
    True,
    0,
    -1,
    2**63,
    10**300,
    1e308,
    -1e308,
    1e-320,
    65536,
    "",
    "x" * 5000,
    "nan",
    "\x1b",
    [],
    {},
    [[]],
    {"": ""},
    [0.0] * 50,
    {"x": {"y": 1}},
)
WORDS = (
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    0x7FFFFFFFFFFFFFFF,
    0xFFFFFFFFFFFFFFFF,
    0x7FF0 << 48,
    0x7FF8 << 48,
)


def changed(name, data, chance):
    """The data of a target's corpus, changed once or several times. chance : random.Random."""
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        try:
            data = (
                STRUCTURES.get(name, of_bytes)(data, chance)
                if chance.random() < 0.6
                else of_bytes(data, chance)
            )
        except (IndexError, struct.error):  # it has no such structure by now
            data = of_bytes(data, chance)
    return data


def of_bytes(data, chance):
    data, at = bytearray(data), chance.randrange(len(data) + 1)
    what, size = chance.randrange(6), chance.choice((1, 2, 4, 8, 64))
    if what == 0:
        data[at : at + 1] = chance.randbytes(1)
    elif what == 1:
        size = min(size, 8)
        data[at : at + size] = (chance.choice(WORDS) & (1 << 8 * size) - 1).to_bytes(
            size, chance.choice(("little", "big"))
        )
    elif what == 2:
        del data[at : at + size]
    elif what == 3:
        data[at:at] = chance.randbytes(size)
    elif what == 4:
        start = chance.randrange(len(data) + 1)
        data[at:at] = data[start : start + size]
    else:
        del data[at:]
    return bytes(data)


def of_text(data, chance):
    text = data.decode("utf-8", "replace")
    what = chance.randrange(4)
    if what == 0:
        found = list(re.finditer(r"[-+.\w]+", text)) or [None]
        if (one := chance.choice(found)) is not None:
            text = text[: one.start()] + chance.choice(NUMBERS) + text[one.end() :]
    else:
        lines = text.splitlines(keepends=True) or [""]
        at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
        if what == 1:
            lines[at:at] = [lines[other]] * chance.choice((1, 1, 3, 100))
        elif what == 2:
            lines[at], lines[other] = lines[other], lines[at]
        else:
            del lines[at]
        text = "".join(lines)
    return text.encode("utf-8", "surrogatepass")


def of_yaml(data, chance):
    try:
        tree = yaml.safe_load(data)
    except (yaml.YAMLError, ValueError, RecursionError):
        return of_text(data, chance)
    places = [((), None)]
    stack = [tree]
    while stack:
        node = stack.pop()
        keys = (
            node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        )
        for key in keys:
            places.append((node, key))
            stack.append(node[key])
    node, key = chance.choice(places)
    value = chance.choice(VALUES)
    if key is None:
        tree = value
    elif isinstance(node, dict) and chance.random() < 0.3:
        other = chance.choice((7, "x", "", -1, 65536, True, "\x1b", key))
        node[other] = node.pop(key) if chance.random() < 0.5 else value
    elif isinstance(node, list) and chance.random() < 0.3:
        node[key : key + chance.randrange(2)] = [node[key]] * chance.choice((0, 2, 20))
    else:
        node[key] = value
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True).encode(
        "utf-8", "surrogatepass"
    )


def of_protobuf(data, chance, depth=0):
    """One field of a message changed, left out or repeated.

    The lengths of the enclosing messages stay right.
    """
    fields, at = [], 0
    while at < len(data):
        start = at
        key, at = _varint(data, at)
        if key & 7 == 0:
            value, at = _varint(data, at)
        else:
            size, at = {1: (8, at), 5: (4, at)}.get(key & 7) or _varint(data, at)
            value, at = data[at : at + size], at + size
        if key & 7 not in (0, 1, 2, 5) or at > len(data):
            return of_bytes(data[start:], chance)
        fields.append([key, value])
    if not fields:
        return chance.choice((b"", chance.randbytes(3)))
    place = chance.randrange(len(fields))
    key, value = fields[place]
    what = chance.random()
    if what < 0.1:
        del fields[place]
    elif what < 0.2:
        fields[place:place] = [fields[place]] * chance.choice(
            (1, 1, 10, 1000 if len(data) < 2000 else 10)
        )
    elif what < 0.3:
        fields[place][0] = chance.choice(
            (chance.randrange(1, 30) << 3 | key & 7, key & ~7 | chance.choice((0, 2, 5)))
        )
    elif isinstance(value, int):
        fields[place][1] = chance.choice(WORDS)
    elif depth < 5 and key & 7 == 2 and len(value) > 3 and what < 0.9:
        try:
            fields[place][1] = of_protobuf(value, chance, depth + 1)
        except (IndexError, TypeError):
            fields[place][1] = of_bytes(value, chance)
    else:
        fields[place][1] = (
            of_bytes(value, chance)
            if value
            else chance.choice((b"Concat", b"Loop", b"\xff" * 20, b"x"))
        )
    return b"".join(_field(*each) for each in fields)


def _varint(data, at):
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80 or shift > 63:
            return value, at


def _number(value):
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(key, value):
    if isinstance(value, int):
        return _number(key & ~7) + _number(value)
    size = b"" if key & 7 in (1, 5) else _number(len(value))
    return _number(key if key & 7 else key | 2) + size + value


def of_mcap(data, chance):
    """One record changed, left out, moved or repeated; the neighbouring records stay right.

    In a chunk that is not compressed, its content is changed.
    """
    found, at = [], len(mcap.MAGIC)
    while at + 9 <= len(data) - len(mcap.MAGIC):
        kind, size = struct.unpack_from("<BQ", data, at)
        if at + 9 + size > len(data):
            return of_bytes(data, chance)
        found.append((kind, data[at + 9 : at + 9 + size]))
        at += 9 + size
    if not found:
        return of_bytes(data, chance)
    place, other = chance.randrange(len(found)), chance.randrange(len(found))
    kind, content = found[place]
    what = chance.randrange(6)
    if what == 0:
        del found[place]
    elif what == 1:
        found[place:place] = [found[other]] * chance.choice((1, 1, 50))
    elif what == 2:
        found[place], found[other] = found[other], found[place]
    else:
        found[place] = (kind, of_bytes(content, chance))
    records = (struct.pack("<BQ", kind, len(content)) + content for kind, content in found)
    return mcap.MAGIC + b"".join(records) + mcap.MAGIC


STATEMENTS = (
    "UPDATE {table} SET {column} = {value} WHERE rowid = {row}",
    "UPDATE {table} SET {column} = {value}",
    "DELETE FROM {table} WHERE rowid = {row}",
    "INSERT INTO {table} SELECT * FROM {table} WHERE 0",
    "UPDATE {table} SET rowid = rowid + 1000",
    "DELETE FROM {table}",
    "DROP TABLE {table}",
    "ALTER TABLE {table} RENAME TO other",
    "ALTER TABLE {table} DROP COLUMN {column}",
    "ALTER TABLE {table} ADD COLUMN more TEXT",
    "DROP INDEX timestamp_idx",
    "CREATE VIEW v AS SELECT * FROM {table}",
    "CREATE INDEX i ON {table}({column})",
    "CREATE TRIGGER t AFTER INSERT ON {table} BEGIN SELECT 1; END",
    "CREATE TABLE IF NOT EXISTS schema(schema_version)",
    "UPDATE messages SET data = substr(data, 1, {row})",
    "UPDATE messages SET data = zeroblob({row} * 1000)",
)
CELLS = (
    "NULL",
    "0",
    "-1",
    "1e300",
    "9223372036854775807",
    "''",
    "'x'",
    "x''",
    "x'00ff'",
    "zeroblob(100000)",
    "'/uwb/tdoa'",
    "'sensor_msgs/msg/Imu'",
    "'a/b'",
    "char(27)",
)
TABLES = {
    "messages": ("id", "topic_id", "timestamp", "data"),
    "topics": (
        "id",
        "name",
        "type",
        "serialization_format",
        "offered_qos_profiles",
        "type_description_hash",
    ),
    "message_definitions": ("topic_type", "encoding", "encoded_message_definition"),
    "schema": ("schema_version", "ros_distro"),
    "metadata": ("metadata",),
}


def of_sqlite(data, chance):
    """One statement run in a database."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        connection = sqlite3.connect(file.name)
        table = chance.choice(list(TABLES))
        words = {
            "table": table,
            "column": chance.choice(TABLES[table]),
            "value": chance.choice(CELLS),
            "row": chance.randrange(1, 9),
        }
        try:
            connection.execute(chance.choice(STATEMENTS).format(**words))
            connection.commit()
        except (sqlite3.Error, UnicodeDecodeError):  # it is damaged by now, or lacks that
            return of_bytes(data, chance)
        finally:
            connection.close()
        file.seek(0)
        return file.read()


STRUCTURES = {
    **dict.fromkeys(
        (
            "csv",
            "csv_salvaged",
            "csv_gzip",
            "survey",
            "table",
            "columns",
            "distances",
            "peers",
        ),
        of_text,
    ),
    **dict.fromkeys(
        (
            "yaml",
            "effects",
            "config",
            "places",
            "walls",
            "antenna",
            "bag_metadata",
            "marks",
            "tags",
            "profile",
        ),
        of_yaml,
    ),
    "model": of_protobuf,
    **dict.fromkeys(("bag_mcap", "bag_mcap_sealed", "bag_mcap_salvaged", "bag_packed"), of_mcap),
    **dict.fromkeys(("bag_sqlite", "bag_sqlite_salvaged"), of_sqlite),
}
