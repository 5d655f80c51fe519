# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Record equations as graphs: run their own code with arrays of symbols.

`Traced` stands for an array with one row per TDOA. Its rows are all pairs of anchors, in all blocks
of copies that an equation makes of the samples. What is indexed by anchors is thus computed as
numbers, and becomes constants by pair. What depends on the tag is recorded: numpy's functions by
the protocols of numpy, compiled functions by `Kernel`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.arrays import SymbolicArray
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import Samples
from uwb_tdoa_bias.effects.samples import Motion

from .graph import Node, Pieces, apply, as_number, constant, joined, pick, scalar, taken, total

MOST_ANCHORS = 128  # constants of pairs grow with the square
LN_10 = math.log(10.0)


def samples_of(anchors: Anchors, motion: bool) -> Samples:
    """Return Samples of symbols for all pairs of Anchors.

    motion : whether there are velocity, acceleration, rate, interval and previous anchor
    """
    count = len(anchors)
    if count > MOST_ANCHORS:
        raise InputError(
            f"anchors: {count} are too many for one file, which may hold {MOST_ANCHORS}; "
            "export the anchors of one area."
        )
    pairs = np.arange(count * count)
    n = _unlike_any_length(len(pairs))
    rows = np.concatenate([pairs, np.zeros(n - len(pairs), dtype=int)])

    def column(*names: str) -> Any:
        each = [Node("input", (), (), name) for name in names]
        index = np.arange(len(each)).reshape((1, -1) if len(each) > 1 else (1,))
        return Traced(pick(each, index), n, len(pairs))

    moving = Motion(column("vx", "vy", "vz"), column("ax", "ay", "az"), column("wx", "wy", "wz"))
    return TracedSamples(
        column("time"),
        rows // count,
        rows % count,
        column("x", "y", "z"),
        column("qx", "qy", "qz", "qw"),
        anchors,
        motion=moving if motion else None,
        interval=column("interval") if motion else None,
        previous=column("previous_anchor") if motion else None,
        yaw_std=column("yaw_std"),
    )


def _unlike_any_length(least: int) -> int:
    """Return a prime from `least` on, so that no other array of an equation has this length."""
    n = max(least, 1009) | 1
    while any(n % k == 0 for k in range(3, math.isqrt(n) + 1, 2)):
        n += 2
    return n


def nodes_of(samples: Samples, values: Any) -> Node:
    """Return the node of an array of an equation, (n, ...): of symbols or of numbers."""
    like: Traced = samples.p  # type: ignore[assignment]  # of `samples_of`
    node = like.lifted(values)
    return taken(node, 0)  # the one block


class TracedSamples(Samples):
    """Samples of symbols."""

    def __len__(self) -> int:
        return len(self.p)


