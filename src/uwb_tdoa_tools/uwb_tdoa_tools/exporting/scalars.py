# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The graph of a correction as a list of operations on single numbers, in single precision.

A Scalar is one operation on numbers of one TDOA. Printers of sequential code print the list of
Scalars in its order. Its kinds are the elementwise ones of `graph`, and

input     `value` is the name of a column
constant  `value` is the number
anchor    `value` is (end, bytes of N float32): the number of the anchor at this end, "a" or "b"
pair      `value` is the bytes of (N, N) float32: the number of the pair
network   `value` is (Dense, number of the output); the inputs are those of the network
pieces    `value` is Pieces, a function of the input

Equal Scalars are one. A sum adds its terms one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import numpy as np
import onnx
from onnx import numpy_helper

from uwb_tdoa_bias.common.errors import InputError

from .graph import COMPARISONS, ELEMENTWISE, LOGICAL, Node, ordered

ACTIVATIONS = ("Relu",)
SAME = 1e-9  # m; a smaller difference of constants is rounding

ANGLE = 3.1416  # rad, no atan2 is larger in single precision


class Scalar(NamedTuple):
    """One operation; inputs are places of other Scalars in the list."""

    kind: str
    inputs: tuple[int, ...] = ()
    value: Any = None

    @property
    def is_bool(self) -> bool:
        """Return whether the result is boolean."""
        return self.kind in (*COMPARISONS, *LOGICAL)


class Dense:
    """Layers of a network: y = activation(weights^T x + biases).

    Attributes
    ----------
    layers : list of (weights (i, o), biases (o,), name of the activation or "")
    constants : numbers that are appended to the output of the last layer
    """

    def __init__(self, content: bytes) -> None:
        """Read an ONNX file; raise InputError if it is not a chain of dense layers."""
        graph = onnx.load_from_string(content).graph
        known = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
        self.layers: list[tuple[np.ndarray, np.ndarray, str]] = []
        self.constants: list[np.float32] = []
        chain = graph.input[0].name
        constant: dict[str, np.float32] = {}
        for node in graph.node:
            first, *others = node.input
            if node.op_type == "Gemm" and first == chain and not node.attribute:
                weights, biases = (known[name].astype(np.float32) for name in others)
                self.layers.append((weights, np.ravel(biases), ""))
                chain = node.output[0]
            elif node.op_type in ACTIVATIONS and first == chain and self.layers:
                self.layers[-1] = (*self.layers[-1][:2], node.op_type)
                chain = node.output[0]
            elif node.op_type == "Mul" and not known[others[0]].any():
                constant[node.output[0]] = np.float32(0.0)  # of the shape of its input
            elif node.op_type == "Add" and first in constant:
                constant[node.output[0]] = np.float32(known[others[0]].ravel()[0])
            elif node.op_type == "Concat" and first == chain and set(others) <= set(constant):
                self.constants = [constant[name] for name in others]
                chain = node.output[0]
            else:
                raise _no_chain(f"it has the operator {node.op_type}")
        if not self.layers or chain != graph.output[0].name:
            raise _no_chain("it is no chain of layers")

    @property
    def widest(self) -> int:
        """Return the largest number of values of a layer."""
        return max(len(biases) for _, biases, _ in self.layers)


def _no_chain(why: str) -> InputError:
    return InputError(
        f"--model: C holds networks of dense layers, and of this one not: {why}; train "
        "--model paper, or write it by --onnx."
    )


@lru_cache(maxsize=8)
def dense(content: bytes) -> Dense:
    """Return the network of an ONNX file; the same object for the same content. Raises InputError."""
    return Dense(content)


