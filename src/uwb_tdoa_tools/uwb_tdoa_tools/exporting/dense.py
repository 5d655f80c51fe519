# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A dense network, out of an ONNX file, for sequential code."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import onnx
from onnx import numpy_helper

if TYPE_CHECKING:
    from uwb_tdoa_bias.correction.session import Session

ACTIVATIONS = ("Relu",)


class Unsupported(ValueError):
    """The network is not a chain of dense layers."""


class Dense:
    """Layers of a network: y = activation(weights^T x + biases).

    Attributes
    ----------
    layers : list of (weights (i, o), biases (o,), name of the activation or "")
    constants : numbers that are appended to the output of the last layer
    """

    def __init__(self, content: bytes) -> None:
        """Read an ONNX file; raise Unsupported."""
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
                raise Unsupported(f"it has the operator {node.op_type}")
        if not self.layers or chain != graph.output[0].name:
            raise Unsupported("it is no chain of layers")

    @classmethod
    def of(cls, session: Session) -> Dense:
        """Return the network of a Session; the same object for the same content."""
        return _dense(session.content)

    @property
    def widest(self) -> int:
        """Return the largest number of values of a layer."""
        return max(len(biases) for _, biases, _ in self.layers)

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Return outputs (n, k) float32 of inputs (n, i); each sum adds its terms one by one."""
        for weights, biases, activation in self.layers:
            total = np.repeat(biases[None], len(x), axis=0)
            for k, row in enumerate(weights):
                total = total + x[:, k, None] * row
            x = np.where(total <= 0.0, np.float32(0.0), total) if activation else total  # NaN stays
        constants = np.array(self.constants, dtype=np.float32)
        return np.concatenate([x, np.tile(constants, (len(x), 1))], axis=1)


@lru_cache(maxsize=8)
def _dense(content: bytes) -> Dense:
    return Dense(content)
