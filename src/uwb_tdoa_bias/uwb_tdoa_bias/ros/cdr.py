# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert serialized messages (CDR) to rows of numbers and back, by the definition of the type.

A message object takes tens of microseconds to make and to read, mostly for fields without use
here. In this module a field is a place in the bytes. All fields behind the strings of a message
have the places that the definition gives. Strings (frame ids) rarely change. The layout follows
OMG Data Distribution Service Interoperability (DDSI-RTPS): CDR with 4 bytes of encapsulation, and
every number aligned to its size. A message in another encapsulation is read as an object.

A topic may carry anything: another version of the type, another encoding, noise. Therefore
lengths, texts and element counts are checked before memory is allocated. A message that fails is
Unreadable, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, reduce
from importlib import import_module
import struct
from typing import Any, TypeVar

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_parser.definition import AbstractString, Array, BasicType, NamespacedType

Message = TypeVar("Message")
Leaves = list[tuple[str, str, int]]  # names, codes and counts, see `_leaves`
STAMP, FRAME = ("sec", "nanosec"), "header.frame_id"
CHILD = "child_frame_id"  # of nav_msgs/Odometry: the frame of its twist
ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little endian
# Plain CDR in big and little endian. The fourth byte holds options.
KNOWN_ENCAPSULATIONS = (b"\x00\x00\x00", b"\x00\x01\x00")
LONGEST_TEXT = 4096  # bytes of a frame_id, or of another text
MOST_ELEMENTS = 10_000  # in a list message: anchors, transforms
LARGEST_ELEMENT = 512  # bytes, on average
ANOTHER = "another version of the type"
LENGTH = struct.Struct("<I")
DOUBLES = "sequence<double>"
PADDING = 3  # bytes; some middlewares pad the end
TEXT = "text"
CODES = {
    "double": "f8",
    "float": "f4",
    "boolean": "?",
    "octet": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
}


def message_class(kind: str) -> Any:
    """Return the class of a message type like "pkg/msg/Name"."""
    package, _, name = kind.partition("/msg/")
    return getattr(import_module(f"{package}.msg"), name)


class Unreadable(ValueError):
    """A message that cannot be read; the text gives the reason."""


class CdrCodec:
    """Reads and writes some fields of messages of one type that begins with a std_msgs/Header.

    dtype : of the rows: "sec" and "nanosec" of the stamp, then the fields under their names in the
        message, e.g. "pose.pose.position": (3,) of float, "pose.covariance": (36,)
    """

    def __init__(self, kind: type, *fields: str, of_twist: bool = False) -> None:
        """Prepare the fields.

        Parameters
        ----------
        kind : class of the messages
        fields : names of fields that are numbers, or contain only numbers of one type
        of_twist : read the frame of a twist: CHILD, if the type has it
        """
        self.kind = kind
        paths = {name: f"header.stamp.{name}" for name in STAMP} | {
            field: field for field in fields
        }
        self._leaves, self._whole = _leaves(kind)
        has_child = any(leaf == CHILD for leaf, *_ in self._leaves)
        self._frame = CHILD if of_twist and has_child else FRAME
        self._paths = {
            name: [leaf for leaf, *_ in self._leaves if f"{leaf}.".startswith(f"{path}.")]
            for name, path in paths.items()
        }
        spaces = {leaf: (code, count) for leaf, code, count in self._leaves}
        columns = []
        for name, leaves in self._paths.items():
            if not leaves:
                raise ValueError(f"{kind.__name__} has no field {paths[name]}; check its spelling.")
            code, count = spaces[leaves[0]][0], sum(spaces[leaf][1] for leaf in leaves)
            columns.append((name, code, count) if count > 1 else (name, code))
        self.dtype = np.dtype(columns)
        self._known: _Layout | None = None  # layout of the latest messages

    def read(
        self, messages: Sequence[bytes], refuse: Callable[[Unreadable], None] | None = None
    ) -> list[tuple[str, np.ndarray, slice]]:
        """Return the content of serialized messages as a list of (frame_id, rows, slice).

        Each entry holds successive messages of one frame; slice : their places in `messages`. Unreadable
        messages are left out and given to refuse(Unreadable); without `refuse` they are raised.
        """
        out, first = [], 0
        while first < len(messages):
            end = first + 1
            try:
                data = messages[first]
                # Only the middleware reads another byte order, or options.
                if data[:4] != ENCAPSULATION and data[:3] in KNOWN_ENCAPSULATIONS:
                    frame, rows = self._convert(data)
                else:
                    layout = self._layout(data)
                    while end < len(messages) and layout.holds(messages[end]):
                        end += 1
                    frame, rows = (
                        layout.frame,
                        np.frombuffer(b"".join(messages[first:end]), layout.dtype),
                    )
                out.append((frame, rows, slice(first, end)))
            except Unreadable as error:
                if refuse is None:
                    raise
                refuse(error)
            first = end
        return out

    def template(self, message: Any) -> CdrTemplate:
        """Return a CdrTemplate of messages that equal this one except for the fields."""
        return CdrTemplate(self, message)

    def layout(self, data: bytes) -> _Layout:
        """Return the places of the fields in a serialized message; raise Unreadable.

        They hold for all messages with the same texts.
        """
        if data[:4] != ENCAPSULATION:
            raise Unreadable("it is not plain CDR in little endian")
        places, texts, end = {}, [], len(ENCAPSULATION)
        for leaf, code, place, end in _walk(data, self._leaves):
            places[leaf] = place
            if code == TEXT:
                texts.append((place, end, data[place:end]))
        frame, _ = read_text(data, places[self._frame], self._frame)
        check_length(data, end, self.kind, exactly=self._whole)
        formats = [self.dtype[name] for name in self._paths]
        offsets = [places[leaves[0]] for leaves in self._paths.values()]
        dtype = np.dtype(
            {
                "names": list(self._paths),
                "formats": formats,
                "offsets": offsets,
                "itemsize": len(data),
            }
        )
        return _Layout(frame, dtype, texts)

    def _layout(self, data: bytes) -> _Layout:
        if self._known is None or not self._known.holds(data):
            self._known = self.layout(data)
        return self._known

    def _convert(self, data: bytes) -> tuple[str, np.ndarray]:
        """Return (frame_id, rows (1,)) of one message, read through a message object."""
        message: Any = decode(data, self.kind)
        row = np.empty(1, self.dtype)
        for name, leaves in self._paths.items():
            row[name] = np.concatenate([np.atleast_1d(_get(message, leaf)) for leaf in leaves])
        frame = _get(message, self._frame)
        if "\ufffd" in frame:  # the type support's replacement of bytes that are not UTF-8
            raise Unreadable(f"{self._frame} is no UTF-8")
        return frame, row


