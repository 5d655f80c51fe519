# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read the data files of bags of ROS 2, MCAP or SQLite, up to where they are cut.

The messages alone count: indexes and statistics may be missing or wrong. The files stay unchanged. Formats:
https://mcap.dev/spec, https://sqlite.org/walformat.html.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
import io
from pathlib import Path
import re
import shutil
import sqlite3
import struct
import sys
from typing import Any, BinaryIO
from urllib.parse import quote
import zlib

import lz4.frame
from rosbags.interfaces import Connection

from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.common.limits import CHUNK_BYTES, MESSAGE_BYTES, Budget, most_unpacked

from . import LOG, MCAP, SQLITE
from .messages import recorded_topic

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Row = tuple[Connection | None, int, bytes]  # topic (None: unreadable), stamp ns, data

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F  # of MCAP
_LATEST = 2**63  # ns
_STEPS = 20_000  # instructions of SQLite between checks of the time: some milliseconds
_PLAIN_SCHEMA = re.compile(
    r"CREATE\s+(TABLE|INDEX)\s[^()]*\([\w\s,\"'`\[\]]*\)\s*", re.IGNORECASE
)  # without inner brackets nothing is computed
_DEFINITIONS = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
_MESSAGES = (
    f"SELECT id, topic_id, timestamp, iif(length(data) <= {MESSAGE_BYTES}, data, NULL) FROM messages "
    "ORDER BY id"
)
# else a Ctrl-C in a callback of SQLite is lost (common/executable.py)
sqlite3.enable_callback_tracebacks(True)


class Damaged(Exception):
    """Report where the readable part of a file ends. The message does not name the file."""


def remedy(file: Path) -> str:
    """Return the command that may find more in a damaged file."""
    plain = file.with_suffix("") if file.suffix == ".zstd" else file
    of_sqlite = f'sqlite3 {plain} ".recover" | sqlite3 recovered.db3'
    of_mcap = f"mcap recover {plain} -o recovered.mcap"
    recover = of_mcap if plain.suffix == ".mcap" else of_sqlite
    return recover if plain == file else f"zstd -d {file}; {recover}"


def merged(file: Path, folder: Path, remarks: list[str]) -> Path:
    """Return a file; if its recorder left a log of SQLite beside it, a copy that SQLite merged with the log."""
    log, copy = file.with_name(file.name + LOG), folder / file.name
    if not log.is_file() or not log.stat().st_size:
        return file
    shutil.copyfile(file, copy)  # without permissions: the copies are written
    shutil.copyfile(log, folder / log.name)
    size = file.stat().st_size + log.stat().st_size
    try:
        with closing(sqlite3.connect(copy, isolation_level=None)) as database:
            (pages,) = database.execute("PRAGMA page_count").fetchone()
            (page_size,) = database.execute("PRAGMA page_size").fetchone()
            if pages * page_size > most_unpacked(size):  # SQLite would create a file of that size
                raise sqlite3.DatabaseError(f"{pages} pages are claimed, more than there are")
            _, _, read = database.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            database.execute("PRAGMA journal_mode=DELETE")
    except sqlite3.DatabaseError as error:
        remarks.append(f"{log.name} cannot be merged ({error}). Its messages are missing.")
        return file
    there = (log.stat().st_size - 32) // (24 + page_size)  # behind headers
    remarks.append(
        f"The recorder did not close {file.name}. {max(read, 0)} of {there} pages in {log.name} are "
        "read, too. Any others are not finished, damaged or older."
    )
    return copy


def rows(file: Path) -> Iterator[Row]:
    """Return the messages of a data file in the order of writing.

    Raises
    ------
    Damaged
        Where the readable part ends.
    TooMuch
        If the file takes too long.
    """
    with file.open("rb") as opened:
        head = opened.read(len(SQLITE))
    if head.startswith(MCAP):
        return _from_mcap(file)
    if head == SQLITE:
        return _from_sqlite(file)
    raise Damaged("it is neither MCAP nor SQLite")


def _from_mcap(file: Path) -> Iterator[Row]:
    schemas: dict[int, list[str]] = {}
    channels: dict[int, Connection | None] = {}
    with file.open("rb") as opened:
        for kind, content in _unchunked(opened, file.stat().st_size):
            try:
                if kind == SCHEMA:
                    (number,) = struct.unpack_from("<H", content)
                    schemas[number] = _texts(content, 2, 3)
                elif kind == CHANNEL:
                    number, schema = struct.unpack_from("<HH", content)
                    (topic,) = _texts(content, 4, 1)
                    qos = content.partition(b"offered_qos_profiles")[2]
                    described = schemas.get(schema, ["", "", ""])
                    offered = _texts(qos, 0, 1) if qos else [""]
                    channels[number] = recorded_topic(topic, *described, *offered)
                else:
                    number, _, stamp = struct.unpack_from("<HIQ", content)
                    yield channels.get(number) if stamp < _LATEST else None, stamp, content[22:]
            except (struct.error, UnicodeDecodeError) as error:
                raise Damaged(f"a record cannot be read: {error}") from error


