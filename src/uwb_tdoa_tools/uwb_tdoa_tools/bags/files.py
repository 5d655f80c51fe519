# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags as files: open them, iterate over their messages, and write new ones atomically.

Data files of bags of ROS 2, MCAP or SQLite, are read up to where they are cut. The
messages alone count: indexes and statistics may be missing or wrong. The files stay unchanged. Formats:
https://mcap.dev/spec, https://sqlite.org/walformat.html.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from heapq import heappop, heappush
import io
from pathlib import Path
import re
import shutil
import sqlite3
import struct
import sys
import tempfile
from typing import Any, BinaryIO
from urllib.parse import quote
import zlib

import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer

from uwb_tdoa_bias.common.errors import (
    CHUNK_BYTES,
    MESSAGE_BYTES,
    READ_BYTES,
    Budget,
    InputError,
    TooMuch,
    most_unpacked,
    refuse_others,
)
from uwb_tdoa_bias.common.files import refuse_output, temporary_folder
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK

from ..choices import STORAGES
from . import LOG, MCAP, METADATA, SQLITE, ZSTD, data_files, is_bag
from .messages import check_type, recorded_topic, typestore

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
    head = _head(file)
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


PLUGINS = dict(zip(STORAGES, (StoragePlugin.MCAP, StoragePlugin.SQLITE3)))


Decoder = Callable[[bytes, str], Any]  # of the bytes of a message, and its type


class Incomplete:
    """A bag that may lack messages.

    Attributes
    ----------
    remarks : sentences on what is missing
    unreadable : {topic: number of messages that do not fit its type}
    """

    remarks: list[str]
    unreadable: Counter[str]
    messages: Callable[..., Iterator[tuple[Connection, int, bytes]]]


