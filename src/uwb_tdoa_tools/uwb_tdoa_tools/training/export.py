"""ONNX files: a graph written node by node with plain operators, and the metadata that Network
reads.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from onnx import NodeProto, TensorProto, checker, helper, numpy_helper

from uwb_tdoa_bias.foundation.version import version

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike
    from onnx import ModelProto

OPSET, IR_VERSION = 13, 8  # whose operators `trial.py` lists


class GraphBuilder:
    """An ONNX graph under construction.

    Values are the names of its tensors, (n, k) float unless said otherwise.
    """

    def __init__(self) -> None:
        self._nodes: list[NodeProto] = []
        self._constants: list[TensorProto] = []
        self.input = "features"

    def constant(self, value: ArrayLike, kind: type[np.generic] = np.float32) -> str:
        """A tensor of fixed values."""
        self._constants.append(
            numpy_helper.from_array(np.asarray(value, dtype=kind), f"c{len(self._constants)}")
        )
        return self._constants[-1].name

    def op(self, kind: str, *inputs: Any, **attributes: Any) -> str:
        """Append an operator; inputs that are no names become constants.

        Returns the name of its output.
        """
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        self._nodes.append(helper.make_node(kind, names, [f"v{len(self._nodes)}"], **attributes))
        return self._nodes[-1].output[0]

    def take(self, value: str, columns: Iterable[int]) -> str:
        """Some columns of a tensor."""
        return self.op("Gather", value, self.constant(list(columns), np.int64), axis=1)

    def rows(self, value: str, width: int) -> str:
        """A tensor with rows of another width, in the same order of numbers."""
        return self.op("Reshape", value, self.constant([-1, width], np.int64))

    def total(self, values: Sequence[str]) -> str:
        """Sum of tensors of one shape."""
        return values[0] if len(values) == 1 else self.op("Sum", *values)

    def row_sum(self, value: str) -> str:
        """Sum along each row: (n, 1)."""
        return self.op("ReduceSum", value, self.constant([1], np.int64), keepdims=1)

    def distance2(self, points: str, centres: np.ndarray) -> str:
        """Squared distances (n, m) from points (n, k) to fixed centres, (m, k) array."""
        cross = self.op("MatMul", points, -2.0 * centres.T)
        own = self.row_sum(self.op("Mul", points, points))
        far = self.op("Add", self.op("Add", cross, own), np.sum(centres**2, axis=1)[None])
        return self.op("Max", far, [0.0])

    def model(self, width: int, outputs: Sequence[str], meta: Mapping[str, Any]) -> ModelProto:
        """The onnx.ModelProto: `width` input columns, the named (n, 1) tensors beside each other as
        output, metadata.
        """
        self._nodes.append(helper.make_node("Concat", outputs, ["bias"], axis=1))
        graph = helper.make_graph(
            self._nodes,
            "bias",
            [helper.make_tensor_value_info(self.input, TensorProto.FLOAT, ["n", width])],
            [helper.make_tensor_value_info("bias", TensorProto.FLOAT, ["n", len(outputs)])],
            self._constants,
        )
        about = {"producer_name": "uwb_tdoa", "producer_version": version()}
        made = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, **about
        )
        helper.set_model_props(made, {key: json.dumps(value) for key, value in meta.items()})
        checker.check_model(made)
        return made
