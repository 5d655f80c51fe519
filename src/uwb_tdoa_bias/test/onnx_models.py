# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small ONNX files for tests. Needs the onnx package."""

import numpy as np
from onnx import TensorProto, helper, numpy_helper

COLUMN = np.array([[0.5], [-1.0], [2.0], [0.25], [1.5]], np.float32)
WEIGHTS = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)
CONSTANTS = {
    "W": WEIGHTS,
    "WT": np.ascontiguousarray(WEIGHTS.T),
    "C": COLUMN,
    "c": np.arange(7, dtype=np.float32),
    "r": np.float32([1, 2, 3, 4, 5]),
    "i": np.array([4, 0, 0]),
    "s": np.array([-1, 1]),
    "t": np.array([-1, 5]),
    "a": np.array([1]),
    "low": np.float32([-0.5]),
    "high": np.float32([0.75]),
    "one": np.float32([1.5]),
    "row": np.float32([[1, 2, 0.5, -1, 3]]),
}


def model(path, nodes, width=5, opset=13, batch="n", **constants):
    """Write a model with metadata and return its path.

    The input is "x". The output is the output of the last node.

    Parameters
    ----------
    nodes : list of (kind, inputs, outputs, attributes)
        Nodes of the graph.
    constants : array
        Constants by name, in addition to CONSTANTS. The graph keeps the ones that a node uses.
    """
    made = [
        helper.make_node(kind, inputs, outputs, **more) for kind, inputs, outputs, more in nodes
    ]
    named = {name for node in made for name in node.input}
    graph = helper.make_graph(
        made,
        "test",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [batch, width])],
        [helper.make_tensor_value_info(nodes[-1][2][0], TensorProto.FLOAT, None)],
        [
            numpy_helper.from_array(np.asarray(value), name)
            for name, value in (CONSTANTS | constants).items()
            if name in named
        ],
    )
    whole = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(whole, {"name": '"test"', "text": "ä"})
    path.write_bytes(whole.SerializeToString())
    return path