class CdrTemplate:
    """Messages that differ only in the fields of a CdrCodec."""

    def __init__(self, codec: CdrCodec, message: Any) -> None:
        self._data = serialize_message(message)
        self._dtype = codec.layout(self._data).dtype

    def rows(self, n: int) -> np.ndarray:
        """Return (n,) rows, to be filled in."""
        return np.frombuffer(
            bytearray(self._data * n), self._dtype
        )  # do not copy the rows: a copy loses the bytes between fields

    def messages(self, rows: np.ndarray) -> Iterator[bytes]:
        """Yield the input of a publisher for each of the rows that `rows` returned."""
        data, size = rows.tobytes(), self._dtype.itemsize
        for k in range(len(rows)):
            yield data[k * size : (k + 1) * size]


class _Layout:
    """Places of the fields in a message.

    frame : frame_id; dtype : of a whole message
    """

    def __init__(self, frame: str, dtype: np.dtype, texts: list[tuple[int, int, bytes]]) -> None:
        self.frame, self.dtype = frame, dtype
        self._size = dtype.itemsize
        # (begin, end, bytes) of each string. In most types the strings are adjacent.
        self._texts = texts

    def holds(self, data: bytes) -> bool:
        """Return whether a message has this layout and this frame."""
        if len(data) != self._size or data[:4] != ENCAPSULATION:
            return False
        for begin, end, text in self._texts:
            if data[begin:end] != text:
                return False
        return True


def decode(data: bytes, kind: type[Message]) -> Message:
    """Return the decoded message of any type, by the middleware; raise Unreadable."""
    if data[:3] not in KNOWN_ENCAPSULATIONS:
        raise Unreadable("it is not plain CDR" if len(data) >= 4 else f"it has {len(data)} bytes")
    _check_size(data, kind)
    try:
        message = deserialize_message(data, kind)
        length = len(serialize_message(message))
    except (implementation.RMWError, UnicodeError, ValueError) as error:
        raise Unreadable(f"{len(data)} bytes cannot be read as {name_of(kind)}") from error
    # With lists of doubles the middleware may serialize to more bytes than it sends. It reads no list
    # that is cut off.
    if _has_doubles(kind):
        length = min(length, len(data))
    check_length(data, length, kind)
    return message


def _has_doubles(kind: Any) -> bool:
    return DOUBLES in kind.get_fields_and_field_types().values()


