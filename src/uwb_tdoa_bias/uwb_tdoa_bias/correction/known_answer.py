"""Makes models/known_answer.onnx, a model that proves the path: anyone can compute what it must
say.

    bias = 0.05 m + 0.02 dx_a + 0.01 m elevation_T_b,  limited to +-1 m

Re-make it, with the onnx package installed:  python -m uwb_tdoa_bias.correction.known_answer known_answer.onnx
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import numpy as np

from ..foundation.files import write_bytes

if TYPE_CHECKING:
    from onnx import ModelProto

# Neither the order of the features nor offset and scale are what a reader that ignores them would
# assume.
FEATURES = ("elevation_T_b", "dx_a")
OFFSET = (0.25, -1.5)  # rad, m
SCALE = (0.5, 4.0)  # rad, m
CLIP = 1.0  # m
SLOPES = (0.01, 0.02)  # m/rad, 1
CONSTANT = 0.05  # m


def known_answer(elevation: float, dx: float) -> float:
    """What the model says, m: elevation of anchor b seen from the tag, rad; dx: anchor a minus tag
    along x, m.
    """
    return np.clip(CONSTANT + SLOPES[0] * elevation + SLOPES[1] * dx, -CLIP, CLIP)


def make() -> ModelProto:
    """The onnx.ModelProto."""
    from onnx import TensorProto, helper, numpy_helper

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


if __name__ == "__main__":
    write_bytes(sys.argv[1], make().SerializeToString())
