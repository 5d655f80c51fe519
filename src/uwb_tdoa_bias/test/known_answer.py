# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A bias network for tests: its output can be computed by hand. Needs the onnx package.

bias = 0.05 m + 0.02 dx_a + 0.01 m elevation_T_b,  limited to +-1 m
"""

import json

import numpy as np
from onnx import TensorProto, helper, numpy_helper

# A reader that ignores the order of the features, the offset or the scale gets a wrong bias.
FEATURES = ("elevation_T_b", "dx_a")
OFFSET = (0.25, -1.5)  # rad, m
SCALE = (0.5, 4.0)  # rad, m
CLIP = 1.0  # m
SLOPES = (0.01, 0.02)  # m/rad, 1
CONSTANT = 0.05  # m


def known_answer(elevation, dx):
    """Return the bias, in m.

    Parameters
    ----------
    elevation : float or array
        Elevation of anchor b seen from the tag, in rad.
    dx : float or array
        Anchor a minus tag along x, in m.
    """
    return np.clip(CONSTANT + SLOPES[0] * elevation + SLOPES[1] * dx, -CLIP, CLIP)


def make():
    """Return the network as an onnx.ModelProto."""
    weight = np.multiply(SLOPES, SCALE).astype(np.float32).reshape(2, 1)
    constant = np.array([CONSTANT + np.dot(SLOPES, OFFSET)], dtype=np.float32)
    graph = helper.make_graph(
        [helper.make_node("Gemm", ["features", "weight", "constant"], ["bias"])],
        "known_answer",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["n", 2])],
        [helper.make_tensor_value_info("bias", TensorProto.FLOAT, ["n", 1])],
        [numpy_helper.from_array(weight, "weight"), numpy_helper.from_array(constant, "constant")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    meta = {
        "features": FEATURES,
        "offset": OFFSET,
        "scale": SCALE,
        "clip": CLIP,
        "name": "known_answer",
    }
    helper.set_model_props(model, {key: json.dumps(value) for key, value in meta.items()})
    return model


def write(folder):
    """Write the model into a folder and return the path of the file."""
    path = folder / "known_answer.onnx"
    path.write_bytes(make().SerializeToString())
    return path
