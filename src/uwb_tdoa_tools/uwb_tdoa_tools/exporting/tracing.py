# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Record the equations of a Corrector as expressions: run their own code with arrays of symbols.

`Traced` stands for an array with one row per TDOA. Its rows are all pairs of anchors, in all blocks
of copies that an equation makes of the samples. What is indexed by anchors is thus computed as
numbers, and becomes constants by pair. What depends on the tag is recorded: numpy's functions by
the protocols of numpy, compiled functions by a run of their Python source for one row of symbols.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
import dis
from functools import partial, reduce
import json
import math
from types import FunctionType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.arrays import SymbolicArray
from uwb_tdoa_bias.common.errors import InputError, written_by
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import INPUTS, KIND, OUTPUTS, Model, Network
from uwb_tdoa_bias.effects import Effect, EffectSet, LabelEffect, Samples, SmoothTerm
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_bias.effects.effect_set import REACH
from uwb_tdoa_bias.effects.floor import FloorMultipath
from uwb_tdoa_bias.effects.samples import Motion

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
NEUTRAL = {"add": 0.0, "mul": 1.0, "and": True, "or": False}
EVEN = 1e-5  # share by which the widths of pieces of one width may differ, rounded
SAME = 1e-9  # m; a smaller difference of constants is rounding
LN_10 = math.log(10.0)
ANGLE = 3.1416  # rad, no atan2 is larger in single precision


class Expression(NDArrayOperatorsMixin):
    """A number of each TDOA, as the module describes.

    Operators of Python and functions of numpy record others, element by element of an array.
    """

    __slots__ = ("inputs", "kind", "value")

    def __init__(self, kind: str, inputs: tuple[Expression, ...] = (), value: Any = None) -> None:
        """Set all attributes."""
        self.kind, self.inputs, self.value = kind, inputs, value

    @property
    def is_bool(self) -> bool:
        """Return whether the result is boolean."""
        if self.kind == "constant":
            return bool(self.value.dtype == bool)
        return self.kind in (*COMPARISONS, *LOGICAL)

    def __bool__(self) -> bool:
        return _WAYS[-1].choose(self)

    # more : the output of +=, whose place the caller gives to the result
    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **more: Any) -> Any:
        arrays = (np.asarray(one, dtype=object) for one in inputs)
        return np.frompyfunc(FUNCTIONS[ufunc], len(inputs), 1)(*arrays)


def constant(values: Any) -> Expression:
    """Return a constant of a number or boolean, or of one for each pair of anchors (N * N,)."""
    values = np.ravel(values)
    values = values if values.dtype == bool else values.astype(float)
    same = (values == values[0]).all() or np.isnan(values).all()
    return Expression("constant", (), values[:1] if same else values)


def expressed(value: Any) -> Expression:
    """Return an Expression as it is, and a number as a constant."""
    return value if isinstance(value, Expression) else constant(value)


def apply(kind: str, *inputs: Any) -> Expression:
    """Return an elementwise Expression of others and of numbers; of constants a constant."""
    known = tuple(map(expressed, inputs))
    if kind == "where":
        known = known[0], *map(_as_number, known[1:])
        if known[0].kind == "constant" and len(known[0].value) == 1:
            return known[1] if known[0].value[0] else known[2]
    elif kind not in LOGICAL:
        known = tuple(map(_as_number, known))
    if all(one.kind == "constant" for one in known):
        with np.errstate(all="ignore"):
            return constant(ELEMENTWISE[kind](*(one.value for one in known)))
    if kind in ("sin", "cos") and known[0].kind == "atan2":
        return _of_angle(kind, *known[0].inputs)
    for one, other in (known, known[::-1]) if kind in NEUTRAL else ():
        if other.kind == "constant" and (other.value == NEUTRAL[kind]).all():
            return one
    return Expression(kind, known)


