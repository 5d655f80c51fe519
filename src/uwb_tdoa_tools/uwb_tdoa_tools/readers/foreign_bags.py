# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read topics of any message type, from bags of ROS 1 and ROS 2.

The fields of a message are named by paths such as "header.stamp", "ranges.id" or "imu_gyro_3d[0]".
"""

from __future__ import annotations

import bz2
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
import re
from typing import Any

import lz4.frame
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import Compression, decompressors
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwb_tdoa_bias.common.errors import (
    CHUNK_BYTES,
    DEFINITION_BYTES,
    InputError,
    TooMuch,
    most_unpacked,
)

from ..bags import is_ros_1
from ..bags.bag import Recorded, recorded_anchors
from ..bags.files import BagReader, Damaged, Incomplete, open_bag, readable, remarks_of
from .tables import BLOCK, Block, Foreign, Wanted

Path_ = tuple[str | int, ...]  # parsed path of a field

# Paths of no field: the time of recording, the place in the array, and the stamp of the header or of the field
# `stamp`. Where that is zero or missing, the time of recording counts.
RECEIVED, INDEX, STAMP = "received", "index", "stamp"
ENTRIES = 8  # of an array in each message of a sample
SHORT = 4  # numbers of an array that are fields of their own
LONGEST_GAP, SHORTEST_OVERLAP = 60.0, 1.0  # s between the parts of a recording
KEPT_BYTES = 64 << 20  # of unpacked chunks of ROS 1
_LIMITED: dict[str, Callable[[bytes, int], bytes]] = {  # of ROS 1: unpack at most so many bytes
    Compression.BZ2.value: lambda data, most: bz2.BZ2Decompressor().decompress(data, most),
    Compression.LZ4.value: lambda data, most: lz4.frame.LZ4FrameDecompressor().decompress(
        data, most
    ),
}
_STEP = re.compile(r"([A-Za-z]\w*)((?:\[\d+\])*)")
_BETWEEN_TYPES = "=" * 80 + "\n"  # line between the types of a definition in IDL


class ForeignBag(Foreign):
    """Topics of open bags that together are one recording: {topic: type of its messages}."""

    time = STAMP, 1.0

    def __init__(self, readers: Mapping[Path, Reader], definitions: Mapping[str, str]) -> None:
        """Keep open bags; see `open_foreign`. Raises InputError."""
        super().__init__()
        self._readers, self._definitions = readers, definitions
        self._stores: dict[tuple[Path, str], Typestore] = {}
        for reader in readers.values():
            for connection in reader.connections:
                self.types[connection.topic] = connection.msgtype
                self.counts[connection.topic] += connection.msgcount
        _check_parts(readers)

    def fields(self, topic: str) -> list[str]:
        """Return the names of the fields of a topic; empty if its type is unknown."""
        for path, reader in self._readers.items():
            for connection in reader.connections:
                if connection.topic == topic:
                    with suppress(InputError):
                        store = self._store(path, connection)
                        return [name for name, _ in store.fielddefs[connection.msgtype][1]]
        return []

    def recorded_anchors(self) -> Recorded | None:
        """Return the anchors in frames or markers of a bag of ROS 2, or None. Raises InputError."""
        found = (
            recorded_anchors(path, reader, "/uwb/anchors")
            for path, reader in self._readers.items()
            if isinstance(reader, BagReader)
        )
        return next(filter(None, found), None)

    def blocks(self, wanted: Sequence[Wanted]) -> Iterator[Block]:
        """Yield the records of topics. Raises InputError."""
        filled = [_empty_block(number, one) for number, one in enumerate(wanted)]
        for topic, place, message in self._messages({one.table for one in wanted}):
            for number, one in enumerate(wanted):
                if one.table != topic:
                    continue
                block = filled[number]
                try:
                    for index in message.rows(one.each):
                        block.places.append(place)
                        for path, values in block.columns.items():
                            values.append(message.value(path, index))
                except KeyError as error:
                    raise self.lacks(topic, error.args[0]) from error
                if len(block.places) >= BLOCK:
                    yield block
                    filled[number] = _empty_block(number, one)
        yield from filled

    def sample(self, table: str, most: int) -> dict[tuple[str, str], list[Any]]:
        """Return {(path, array that it lies in, or ""): values} of the first messages of a topic."""
        messages = [message for _, _, message in islice(self._messages({table}), most)]
        # an array may be empty in the first
        found: dict[tuple[str, str], list[Any]] = {
            key: [] for message in messages for key in _paths(message.content, "", "")
        }
        for message in messages:
            for (path, each), values in found.items():
                with suppress(KeyError):
                    values += [message.value(path, row) for row in message.rows(each)[:ENTRIES]]
        return found

    def _messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Message]]:
        """Yield (topic, its number, Message) of topics. Raises InputError."""
        numbers: Counter[str] = Counter()
        for path, reader in self._readers.items():
            wanted = [each for each in reader.connections if each.topic in topics]
            decode = "deserialize_cdr" if isinstance(reader, BagReader) else "deserialize_ros1"
            decoders = {each.id: getattr(self._store(path, each), decode) for each in wanted}
            for connection, received, content in readable(reader, wanted, decoders):
                topic, message = connection.topic, Message(content, received)
                numbers[topic] += 1
                self.unstamped[topic] += not message.is_stamped
                yield topic, numbers[topic], message
            self.remarks += [each for each in remarks_of(reader) if each not in self.remarks]

    def _store(self, path: Path, connection: Connection) -> Typestore:
        """Return the types of a topic: as in the bag, else of ROS or of the profile."""
        kind, text = connection.msgtype, connection.msgdef.data
        if (path, kind) in self._stores:
            return self._stores[path, kind]
        if len(text) > DEFINITION_BYTES:
            raise InputError(
                f"{path}: the definition of {kind} has more than {DEFINITION_BYTES} bytes; "
                "record it again."
            )
        try:
            if text:
                store = get_typestore(Stores.EMPTY)
                store.register(_types(connection))
            else:
                store = get_typestore(Stores.ROS2_JAZZY)
                undefined = [name for name in self._definitions if name not in store.fielddefs]
                for name in undefined:
                    store.register(get_types_from_msg(self._definitions[name], name))
            store.get_msgdef(kind)
        except Exception as error:  # parsers of rosbags raise many types
            raise InputError(
                f"{path}: {connection.topic} has the type {kind}, whose definition is not in "
                f"the bag; write it into the profile, under types ({error!r})."
            ) from error
        self._stores[path, kind] = store
        return store


def _check_parts(readers: Mapping[Path, Reader]) -> None:
    """Raise InputError unless bags that share a topic follow each other in time."""
    ends: dict[str, tuple[int, Path]] = {}  # of topics: last time so far, and its bag
    for path, reader in sorted(readers.items(), key=lambda one: one[1].start_time):
        topics = {connection.topic for connection in reader.connections}
        before = [ends[topic] for topic in topics & ends.keys()]
        end, last = max(before, default=(reader.start_time, path))
        gap = (reader.start_time - end) / 1e9
        if not -SHORTEST_OVERLAP < gap < LONGEST_GAP:
            what = f"{gap:.0f} s apart" if gap > 0.0 else f"over {-gap:.1f} s at the same time"
            raise InputError(
                f"{path}: and {last} hold the same topics {what}: they are several recordings; "
                "give one."
            )
        mine = reader.end_time, path
        ends |= {topic: max(mine, ends.get(topic, mine)) for topic in topics}


class Message:
    """A message, with the time when it was recorded.

    Attributes
    ----------
    content : the message, as rosbags gives it.
    is_stamped : whether the message has a stamp.
    """

    def __init__(self, content: Any, received: int) -> None:
        self.content = content
        stamp: Any = getattr(getattr(content, "header", content), "stamp", None)
        in_header = stamp.sec * 10**9 + stamp.nanosec if hasattr(stamp, "nanosec") else 0
        self.is_stamped = in_header != 0
        self._times = {RECEIVED: received / 1e9, STAMP: (in_header or received) / 1e9}

    def rows(self, each: str) -> Sequence[int | None]:
        """Return the places in the array at a path; [None] for the message itself. Raises KeyError."""
        if not each:
            return [None]
        value = self._value(parsed(each), None)
        if not _is_array(value):
            raise KeyError(each)
        return range(len(value))

    def value(self, path: str, index: int | None = None) -> Any:
        """Return the number, text or stamp (in s) at a path; raise KeyError if there is none.

        index : place in each array that the path does not index itself; "" beyond the end.
        """
        if path in self._times:
            return self._times[path]
        if path == INDEX:
            return index
        value = self._value(parsed(path), index)
        if hasattr(value, "nanosec"):
            return (value.sec * 10**9 + value.nanosec) / 1e9
        if _is_array(value) or hasattr(value, "__msgtype__"):
            raise KeyError(path)
        return value

    def _value(self, steps: Path_, index: int | None) -> Any:
        value = self.content
        for step in steps:
            try:
                if isinstance(step, int):
                    value = value[step]
                else:
                    value = getattr(_entry(value, index), step)
            except (AttributeError, IndexError, TypeError):
                raise KeyError(".".join(map(str, steps))) from None
        return _entry(value, index)


def _empty_block(number: int, one: Wanted) -> Block:
    return Block(number, [], {path: [] for path in one.paths})


def _paths(value: Any, path: str, each: str) -> Iterator[tuple[str, str]]:
    """Yield (path of a number, text or stamp, the array that it lies in, or "") below a path.

    Arrays are looked at by their first entry.
    """
    if hasattr(value, "__msgtype__"):
        for name in value.__dataclass_fields__:
            if not name.startswith("__"):
                yield from _paths(getattr(value, name), f"{path}.{name}".lstrip("."), each)
    elif _is_array(value) and not each:
        if len(value) and hasattr(value[0], "__msgtype__"):
            yield from _paths(value[0], path, path)
            return
        yield path, path
        for number in range(min(len(value), SHORT)):
            yield f"{path}[{number}]", ""
    elif not _is_array(value):
        yield path, each


@lru_cache(maxsize=1024)
def parsed(path: str) -> Path_:
    """Return the steps of a path. Raises InputError."""
    steps: list[str | int] = []
    for part in path.split("."):
        match = _STEP.fullmatch(part)
        if not match:
            raise InputError(
                f"{path!r} is no field of a message; write fields as header.stamp or ranges.id, "
                "and numbers of an array as gyro[0]."
            )
        steps += [match[1], *(int(number) for number in re.findall(r"\d+", match[2]))]
    return tuple(steps)


def _is_array(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, (str, bytes))


def _entry(value: Any, index: int | None) -> Any:
    """Return the entry of an array, or the value itself if it is none."""
    if index is None or not _is_array(value):
        return value
    return value[index] if index < len(value) else ""


@contextmanager
def open_foreign(paths: Sequence[Path], definitions: Mapping[str, str]) -> Iterator[ForeignBag]:
    """Yield the ForeignBag of bags that are one recording.

    Parameters
    ----------
    definitions : {type: text of its .msg file}, for bags that have no definitions.

    Raises InputError.
    """
    readers: dict[Path, Reader] = {}
    with ExitStack() as stack:
        for path in paths:
            opened: AbstractContextManager[Reader] = (
                closing(Ros1Bag(path)) if is_ros_1(path) else open_bag(path)
            )
            readers[path] = stack.enter_context(opened)
        yield ForeignBag(readers, definitions)


def _types(connection: Connection) -> Any:
    """Return the types in the definition of a topic, in .msg or IDL syntax, for `Typestore.register`."""
    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, connection.msgtype)
    types: dict[str, Any] = {}
    for part in text.split(_BETWEEN_TYPES):
        # A line "IDL: NAME_OF_THE_TYPE" precedes each type.
        idl = part.partition("\n")[2] if part.startswith("IDL: ") else part
        if idl.strip():
            types |= get_types_from_idl(idl)
    return types


class Ros1Bag(Ros1Reader, Incomplete):
    """A bag of ROS 1 with the attributes of a BagReader."""

    def __init__(self, path: Path) -> None:
        """Open a bag. Raises InputError."""
        super().__init__(path)
        self._file = path
        self.remarks, self.unreadable = [], Counter()
        try:
            self.open()
            _check_counts(self)
            _limit_and_cache_unpacking(self, path)
        except Exception as error:  # rosbags raises whatever its parsers run into
            raise self._damaged(error) from error

    def messages(
        self,
        connections: Collection[Connection] = (),
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield (connection, stamp ns, bytes) as the parent does. Raises InputError."""
        room = most = most_unpacked(self._file.stat().st_size)
        try:
            for connection, stamp, data in super().messages(connections, start, stop):
                room -= len(data)
                if room < 0:
                    raise TooMuch(
                        f"{self.path}: has more than {most} bytes of messages; give another file, "
                        "or split it."
                    )
                yield connection, stamp, data
        except InputError:
            raise
        except Exception as error:  # as above
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> InputError:
        said = " ".join(str(error).split()) or type(error).__name__
        return InputError(
            f"{self.path}: this bag of ROS 1 is cut or damaged ({said}); copy it again, or repair "
            f"it with rosbag reindex {self._file.name}."
        )


