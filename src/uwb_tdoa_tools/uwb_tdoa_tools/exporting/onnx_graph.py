# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write ONNX graphs of plain operators."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from onnx import NodeProto, TensorProto, checker, compose, helper, numpy_helper

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.text import version

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike
    from onnx import ModelProto

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

    def total(self, values: Sequence[str]) -> str:
        """Sum tensors of one shape."""
        return values[0] if len(values) == 1 else self.op("Sum", *values)

    def row_sum(self, value: str) -> str:
        """Sum along each row: (n, 1)."""
        return self.op("ReduceSum", value, self.constant([1], np.int64), keepdims=1)

    def distance2(self, points: str, centres: np.ndarray) -> str:
        """Return squared distances (n, m) from points (n, k) to fixed centres (m, k)."""
        cross = self.op("MatMul", points, -2.0 * centres.T)
        own = self.row_sum(self.op("Mul", points, points))
        far = self.op("Add", self.op("Add", cross, own), np.sum(centres**2, axis=1)[None])
        return self.op("Max", far, [0.0])

    def model(self, width: int, outputs: Sequence[str], meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model.

        Parameters
        ----------
        width : int
            Number of input columns.
        outputs : sequence of str
            Tensors (n, 1) that are concatenated as output.
        meta : mapping
            Metadata, stored as JSON.
        """
        self._nodes.append(helper.make_node("Concat", outputs, [self._output], axis=1))
        return self.whole(width, len(outputs), meta)

    def whole(self, width: int, outputs: int, meta: Mapping[str, Any]) -> ModelProto:
        """Return the ONNX model whose last operator gives the output, (n, outputs)."""
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
