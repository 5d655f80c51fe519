# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Node, an operation in the graph of a correction.

A node is an array per TDOA: its `shape` has no axis of TDOAs. Printers translate these kinds; all
have the meaning of numpy, NaN included.

input     one column of the input table; `value` is its name, the shape is ()
constant  `value` is (1, *shape), or (N * N, *shape) with one array for each pair of anchors; the
          pair in rows a and b of the anchors has row a * N + b
pick      elements of its inputs: all inputs are flattened and joined, and `value`, an integer
          array of the result's shape, says which element stands where. This is the only structural
          kind: columns, stacks, concatenations and reshapes are all picks.
sum       the sum over the last axis
pieces    a function of its first input; `value` is its Pieces. The second input is the same of
          other nodes, in tensors.
network   the output (outputs,) of an ONNX model for its input (width,); `value` is its Session
Other kinds are elementwise, of inputs that have as many axes as the result and broadcast:
neg abs sqrt exp log sin cos floor, add sub mul div max min atan2, lt le eq (to bool),
not and or (of bool), where (of bool and two numbers).

A node is evaluated once, however many others use it: `ordered` lists the nodes of a graph, equal
ones only once, inputs first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "floor": np.floor,
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "max": np.maximum,
    "min": np.minimum,
    "atan2": np.arctan2,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "not": np.logical_not,
    "and": np.logical_and,
    "or": np.logical_or,
    "where": np.where,
}
COMPARISONS, LOGICAL = ("lt", "le", "eq"), ("not", "and", "or")
NEUTRAL = {"add": 0.0, "mul": 1.0}
EVEN = 1e-5  # share by which the widths of pieces of one width may differ, rounded


class Node:
    """An operation of a graph.

    Attributes
    ----------
    kind, inputs, value : as the module describes
    shape : of its result, without the axis of TDOAs
    is_bool : whether the result is boolean
    """

    __slots__ = ("inputs", "is_bool", "kind", "shape", "value")

    def __init__(
        self,
        kind: str,
        inputs: tuple[Node, ...],
        shape: tuple[int, ...],
        value: Any = None,
        is_bool: bool = False,
    ) -> None:
        """Set all attributes."""
        self.kind, self.inputs, self.shape, self.value = kind, inputs, shape, value
        self.is_bool = is_bool

    @property
    def size(self) -> int:
        """Return the number of elements per TDOA."""
        return int(np.prod(self.shape, dtype=int))


class Pieces(NamedTuple):
    """A function that is 0 up to the first break, polynomial between breaks, then constant.

    Attributes
    ----------
    breaks : k + 1 numbers
    table : k rows of degree + 1; the value at the begin of each piece, then the coefficients of
        the powers of the distance from there
    """

    breaks: tuple[float, ...]
    table: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, breaks: np.ndarray, coefficients: np.ndarray) -> Pieces:
        """Return Pieces of k + 1 breaks and of (degree, k) coefficients of the powers 1, 2 ..."""
        degrees = np.arange(1, len(coefficients) + 1)[:, None]
        gained = np.sum(coefficients * np.diff(breaks) ** degrees, axis=0)
        begin = np.concatenate([[0.0], np.cumsum(gained)[:-1]])
        rows = np.stack([begin, *coefficients], axis=1).astype(np.float32)
        table: list[list[float]] = rows.tolist()
        return cls(tuple(map(float, breaks.astype(np.float32))), tuple(map(tuple, table)))

    @property
    def scale(self) -> np.float32:
        """Return the number of pieces per unit if all are equally wide, else 0."""
        width = np.diff(self.breaks)
        even = np.ptp(width) < EVEN * width.mean()
        return np.float32(1.0 / width.mean() if even else 0.0)


def constant(value: Any) -> Node:
    """Return a constant node of (1 or N * N, *shape) numbers or booleans."""
    value = np.asarray(value)
    is_bool = value.dtype == bool
    value = value if is_bool else value.astype(float)
    if len(value) > 1 and _equal(value, value[:1]):
        value = value[:1]
    return Node("constant", (), value.shape[1:], value, is_bool)


def scalar(value: float) -> Node:
    """Return a constant node of one number for all TDOAs."""
    return constant(np.reshape(value, (1,)))


def apply(kind: str, *inputs: Node) -> Node:
    """Return an elementwise node; of constants a constant."""
    axes = max(len(one.shape) for one in inputs)
    inputs = tuple(_with_axes(one, axes) for one in inputs)
    if kind == "where":
        inputs = inputs[0], *map(as_number, inputs[1:])
    elif kind not in LOGICAL:
        inputs = tuple(map(as_number, inputs))
    shape = np.broadcast_shapes(*(one.shape for one in inputs))
    if all(one.kind == "constant" for one in inputs):
        with np.errstate(all="ignore"):
            return constant(ELEMENTWISE[kind](*(one.value for one in inputs)))
    for one, other in (inputs, inputs[::-1]) if kind in NEUTRAL else ():
        if other.kind == "constant" and one.shape == shape and (other.value == NEUTRAL[kind]).all():
            return one
    return Node(kind, inputs, shape, is_bool=kind in (*COMPARISONS, *LOGICAL))


