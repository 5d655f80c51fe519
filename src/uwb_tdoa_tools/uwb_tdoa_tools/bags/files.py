# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags as files: open them, iterate over their messages, and write new ones atomically."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import math
from pathlib import Path
import re
import shutil
import sys
import tempfile
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import refuse_output, temporary_folder
from uwb_tdoa_bias.common.limits import READ_BYTES, TooMuch, most_unpacked
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK

from ..choices import STORAGES
from ..command_lines import SALVAGE
from . import is_bag, is_ros_1, mcap, write_ahead
from .completion import completed
from .integrity import (
    CHECKSUM_KEY,
    NO_CHECKSUM,
    check as check_whole,
    data_files,
    is_mcap,
    metadata,
    sqlite_messages,
    write_checksums,
)
from .mcap import Damaged, zstd
from .message_types import check_type, typestore
from .salvage import as_written, salvage as write_sound_part

PLUGINS = dict(zip(STORAGES, (StoragePlugin.MCAP, StoragePlugin.SQLITE3)))


class BagReader(Reader):
    """A Reader that records which parts of a bag cannot be read.

    Attributes
    ----------
    remarks : sentences on the missing parts of a damaged bag
    data : its data files
    packed : whether each message is compressed
    falls_back : whether the times of the messages fall back, in the order of writing
    unreadable : {topic: number of messages that do not fit its type}
    most : limit of the bytes of all messages together
    """

    remarks: list[str]
    data: list[Path]
    packed: bool
    falls_back: bool
    unreadable: Counter[str]
    most: int


class Ros1Bag(Ros1Reader):
    """A bag of ROS 1, for `files.messages`."""

    def __init__(self, path: Path) -> None:
        """Limit what all messages together may hold."""
        super().__init__(path)
        self.most = most_unpacked(path.stat().st_size)
        self.remarks, self.unreadable = list[str](), Counter[str]()


@contextmanager
def new_bag(out: str | Path, storage: str = "mcap", force: bool = False) -> Iterator[Writer]:
    """Give a rosbags Writer; the bag appears at `out` only if the block ends without an exception.

    Parameters
    ----------
    storage : "mcap" or "sqlite3"
    force : whether to replace an existing bag. Raises InputError.
    """
    out = Path(out)
    if storage not in STORAGES:
        raise InputError(f"storage: {storage!r} is not known; choose one of {', '.join(STORAGES)}.")
    check_output(out, force)
    out.parent.mkdir(parents=True, exist_ok=True)
    # A folder next to `out`, so the last step is a rename. The bag in it has its final name, because
    # rosbags names the data file after it.
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        with Writer(
            scratch / out.name, version=Writer.VERSION_LATEST, storage_plugin=PLUGINS[storage]
        ) as writer:
            writer.set_custom_data(CHECKSUM_KEY, NO_CHECKSUM)
            yield writer
        write_checksums(scratch / out.name)
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
    if not (out / "metadata.yaml").is_file():
        raise InputError(
            f"{out}: exists and is not a bag, so --force does not replace it; choose another name."
        )


@contextmanager
def open_bag(path: str | Path, salvage: bool = False) -> Iterator[BagReader]:
    """Yield an open BagReader of a bag directory or of one .mcap or .db3 file.

    Raises InputError if the path is no bag, or a damaged one without `salvage`. What must be
    unpacked, completed or repaired is copied to a temporary folder first.

    salvage : read the intact messages of a cut or damaged bag; `remarks` lists what is missing
    """
    path = Path(path)
    if not is_bag(path):
        raise InputError(
            f"{path}: is not a bag; give the directory with metadata.yaml or its .mcap or "
            ".db3 file."
        )
    with temporary_folder() as folder:
        reader = _opened(path, folder, salvage)
        try:
            yield reader
        finally:
            with suppress(Exception):  # errors of rosbags on faulty content
                reader.close()


def _opened(path: Path, folder: Path, salvage: bool) -> BagReader:
    given, remarks = path, list[str]()
    try:
        if files := write_ahead.unclosed(path):
            (folder / "closed").mkdir()
            path, lost = write_ahead.merged_copy(path, folder / "closed")
            if lost and not salvage:
                raise Damaged("; ".join(lost))
            names = " and ".join(file.name for file in files)
            remarks.append(
                f"the recorder did not close {names}: what it left in the -wal or -journal file "
                "beside it is read, too."
            )
            remarks += [f"{sentence}." for sentence in lost]
        try:
            (folder / "completed").mkdir()
            path, more = completed(path, folder / "completed")
            remarks += more
        except (Damaged, InputError):
            if not salvage:
                raise
        readable = path
        if salvage:
            readable = folder / "sound"
            remarks += write_sound_part(path, readable)
        else:
            check_whole(path)
        reader = BagReader(readable)
        with _closing_second_connections(reader):
            reader.open()
        _align_qos_with_metadata(reader)
        information = metadata(readable) if readable.is_dir() else {"compression_mode": ""}
        reader.data = data_files(readable, information) if readable.is_dir() else [readable]
        reader.packed = information["compression_mode"] == "message"
        reader.falls_back = any(_falls_back(file) for file in reader.data)
        reader.remarks, reader.unreadable = remarks, Counter()
        reader.most = most_unpacked(
            sum(file.stat().st_size for file in (path, *path.glob("*")) if file.is_file())
        )
        for connection in reader.connections:
            if not re.fullmatch(r"[/\w]+", connection.topic) or not re.fullmatch(
                r"\w+/\w+/\w+", connection.msgtype
            ):
                raise Damaged(f"topic {connection.topic!r} of type {connection.msgtype!r} is none")
    except InputError:
        raise
    except Exception as error:  # rosbags raises whatever its parsers run into
        raise damaged(given, error) from error
    return reader