class BagReader(Incomplete):
    """A bag of ROS 2: the messages in its data files, up to where they are cut.

    Attributes
    ----------
    connections : topics with messages, numbered, with counts
    custom : custom data of metadata.yaml
    start_time, end_time : ns, of the first and the last message
    """

    def __init__(self, path: Path, folder: Path) -> None:
        """Find the topics of a bag.

        folder : an empty one, for copies of files that are packed, or that the recorder did not close

        Raises InputError if no message can be read.
        """
        self.remarks, self.unreadable = [], Counter()
        stated = _stated(path, self.remarks) if path.is_dir() else {}
        self.custom: dict[str, Any] = stated.get("custom_data") or {}
        files = _listed(path, stated, self.remarks) if path.is_dir() else [path]
        self._path, budget = path, Budget(path)
        self._most = most_unpacked(sum(file.stat().st_size for file in files))
        self._files = {}
        for file in files:
            if _head(file).startswith(ZSTD):
                self._files[file] = _unpacked(file, folder, budget, self._most)
            else:
                self._files[file] = merged(file, folder, self.remarks)
        self._scan()
        count = sum(connection.msgcount for connection in self.connections)
        if not count and (self.remarks or not files):
            raise InputError(
                f"{path}: holds no message that can be read; copy it again, or record it again "
                f"({' '.join(self.remarks)})."
            )
        if stated and stated.get("message_count") != count:
            self.remarks.append(
                f"metadata.yaml states {stated.get('message_count')!r} messages. The files hold "
                f"{count}, which are read."
            )

    def messages(
        self, connections: Collection[Connection] | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, stamp ns, bytes) of the given connections, default all.

        They come by stamp, or as they were written where the clock of the recorder was set back. Raises
        TooMuch.
        """
        chosen = self.connections if connections is None else connections
        wanted = {(one.topic, one.msgtype): one for one in chosen}
        room = self._most
        for file in self._files.values() if wanted else ():
            found = (
                (wanted[topic.topic, topic.msgtype], stamp, data)
                for topic, stamp, data in _intact(file)
                if topic is not None and (topic.topic, topic.msgtype) in wanted
            )
            for connection, stamp, data in _by_stamp(found):
                if data.startswith(ZSTD):  # of rosbag2's compression mode "message"
                    try:
                        data = zstd.ZstdDecompressor().decompress(data, MESSAGE_BYTES)
                    except zstd.ZstdError:
                        self.unreadable[connection.topic] += 1
                        continue
                room -= len(data)
                if room < 0:
                    raise TooMuch(
                        f"{self._path}: has more than {self._most} bytes of messages; give another "
                        "file, or split it."
                    )
                yield connection, stamp, data

    def _scan(self) -> None:
        """Set the topics, and the first and the last stamp; add remarks on what is lost."""
        topics: dict[tuple[str, str], Connection] = {}
        counts, self.start_time, self.end_time = Counter[tuple[str, str]](), 2**63 - 1, 0
        for file, whole in self._files.items():
            read, lost = counts.total(), 0
            try:
                for topic, stamp, _ in rows(whole):
                    if topic is None:
                        lost += 1
                        continue
                    topics.setdefault((topic.topic, topic.msgtype), topic)
                    counts[topic.topic, topic.msgtype] += 1
                    self.start_time = min(self.start_time, stamp)
                    self.end_time = max(self.end_time, stamp)
            except Damaged as damage:
                self.remarks.append(
                    f"{file.name} is cut or damaged ({damage}). The {counts.total() - read} messages "
                    f"before that are read. This may find more: {remedy(file)}"
                )
            if lost:
                self.remarks.append(f"{file.name}: {lost} messages cannot be read: left out.")
        self.connections = [
            topic._replace(id=number, msgcount=counts[key])
            for number, (key, topic) in enumerate(topics.items(), start=1)
        ]


def _stated(folder: Path, remarks: list[str]) -> dict[str, Any]:
    """Return the content of metadata.yaml; an empty dict, and a remark, if it is of no use."""
    try:
        stated = read_yaml(folder / METADATA)["rosbag2_bagfile_information"]
        if isinstance(stated["relative_file_paths"], list):
            return dict(stated)
    except (InputError, TypeError, KeyError, ValueError):
        pass
    what = "is of no use" if (folder / METADATA).exists() else "is missing"
    remarks.append(f"metadata.yaml {what}. The bag is read without it.")
    return {}


def _listed(folder: Path, stated: dict[str, Any], remarks: list[str]) -> list[Path]:
    """Return the data files in a folder: those of metadata.yaml, packed or not, if all are there."""
    there = {file.name: file for file in data_files(folder)}
    files = dict[Path, None]()
    for name in (Path(str(name)).name for name in stated.get("relative_file_paths", ())):
        found = [one for one in (name, f"{name}.zstd", name.removesuffix(".zstd")) if one in there]
        if not found:
            remarks.append(
                f"metadata.yaml names {name}, which is not there. Read: {' and '.join(there)}."
            )
            return list(there.values())
        files[there[found[0]]] = None
    return list(files or there.values())


def _head(file: Path) -> bytes:
    with file.open("rb") as opened:
        return opened.read(len(SQLITE))


def _unpacked(file: Path, folder: Path, budget: Budget, most: int) -> Path:
    """Unpack a file that rosbag2 has packed into a folder, up to where it is cut; return the new file.

    Raises TooMuch if all files of the budget together have more than `most` bytes.
    """
    with zstd.open(file, "rb") as source, open(folder / file.name, "wb") as target:
        with suppress(zstd.ZstdError, EOFError):  # `rows` names the place
            while block := source.read1(1 << 20):
                budget.spend("bytes when its files are unpacked", len(block), most)
                target.write(block)
    return folder / file.name


def _intact(file: Path) -> Iterator[Row]:
    """Yield the messages of a data file up to where it is cut."""
    with suppress(Damaged):
        yield from rows(file)


def _by_stamp(
    found: Iterator[tuple[Connection, int, bytes]],
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield (connection, stamp ns, bytes) by stamp.

    What follows a fall of more than LARGEST_STEP_BACK follows: the clock of the recorder, or of the
    recorded system, was set.
    """
    held: list[tuple[int, int, tuple[Connection, int, bytes]]] = []
    largest, newest = round(1e9 * LARGEST_STEP_BACK), 0
    for number, (connection, stamp, data) in enumerate(found):
        newest = max(newest, stamp)
        was_set = stamp < newest - largest
        while held and (was_set or held[0][0] < newest - largest):
            yield heappop(held)[2]
        newest = stamp if was_set else newest
        heappush(held, (stamp, number, (connection, stamp, data)))
    while held:
        yield heappop(held)[2]


