# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print a TracedCorrection as an ONNX file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_bytes
from uwb_tdoa_bias.common.limits import MODEL_BYTES
from uwb_tdoa_bias.common.text import version
from uwb_tdoa_bias.correction.model import INPUTS, OUTPUTS, Model
from uwb_tdoa_bias.correction.trial import Unplayable, tried_out
from uwb_tdoa_bias.effects import EffectSet

from .correction import TracedCorrection, trace
from .graph import Node, ordered

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

    def constant(self, value: ArrayLike, kind: type[np.generic] = np.float32) -> str:
        """Add a constant tensor."""
        self._constants.append(
            numpy_helper.from_array(np.asarray(value, dtype=kind), f"c{len(self._constants)}")
        )
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

    def take(self, value: str, columns: Iterable[int]) -> str:
        """Select columns."""
        return self.op("Gather", value, self.constant(list(columns), np.int64), axis=1)

    def reshaped(self, value: str, *shape: int) -> str:
        """Reshape; 0 keeps the length of an axis."""
        return self.op("Reshape", value, self.constant(shape, np.int64))

    def row_sum(self, value: str) -> str:
        """Sum along each row: (n, 1)."""
        return self.op("ReduceSum", value, self.constant([1], np.int64), keepdims=1)

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

    Raises InputError if the correction cannot be traced, or if no node would load the file.
    """
    traced = trace(anchors, effects, network)
    content = printed(traced).SerializeToString()
    _try_out(content)
    write_bytes(path, content)
    return traced


def _try_out(content: bytes) -> None:
    """Raise InputError unless the content of a file passes the trial of all models."""
    try:
        if len(content) > MODEL_BYTES:
            raise Unplayable(f"it has {len(content)} bytes, more than {MODEL_BYTES}")
        tried_out(content)
    except Unplayable as error:
        raise InputError(
            f"effects: no node would load this correction ({error}); export fewer effects, or the "
            "anchors of one area."
        ) from error


def printed(traced: TracedCorrection) -> ModelProto:
    """Return the ONNX model of a TracedCorrection, checked by onnx."""
    return _Printer(traced).model()


def _is_constant(table: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return which columns of a table (N, N, k) are `some` in all rows, (k,)."""
    same = (table == some) | (np.isnan(table) & np.isnan(some))
    return np.asarray(same.all(axis=(0, 1)))


