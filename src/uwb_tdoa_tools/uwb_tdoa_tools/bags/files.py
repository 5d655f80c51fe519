# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags as files: open them, iterate over their messages, and write new ones atomically."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from heapq import heappop, heappush
from pathlib import Path
import shutil
import tempfile
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import refuse_output, temporary_folder
from uwb_tdoa_bias.common.limits import (
    MESSAGE_BYTES,
    READ_BYTES,
    Budget,
    TooMuch,
    most_unpacked,
)
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK

from ..choices import STORAGES
from . import METADATA, ZSTD, data_files, is_bag, repair
from .messages import check_type, typestore
from .repair import Damaged, zstd

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
            if _is_packed(file):
                whole = _unpacked(file, folder, budget, self._most)
            else:
                whole = repair.merged(file, folder, self.remarks)
            self._files[file] = whole
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
                for topic, stamp, _ in repair.rows(whole):
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
                    f"before that are read. This may find more: {repair.remedy(file)}"
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


def _is_packed(file: Path) -> bool:
    with file.open("rb") as opened:
        return opened.read(len(ZSTD)) == ZSTD


def _unpacked(file: Path, folder: Path, budget: Budget, most: int) -> Path:
    """Unpack a file that rosbag2 has packed into a folder, up to where it is cut; return the new file.

    Raises TooMuch if all files of the budget together have more than `most` bytes.
    """
    with zstd.open(file, "rb") as source, open(folder / file.name, "wb") as target:
        with suppress(zstd.ZstdError, EOFError):  # `repair.rows` names the place
            while block := source.read1(1 << 20):
                budget.spend("bytes when its files are unpacked", len(block), most)
                target.write(block)
    return folder / file.name


def _intact(file: Path) -> Iterator[repair.Row]:
    """Yield the messages of a data file up to where it is cut."""
    try:
        yield from repair.rows(file)
    except Damaged:
        return


def _by_stamp(
    found: Iterator[tuple[Connection, int, bytes]],
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield (connection, stamp ns, bytes) by stamp.

    What follows a fall of more than LARGEST_STEP_BACK follows: the clock of the recorder, or of the
    recorded system, was set.
    """
    held: list[tuple[int, int, Connection, bytes]] = []
    largest, newest = round(1e9 * LARGEST_STEP_BACK), 0
    for number, (connection, stamp, data) in enumerate(found):
        newest = max(newest, stamp)
        was_set = stamp < newest - largest
        while held and (was_set or held[0][0] < newest - largest):
            earlier, _, of, content = heappop(held)
            yield of, earlier, content
        newest = stamp if was_set else newest
        heappush(held, (stamp, number, connection, data))
    while held:
        earlier, _, of, content = heappop(held)
        yield of, earlier, content


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
