"""What an ONNX file says, of which only what a model of dense layers needs is read: no graph within a graph, no function, no numbers
that are in other files. Sizes are bounded by `limits`.

Protocol buffers as of onnx.proto (https://github.com/onnx/onnx, version 1.14); the wire format is that of
https://protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
import struct
from typing import Any, TYPE_CHECKING, TypeVar

import numpy as np

from ..foundation.errors import InputError
from ..foundation.files import read_bytes
from ..foundation.limits import MODEL_BYTES, MODEL_NODES

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

VARINT, BYTES, FOUR_BYTES = 0, 2, 5  # wire types; in those of eight bytes nothing is that is read here
Shape = list[int | None]  # of a value; None for what is not fixed
Value = TypeVar("Value")
KINDS = {1: np.float32, 7: np.int64}  # of tensors, by TensorProto.DataType


class Unreadable(ValueError):
    """The file is none, or holds what is not read here."""


def _refuse_if(wrong: object, why: str) -> None:
    if wrong:
        raise Unreadable(why)


@dataclass(frozen=True)
class Node:
    """kind : name of the operator; inputs, outputs : names of values; attributes : {name: number, (n,) ints, bytes or array}."""

    kind: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, Any]


@dataclass(frozen=True)
class Graph:
    """nodes : in the order of their execution; constants : {name: array}; inputs : [(name, shape, with None for what is not
    fixed)]; outputs : names; shapes : [(name, shape)] of what the file says of other values; meta : {key: text}; content : the bytes
    of the file."""

    nodes: list[Node]
    constants: dict[str, np.ndarray]
    inputs: list[tuple[str, Shape]]
    outputs: list[str]
    shapes: list[tuple[str, Shape]]
    meta: dict[str, str]
    content: bytes


def read_graph(path: str | Path) -> Graph:
    """The Graph of a file; raises Unreadable, and InputError for a file that is none or too large."""
    try:
        content = read_bytes(path, MODEL_BYTES)
        model = _message(content, 8, 14, 20, 25, 26)
        graph = _message(model[7][0], 1, 5, 11, 12, 13, 14, 15, 16)
        for part, where in (("nodes", graph[1]), ("constants", graph[5]), ("entries of metadata", model[14])):
            _refuse_if(len(where) > MODEL_NODES, f"more than {MODEL_NODES} {part}")
        _refuse_if(model[25] or graph[15], "functions or sparse constants")
        constants = _unique(map(_tensor, graph[5]))
        inputs, outputs, others = ([_value(data) for data in graph[k]] for k in (11, 12, 13))
        said = [(name, shape) for name, kind, shape in (*outputs, *others) if name not in constants and _is_float(kind, name)]
        entries = [_message(data) for data in model[14]]
        return Graph(
            nodes=[_node(data) for data in graph[1]],
            constants=constants,
            inputs=[(name, shape or []) for name, kind, shape in inputs if name not in constants and _is_float(kind, name)],
            outputs=[name for name, *_ in outputs],
            shapes=[(name, shape) for name, shape in said if shape is not None],
            meta={entry[1][0].decode(): entry[2][0].decode() for entry in entries},
            content=content,
        )
    except (InputError, Unreadable):
        raise
    except (IndexError, KeyError, TypeError, AttributeError, ValueError, OverflowError, struct.error) as error:
        raise Unreadable(f"no ONNX model, {error!r}") from error


def _message(data: bytes, *repeated: int) -> dict[int, list[Any]]:
    """{number of a field: its values in their order}: ints, bytes, or float32 as float. Only fields that are `repeated` come twice: of
    others, one reader takes the first, one the last, and one both."""
    out: dict[int, list[Any]] = defaultdict(list)
    value: int | bytes | float
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        _refuse_if(not 0 < key < 1 << 32, "no protocol buffer")
        if key & 7 == VARINT:
            value, place = _varint(data, place)
        else:
            size = {BYTES: None, FOUR_BYTES: 4}.get(key & 7, -1)
            if size is None:
                size, place = _varint(data, place)
            _refuse_if(not 0 <= size <= len(data) - place, "no protocol buffer")
            value, place = data[place : place + size], place + size
            if key & 7 == FOUR_BYTES:
                (value,) = struct.unpack("<f", value)
        out[key >> 3].append(value)
    _refuse_if(any(len(values) > 1 and field not in repeated for field, values in out.items()), "a field twice")
    return out


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if shift > 70:
            raise Unreadable("a number of more than 64 bits")
        if byte < 0x80:
            return (value - (1 << 64) if value >> 63 else value), place


def _ints(values: list[int | bytes]) -> list[int]:
    """Of a repeated int64, packed or not."""
    out = []
    for value in values:
        if isinstance(value, int):
            out.append(value)
            continue
        place = 0
        while place < len(value):
            one, place = _varint(value, place)
            out.append(one)
    return out


def _floats(values: list[float | bytes]) -> np.ndarray:
    """Of a repeated float, packed or not: (n,) float32."""
    return np.concatenate([np.array([v], "f4") if isinstance(v, float) else np.frombuffer(v, "<f4") for v in values])


def _unique(pairs: Iterable[tuple[str, Value]]) -> dict[str, Value]:
    """{name: value}: a name that comes twice is refused."""
    pairs = list(pairs)
    _refuse_if(len(out := dict(pairs)) < len(pairs), "a name twice")
    return out


def _tensor(data: bytes) -> tuple[str, np.ndarray]:
    """(name, array) of a TensorProto. Its numbers are in one of the fields that its type may have."""
    fields = _message(data, 1, 4, 5, 6, 7, 10, 11, 13, 16)
    kind = KINDS[fields[2][0]]
    own = 4 if kind is np.float32 else 7
    there = [number for number in (4, 5, 6, 7, 9, 10, 11) if fields[number]]
    _refuse_if(fields[13] or fields[14] or there not in ([own], [9]), "a tensor whose numbers are elsewhere")
    if fields[9]:
        values = np.frombuffer(fields[9][0], np.dtype(kind).newbyteorder("<"))
    else:
        values = _floats(fields[4]) if own == 4 else np.array(_ints(fields[7]))
    name = fields[8][0].decode() if fields[8] else ""
    return name, values.astype(kind).reshape(_ints(fields[1]))


def _node(data: bytes) -> Node:
    fields = _message(data, 1, 2, 5, 9)
    _refuse_if(fields[7] and fields[7][0] not in (b"", b"ai.onnx"), "an operator that is none of ONNX")
    inputs, outputs = ([name.decode() for name in fields[k]] for k in (1, 2))
    return Node(fields[4][0].decode(), inputs, outputs, _unique(map(_attribute, fields[5])))


def _attribute(data: bytes) -> tuple[str, float | list[int] | bytes | np.ndarray]:
    fields = _message(data, 7, 8, 9, 10, 11, 15, 23)
    _refuse_if(any(fields[k] for k in (6, 10, 11, 22, 23)), "a graph within a graph, or a constant of another kind")
    value: float | list[int] | bytes | np.ndarray
    if fields[5]:
        value = _tensor(fields[5][0])[1]
    elif fields[2]:
        value = float(fields[2][0])
    elif fields[3]:
        value = fields[3][0]
    else:
        value = _ints(fields[8]) if fields[8] else b"".join(fields[4])
    return fields[1][0].decode(), value


def _value(data: bytes) -> tuple[str, list[int], Shape | None]:
    """(name, type of its numbers, shape or None) of a ValueInfoProto of a tensor."""
    fields = _message(data, 4)
    if not fields[2]:
        return fields[1][0].decode(), [1], None
    tensor = _message(_message(fields[2][0])[1][0])
    if not tensor[2]:
        return fields[1][0].decode(), tensor[1], None
    dimensions = [_message(one) for one in _message(tensor[2][0], 1)[1]]
    return fields[1][0].decode(), tensor[1], [one[1][0] if one[1] else None for one in dimensions]


def _is_float(kind: list[int], name: str) -> bool:
    _refuse_if(kind != [1], f"{name[:40]!r} is no float32")
    return True