def _of_angle(kind: str, y: Expression, x: Expression) -> Expression:
    """Return the sine or cosine of the angle of (x, y), without the angle."""
    length = apply("sqrt", x * x + y * y)
    share = (x if kind == "cos" else y) / length
    return apply("where", apply("eq", length, 0.0), float(kind == "cos"), share)


def remainder(x: Any, period: Any) -> Expression:
    """Return what numpy.remainder does.

    A comparison wraps an angle that is less than a turn off. The function floor of libm is slow.
    """
    low, high = _bounds(expressed(x))
    if not isinstance(period, Expression) and -period <= low and high < period:
        return apply("where", apply("lt", x, 0.0), x + period, x)
    return apply("sub", x, period * apply("floor", x / period))


def _bounds(one: Expression) -> tuple[float, float]:
    """Return bounds of an Expression, as far as angles and their sums need them."""
    known = [_bounds(each) for each in one.inputs] if one.kind in ("atan2", "sub", "where") else []
    if one.kind == "constant":
        return float(one.value.min()), float(one.value.max())
    if one.kind == "sqrt":
        return 0.0, np.inf
    if one.kind == "atan2":
        largest = ANGLE if known[1][0] < 0.0 else 0.5 * ANGLE
        return -largest, largest
    if one.kind == "sub":
        return known[0][0] - known[1][1], known[0][1] - known[1][0]
    if one.kind == "where":
        return min(known[1][0], known[2][0]), max(known[1][1], known[2][1])
    return -np.inf, np.inf