@contextmanager
def new_bag(out: str | Path, storage: str = "mcap", force: bool = False) -> Iterator[Writer]:
    """Give a rosbags Writer; the bag appears at `out` only if the block ends without an exception.

    Parameters
    ----------
    storage : "mcap" or "sqlite3"
    force : whether to replace an existing bag. Raises InputError.
    """
    out = Path(out)
    refuse_others("storage", [storage], STORAGES)
    check_output(out, force)
    out.parent.mkdir(parents=True, exist_ok=True)
    # A folder next to `out`, so the last step is a rename. The bag in it has its final name, because
    # rosbags names the data file after it.
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        with Writer(
            scratch / out.name, version=Writer.VERSION_LATEST, storage_plugin=PLUGINS[storage]
        ) as writer:
            yield writer
        if out.exists():
            check_output(out, force)
            out.rename(scratch / "replaced")
        (scratch / out.name).rename(out)
    finally:
        shutil.rmtree(scratch)


def check_output(out: str | Path, force: bool = False) -> None:
    """Raise InputError if a new bag cannot be written to `out`.

    force : whether an existing bag may be replaced; other files never are
    """
    out = Path(out)
    if not out.name:
        raise InputError(f"{out}: is no name for a bag; give the path of a new directory.")
    refuse_output(out)
    if not out.exists():
        return
    if not force:
        raise InputError(f"{out}: exists already; choose another name, or --force to replace it.")
    if not (out / METADATA).is_file():
        raise InputError(
            f"{out}: exists and is not a bag, so --force does not replace it; choose another name."
        )


@contextmanager
def open_bag(path: str | Path) -> Iterator[BagReader]:
    """Yield the BagReader of a bag directory or of one .mcap or .db3 file.

    Raises InputError if the path is no bag, or holds no message that can be read.
    """
    path = Path(path)
    if not is_bag(path):
        raise InputError(
            f"{path}: is not a bag; give the directory with metadata.yaml or its .mcap or "
            ".db3 file."
        )
    with temporary_folder() as folder:
        yield BagReader(path, folder)


def readable(
    reader: Incomplete,
    connections: list[Connection],
    decoders: Mapping[int, Decoder] | None = None,
) -> Iterator[tuple[Connection, int, Any]]:
    """Yield (connection, stamp ns, message) of the given connections.

    Messages that cannot be decoded, e.g. of a faulty publisher, are counted in the reader.

    decoders : {id of a connection: function of (data, type)}; default: by the installed types
    """
    for connection, stamp, data in reader.messages(connections) if connections else ():
        decode = decoders[connection.id] if decoders else typestore().deserialize_cdr
        try:
            if len(data) > READ_BYTES:
                raise ValueError
            message = decode(data, connection.msgtype)
        except Exception:  # rosbags raises whatever its parsers run into
            reader.unreadable[connection.topic] += 1
            continue
        yield connection, stamp, message


def connections_of(
    path: str | Path, reader: BagReader, topic: str, msgtype: str | None = None
) -> list[Connection]:
    """Return the connections of a topic; raise InputError for another or unknown type."""
    found = [connection for connection in reader.connections if connection.topic == topic]
    for connection in found:
        if msgtype is not None and connection.msgtype != msgtype:
            raise InputError(
                f"{path}: {connection.topic} is {connection.msgtype}; {msgtype} is needed there."
            )
        check_type(path, connection)
    return found


def remarks_of(reader: Incomplete) -> list[str]:
    """Return sentences on all missing parts found so far."""
    return [
        *reader.remarks,
        *(
            f"{topic}: {count} messages left out, they cannot be read."
            for topic, count in reader.unreadable.items()
        ),
    ]