class Program:
    """All Scalars of some outputs, inputs before their users.

    Attributes
    ----------
    scalars : list of Scalar
    outputs : places of the outputs
    """

    def __init__(self, outputs: Sequence[Node], count: int) -> None:
        """Take the nodes () of the outputs apart. count : N, number of anchors."""
        self.scalars: list[Scalar] = []
        self._known: dict[Any, int] = {}
        self._count = count
        places: dict[int, np.ndarray] = {}
        nodes, merged = ordered(outputs)
        for node in nodes:
            places[id(node)] = self._elements(node, places)
        self.outputs = [int(places[id(one)]) for one in merged]
        self._keep_used()

    def _elements(self, node: Node, places: dict[int, np.ndarray]) -> np.ndarray:
        """Return the places of the elements of a node, an array of its shape.

        places : {id of a node: places of its elements}, of all nodes before
        """
        inputs = [places[id(one)] for one in node.inputs]
        if node.kind == "input":
            return np.array(self.add("input", (), node.value))
        if node.kind == "constant":
            return self._constants(node)
        if node.kind == "pick":
            return np.concatenate([one.ravel() for one in inputs])[node.value]
        if node.kind == "pieces":
            return _each(lambda at: self.add("pieces", (at,), node.value), inputs[:1])
        if node.kind == "sum":
            return _each(lambda *terms: reduce(self._plus, terms), np.moveaxis(inputs[0], -1, 0))
        if node.kind == "network":
            network = dense(node.value.content)
            values = [(network, k) for k in range(node.size)]
            return np.array([self.add("network", tuple(inputs[0]), one) for one in values])
        return _each(lambda *some: self.add(node.kind, some), np.broadcast_arrays(*inputs))

    def _constants(self, node: Node) -> np.ndarray:
        count = self._count
        rows = np.broadcast_to(node.value, (count * count, *node.shape))
        elements = rows.reshape(count, count, -1)
        each = [self._from_table(elements[:, :, k]) for k in range(elements.shape[2])]
        return np.array(each, dtype=int).reshape(node.shape)

    def _from_table(self, values: np.ndarray) -> int:
        """Return the place of a number for each pair of anchors, values (N, N)."""
        of_b = values[0].astype(float)
        if (values == values[0, 0]).all() or np.isnan(values).all():
            return self.add("constant", (), values[0, 0])
        if (values == values[:, :1]).all():
            return self._of_anchor("a", values[:, 0])
        if (values == values[:1]).all():
            return self._of_anchor("b", values[0])
        if np.abs(values - (of_b - of_b[:, None])).max() < SAME:
            ends = self._of_anchor("b", of_b), self._of_anchor("a", of_b)
            return self.add("sub", ends)
        return self.add("pair", (), _bytes(values))

    def _of_anchor(self, end: str, values: np.ndarray) -> int:
        return self.add("anchor", (), (end, _bytes(values)))

    def _plus(self, one: int, other: int) -> int:
        return self.add("add", (one, other))

    def add(self, kind: str, inputs: tuple[int, ...] = (), value: Any = None) -> int:
        """Return the place of a Scalar, which is new unless there is an equal or a simpler one."""
        inputs = tuple(map(int, inputs))
        if kind == "constant":
            value = np.float32(value)
        elif kind in ELEMENTWISE:
            simpler = self._simpler(kind, inputs)
            if simpler is not None:
                return simpler
        key = kind, inputs, value.tobytes() if isinstance(value, np.float32) else value
        if key not in self._known:
            self._known[key] = len(self.scalars)
            self.scalars.append(Scalar(kind, inputs, value))
        return self._known[key]

    def _simpler(self, kind: str, inputs: tuple[int, ...]) -> int | None:
        """Return the place of an equal Scalar that C computes without a slow function of libm."""
        known = [self.scalars[k] for k in inputs]
        if kind in ("sin", "cos") and known[0].kind == "atan2":
            return self._of_angle(kind, *known[0].inputs)
        if kind == "sub" and known[1].kind == "mul":
            return self._wrapped(*inputs)
        return None

    def _of_angle(self, kind: str, y: int, x: int) -> int:
        """Return the place of the sine or cosine of the angle of (x, y), without the angle."""
        squares = self.add("mul", (x, x)), self.add("mul", (y, y))
        length = self.add("sqrt", (self.add("add", squares),))
        share = self.add("div", (x if kind == "cos" else y, length))
        zero, at_zero = self.add("constant", (), 0.0), float(kind == "cos")
        there = self.add("lt", (zero, length))
        return self.add("where", (there, share, self.add("constant", (), at_zero)))

    def _wrapped(self, x: int, multiple: int) -> int | None:
        """Return the place of x - multiple if that wraps an angle less than a turn off, without floor.

        multiple : place of period * floor(x / period)
        """
        turn = self.scalars[multiple].inputs
        floor = self.scalars[turn[1]]
        if floor.kind != "floor" or self.scalars[floor.inputs[0]] != Scalar("div", (x, turn[0])):
            return None
        period = self.scalars[turn[0]]
        low, high = self._range(x)
        if period.kind != "constant" or low < -period.value or high >= period.value:
            return None
        below = self.add("lt", (x, self.add("constant", (), 0.0)))
        return self.add("where", (below, self.add("add", (x, turn[0])), x))

    def _range(self, place: int) -> tuple[float, float]:
        """Return bounds of a Scalar, as far as angles and their sums need them."""
        one = self.scalars[place]
        if one.kind == "constant":
            return float(one.value), float(one.value)
        if one.kind == "sqrt":
            return 0.0, np.inf
        if one.kind == "atan2":
            largest = ANGLE if self._range(one.inputs[1])[0] < 0.0 else 0.5 * ANGLE
            return -largest, largest
        known = [self._range(k) for k in one.inputs] if one.kind in ("sub", "where") else []
        if one.kind == "sub":
            return known[0][0] - known[1][1], known[0][1] - known[1][0]
        if one.kind == "where":
            return min(known[1][0], known[2][0]), max(known[1][1], known[2][1])
        return -np.inf, np.inf

    def _keep_used(self) -> None:
        """Remove what no output needs."""
        used = needed(self.scalars, self.outputs)
        new = {old: k for k, old in enumerate(used)}
        self.scalars = [
            Scalar(one.kind, tuple(new[i] for i in one.inputs), one.value)
            for one in (self.scalars[old] for old in used)
        ]
        self.outputs = [new[k] for k in self.outputs]


def _bytes(values: np.ndarray) -> bytes:
    return values.astype(np.float32).tobytes()


def needed(scalars: Sequence[Scalar], outputs: Iterable[int]) -> list[int]:
    """Return the places of some outputs and of all that they are computed from, rising."""
    used, stack = set(), list(outputs)
    while stack:
        place = stack.pop()
        if place not in used:
            used.add(place)
            stack.extend(scalars[place].inputs)
    return sorted(used)


def _each(function: Callable[..., int], arrays: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Return function(one number of each array) for all elements of arrays of one shape."""
    shape = np.shape(arrays[0])
    flat = [function(*numbers) for numbers in zip(*(np.ravel(one) for one in arrays))]
    return np.array(flat, dtype=int).reshape(shape)