@contextmanager
def _closing_second_connections(reader: Reader) -> Iterator[None]:
    """Close the second connection of rosbags to each SQLite file.

    rosbags opens each file twice and closes it once. Otherwise every file would stay open.
    """
    before = {*map(id, _connections())}
    yield
    used = {
        id(getattr(one, "dbconn", None))
        for one in (reader.storage, *getattr(reader.storage, "storages", ()))
    }
    for connection in _connections():
        if id(connection) not in before | used:
            connection.close(True)


def _connections() -> list[Any]:
    """Return all open connections to SQLite files of rosbags."""
    return sys.modules["apsw"].connections() if "apsw" in sys.modules else []


def _align_qos_with_metadata(reader: Reader) -> None:
    """Set the QoS of each topic in the data files of an open Reader to that in metadata.yaml.

    rosbags compares both as text. Where they differ it drops the messages without a word, as with a
    metadata.yaml of another version of the recorder. A single file has no metadata.yaml.
    """
    recorded = {
        (topic.topic, topic.msgtype): topic.ext.offered_qos_profiles  # type: ignore[union-attr]  # always a bag of ROS 2
        for topic in reader.connections
    }
    for file in getattr(reader.storage, "storages", ()):
        for k, topic in enumerate(file.connections):
            qos = recorded.get((topic.topic, topic.msgtype), topic.ext.offered_qos_profiles)
            file.connections[k] = topic._replace(ext=topic.ext._replace(offered_qos_profiles=qos))


def _as_written(
    reader: BagReader, connections: list[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield (connection, stamp ns, bytes) of the given connections in the order of writing."""
    wanted = {(connection.topic, connection.msgtype): connection for connection in connections}
    for file in reader.data:
        for written, stamp, data in as_written(file, Counter()):
            if (connection := wanted.get((written.topic, written.msgtype))) is not None:
                yield connection, stamp, zstd.decompress(data) if reader.packed else data


def _falls_back(file: Path) -> bool:
    """Return whether the times of a data file fall by more than LARGEST_STEP_BACK.

    Then the clock of the recorder, or of the recorded system, was set.
    """
    newest = -math.inf
    if is_mcap(file):
        times: Iterator[int] = (
            int.from_bytes(content[6:14], "little")
            for kind, content in mcap.intact_records(file)
            if kind == mcap.MESSAGE and len(content) >= 14
        )
    else:
        times = (stamp for _, _, stamp, _ in sqlite_messages(file))
    for stamp in times:
        if stamp < newest - 1e9 * LARGEST_STEP_BACK:
            return True
        newest = max(newest, stamp)
    return False


def messages(
    path: str | Path,
    reader: BagReader | Ros1Bag,
    connections: list[Connection],
    written: bool = False,
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield (connection, stamp ns, bytes) of the given connections, of a bag of ROS 1 or ROS 2.

    Raises InputError for another number of messages than the bag states, or for more bytes than
    `reader.most`.

    written : use the order of writing if the times fall back; default: the bag's order
    """
    found: Iterator[tuple[Connection, int, bytes]] = iter(())
    if connections:
        found = (
            _as_written(reader, connections)
            if written and isinstance(reader, BagReader) and reader.falls_back
            else reader.messages(connections=connections)
        )
    left = {(connection.topic, connection.msgtype): 0 for connection in connections}
    for connection in connections:
        left[connection.topic, connection.msgtype] += connection.msgcount
    room = reader.most
    while True:
        try:
            connection, stamp, data = next(found)
        except StopIteration:
            break
        except InputError:
            raise
        except Exception as error:  # as in _opened
            raise damaged(path, error) from error
        left[connection.topic, connection.msgtype] -= 1
        room -= len(data)
        if room < 0:
            raise TooMuch(
                f"{path}: has more than {reader.most} bytes of messages; give another file, "
                "or split it."
            )
        yield connection, stamp, data
    for (topic, _), count in left.items():
        if count:
            what = (
                f"{count} messages are missing" if count > 0 else f"{-count} messages are too many"
            )
            raise damaged(path, f"{what} on {topic}")


def readable(
    path: str | Path, reader: BagReader, connections: list[Connection]
) -> Iterator[tuple[Connection, int, Any]]:
    """Yield (connection, stamp ns, message) of the given connections.

    Messages that cannot be decoded, e.g. of a faulty publisher, are counted too. If the times of the
    bag fall back, the order of writing holds.
    """
    for connection, stamp, data in messages(path, reader, connections, written=True):
        try:
            if len(data) > READ_BYTES:
                raise ValueError
            message = typestore().deserialize_cdr(data, connection.msgtype)
        except Exception:  # as in _opened
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


def remarks_of(reader: BagReader | Ros1Bag) -> list[str]:
    """Return sentences on all missing parts found so far."""
    return [
        *reader.remarks,
        *(
            f"{topic}: {count} messages left out, they cannot be read."
            for topic, count in reader.unreadable.items()
        ),
    ]


def damaged(path: str | Path, error: Exception | str) -> InputError:
    """Return the error of a bag that cannot be read, with the remedy."""
    said = " ".join(str(error).split()) or type(error).__name__
    if is_ros_1(path):
        return InputError(
            f"{path}: this bag of ROS 1 is cut or damaged ({said}); copy it again, or repair it "
            f"with rosbag reindex {Path(path).name}."
        )
    return InputError(
        f"{path}: the bag is cut or damaged ({said}); copy it again, record it again, or {SALVAGE}."
    )