def _power(base: Any, exponent: Any) -> Expression:
    """Return a positive whole power by repeated squares, or a number to the power of a symbol."""
    if isinstance(exponent, Expression):
        return apply("exp", exponent * math.log(base))
    if exponent != round(exponent) or exponent < 1:
        raise TypeError(
            f"an effect may not take the power {exponent!r}, only positive integers; write the "
            "equation with numpy.sqrt"
        )
    if exponent == 1:
        return expressed(base)
    half = _power(base, exponent // 2)
    square = apply("mul", half, half)
    return apply("mul", square, base) if exponent % 2 else square


FUNCTIONS: dict[Any, Callable[..., Any]] = {  # of numpy, for numbers and Expressions
    **{function: partial(apply, kind) for kind, function in ELEMENTWISE.items()},
    np.not_equal: lambda x, y: apply("not", apply("eq", x, y)),
    np.invert: partial(apply, "not"),
    np.bitwise_and: partial(apply, "and"),
    np.bitwise_or: partial(apply, "or"),
    np.greater: lambda x, y: apply("lt", y, x),
    np.greater_equal: lambda x, y: apply("le", y, x),
    np.isnan: lambda x: apply("not", apply("eq", x, x)),
    np.isfinite: lambda x: apply("eq", x - x, 0.0),
    np.square: lambda x: x * x,
    np.power: _power,
    np.hypot: lambda x, y: apply("sqrt", x * x + y * y),
    np.copysign: lambda size, sign: apply("where", apply("lt", sign, 0.0), -abs(size), abs(size)),
    np.log10: lambda x: apply("log", x) * (1.0 / LN_10),
    np.remainder: remainder,
    np.arcsin: lambda x: apply("atan2", x, apply("sqrt", (1.0 - x) * (1.0 + x))),
}


class _Way:
    """The way through the branches of a function: the first outcomes, then True."""

    def __init__(self, outcomes: list[bool]) -> None:
        self.outcomes = outcomes
        self.seen: list[Expression] = []

    def choose(self, condition: Expression) -> bool:
        """Return the outcome of a condition on this way."""
        if condition.kind == "constant" and len(condition.value) == 1:
            return bool(condition.value[0])
        self.seen.append(condition)
        if len(self.seen) > len(self.outcomes):
            self.outcomes.append(True)
        return self.outcomes[len(self.seen) - 1]


_WAYS: list[_Way] = []


def merged(run: Callable[[], Iterable[Any]], known: Sequence[bool] = ()) -> list[Expression]:
    """Return the numbers of run() over all ways through its branches, joined by `where`.

    known : outcomes of the first conditions
    """
    _WAYS.append(_Way(list(known)))
    try:
        values = list(map(expressed, run()))
    finally:
        way = _WAYS.pop()
    for place in reversed(range(len(known), len(way.seen))):
        others = merged(run, [*way.outcomes[:place], False])
        condition = way.seen[place]
        values = [
            one if one is other else apply("where", condition, one, other)
            for one, other in zip(values, others)
        ]
    return values


def _as_number(one: Expression) -> Expression:
    """Return an Expression with 1 and 0 for a boolean one."""
    return apply("where", one, 1.0, 0.0) if one.is_bool else one


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


class Scalar(NamedTuple):
    """An operation of a Program; inputs are places of other Scalars in the list."""

    kind: str
    inputs: tuple[int, ...] = ()
    value: Any = None

    @property
    def is_bool(self) -> bool:
        """Return whether the result is boolean."""
        return self.kind in (*COMPARISONS, *LOGICAL)


class Program:
    """All Scalars of some outputs, inputs before their users. Equal Scalars are one.

    Attributes
    ----------
    scalars : list of Scalar
    outputs : places of the outputs
    """

    def __init__(self, outputs: Sequence[Expression], count: int) -> None:
        """List what outputs need. count : N, number of anchors."""
        self.scalars: list[Scalar] = []
        self._known: dict[Any, int] = {}
        self._count = count
        places: dict[int, int] = {}
        for one in _ordered(outputs):
            if one.kind == "constant":
                places[id(one)] = self._constant(one)
            else:
                inputs = (places[id(each)] for each in one.inputs)
                places[id(one)] = self._add(one.kind, tuple(inputs), one.value)
        self.outputs = [places[id(one)] for one in outputs]

    def _constant(self, one: Expression) -> int:
        """Return the place of a constant; of booleans by pair it is a comparison."""
        if len(one.value) == 1:
            return self._add("constant", (), one.value[0])
        table = self._of_table(one.value.reshape(self._count, self._count).astype(float))
        return self._add("lt", (self._add("constant", (), 0.0), table)) if one.is_bool else table

    def _of_table(self, values: np.ndarray) -> int:
        """Return the place of a number for each pair of anchors, values (N, N)."""
        if _same(values, values[:, :1]):
            return self._of_anchor("a", values[:, 0])
        if _same(values, values[:1]):
            return self._of_anchor("b", values[0])
        if np.abs(values - (values[0] - values[0][:, None])).max() < SAME:
            return self._add(
                "sub", (self._of_anchor("b", values[0]), self._of_anchor("a", values[0]))
            )
        return self._add("pair", (), _bytes(values))

    def _of_anchor(self, end: str, values: np.ndarray) -> int:
        return self._add("anchor", (), (end, _bytes(values)))

    def _add(self, kind: str, inputs: tuple[int, ...] = (), value: Any = None) -> int:
        """Return the place of a Scalar, which is new unless there is an equal one."""
        if kind == "constant":
            value = np.float32(value)
        key = kind, inputs, value.tobytes() if kind == "constant" else value
        if key not in self._known:
            self._known[key] = len(self.scalars)
            self.scalars.append(Scalar(kind, inputs, value))
        return self._known[key]


def _ordered(outputs: Sequence[Expression]) -> list[Expression]:
    """Return some Expressions and all that they are computed from, inputs before their users."""
    done: dict[int, Expression] = {}
    stack = list(outputs)[::-1]
    while stack:
        waiting = [one for one in stack[-1].inputs if id(one) not in done]
        stack.extend(waiting)
        if not waiting:
            one = stack.pop()
            done[id(one)] = one
    return list(done.values())


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return np.array_equal(one, np.broadcast_to(other, one.shape), equal_nan=True)


def _bytes(values: np.ndarray) -> bytes:
    return values.astype(np.float32).tobytes()


MOST_ANCHORS = 128  # constants of pairs grow with the square


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
        each = np.array([Expression("input", (), name) for name in names])
        return Traced(each[None] if len(each) > 1 else each, n, len(pairs))

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


def expressions_of(samples: Samples, values: Any) -> list[Expression]:
    """Return the Expressions of a row of an equation: (n,) or (n, k) symbols or numbers."""
    like: Traced = samples.p  # type: ignore[assignment]  # of `samples_of`
    return list(map(expressed, np.ravel(like.lifted(values)[0])))


class TracedSamples(Samples):
    """Samples of symbols."""

    def __len__(self) -> int:
        return len(self.p)


def _constants(values: np.ndarray) -> np.ndarray:
    """Return an array of constants, each of the numbers along the last axis."""
    each = map(constant, values.reshape(-1, values.shape[-1]))
    return np.array([*each], dtype=object).reshape(values.shape[:-1])


class Traced(NDArrayOperatorsMixin, SymbolicArray):
    """An array of symbols, for numpy of shape (blocks * n, ...).

    Attributes
    ----------
    elements : (blocks, ...) array of Expressions, and of numbers
    n : number of rows of a block. No other array has this length.
    pairs : only the first `pairs` rows of a block are used; the rest is padding.
    """

    def __init__(self, elements: np.ndarray, n: int, pairs: int) -> None:
        """Store the attributes."""
        self.elements, self.n, self.pairs = elements, n, pairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape that numpy would have."""
        return (len(self.elements) * self.n, *self.elements.shape[1:])

    @property
    def ndim(self) -> int:
        """Return the number of axes."""
        return self.elements.ndim

    def __len__(self) -> int:
        return self.shape[0]

    def of(self, elements: Any) -> Traced:
        """Return an array of other elements, which is like this one."""
        return Traced(elements, self.n, self.pairs)

    def lifted(self, values: Any) -> np.ndarray:
        """Return the elements of an operand: of symbols, of numbers by row, or of others."""
        if isinstance(values, Traced):
            return values.elements
        values = np.asarray(values)
        if not self.is_by_row(values):
            return values.astype(object)
        blocks = np.moveaxis(
            values.reshape(len(values) // self.n, self.n, *values.shape[1:]), 1, -1
        )
        return _constants(blocks[..., : self.pairs])

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
            return np.sum(values * weights, axis=-1)
        return self.each(FUNCTIONS[ufunc], *inputs)

    def each(self, function: Callable[..., Any], *inputs: Any) -> Traced:
        """Return a function of numbers for all elements of some operands."""
        elements = map(self.lifted, inputs)
        return self.of(np.frompyfunc(function, len(inputs), 1)(*elements))

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function not in _ARRAYS:
            return NotImplemented
        return _ARRAYS[function](self, *args, **kwargs)

    # What equations use of arrays

    def __getitem__(self, key: Any) -> Traced:
        """Return all rows of some blocks. Other axes have the indices of numpy."""
        key = key if isinstance(key, tuple) else (key,)
        if key[0] is Ellipsis:
            indexed = [one for one in key[1:] if one is not None]  # None adds an axis
            key = (slice(None),) * (self.ndim - len(indexed)) + key[1:]
        first, *others = key
        begin, end, step = first.indices(len(self)) if isinstance(first, slice) else (0, 1, 1)
        if begin % self.n or end % self.n or step != 1:
            raise TypeError(
                f"an effect may not select single rows ({first!r}); write the equation for all rows"
            )
        return self.of(self.elements[(slice(begin // self.n, end // self.n), *others)])

    @property
    def T(self) -> list[Traced]:  # noqa: N802  # as of numpy
        """Return the columns of a table."""
        return [self[:, column] for column in range(self.shape[1])]

    def any(self) -> bool:
        """Return True: the expressions hold for all samples."""
        return True

    def all(self) -> bool:
        """Return True: limits of a model that all samples keep are not recorded; readers apply them."""
        return True

    def reshape(self, *shape: int) -> Blocks:
        """Return parts of whole blocks; shape : (-1, rows of a part) or (parts, -1)."""
        parts, rows = shape
        parts = len(self) // rows if parts < 0 else parts
        return Blocks(map(self.of, self.elements.reshape(parts, -1)))

    # SymbolicArray

    def filled(self, kernel: Callable[..., Any], shape: tuple[int, ...], inputs: Any) -> Traced:
        def run(block: int) -> np.ndarray:
            out = np.empty((1, *shape[1:]), dtype=object)
            _python_of(kernel)(*(self._row(one, block) for one in inputs), out)
            return out.ravel()

        blocks = len(self.elements)
        rows = [merged(partial(run, block)) for block in range(blocks)]
        return self.of(np.array(rows, dtype=object).reshape(blocks, *shape[1:]))

    def _row(self, value: Any, block: int) -> Any:
        """Return an argument of a kernel: one row of symbols in place of all rows of a block."""
        if isinstance(value, np.ndarray) and not self.is_by_row(value):
            return _Table(value)
        if not isinstance(value, (Traced, np.ndarray)):
            return value
        return self.lifted(value)[block : block + 1]

    def piecewise(
        self, function: Callable[[np.ndarray], np.ndarray], breaks: np.ndarray, degree: int
    ) -> Traced:
        breaks = np.asarray(breaks, dtype=float)
        width, share = np.diff(breaks), np.linspace(0.0, 1.0, degree + 1)
        at = (breaks[:-1, None] + width[:, None] * share).ravel()
        values: np.ndarray = function(np.repeat(at, len(self)))
        values = values.reshape(len(width), len(share), -1, self.n)[..., : self.pairs]
        np.testing.assert_allclose(values[1:, 0], values[:-1, -1], atol=1e-9)
        solved = np.linalg.inv(np.vander(share, increasing=True))
        powers: np.ndarray = np.einsum("ksbp,ds->bdkp", values, solved)
        powers = powers / width[:, None] ** np.arange(degree + 1).reshape(-1, 1, 1)
        pieces = [_polynomials(x, breaks, some) for x, some in zip(self.elements, powers)]
        return self.of(np.array(pieces))

    def played(self, model: Any) -> Traced:
        (inputs,) = self.elements
        row = tuple(map(expressed, inputs))
        outputs = [Expression("network", row, (model, k)) for k in range(model.outputs)]
        return self.of(np.array([outputs]))


def _polynomials(x: Any, breaks: np.ndarray, powers: np.ndarray) -> Expression:
    """Return the value at x of polynomials between breaks, of powers (degree + 1, pieces, pairs)."""
    level, rising = powers[0, 0], powers[1:]
    if (rising == rising[..., :1]).all() and expressed(x).kind != "constant":
        return Expression("pieces", (x,), Pieces.of(breaks, rising[..., 0])) + constant(level)
    gained = constant(0.0)
    for begin, width, terms in zip(breaks, np.diff(breaks), rising.swapaxes(0, 1)):
        inside = apply("min", apply("max", apply("sub", x, begin), 0.0), width)
        value = constant(0.0)
        for power in terms[::-1]:
            value = (value + constant(power)) * inside
        gained = gained + value
    return gained + constant(level)


class Blocks(list[Traced]):
    """Parts of equal length of an array: numpy's (parts, rows)."""

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        return Blocks(found) if isinstance(key, slice) else found

    def min(self, axis: int) -> Any:
        """Return the least of all parts."""
        return reduce(np.minimum, list[Any](self))

    def mean(self, axis: int) -> Any:
        """Return the mean of all parts."""
        return sum(self[1:], self[0]) / len(self)

    def std(self, axis: int) -> Any:
        """Return the standard deviation of all parts."""
        middle = self.mean(0)
        return np.sqrt(Blocks((one - middle) ** 2 for one in self).mean(0))


# Functions of arrays


def _concatenate(like: Traced, arrays: Any, axis: int = 0) -> Traced:
    return like.of(np.concatenate([like.lifted(one) for one in arrays], axis))


def _stack(like: Traced, arrays: Any, axis: int) -> Traced:
    return like.of(np.stack(np.broadcast_arrays(*map(like.lifted, arrays)), axis))


def _sum(like: Traced, values: Traced, axis: int) -> Traced:
    assert axis % values.ndim  # not over the rows
    return like.of(values.elements.sum(axis))


def _einsum(like: Traced, subscripts: str, one: Any, other: Any) -> Any:
    assert subscripts == "...k,...k->..."
    return np.sum(like.each(partial(apply, "mul"), one, other), axis=-1)


_ARRAYS: dict[Any, Callable[..., Any]] = {
    np.concatenate: _concatenate,
    np.hstack: partial(_concatenate, axis=1),
    np.stack: _stack,
    np.where: lambda like, *inputs: like.each(FUNCTIONS[np.where], *inputs),
    np.sum: _sum,
    np.linalg.norm: lambda like, values, axis: np.sqrt(np.sum(values * values, axis=axis)),
    np.clip: lambda like, values, low, high: np.minimum(np.maximum(values, low), high),
    np.nan_to_num: lambda like, values: np.where(np.isnan(values), 0.0, values),
    np.repeat: lambda like, values, count, axis: like.of(np.repeat(values.elements, count, axis)),
    np.einsum: _einsum,
    np.zeros_like: lambda like, values: like.of(np.zeros(values.elements.shape, dtype=object)),
    np.ones_like: lambda like, values: like.of(np.ones(values.elements.shape, dtype=object)),
}


# Compiled functions


class _Table:
    """An array of numbers that a compiled function indexes by the row of an anchor."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __len__(self) -> int:
        return len(self._values)

    def __getitem__(self, key: Any) -> Any:
        first, *others = key if isinstance(key, tuple) else (key,)
        if not isinstance(first, Expression):
            return self._values[key]
        found = self._values[(first.value.astype(int), *others)]  # (pairs, ...)
        return _constants(np.moveaxis(found, 0, -1))[()]


_MATH = SimpleNamespace(
    sqrt=np.sqrt,
    hypot=np.hypot,
    atan2=np.arctan2,
    isfinite=np.isfinite,
    copysign=np.copysign,
)
_NUMPY = SimpleNamespace(
    empty=lambda shape: np.empty(shape, dtype=object),
    maximum=np.maximum,
    minimum=np.minimum,
    inf=np.inf,
    nan=np.nan,
    ndarray=np.ndarray,
)


def _python_of(kernel: Any) -> Callable[..., Any]:
    """Return the Python function of a compiled one, with functions of symbols for its own."""
    plain = getattr(kernel, "py_func", kernel)
    own = {}
    loaded = (one.argval for one in dis.get_instructions(plain) if one.opname == "LOAD_GLOBAL")
    for name in loaded:  # co_names would hold attributes too
        value = plain.__globals__.get(name)
        called = getattr(value, "py_func", value)
        if isinstance(called, FunctionType) and called.__module__.startswith("uwb_tdoa"):
            own[name] = _python_of(value)
    return FunctionType(plain.__code__, {**plain.__globals__, **own, "math": _MATH, "np": _NUMPY})


FARTHEST = 500.0  # m from the origin: single precision resolves 0.03 mm there
G = 9.81  # m/s^2
# Metres per unit of a parameter, and under which condition. Inertial errors grow with the time t
# that the filter has no TDOA: a force by t^2 / 2, a tilt by g t^2 / 2, a rate by g t^3 / 6.
PER_UNIT = {
    "m": (1.0, ""),
    "s": (1.0, "at 1 m/s"),
    "m/s": (1.0, "after 1 s"),
    "m/s^2": (0.5, "after 1 s without TDOAs"),
    "rad": (0.5 * G, "after 1 s without TDOAs"),
    "rad/s": (G / 6.0, "after 1 s without TDOAs"),
}
# Of a share or an angle what it means depends on the channel
PER_UNIT_OF_CHANNEL = {
    ("tdoa", "1"): (1.0, "for outliers of 1 m"),
    ("height", "1"): (1.0, "at 1 m"),
    ("velocity", "1"): (1.0, "after 1 s at 1 m/s"),
    ("velocity", "rad"): (1.0, "after 1 s at 1 m/s"),
    ("yaw_rate", "1"): (0.5, "after 1 s at 1 m/s and 1 rad/s"),
    ("accel", "1"): (0.5, "after 1 s without TDOAs at 1 m/s^2"),
    ("gyro", "1"): (G / 6.0, "after 1 s without TDOAs at 1 rad/s"),
}
SENSOR_UNITS = {"gyro": "rad/s", "accel": "m/s^2", "velocity": "m/s", "yaw_rate": "rad/s"}


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not in a file.

    label : name in reports; worth : m, size of its error; when : condition of that, or ""
    why : the reason, a clause
    """

    label: str
    worth: float
    when: str
    why: str

    def __str__(self) -> str:
        """Return a sentence."""
        condition = f" {self.when}" if self.when else ""
        return f"{self.label} is left out: {self.why}. It is worth {self.worth:.2g} m{condition}."


def left_out(effect: Effect, anchors: Anchors) -> LeftOut:
    """Return the LeftOut of an effect."""
    if isinstance(effect, LabelEffect):
        between = anchors.positions[:, None] - anchors.positions
        far = float(np.max(np.linalg.norm(between, axis=-1)))
        why = "it changes the ids or the sign of a TDOA before the correction"
        return LeftOut(effect.label, far, "at most, the distance between two anchors", why)
    unit = _unit(effect)
    per_unit, when = PER_UNIT_OF_CHANNEL.get((effect.channels[0], unit)) or PER_UNIT[unit]
    largest = max((abs(_own(effect, key)) for key in effect.values), default=0.0)
    return LeftOut(effect.label, per_unit * largest, when, _why(effect))


def _unit(effect: Effect) -> str:
    if isinstance(effect, SmoothTerm):
        return SENSOR_UNITS.get(effect.channels[0], "m")
    return effect.unit_of(effect.row.example)


def _own(effect: Effect, key: str) -> float:
    """Return a value if it is a size in the first unit of the effect, else 0."""
    other = effect.is_condition(key) or effect.unit_of(key) != effect.unit_of(effect.row.example)
    return 0.0 if other else effect.values[key]


def _why(effect: Effect) -> str:
    if effect.is_hypothesis:
        return "the filter weighs it, and nothing corrects it; C holds it as noise near the floor"
    if "tdoa" not in effect.channels:
        return f"it acts on {listed(effect.channels)}, not on TDOAs"
    if effect.stamp_offset("tdoa"):
        return "it changes the stamps of TDOAs before the correction"
    if isinstance(effect, SmoothTerm):
        return f"no vehicle computes {effect.covariate}"
    return effect.why_unusable


class FloorWeight(FloorMultipath):
    """The noise of TDOAs near the floor, for a filter that does not weigh whether an anchor is late.

    Nothing is corrected. Where an anchor may be late, its whole delay counts as noise, at any place.
    The filter may be REACH too high: otherwise its first error would end the weight.
    """

    is_hypothesis = False
    bias = Effect.bias

    def noise_std(self, samples: Samples) -> np.ndarray:
        rows = np.concatenate([samples.a, samples.b])
        delays, _, noises = (values[rows] for values in self.of_each(samples.anchors))
        low = replace(samples, p=samples.p - np.array([0.0, 0.0, REACH]))
        share, _ = self._late(low, rows)
        power: np.ndarray = np.nan_to_num((delays**2 + noises**2) * share)
        of_a, of_b = power.reshape(2, -1)
        return np.sqrt(of_a + of_b)


@dataclass(frozen=True)
class TracedCorrection:
    """The expressions of a correction.

    Attributes
    ----------
    anchors : Anchors
    effects : EffectSet of the recorded effects
    network : recorded Network, or None
    outputs : list of Expression, in the order of OUTPUTS
    floor : FloorWeight of what only C holds
    left_out : tuple of LeftOut
    """

    anchors: Anchors
    effects: EffectSet
    network: Network | None
    outputs: list[Expression]
    left_out: tuple[LeftOut, ...]
    floor: EffectSet

    def meta(self) -> dict[str, Any]:
        """Return the metadata of a file: what goes in, what comes out, and where it is from."""
        network = {} if self.network is None else self.network.meta
        of_effects = self.effects.name if len(self.effects) else ""
        of_network = self.network.name if self.network else ""
        return {
            "kind": KIND,
            "name": "+".join(filter(None, (of_effects, of_network))),
            "inputs": [list(column) for column in INPUTS],
            "outputs": [list(column) for column in OUTPUTS],
            "frame": self.anchors.frame,
            "anchor_ids": self.anchors.ids.tolist(),
            "anchor_positions": self.anchors.positions.tolist(),
            "effects": [effect.label for effect in self.effects],
            "of_effects": of_effects,
            "needs_motion": self.effects.needs_motion,
            "has_slope": len(self.effects.state_dependent) > 0,
            "sources": {effect.label: effect.source for effect in self.effects if effect.source},
            "network": {key: json.loads(network[key]) for key in PROVENANCE if key in network},
            "left_out": [str(one) for one in self.left_out],
            "written_by": written_by(),
        }


# Keys of a network's metadata that say what it was made of
PROVENANCE = ("name", "kind", "data", "trained_on", "validated_on")


def trace(
    anchors: Anchors, effects: EffectSet | None, network: Model | None = None
) -> TracedCorrection:
    """Return the TracedCorrection of some Anchors; raise InputError."""
    far = np.abs(anchors.positions).max(axis=1) > FARTHEST
    if far.any():
        raise InputError(
            f"anchors: anchor {anchors.ids[far][0]} is more than {FARTHEST:g} m from the origin, "
            "where single precision is too coarse; give positions in a frame that begins nearby."
        )
    if network is not None and not isinstance(network, Network):
        raise InputError(
            f"model: {network.name} is an exported correction already; give the network of which "
            "it was made, as train writes it."
        )
    effects = EffectSet() if effects is None else effects
    held = effects.where(is_traceable)
    omitted = [left_out(effect, anchors) for effect in effects if not is_traceable(effect)]
    if not len(held) and network is None:
        raise InputError(
            f"effects: nothing can be exported. {' '.join(map(str, omitted))} Give effects on "
            "TDOAs, or a network."
        )
    samples = samples_of(anchors, held.needs_motion)
    found = Corrector(anchors, held, network).prediction(samples)
    columns = found.bias, found.std, found.slope, found.status
    outputs = [one for values in columns for one in expressions_of(samples, values)]
    floor = tuple(FloorWeight(one.values) for one in effects if isinstance(one, FloorMultipath))
    return TracedCorrection(anchors, held, network, outputs, tuple(omitted), EffectSet(floor))


def is_traceable(effect: Effect) -> bool:
    """Return whether a Corrector corrects an effect, or widens the noise by it, from its inputs."""
    kind = type(effect)
    acts = kind.bias is not Effect.bias or kind.noise_std is not Effect.noise_std
    usable = effect.usable and not effect.is_hypothesis
    return acts and usable and "tdoa" in effect.channels