class _Printer:
    """Prints the nodes of a graph in their order. Tensors are (n, *shape)."""

    def __init__(self, traced: TracedCorrection) -> None:
        self._traced, self._count = traced, len(traced.anchors)
        self._graph = GraphBuilder("state", "correction")
        self._names: dict[int, str] = {}

    def model(self) -> ModelProto:
        graph, outputs = self._graph, self._traced.outputs
        wanted = [outputs[name] for name in ("bias", "std", "slope", "status")]
        nodes, wanted = ordered(wanted)
        known = self._find_anchors(nodes)
        for node in nodes:
            if id(node) not in self._names:
                self._names[id(node)] = self._print(node)
        columns = [self._flat(node) for node in wanted]
        together = graph.op("Concat", *columns, axis=1)
        off = graph.row_sum(graph.op("Sub", together, together))  # NaN unless all are finite
        graph.op("Where", graph.op("And", known, graph.op("Equal", off, [0.0])), together, [0.0])
        return graph.model(len(INPUTS), len(OUTPUTS), self._traced.meta())

    def _find_anchors(self, nodes: list[Node]) -> str:
        """Look up the constants of both anchors; return whether they are two known ones, (n, 1)."""
        graph, ids = self._graph, self._traced.anchors.ids.astype(float)
        one, other = (
            graph.op("Equal", graph.take(graph.input, [COLUMN[name]]), ids[None])
            for name in ("anchor_a", "anchor_b")
        )
        hits_a = graph.op("Where", one, [1.0], [0.0])
        hits_b = graph.op("Where", other, [1.0], [0.0])
        constants = [node for node in nodes if node.kind == "constant" and len(node.value) > 1]
        if constants:
            self._name_constants(constants, hits_a, hits_b)
        found = graph.op("Mul", graph.row_sum(hits_a), graph.row_sum(hits_b))
        same = graph.row_sum(graph.op("Mul", hits_a, hits_b))
        return graph.op("Less", [0.5], graph.op("Sub", found, same))

    def _name_constants(self, nodes: list[Node], hits_a: str, hits_b: str) -> None:
        """Name the constants that depend on the anchors: each number has a row for one or both."""
        graph, count = self._graph, self._count
        values = [node.value.reshape(count, count, -1).astype(float) for node in nodes]
        table = np.concatenate(values, axis=2)
        of_a = _is_constant(table, table[:, :1])
        of_b = _is_constant(table, table[:1]) & ~of_a
        of_both = ~(of_a | of_b)
        rows = [self._look_up(hits_a, table[:, 0, of_a])] if of_a.any() else []
        rows += [self._look_up(hits_b, table[0][:, of_b])] if of_b.any() else []
        if of_both.any():
            first = graph.reshaped(hits_a, 0, count, 1)
            second = graph.reshaped(hits_b, 0, 1, count)
            hits = graph.reshaped(graph.op("Mul", first, second), 0, count**2)
            rows += [self._look_up(hits, table[:, :, of_both].reshape(count**2, -1))]
        joined = graph.op("Concat", *rows, axis=1) if len(rows) > 1 else rows[0]
        columns = np.concatenate([np.flatnonzero(kind) for kind in (of_a, of_b, of_both)])
        place = np.argsort(columns)
        for node in nodes:
            mine, place = place[: node.size], place[node.size :]
            name = graph.take(joined, mine.tolist())
            name = graph.op("Less", [0.5], name) if node.is_bool else name
            self._names[id(node)] = self._shaped(name, node.shape, (node.size,))

    def _look_up(self, hits: str, values: np.ndarray) -> str:
        """Return the row of a table that `hits` has a 1 for.

        A sum over all rows, of which one counts, needs no index that could be wrong. A sum takes no
        NaN: these are put in afterwards.
        """
        graph, unknown = self._graph, np.isnan(values)
        rows = graph.op("MatMul", hits, np.where(unknown, 0.0, values))
        if not unknown.any():
            return rows
        missing = graph.op("Less", [0.5], graph.op("MatMul", hits, unknown.astype(float)))
        return graph.op("Where", missing, [np.nan], rows)

    def _print(self, node: Node) -> str:
        graph = self._graph
        inputs = [self._names[id(one)] for one in node.inputs]
        if node.kind == "input":
            return self._shaped(graph.take(graph.input, [COLUMN[node.value]]), (), (1,))
        if node.kind == "constant":
            return graph.constant(node.value, np.bool_ if node.is_bool else np.float32)
        if node.kind == "pick":
            return self._print_pick(node)
        if node.kind == "sum":
            axis = np.array([len(node.shape) + 1])
            return graph.op("ReduceSum", inputs[0], graph.constant(axis, np.int64), keepdims=0)
        if node.kind == "pieces":
            return inputs[1]
        if node.kind == "network":
            return graph.inlined(load_model_from_string(node.value.content), inputs[0])
        if node.kind == "atan2":
            return self._print_atan2(*inputs)
        return graph.op(OPERATORS[node.kind], *inputs)

    def _print_pick(self, node: Node) -> str:
        graph = self._graph
        if all(one.kind == "input" for one in node.inputs):  # columns of the table
            columns = [COLUMN[one.value] for one in node.inputs]
            name = graph.take(graph.input, np.array(columns)[node.value.ravel()].tolist())
            return self._shaped(name, node.shape, (node.size,))
        flat = [self._flat(one) for one in node.inputs]
        name = graph.op("Concat", *flat, axis=1) if len(flat) > 1 else flat[0]
        total = sum(one.size for one in node.inputs)
        if not np.array_equal(node.value.ravel(), np.arange(total)):
            name = graph.take(name, node.value.ravel().tolist())
        return self._shaped(name, node.shape, (node.size,))

    def _flat(self, node: Node) -> str:
        """Return a tensor (n, size)."""
        if node.kind == "constant" and len(node.value) == 1:  # for all TDOAs alike
            ones = self._graph.op("Equal", self._graph.take(self._graph.input, [0]), [-1.0])
            kind: Any = np.bool_ if node.is_bool else np.float32
            value = self._graph.constant(node.value.reshape(1, -1), kind)
            return self._graph.op("Where", ones, value, value)
        return self._shaped(self._names[id(node)], (node.size,), node.shape)

    def _shaped(self, name: str, shape: tuple[int, ...], known: tuple[int, ...]) -> str:
        if shape == known:
            return name
        return self._graph.reshaped(name, 0, *shape)

    def _print_atan2(self, y: str, x: str) -> str:
        """Return the angle in all quadrants; the sign of a zero counts, as in numpy."""
        graph = self._graph
        angle = graph.op("Atan", graph.op("Div", y, x))
        at_origin = graph.op("And", graph.op("Equal", x, [0.0]), graph.op("Equal", y, [0.0]))
        angle = graph.op("Where", at_origin, [0.0], angle)
        is_below = graph.op("Less", graph.op("Div", [1.0], y), [0.0])
        half_turn = graph.op("Where", is_below, [-np.pi], [np.pi])
        behind = graph.op("Where", graph.op("Less", x, [0.0]), half_turn, [0.0])
        return graph.op("Add", angle, behind)