def as_number(node: Node) -> Node:
    """Return a node with 1 and 0 for a boolean one."""
    return apply("where", node, scalar(1.0), scalar(0.0)) if node.is_bool else node


def pick(inputs: Sequence[Node], index: np.ndarray) -> Node:
    """Return the node of elements of the flattened, joined inputs."""
    if all(one.kind == "constant" for one in inputs):
        rows = max(len(one.value) for one in inputs)
        flat = [np.broadcast_to(one.value, (rows, *one.shape)) for one in inputs]
        joined = np.concatenate([one.reshape(rows, -1) for one in flat], axis=1)
        return constant(joined[:, index])
    sources, index = _sources(inputs, index)
    if len(sources) == 1 and index.shape == sources[0].shape and _counts_up(index):
        return sources[0]
    assert len({one.is_bool for one in sources}) == 1  # no effect mixes them
    return Node("pick", tuple(sources), index.shape, index, sources[0].is_bool)


def _sources(inputs: Sequence[Node], index: np.ndarray) -> tuple[list[Node], np.ndarray]:
    """Return the nodes that a pick uses, none of them a pick, and its index into these."""
    sources: dict[int, Node] = {}
    owner, element = [], []  # of each element of the joined inputs: source, place in it
    for one in inputs:
        if one.kind != "pick":
            sources[id(one)] = one
            owner.append(np.full(one.size, id(one)))
            element.append(np.arange(one.size))
            continue
        starts = np.cumsum([0, *(inner.size for inner in one.inputs)])
        place = np.searchsorted(starts, one.value.ravel(), side="right") - 1
        sources.update({id(inner): inner for inner in one.inputs})
        owner.append(np.array([id(inner) for inner in one.inputs])[place])
        element.append(one.value.ravel() - starts[place])
    owners, elements = np.concatenate(owner)[index], np.concatenate(element)[index]
    used = [node for key, node in sources.items() if (owners == key).any()]
    starts = np.cumsum([0, *(one.size for one in used)])
    for start, one in zip(starts, used):
        elements = elements + start * (owners == id(one))
    return used, elements


def joined(inputs: Sequence[Node], axis: int) -> Node:
    """Return the concatenation of nodes along an axis."""
    starts = np.cumsum([0, *(one.size for one in inputs)])
    parts = [start + np.arange(one.size).reshape(one.shape) for start, one in zip(starts, inputs)]
    return pick(inputs, np.concatenate(parts, axis=axis))


def taken(node: Node, key: Any) -> Node:
    """Return node[key], with the indices of numpy."""
    return pick([node], np.arange(node.size).reshape(node.shape)[key])


def total(node: Node) -> Node:
    """Return the sum over the last axis."""
    if node.kind == "constant":
        return constant(node.value.sum(axis=-1))
    if node.shape[-1] == 1:
        return taken(node, (..., 0))
    return Node("sum", (as_number(node),), node.shape[:-1])


def ordered(outputs: Sequence[Node]) -> tuple[list[Node], list[Node]]:
    """Return (all nodes of a graph, inputs before their users; the outputs), equal nodes merged."""
    merged: dict[int, Node] = {}
    known: dict[tuple[Any, ...], Node] = {}
    stack = list(outputs)[::-1]
    while stack:
        node = stack[-1]
        waiting = [one for one in node.inputs if id(one) not in merged]
        if waiting:
            stack.extend(waiting)
            continue
        stack.pop()
        if id(node) in merged:
            continue
        inputs = tuple(merged[id(one)] for one in node.inputs)
        key = node.kind, tuple(map(id, inputs)), node.shape, _hashable(node.value)
        if key not in known:
            known[key] = Node(node.kind, inputs, node.shape, node.value, node.is_bool)
        merged[id(node)] = known[key]
    return list(known.values()), [merged[id(one)] for one in outputs]


def _with_axes(node: Node, axes: int) -> Node:
    """Return the node with more axes, of length 1, before its own."""
    missing = axes - len(node.shape)
    return taken(node, (None,) * missing) if missing else node


def _counts_up(index: np.ndarray) -> bool:
    return np.array_equal(index.ravel(), np.arange(index.size))


def _equal(one: np.ndarray, other: np.ndarray) -> bool:
    return np.array_equal(one, np.broadcast_to(other, one.shape), equal_nan=one.dtype != bool)


def _hashable(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value if isinstance(value, (str, tuple, type(None))) else id(value)