def read_text(data: bytes, place: int, what: str) -> tuple[str, int]:
    """Return (text, place behind it) of plain little-endian CDR; raise Unreadable.

    Parameters
    ----------
    place : of the length of the text
    what : name of the text, for messages
    """
    if place + 4 > len(data):
        raise Unreadable(f"it ends after {len(data)} bytes, before {what}")
    (length,), begin = LENGTH.unpack_from(data, place), place + 4
    end = begin + length
    if length > LONGEST_TEXT or end > len(data):
        raise Unreadable(f"{what} would be {length} bytes long, in a message of {len(data)}")
    content = data[begin : end - 1] if length else b""
    if length and (data[end - 1] or b"\0" in content):
        raise Unreadable(f"{what} does not end where it says")
    try:
        return content.decode(), end
    except UnicodeDecodeError as error:
        raise Unreadable(f"{what} is no UTF-8") from error


def check_length(data: bytes, length: int, kind: type, exactly: bool = True) -> None:
    """Raise Unreadable for a message shorter than `length` bytes, or, with `exactly`, longer."""
    if length > len(data):
        raise Unreadable(
            f"{len(data)} bytes are {length - len(data)} too few for {name_of(kind)}: cut "
            f"off, or of {ANOTHER}"
        )
    if exactly and length < len(data) - PADDING:
        raise Unreadable(
            f"{len(data)} bytes are {len(data) - length} too many for {name_of(kind)}: of {ANOTHER}"
        )


def _check_size(data: bytes, kind: type) -> None:
    """Raise Unreadable before too much memory is allocated.

    This concerns long messages, and lists that claim more elements than they have.
    """
    leaves, whole = _leaves(kind)
    texts = sum(code == TEXT for _, code, _ in leaves)
    fixed = sum(np.dtype(code).itemsize * count + 8 for _, code, count in leaves if code != TEXT)
    element = 0 if whole else LARGEST_ELEMENT
    if len(data) > 4 + fixed + texts * (LONGEST_TEXT + 8) + MOST_ELEMENTS * element:
        limit = f"up to {MOST_ELEMENTS} elements" if element else f"any {name_of(kind)}"
        raise Unreadable(f"{len(data)} bytes are too many for {limit}")
    if whole or data[:4] != ENCAPSULATION:
        return
    end = len(ENCAPSULATION)
    for *_, end in _walk(data, leaves):
        pass
    place = aligned(end, 4)
    if place + 4 > len(data):
        raise Unreadable(f"it ends after {len(data)} bytes, before its list")
    (count,) = LENGTH.unpack_from(data, place)
    if count > MOST_ELEMENTS:
        raise Unreadable(f"its list would have {count} elements; at most {MOST_ELEMENTS} are read")
    if count > len(data) - place:
        raise Unreadable(f"its list would have {count} elements, in {len(data)} bytes")


def name_of(kind: type) -> str:
    """Return the name of a message class, like sensor_msgs/Imu."""
    return f"{kind.__module__.partition('.')[0]}/{kind.__name__}"


def _walk(data: bytes, leaves: Leaves) -> Iterator[tuple[str, str, int, int]]:
    """Yield (name, code, place, place behind it) of leaves in plain little-endian CDR.

    Raises Unreadable for a text that is none.
    """
    end = len(ENCAPSULATION)
    for leaf, code, count in leaves:
        if code == TEXT:
            place = aligned(end, 4)
            _, end = read_text(data, place, leaf)
        else:
            size = np.dtype(code).itemsize
            place = aligned(end, size)
            end = place + size * count
        yield leaf, code, place, end


@cache
def _leaves(kind: Any) -> tuple[Leaves, bool]:
    """Return the leaves of a message class up to the first field without fixed size.

    Returns ([(name of a number, an array of numbers or a string; code out of CODES, or TEXT; count)],
    whether these are all fields).
    """
    out: Leaves = []
    for name, slot in zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES):
        count, slot = (slot.size, slot.value_type) if isinstance(slot, Array) else (1, slot)
        if isinstance(slot, BasicType) and slot.typename in CODES:
            out.append((name, CODES[slot.typename], count))
        elif isinstance(slot, AbstractString) and count == 1:
            out.append((name, TEXT, 1))
        elif isinstance(slot, NamespacedType) and count == 1:
            inner, whole = _leaves(getattr(import_module(".".join(slot.namespaces)), slot.name))
            out += [(f"{name}.{leaf}", code, several) for leaf, code, several in inner]
            if not whole:
                return out, False
        else:
            return out, False
    return out, True


def aligned(place: int, size: int) -> int:
    """Return the next place aligned to `size`, counted from the end of the encapsulation."""
    return place + (4 - place) % size


def _get(message: Any, path: str) -> Any:
    return reduce(getattr, path.split("."), message)