def _unchunked(file: BinaryIO, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of the schemas, channels and messages of an MCAP file of `end` bytes."""
    left = most_unpacked(end)
    file.seek(len(MCAP))
    for kind, content in _records(file, end):
        if kind in (DATA_END, FOOTER):
            return
        if kind == CHUNK:
            size, data = _chunk(content, min(left, CHUNK_BYTES))
            left -= size
            inside = _records(io.BytesIO(data), len(data))
            yield from (record for record in inside if record[0] in (SCHEMA, CHANNEL, MESSAGE))
        elif content:
            yield kind, content
    raise Damaged("it ends early")


def _records(file: BinaryIO, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of the records up to byte `end`, of unused ones without content.

    A chunk that is cut is yielded as far as it is there. Raises Damaged after it, and where another record is cut.
    """
    while (start := file.tell()) < end:
        head = file.read(9)
        kind, size = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
        there, used = min(size, end - file.tell()), kind in (SCHEMA, CHANNEL, MESSAGE, CHUNK)
        if kind == 0 or (there < size and kind != CHUNK) or (used and there > CHUNK_BYTES):
            raise Damaged("a record is cut")
        yield kind, file.read(there) if used else b""
        if there < size:
            raise Damaged("a chunk is cut")
        file.seek(start + 9 + size)


def _chunk(content: bytes, most: int) -> tuple[int, bytes]:
    """Return (stated size, unpacked content) of a chunk of at most `most` bytes; of a cut one what is there."""
    try:
        size, crc, length = struct.unpack_from("<QII", content, 16)
        compression, data = content[32 : 32 + length], content[40 + length :]
        if size > most:
            raise Damaged(f"a chunk claims {size} bytes, more than {most}")
        if compression == b"lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
        elif compression == b"zstd":
            data = zstd.ZstdDecompressor().decompress(data, size + 1)
        elif compression:
            raise Damaged(f"compression {compression[:20]!r} is not known")
    except (struct.error, RuntimeError, EOFError, zstd.ZstdError) as error:
        raise Damaged(f"a chunk cannot be unpacked: {error}") from error
    if len(data) > size or (crc and len(data) == size and zlib.crc32(data) != crc):
        raise Damaged("the size or the checksum of a chunk is wrong")
    return size, data


def _texts(content: bytes, at: int, count: int) -> list[str]:
    """Return `count` texts from byte `at` on, each stored after its length."""
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, at)
        at += 4 + length
        found.append(content[at - length : at].decode())
    return found


def _from_sqlite(file: Path) -> Iterator[Row]:
    size, name, definitions, topics = file.stat().st_size, quote(str(file.absolute())), {}, {}
    budget, left = Budget(file, size), most_unpacked(size)
    with closing(sqlite3.connect(f"file:{name}?mode=ro&immutable=1", uri=True)) as database:
        database.set_progress_handler(budget.is_late, _STEPS)
        try:
            database.execute("PRAGMA writable_schema=ON")  # else no page of a cut file is read
            tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE sql NOTNULL"))
            for name, text in tables.items():
                if not _PLAIN_SCHEMA.fullmatch(text):
                    raise Damaged(f"{name} in it is no table and no index of columns")
            if "message_definitions" in tables:  # since ROS 2 Iron
                definitions = {kind: texts for kind, *texts in database.execute(_DEFINITIONS)}
            qos = "offered_qos_profiles" if "offered_qos" in tables.get("topics", "") else "''"
            for number, topic, kind, offered in database.execute(
                f"SELECT id, name, type, {qos} FROM topics"
            ):
                texts = [topic, kind, *definitions.get(kind, ["", ""]), offered]
                topics[number] = recorded_topic(*map(str, texts))
            for _, topic, stamp, data in _messages(database, file):
                sound = type(stamp) is int and type(data) is bytes and 0 <= stamp < _LATEST
                yield (topics.get(topic), stamp, data) if sound else (None, 0, b"")
                left -= len(data or b"")
                if left < 0:
                    raise Damaged("its messages are larger than they may be")
                budget.restart()  # the time of the caller does not count
        except (sqlite3.Error, UnicodeDecodeError, TypeError) as error:
            budget.check_time()
            raise Damaged(str(error)) from error


def _messages(database: sqlite3.Connection, file: Path) -> Iterator[tuple[Any, ...]]:
    """Yield (id, topic_id, timestamp, data) in the order of ids.

    Where the inner pages are cut away, each page with messages is read, in a copy, as if it were the whole table.
    """
    last = -_LATEST
    try:
        for row in database.execute(_MESSAGES):
            if not row[0] > last:
                raise sqlite3.DatabaseError("its messages are out of order")
            last = row[0]
            yield row
    except sqlite3.DatabaseError:
        (page_size,) = database.execute("PRAGMA page_size").fetchone()
        with temporary_folder() as folder:
            copy = Path(shutil.copyfile(file, folder / "copy"))
            with closing(sqlite3.connect(copy, isolation_level=None)) as writable:
                writable.executescript(
                    "PRAGMA writable_schema=ON; PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF"
                )
                for page in _pages_with_rows(file, page_size) if last == -_LATEST else ():
                    writable.execute(
                        "UPDATE sqlite_master SET rootpage = ? WHERE name = 'messages'", [page]
                    )
                    writable.execute(f"PRAGMA schema_version = {page}")  # forget the page before
                    yield from (row for row in writable.execute(_MESSAGES) if type(row[3]) is bytes)
        raise


def _pages_with_rows(file: Path, page_size: int) -> list[int]:
    """Return the numbers of the pages that are leaves of tables."""
    pages = range(1, file.stat().st_size // page_size)
    with file.open("rb") as opened:
        return [
            number + 1
            for number in pages
            if opened.seek(number * page_size) and opened.read(1) == b"\x0d"
        ]
