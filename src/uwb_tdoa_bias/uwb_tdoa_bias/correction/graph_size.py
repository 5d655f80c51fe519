"""The shape of every value of an ONNX graph, and what a row of its input costs: found before onnxruntime sees the graph.

A graph comes from anywhere. So its operators, and their attributes, are those of a list; each row of the output follows from one row
of the input; and the numbers and the work of a row are bounded (`limits`). No operator takes constants alone, so nothing unfolds while
onnxruntime folds constants. What does not fit is Unplayable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..foundation.limits import MODEL_NODES, MODEL_NUMBERS, MODEL_WORK
from .onnx_file import Graph, Node, Shape

Attributes = dict[str, tuple[str, ...]]  # of each operator

# Operators with their attributes. Of one value: as many numbers come out as go in, each follows from its own, or from its own row.
UNARY: Attributes = {name: () for name in "Identity Abs Neg Exp Log Sqrt Sin Cos Tanh Relu Sigmoid Erf".split()}
UNARY |= {name: () for name in "Softplus Softsign Reciprocal Floor Ceil Sign".split()}
UNARY |= {"LeakyRelu": ("alpha",), "Elu": ("alpha",), "Celu": ("alpha",), "Selu": ("alpha", "gamma"), "HardSigmoid": ("alpha", "beta")}
OF_ROWS: Attributes = {"Softmax": ("axis",), "LogSoftmax": ("axis",)}
ELEMENTWISE: Attributes = {name: () for name in "Add Sub Mul Div Max Min Sum".split()}  # of two and more
OTHERS: Attributes = {
    "MatMul": (), "Gemm": ("alpha", "beta", "transA", "transB"), "Gather": ("axis",), "Reshape": ("allowzero",), "Concat": ("axis",),
    "ReduceSum": ("axes", "keepdims", "noop_with_empty_axes"), "ReduceMax": ("axes", "keepdims", "noop_with_empty_axes"),
    "Clip": ("min", "max"), "Constant": ("value",),
}  # fmt: skip
ATTRIBUTES = UNARY | ELEMENTWISE | OTHERS | OF_ROWS
PACKED = 4  # numbers that onnxruntime adds up at a time


class Unplayable(ValueError):
    """The graph has an operator, or a use of one, that is not played here, or is too large."""


def _refuse_if(wrong: object, why: str) -> None:
    if wrong:
        raise Unplayable(why)


@dataclass(frozen=True)
class Size:
    """width : columns of the input; outputs : of the output; alone : whether each row has to be played by itself to get the same bits
    whatever comes with it."""

    width: int
    outputs: int
    alone: bool


def size_of(graph: Graph) -> Size:
    """The Size of a graph. Raises Unplayable."""
    _refuse_if(len(graph.inputs) != 1 or len(graph.outputs) != 1 or len(graph.inputs[0][1]) != 2, "more than one input or output")
    (name, (rows, width)) = graph.inputs[0]
    if not width:
        raise Unplayable("an input of unknown width")
    walk = _Walk(graph.constants, name, width)
    for node in graph.nodes:
        try:
            walk.pass_over(node)
        except Unplayable:
            raise
        except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:  # an input or an attribute lacks or is none
            raise Unplayable(f"{node.kind[:40]!r} cannot be used so, {error!r}") from error
    walk.compare(graph.shapes, rows)
    outputs, of_one = walk.value(graph.outputs[0])
    _refuse_if(of_one != 1, "an output with other rows than the input")
    return Size(width, outputs, walk.alone or rows == 1)


class _Walk:
    """What is known after some nodes. A value has columns, and so many rows of them for each row of the input."""

    def __init__(self, constants: dict[str, np.ndarray], name: str, width: int) -> None:
        self._constants = dict(constants)
        self._values: dict[str, tuple[int, int]] = {}
        self._numbers = self._work = self._operations = 0  # of one row of the input, so far
        self.alone = False
        self._put(name, width, 1, 0)

    def value(self, name: str) -> tuple[int, int]:
        """(columns, rows for each row of the input)."""
        _refuse_if(name not in self._values, f"{name[:40]!r} is no value")
        return self._values[name]

    def compare(self, shapes: list[tuple[str, Shape]], rows: int | None) -> None:
        """Raises Unplayable unless what a file says of its values is what they are, as onnxruntime believes it. rows : of the input, or
        None."""
        for name, shape in shapes:
            columns, of_one = self._values.get(name, (None, None))
            known = None if rows is None or of_one is None else rows * of_one, columns
            _refuse_if(
                columns and (len(shape) != 2 or any(said not in (None, true) for said, true in zip(shape, known))),
                f"{name[:40]!r} has another shape than the file says",
            )

    def pass_over(self, node: Node) -> None:
        """Add what a node makes."""
        kind, (name,) = node.kind, node.outputs
        _refuse_if(kind not in ATTRIBUTES, f"operator {kind[:40]!r} is none of {', '.join(ATTRIBUTES)}")
        _refuse_if(
            not {*node.attributes} <= {*ATTRIBUTES[kind]},
            f"{kind!r} has an attribute that is none of {', '.join(ATTRIBUTES[kind]) or 'none'}",
        )
        _refuse_if(not name or name in self._values or name in self._constants, f"{name[:40]!r} is made twice")
        if kind == "Constant":
            self._constants[name] = np.asarray(node.attributes["value"])
            return
        rule = getattr(self, f"_of_{kind.lower()}", self._of_elementwise if kind in ELEMENTWISE else self._of_unary)
        columns, rows, inner = rule(node)
        self._operations += max(1, len(node.inputs) - 1)
        self._put(name, columns, rows, columns * rows * inner)

    def _put(self, name: str, columns: int, rows: int, work: int) -> None:
        self._numbers, self._work = self._numbers + columns * rows, self._work + work
        _refuse_if(columns < 1 or self._numbers > MODEL_NUMBERS, f"no column, or more than {MODEL_NUMBERS} numbers for each row")
        _refuse_if(
            self._work > MODEL_WORK or self._operations > MODEL_NODES,
            f"more than {MODEL_WORK} additions and multiplications for each row, or {MODEL_NODES} operations",
        )
        self._values[name] = columns, rows

    def _constant(self, name: str) -> np.ndarray:
        _refuse_if(name not in self._constants, f"{name[:40]!r} is no constant")
        return self._constants[name]

    def _fits(self, name: str, columns: int) -> None:
        """Raises Unplayable unless a constant is the same for all rows, of so many columns or one."""
        array = self._constant(name)
        _refuse_if(
            array.dtype != np.float32 or array.size not in (1, columns) or array.shape[:-1] not in ((), (1,)),
            "a constant that differs between rows",
        )

    # Each rule: (columns, rows for each row of the input, additions or multiplications for each number that comes out).

    def _of_unary(self, node: Node) -> tuple[int, int, int]:
        (name,) = node.inputs
        _refuse_if(node.attributes.get("axis", -1) not in (-1, 1), "rows of the input that mix")
        return *self.value(name), 1

    def _of_clip(self, node: Node) -> tuple[int, int, int]:
        name, *limits = node.inputs
        for limit in filter(None, limits):
            self._fits(limit, 1)
        return *self.value(name), 2

    def _of_elementwise(self, node: Node) -> tuple[int, int, int]:
        _refuse_if(len(node.inputs) < 2, "less than two operands")
        values = [self._values[name] for name in node.inputs if name in self._values]
        _refuse_if(len({rows for _, rows in values}) != 1, "rows that do not fit")
        constants = [name for name in node.inputs if name not in self._values]
        columns = max(max(own for own, _ in values), *(self._constant(name).size for name in constants), 1)
        _refuse_if(any(own not in (1, columns) for own, _ in values), "columns that do not fit")
        for name in constants:
            self._fits(name, columns)
        return columns, values[0][1], len(node.inputs) - 1

    def _of_matmul(self, node: Node) -> tuple[int, int, int]:
        name, weights = node.inputs
        return self._product(name, self._constant(weights))

    def _of_gemm(self, node: Node) -> tuple[int, int, int]:
        name, of_weights, *added = node.inputs
        _refuse_if(node.attributes.get("transA", 0) != 0, "rows of the input that mix")
        weights = self._constant(of_weights)
        columns, rows, inner = self._product(name, weights.T if node.attributes.get("transB", 0) else weights)
        for one in filter(None, added):
            self._fits(one, columns)
        return columns, rows, inner + len(added)

    def _product(self, name: str, weights: np.ndarray) -> tuple[int, int, int]:
        inner, rows = self.value(name)
        _refuse_if(weights.dtype != np.float32 or weights.ndim != 2 or len(weights) != inner, "a product that does not fit")
        return weights.shape[1], rows, inner

    def _of_gather(self, node: Node) -> tuple[int, int, int]:
        name, of_taken = node.inputs
        (own, rows), taken = self.value(name), self._constant(of_taken)
        _refuse_if(
            node.attributes.get("axis", 0) != 1 or taken.ndim != 1 or not ((0 <= taken) & (taken < own)).all(),
            "other than columns taken",
        )
        return len(taken), rows, 1

    def _of_reshape(self, node: Node) -> tuple[int, int, int]:
        name, shape = node.inputs
        (own, rows), shape = self.value(name), self._constant(shape).tolist()
        _refuse_if(len(shape) != 2 or shape[0] != -1 or shape[1] < 1 or own * rows % shape[1], "a shape in which rows of the input mix")
        return shape[1], own * rows // shape[1], 1

    def _of_concat(self, node: Node) -> tuple[int, int, int]:
        parts = [self.value(name) for name in node.inputs]
        rows = {rows for _, rows in parts}
        _refuse_if(node.attributes.get("axis") not in (1, -1) or len(rows) != 1, "rows that do not fit")
        return sum(columns for columns, _ in parts), rows.pop(), 1

    def _of_reducesum(self, node: Node) -> tuple[int, int, int]:
        columns, rows, inner = self._of_reducemax(node)
        # In which order numbers of a row are added depends on where in memory the row begins, unless they fill whole packets.
        self.alone |= inner >= PACKED and inner % PACKED != 0
        return columns, rows, inner

    def _of_reducemax(self, node: Node) -> tuple[int, int, int]:
        name, *given = node.inputs
        axes = node.attributes.get("axes") or (self._constant(given[0]).tolist() if given else None)
        _refuse_if(axes not in ([1], [-1]) or node.attributes.get("keepdims", 1) != 1, "other than rows reduced")
        own, rows = self.value(name)
        return 1, rows, own