class Traced(NDArrayOperatorsMixin, SymbolicArray):
    """An array of symbols: (blocks * n, ...) for numpy, a node of shape (blocks, ...) in the graph.

    Attributes
    ----------
    node : Node of the array.
    n : number of rows of a block. No other array has this length.
    pairs : only the first `pairs` rows of a block are used; the rest is padding.
    """

    def __init__(self, node: Node, n: int, pairs: int) -> None:
        """Store the attributes."""
        self.node, self.n, self.pairs = node, n, pairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape that numpy would have."""
        return (self.node.shape[0] * self.n, *self.node.shape[1:])

    @property
    def ndim(self) -> int:
        """Return the number of axes."""
        return len(self.node.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def _of(self, node: Node) -> Traced:
        return Traced(node, self.n, self.pairs)

    def lifted(self, values: Any) -> Node:
        """Return the node of an operand: of symbols, of numbers by row, or of others."""
        if isinstance(values, Traced):
            return values.node
        values = np.asarray(values)
        if not self.is_by_row(values):
            return constant(values[None])
        blocks = values.reshape(len(values) // self.n, self.n, *values.shape[1:])
        return constant(np.moveaxis(blocks, 0, 1)[: self.pairs])

    def is_by_row(self, values: np.ndarray) -> bool:
        """Return whether an array of numbers has a row for each of the samples."""
        return values.ndim > 0 and len(values) > 0 and len(values) % self.n == 0

    # The protocols of numpy

    def __array__(self, *args: Any, **more: Any) -> np.ndarray:
        raise TypeError(
            "an effect may not convert its inputs to an array; write the equation with functions of "
            "numpy"
        )

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **more: Any) -> Any:
        more.pop("out", None)  # in place: the caller takes the result
        if method != "__call__" or more:
            return NotImplemented
        if ufunc is np.matmul:
            values, weights = inputs
            return self._of(total(apply("mul", values.node, constant(np.asarray(weights)[None]))))
        if ufunc is np.power:
            return self._of(_power(self, *inputs))
        return self._of(_UFUNCS[ufunc](*map(self.lifted, inputs)))

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function not in _FUNCTIONS:
            return NotImplemented
        return self._of(_FUNCTIONS[function](self, *args, **kwargs))

    # What equations use of arrays

    def __getitem__(self, key: Any) -> Traced:
        """Return all rows of some blocks. Other axes have the indices of numpy."""
        key = key if isinstance(key, tuple) else (key,)
        if key[0] is Ellipsis:
            indexed = [one for one in key[1:] if one is not None]  # None adds an axis
            key = (slice(None),) * (self.ndim - len(indexed)) + key[1:]
        first, *others = key
        blocks = self._blocks(first) if isinstance(first, slice) else None
        if blocks is None:
            raise TypeError(
                f"an effect may not select single rows ({first!r}); write the equation for all rows"
            )
        return self._of(taken(self.node, (blocks, *others)))

    def _blocks(self, rows: slice) -> slice | None:
        """Return the slice of the blocks that rows consist of; None if these are not whole blocks."""
        start, stop, step = rows.indices(len(self))
        if start % self.n or stop % self.n or step != 1:
            return None
        return slice(start // self.n, stop // self.n)

    @property
    def T(self) -> list[Traced]:  # noqa: N802  # as of numpy
        """Return the columns of a table."""
        return [self[:, column] for column in range(self.shape[1])]

    def any(self) -> bool:
        """Return True: a graph holds for all samples."""
        return True

    def reshape(self, *shape: int) -> Blocks:
        """Return parts of whole blocks; shape : (-1, rows of a part) or (parts, -1)."""
        parts, rows = shape
        if rows < 0:
            rows = len(self) // parts
        assert self.ndim == 1 and rows % self.n == 0 and len(self) % rows == 0
        return Blocks([self[first : first + rows] for first in range(0, len(self), rows)])

    # SymbolicArray

    def filled(self, kernel: Callable[..., Any], shape: tuple[int, ...], inputs: Any) -> Traced:
        rows = len(self)
        out = np.empty([1 if size == rows else size for size in shape], dtype=object)
        arguments = [self._as_symbols(one) for one in inputs]

        def run() -> list[Any]:
            out.fill(None)
            _python_of(kernel)(*arguments, out)
            return list(out.ravel())

        elements = [_node_of(one) for one in _merged(run)]
        blocks = self.node.shape[0]
        elements = [_broadcast(one, (blocks,)) for one in elements]
        index = np.arange(len(elements) * blocks).reshape(len(elements), blocks).T
        return self._of(pick(elements, index.reshape(blocks, *out.shape[1:])))

    def _as_symbols(self, value: Any) -> Any:
        """Return an argument of a kernel: one row of symbols in place of all rows."""
        if isinstance(value, np.ndarray) and not self.is_by_row(value):
            return _Table(value)
        if not isinstance(value, (Traced, np.ndarray)):
            return value
        node = self.lifted(value)
        shape = node.shape[1:]
        row = np.empty((1, *shape), dtype=object)
        for place in np.ndindex(*shape):
            row[(0, *place)] = Symbol(taken(node, (slice(None), *place)))
        return row

    def piecewise(
        self, function: Callable[[np.ndarray], np.ndarray], breaks: np.ndarray, degree: int
    ) -> Traced:
        breaks, blocks = np.asarray(breaks, dtype=float), self.node.shape[0]
        width, share = np.diff(breaks), np.linspace(0.0, 1.0, degree + 1)
        at = (breaks[:-1, None] + width[:, None] * share).ravel()
        values: np.ndarray = function(np.repeat(at, len(self)))
        values = values.reshape(len(at), blocks, self.n)
        values = np.moveaxis(values, [0, 1, 2], [2, 1, 0])[: self.pairs]
        values = values.reshape(self.pairs, blocks, len(width), degree + 1)
        np.testing.assert_allclose(values[:, :, 1:, 0], values[:, :, :-1, -1], atol=1e-9)
        solved = np.linalg.inv(np.vander(share, increasing=True))
        powers: np.ndarray = np.einsum("lbks,ds->dlbk", values, solved)
        powers = powers / width ** np.arange(degree + 1).reshape(-1, 1, 1, 1)
        if (powers == powers[:, :, :1]).all():
            powers = powers[:, :, :1]  # the same in all blocks
        inside = apply(
            "max",
            apply("sub", taken(self.node, (..., None)), constant(breaks[None, :-1])),
            scalar(0.0),
        )
        inside = apply("min", inside, constant(width[None]))
        out = constant(powers[-1])
        for power in powers[-2:0:-1]:
            out = apply("add", apply("mul", out, inside), constant(power))
        gained = total(apply("mul", out, inside))
        if gained.kind == "sum" and (powers[1:] == powers[1:, :1, :1]).all():
            pieces = Pieces.of(breaks, powers[1:, 0, 0])
            gained = Node("pieces", (self.node, gained), gained.shape, pieces)
        return self._of(apply("add", gained, constant(powers[0, :, :, 0])))

    def played(self, model: Any) -> Traced:
        assert self.node.shape[0] == 1
        node = Node("network", (taken(self.node, 0),), (model.outputs,), model)
        return self._of(taken(node, (None,)))


class Blocks(list[Traced]):
    """Parts of equal length of an array: numpy's (parts, rows)."""

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        return Blocks(found) if isinstance(key, slice) else found

    def min(self, axis: int) -> Any:
        """Return the least of all parts."""
        least = self[0]
        for one in self[1:]:
            least = np.minimum(least, one)
        return least

    def mean(self, axis: int) -> Any:
        """Return the mean of all parts."""
        return sum(self[1:], self[0]) / len(self)

    def std(self, axis: int) -> Any:
        """Return the standard deviation of all parts."""
        middle = self.mean(0)
        return np.sqrt(Blocks([(one - middle) ** 2 for one in self]).mean(0))


