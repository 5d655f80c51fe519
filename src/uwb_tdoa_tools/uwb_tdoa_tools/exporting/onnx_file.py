# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print a TracedCorrection as an ONNX file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from onnx import (
    ModelProto,
    NodeProto,
    TensorProto,
    checker,
    compose,
    helper,
    load_model_from_string,
    numpy_helper,
)

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import MODEL_BYTES, InputError, version
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_bias.correction.model import INPUTS, OUTPUTS, Model
from uwb_tdoa_bias.correction.trial import Unplayable, tried_out
from uwb_tdoa_bias.effects import EffectSet

from .tracing import Pieces, Program, Scalar, TracedCorrection, trace

# `trial.py` lists the operators of these versions
OPSET, LAST_OPSET, IR_VERSION = 13, 17, 8


class GraphBuilder:
    """Build an ONNX graph from plain operators.

    Values are names of tensors. Tensors are (n, k) of float unless stated otherwise.
    """

    def __init__(self, input_name: str = "features", output_name: str = "bias") -> None:
        """Set the names of the input and of the output."""
        self._nodes: list[NodeProto] = []
        self._constants: list[TensorProto] = []
        self.input, self._output, self._opset = input_name, output_name, OPSET

    def constant(self, value: ArrayLike) -> str:
        """Add a constant tensor: of whole numbers, or of float."""
        numbers = np.asarray(value)
        numbers = numbers.astype(np.int64 if numbers.dtype.kind == "i" else np.float32)
        self._constants.append(numpy_helper.from_array(numbers, f"c{len(self._constants)}"))
        return self._constants[-1].name

    def op(self, kind: str, *inputs: Any, **attributes: Any) -> str:
        """Append an operator and return the name of its output.

        Inputs that are no names become constants.
        """
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        self._nodes.append(helper.make_node(kind, names, [f"v{len(self._nodes)}"], **attributes))
        return self._nodes[-1].output[0]

    def inlined(self, model: ModelProto, value: str) -> str:
        """Append the operators of a whole model with the input `value`; return its output."""
        (declared,) = (one.version for one in model.opset_import if one.domain in ("", "ai.onnx"))
        if not OPSET <= declared <= LAST_OPSET or model.functions:
            raise InputError(
                f"model: it has opset {declared}, or functions of its own; export it with opset "
                f"{OPSET} to {LAST_OPSET}."
            )
        self._opset = max(self._opset, declared)
        inside = compose.add_prefix(model, f"m{len(self._nodes)}_").graph
        weights = {one.name for one in inside.initializer}
        (entry,) = (one.name for one in inside.input if one.name not in weights)
        for node in inside.node:
            node.input[:] = [value if name == entry else name for name in node.input]
        self._constants.extend(inside.initializer)
        self._nodes.extend(inside.node)
        return inside.output[0].name

    def joined(self, values: Sequence[str]) -> str:
        """Join the columns of tensors."""
        return self.op("Concat", *values, axis=1) if len(values) > 1 else values[0]

    def row_sum(self, value: str) -> str:
        """Sum along each row: (n, 1)."""
        return self.op("ReduceSum", value, [1], keepdims=1)

    def model(self, width: int, outputs: int, meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model whose last operator gives the output, (n, outputs).

        Parameters
        ----------
        width : int
            Number of input columns.
        outputs : int
            Number of output columns.
        meta : mapping
            Metadata, stored as JSON.
        """
        self._nodes[-1].output[:] = [self._output]
        graph = helper.make_graph(
            self._nodes,
            self._output,
            [helper.make_tensor_value_info(self.input, TensorProto.FLOAT, ["n", width])],
            [helper.make_tensor_value_info(self._output, TensorProto.FLOAT, ["n", outputs])],
            self._constants,
        )
        about = {"producer_name": "uwb_tdoa", "producer_version": version()}
        made = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", self._opset)],
            ir_version=IR_VERSION,
            **about,
        )
        helper.set_model_props(made, {key: json.dumps(value) for key, value in meta.items()})
        checker.check_model(made, full_check=True)
        return made


OPERATORS = {
    "neg": "Neg",
    "abs": "Abs",
    "sqrt": "Sqrt",
    "exp": "Exp",
    "log": "Log",
    "sin": "Sin",
    "cos": "Cos",
    "floor": "Floor",
    "add": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "div": "Div",
    "max": "Max",
    "min": "Min",
    "lt": "Less",
    "le": "LessOrEqual",
    "eq": "Equal",
    "not": "Not",
    "and": "And",
    "or": "Or",
    "where": "Where",
}
COLUMN = {name: place for place, (name, *_) in enumerate(INPUTS)}


def write_onnx(
    path: str | Path,
    anchors: Anchors,
    effects: EffectSet | None,
    network: Model | None = None,
) -> TracedCorrection:
    """Write the correction of some Anchors as an ONNX file, and return what it holds.

    Its folder is made if needed.
    Raises InputError if the correction cannot be traced, or if no node would load the file.
    """
    traced = trace(anchors, effects, network)
    content = printed(traced).SerializeToString()
    try:
        if len(content) > MODEL_BYTES:
            raise Unplayable(f"it has {len(content)} bytes, more than {MODEL_BYTES}")
        tried_out(content)
    except Unplayable as error:
        raise InputError(
            f"effects: no node would load this correction ({error}); export fewer effects, or the "
            "anchors of one area."
        ) from error
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, content)
    return traced


def printed(traced: TracedCorrection) -> ModelProto:
    """Return the ONNX model of a TracedCorrection, checked by onnx."""
    return _Printer(traced).model()


def steps(scalars: Sequence[Scalar]) -> Iterator[tuple[tuple[Any, ...], list[int]]]:
    """Yield (kind, places) of operations that are computed together, inputs before their users.

    The kind of an elementwise operation is (its name,), that of others ("pieces", Pieces) or
    ("network", Session, places of the inputs). A step takes the most common kind of those that are
    ready: copies of an equation thus proceed in step.
    """
    users = defaultdict(list)
    for place, one in enumerate(scalars):
        for i in set(one.inputs):
            users[i].append(place)
    missing = [len(set(one.inputs)) for one in scalars]
    ready: dict[tuple[Any, ...], list[int]] = {}
    done = [place for place, one in enumerate(scalars) if not one.inputs]
    while True:
        for user in (user for place in done for user in users[place]):
            missing[user] -= 1
            if not missing[user]:
                ready.setdefault(_kind(scalars[user]), []).append(user)
        if not ready:
            return
        kind = max(ready, key=lambda one: len(ready[one]))
        done = ready.pop(kind)
        yield kind, done


def _kind(one: Scalar) -> tuple[Any, ...]:
    if one.kind == "network":
        return one.kind, one.value[0], one.inputs
    return (one.kind, one.value) if one.kind == "pieces" else (one.kind,)


class _Printer:
    """Print the steps of a Program. The results of a step are the columns of a tensor (n, k)."""

    def __init__(self, traced: TracedCorrection) -> None:
        self._traced, self._count = traced, len(traced.anchors)
        self._graph = GraphBuilder("state", "correction")
        self._program = Program(traced.outputs, self._count)
        self._scalars = self._program.scalars
        self._widths: dict[str, int] = {}  # columns of the tensors
        self._at: dict[int, tuple[str, int]] = {}  # places of Scalars: tensor and column

    def model(self) -> ModelProto:
        graph = self._graph
        known = self._leaves()
        for kind, places in steps(self._scalars):
            inputs = zip(*(self._scalars[place].inputs for place in places))
            if kind[0] == "network":
                columns = [self._scalars[place].value[1] for place in places]
                model = load_model_from_string(kind[1].content)
                made = graph.inlined(model, self._columns(kind[2]))
                self._keep(made, kind[1].outputs, zip(places, columns))
                continue
            self._keep_all(self._operation(kind, *map(self._columns, inputs)), places)
        together = self._gathered(self._program.outputs)
        off = graph.row_sum(graph.op("Sub", together, together))  # NaN unless all are finite
        graph.op("Where", graph.op("And", known, graph.op("Equal", off, [0.0])), together, [0.0])
        return graph.model(len(INPUTS), len(OUTPUTS), self._traced.meta())

    def _keep(self, tensor: str, width: int, columns: Iterable[tuple[int, int]]) -> None:
        """Remember a tensor of some columns. columns : (place of a Scalar, its column)"""
        self._widths[tensor] = width
        self._at.update({place: (tensor, column) for place, column in columns})

    def _columns(self, places: Sequence[int]) -> str:
        """Return a tensor with some Scalars in its columns; of constants it has one row."""
        some = [self._scalars[place] for place in places]
        if all(one.kind == "constant" for one in some):
            return self._graph.constant([[one.value for one in some]])
        return self._gathered(places)

    def _gathered(self, places: Sequence[int]) -> str:
        """Return a tensor (n, k) with k Scalars in its columns."""
        found = [self._at[place] for place in places]
        tensors = list(dict.fromkeys(tensor for tensor, _ in found))
        widths = [self._widths[tensor] for tensor in tensors]
        starts = dict(zip(tensors, np.cumsum([0, *widths]).tolist()))
        name = self._graph.joined(tensors)
        index = [starts[tensor] + column for tensor, column in found]
        is_whole = index == list(range(sum(widths)))
        return name if is_whole else self._graph.op("Gather", name, index, axis=1)

    def _leaves(self) -> str:
        """Find inputs and constants; return whether the anchors are two known ones, (n, 1)."""
        graph, count = self._graph, self._count
        leaves = defaultdict(list)
        for place, one in enumerate(self._scalars):
            if not one.inputs:
                leaves[one.value[0] if one.kind == "anchor" else one.kind].append(place)
        columns = [(place, COLUMN[self._scalars[place].value]) for place in leaves["input"]]
        self._keep(graph.input, len(INPUTS), columns)
        if leaves["constant"]:
            row = [[self._scalars[place].value for place in leaves["constant"]]]
            never = graph.op("Equal", graph.op("Gather", graph.input, [0], axis=1), [-1.0])
            self._keep_all(graph.op("Where", never, row, row), leaves["constant"])
        ids = self._traced.anchors.ids.astype(float)[None]
        hits = {}
        for end in "ab":
            of_end = graph.op("Gather", graph.input, [COLUMN[f"anchor_{end}"]], axis=1)
            is_here = graph.op("Equal", of_end, ids)
            hits[end] = graph.op("Where", is_here, [1.0], [0.0])
            values = [self._scalars[place].value[1] for place in leaves[end]]
            self._look_up(hits[end], leaves[end], values)
        if leaves["pair"]:
            first = graph.op("Reshape", hits["a"], [0, count, 1])  # 0 keeps the length of an axis
            second = graph.op("Reshape", hits["b"], [0, 1, count])
            both = graph.op("Reshape", graph.op("Mul", first, second), [0, count**2])
            values = [self._scalars[place].value for place in leaves["pair"]]
            self._look_up(both, leaves["pair"], values)
        found = graph.op("Mul", *map(graph.row_sum, hits.values()))
        same = graph.row_sum(graph.op("Mul", *hits.values()))
        return graph.op("Less", [0.5], graph.op("Sub", found, same))

    def _keep_all(self, tensor: str, places: list[int]) -> None:
        self._keep(tensor, len(places), zip(places, range(len(places))))

    def _look_up(self, hits: str, places: list[int], values: list[bytes]) -> None:
        """Look up some constants in the row of a table that `hits` has a 1 for.

        A sum over all rows, of which one counts, needs no index that could be wrong. A sum takes no
        NaN: these are put in afterwards.
        """
        if not places:
            return
        graph, table = self._graph, np.stack([np.frombuffer(one, np.float32) for one in values]).T
        unknown = np.isnan(table)
        rows = graph.op("MatMul", hits, np.where(unknown, 0.0, table))
        if unknown.any():
            missing = graph.op("Less", [0.5], graph.op("MatMul", hits, unknown.astype(float)))
            rows = graph.op("Where", missing, [np.nan], rows)
        self._keep_all(rows, places)

    def _operation(self, kind: tuple[Any, ...], *inputs: str) -> str:
        if kind[0] == "atan2":
            return self._atan2(*inputs)
        if kind[0] == "pieces":
            return self._pieces(kind[1], *inputs)
        return self._graph.op(OPERATORS[kind[0]], *inputs)

    def _pieces(self, pieces: Pieces, x: str) -> str:
        """Return the sum of what a function gains in each of its pieces."""
        graph, breaks = self._graph, np.array(pieces.breaks)
        above = graph.op("Sub", graph.op("Reshape", x, [0, -1, 1]), breaks[:-1])
        inside = graph.op("Min", graph.op("Max", above, [0.0]), np.diff(breaks))
        _, *first, last = np.array(pieces.table).T
        value = graph.op("Mul", inside, last)
        for power in first[::-1]:
            value = graph.op("Mul", graph.op("Add", value, power), inside)
        return graph.op("ReduceSum", value, [2], keepdims=0)

    def _atan2(self, y: str, x: str) -> str:
        """Return the angle in all quadrants; the sign of a zero counts, as in numpy."""
        graph = self._graph
        angle = graph.op("Atan", graph.op("Div", y, x))
        at_origin = graph.op("And", graph.op("Equal", x, [0.0]), graph.op("Equal", y, [0.0]))
        angle = graph.op("Where", at_origin, [0.0], angle)
        is_below = graph.op("Less", graph.op("Div", [1.0], y), [0.0])
        half_turn = graph.op("Where", is_below, [-np.pi], [np.pi])
        behind = graph.op("Where", graph.op("Less", x, [0.0]), half_turn, [0.0])
        return graph.op("Add", angle, behind)