def _check_counts(reader: Ros1Reader) -> None:
    """Raise Damaged unless the index of an open reader has as many messages as its chunks state."""
    stated: Counter[int] = Counter()
    for chunk in reader.chunk_infos:
        stated.update(chunk.connection_counts)
    for connection in reader.connections:
        if stated.pop(connection.id, 0) != connection.msgcount:
            raise Damaged(f"messages are missing on {connection.topic}")
    if stated:
        raise Damaged("messages belong to no topic")


def _limit_and_cache_unpacking(reader: Ros1Reader, path: Path) -> None:
    """Limit the bytes to which the chunks of an open reader unpack, and cache unpacked chunks.

    Each chunk is limited, and the sum of all chunks. TooMuch is raised when a message of the chunk
    is read. rosbags unpacks a chunk for each message if the topics of a bag lie in different
    chunks, so the latest KEPT_BYTES of chunks are cached.
    """
    kept: OrderedDict[int, bytes] = OrderedDict()  # {position of a chunk: its content}
    sizes: dict[int, int] = {}  # of all chunks that were unpacked
    total_limit = most_unpacked(path.stat().st_size)
    # A chunk names its compression only by the function that unpacks it.
    unpack = {id(decompressors[name]): function for name, function in _LIMITED.items()}

    def unpacked(position: int, data: bytes, function: Callable[[bytes, int], bytes]) -> bytes:
        if position in kept:
            kept.move_to_end(position)
            return kept[position]
        remaining = total_limit - sum(sizes.values()) + sizes.get(position, 0)
        most = min(CHUNK_BYTES, remaining)
        content = function(data, most + 1)
        if len(content) > most:
            limit = CHUNK_BYTES if most < remaining else total_limit
            raise TooMuch(
                f"{path}: unpacks to more than {limit} bytes; give another file, or split it."
            )
        kept[position], sizes[position] = content, len(content)
        while sum(map(len, kept.values())) > KEPT_BYTES and len(kept) > 1:
            kept.popitem(last=False)
        return content

    for position, chunk in reader.chunks.items():
        function = unpack.get(id(chunk.decompressor))
        if function:
            of_chunk = partial(unpacked, position, function=function)
            reader.chunks[position] = chunk._replace(decompressor=of_chunk)


Reader = BagReader | Ros1Bag