# Functions of numpy


def _greater(x: Node, y: Node) -> Node:
    return apply("lt", y, x)


def _greater_equal(x: Node, y: Node) -> Node:
    return apply("le", y, x)


def _is_nan(x: Node) -> Node:
    return apply("not", apply("eq", x, x))


def _is_finite(x: Node) -> Node:
    difference = apply("sub", x, x)
    return apply("eq", difference, scalar(0.0))


def _square(x: Node) -> Node:
    return apply("mul", x, x)


def _hypot(x: Node, y: Node) -> Node:
    return apply("sqrt", apply("add", _square(x), _square(y)))


def _log10(x: Node) -> Node:
    return apply("mul", apply("log", x), scalar(1.0 / LN_10))


def _remainder(x: Node, y: Node) -> Node:
    return apply("sub", x, apply("mul", y, apply("floor", apply("div", x, y))))


def _arcsin(x: Node) -> Node:
    one = scalar(1.0)
    flat = apply("mul", apply("sub", one, x), apply("add", one, x))
    return apply("atan2", x, apply("sqrt", flat))


def _integer_power(x: Node, exponent: int) -> Node:
    """Return x to a positive power by repeated squares."""
    if exponent == 1:
        return x
    half = _square(_integer_power(x, exponent // 2))
    return apply("mul", half, x) if exponent % 2 else half


def _power(like: Traced, base: Any, exponent: Any) -> Node:
    """Return a positive whole power of symbols, or a number to the power of symbols."""
    if isinstance(exponent, Traced):
        scaled = apply("mul", exponent.node, scalar(math.log(base)))
        return apply("exp", scaled)
    if exponent != round(exponent) or exponent < 1:
        raise TypeError(
            f"an effect may not take the power {exponent!r}, only positive integers; write the "
            "equation with numpy.sqrt"
        )
    return _integer_power(like.lifted(base), int(exponent))


def _binary(kind: str) -> Callable[..., Node]:
    return lambda *inputs: apply(kind, *inputs)


_UFUNCS: dict[Any, Callable[..., Node]] = {
    np.add: _binary("add"),
    np.subtract: _binary("sub"),
    np.multiply: _binary("mul"),
    np.divide: _binary("div"),
    np.maximum: _binary("max"),
    np.minimum: _binary("min"),
    np.arctan2: _binary("atan2"),
    np.negative: _binary("neg"),
    np.absolute: _binary("abs"),
    np.sqrt: _binary("sqrt"),
    np.exp: _binary("exp"),
    np.log: _binary("log"),
    np.sin: _binary("sin"),
    np.cos: _binary("cos"),
    np.floor: _binary("floor"),
    np.less: _binary("lt"),
    np.less_equal: _binary("le"),
    np.equal: _binary("eq"),
    np.logical_not: _binary("not"),
    np.invert: _binary("not"),
    np.logical_and: _binary("and"),
    np.bitwise_and: _binary("and"),
    np.logical_or: _binary("or"),
    np.bitwise_or: _binary("or"),
    np.greater: _greater,
    np.greater_equal: _greater_equal,
    np.isnan: _is_nan,
    np.isfinite: _is_finite,
    np.square: _square,
    np.hypot: _hypot,
    np.log10: _log10,
    np.remainder: _remainder,
    np.arcsin: _arcsin,
}


def _concatenate(like: Traced, arrays: Sequence[Any], axis: int = 0) -> Node:
    nodes = [node for node in map(like.lifted, arrays) if node.size]
    return joined(_of_one_type(nodes), axis)


def _of_one_type(nodes: list[Node]) -> list[Node]:
    """Return the nodes, as numbers unless all are boolean."""
    return nodes if all(one.is_bool for one in nodes) else list(map(as_number, nodes))


def _stack(like: Traced, arrays: Sequence[Any], axis: int) -> Node:
    nodes = [taken(like.lifted(one), (..., None)) for one in arrays]
    shape = np.broadcast_shapes(*(one.shape for one in nodes))
    assert axis in (-1, len(shape) - 1)
    return joined(_of_one_type([_broadcast(one, shape) for one in nodes]), -1)


def _where(like: Traced, condition: Any, one: Any, other: Any) -> Node:
    return apply("where", *map(like.lifted, (condition, one, other)))


def _sum(like: Traced, values: Traced, axis: int) -> Node:
    assert axis in (-1, values.ndim - 1)
    return total(values.node)


def _norm(like: Traced, values: Traced, axis: int) -> Node:
    return apply("sqrt", _sum(like, values * values, axis))


def _clip(like: Traced, values: Any, low: float, high: float) -> Node:
    held = apply("max", like.lifted(values), scalar(low))
    return apply("min", held, scalar(high))


def _nan_to_num(like: Traced, values: Traced) -> Node:
    return apply("where", _is_nan(values.node), scalar(0.0), values.node)


def _repeat(like: Traced, values: Traced, count: int, axis: int) -> Node:
    assert values.node.shape[axis] == 1
    return joined([values.node] * count, axis) if count else constant(np.zeros((1, 1, 0)))


def _einsum(like: Traced, subscripts: str, one: Any, other: Any) -> Node:
    assert subscripts == "...k,...k->..."
    return total(apply("mul", like.lifted(one), like.lifted(other)))


def _zeros_like(like: Traced, values: Traced) -> Node:
    return constant(np.zeros((1, *values.node.shape)))


def _ones_like(like: Traced, values: Traced) -> Node:
    return constant(np.ones((1, *values.node.shape)))


_FUNCTIONS: dict[Any, Callable[..., Node]] = {
    np.concatenate: _concatenate,
    np.hstack: lambda like, arrays: _concatenate(like, arrays, 1),
    np.stack: _stack,
    np.where: _where,
    np.sum: _sum,
    np.linalg.norm: _norm,
    np.clip: _clip,
    np.nan_to_num: _nan_to_num,
    np.repeat: _repeat,
    np.einsum: _einsum,
    np.zeros_like: _zeros_like,
    np.ones_like: _ones_like,
}


def _broadcast(node: Node, shape: tuple[int, ...]) -> Node:
    index = np.arange(node.size).reshape(node.shape)
    return pick([node], np.broadcast_to(index, shape))


# Compiled functions: their Python source runs for one row of symbols


class Symbol:
    """A number in a compiled function."""

    __array_ufunc__ = None  # numpy leaves operators to this class

    def __init__(self, node: Node) -> None:
        """Set the node."""
        self.node = node

    def __bool__(self) -> bool:
        return _PATHS[-1].choose(self.node)

    def __pow__(self, exponent: int) -> Symbol:
        return Symbol(_integer_power(self.node, exponent))

    def __neg__(self) -> Symbol:
        return Symbol(apply("neg", self.node))

    def __abs__(self) -> Symbol:
        return Symbol(apply("abs", self.node))

    __hash__ = None  # type: ignore[assignment]  # == is recorded


def _node_of(value: Any) -> Node:
    return value.node if isinstance(value, Symbol) else scalar(value)


def _operator(operation: Callable[[Node, Node], Node], swapped: bool = False) -> Any:
    """Return the method of Symbol for an operator; arrays take it element by element."""

    def method(self: Symbol, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            out = np.empty(other.shape, dtype=object)
            for place in np.ndindex(*other.shape):
                out[place] = method(self, other[place])
            return out
        both = self.node, _node_of(other)
        return Symbol(operation(*(both[::-1] if swapped else both)))

    return method


for _name, _function in {
    "add": _binary("add"),
    "sub": _binary("sub"),
    "mul": _binary("mul"),
    "truediv": _binary("div"),
}.items():
    setattr(Symbol, f"__{_name}__", _operator(_function))
    setattr(Symbol, f"__r{_name}__", _operator(_function, swapped=True))
for _name, _function in {
    "lt": _binary("lt"),
    "le": _binary("le"),
    "gt": _greater,
    "ge": _greater_equal,
    "eq": _binary("eq"),
    "ne": lambda x, y: apply("not", apply("eq", x, y)),
}.items():
    setattr(Symbol, f"__{_name}__", _operator(_function))


class _Table:
    """An array of numbers that a compiled function indexes by the row of an anchor."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __len__(self) -> int:
        return len(self._values)

    def __getitem__(self, key: Any) -> Any:
        first, *others = key if isinstance(key, tuple) else (key,)
        if not isinstance(first, Symbol):
            return self._values[key]
        found = self._values[(first.node.value.astype(int), *others)]  # (pairs, blocks, ...)
        shape = found.shape[2:]
        if not shape:
            return Symbol(constant(found))
        out = np.empty(shape, dtype=object)
        for place in np.ndindex(*shape):
            out[place] = Symbol(constant(found[(..., *place)]))
        return out


class _Paths:
    """The way through the branches of a compiled function: the first outcomes, then True."""

    def __init__(self, outcomes: list[bool]) -> None:
        self.outcomes, self.seen = outcomes, []  # type: tuple[list[bool], list[Node]]

    def choose(self, condition: Node) -> bool:
        """Return the outcome of a condition on this way."""
        if condition.kind == "constant" and condition.value.size == 1:
            return bool(condition.value.all())
        self.seen.append(condition)
        if len(self.seen) > len(self.outcomes):
            self.outcomes.append(True)
        return self.outcomes[len(self.seen) - 1]


_PATHS: list[_Paths] = []


def _merged(run: Callable[[], list[Any]], known: Sequence[bool] = ()) -> list[Any]:
    """Return what run() returns over all ways through its branches, joined by `where`.

    known : outcomes of the first conditions
    """
    _PATHS.append(_Paths(list(known)))
    try:
        values = run()
    finally:
        way = _PATHS.pop()
    for place in reversed(range(len(known), len(way.seen))):
        others = _merged(run, [*way.outcomes[:place], False])
        condition = way.seen[place]
        values = [_chosen(condition, one, other) for one, other in zip(values, others)]
    return values


def _chosen(condition: Node, one: Any, other: Any) -> Any:
    if one is other or (
        isinstance(one, Symbol) and isinstance(other, Symbol) and one.node is other.node
    ):
        return one
    return Symbol(apply("where", condition, _node_of(one), _node_of(other)))


def _one_or_two(operation: Callable[..., Node], plain: Callable[..., float]) -> Callable[..., Any]:
    """Return a function of numbers and Symbols."""

    def function(*values: Any) -> Any:
        if any(isinstance(value, Symbol) for value in values):
            return Symbol(operation(*map(_node_of, values)))
        return plain(*values)

    return function


def _copysign(size: Node, sign: Node) -> Node:
    positive = apply("abs", size)
    return apply("where", apply("lt", sign, scalar(0.0)), apply("neg", positive), positive)


_MATH = SimpleNamespace(
    sqrt=_one_or_two(_binary("sqrt"), math.sqrt),
    hypot=_one_or_two(_hypot, math.hypot),
    atan2=_one_or_two(_binary("atan2"), math.atan2),
    isfinite=_one_or_two(_is_finite, math.isfinite),
    copysign=_one_or_two(_copysign, math.copysign),
)
_NUMPY = SimpleNamespace(
    empty=lambda shape: np.empty(shape, dtype=object),
    maximum=_one_or_two(_binary("max"), np.maximum),
    minimum=_one_or_two(_binary("min"), np.minimum),
    inf=np.inf,
    nan=np.nan,
    ndarray=np.ndarray,
)


def _python_of(kernel: Any) -> Callable[..., Any]:
    """Return the Python function of a compiled one, with functions of symbols for its own."""
    plain = getattr(kernel, "py_func", kernel)
    own = {}
    for name in plain.__code__.co_names:
        value = plain.__globals__.get(name)
        called = getattr(value, "py_func", value)
        if isinstance(called, FunctionType) and called.__module__.startswith("uwb_tdoa"):
            own[name] = _python_of(value)
    return FunctionType(plain.__code__, {**plain.__globals__, **own, "math": _MATH, "np": _NUMPY})
