# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a correction computes for one TDOA: expressions of single numbers, and their list.

An Expression is recorded by `tracing`. Its kinds have the meaning of numpy, NaN included:

input     one column of the input table; `value` is its name
constant  `value` is (1,), or (N * N,) with a number or a boolean for each pair of anchors; the pair
          in rows a and b of the anchors has row a * N + b
pieces    a function of its input; `value` is its Pieces
network   one output of an ONNX model; `value` is (Session, number of the output)
Other kinds are the elementwise functions of ELEMENTWISE. Comparisons and logic give booleans.

A Program is the list of all Scalars that some Expressions need, which both printers print. A Scalar
is an Expression whose inputs are places in the list, and whose constants are of three kinds:

constant  `value` is the number, float32
anchor    `value` is (end, bytes of N float32): the number of the anchor at this end, "a" or "b"
pair      `value` is the bytes of (N, N) float32: the number of the pair
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

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
