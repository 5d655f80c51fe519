"""What a row of a graph costs, and which graphs are not played."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402
from onnx_models import model  # noqa: E402
from uwb_tdoa_bias.correction.graph_size import Size, Unplayable, size_of  # noqa: E402
from uwb_tdoa_bias.correction.network import MODELS  # noqa: E402
from uwb_tdoa_bias.correction.onnx_file import read_graph  # noqa: E402


def size(path):
    return size_of(read_graph(path))


def test_sizes(tmp_path):
    assert size(MODELS / "default.onnx") == Size(14, 3, False)
    assert size(model(tmp_path / "m", [("Gemm", ["x", "W", "c"], ["y"], {})])) == Size(5, 7, False)
    assert size(model(tmp_path / "m", [("Gemm", ["x", "W", "c"], ["y"], {})], batch=1)) == Size(5, 7, True)
    summed = [("ReduceSum", ["x", "a"], ["y"], {"keepdims": 1})]
    assert [size(model(tmp_path / "m", summed, width)).alone for width in (1, 3, 4, 5, 7, 8)] == [False, False, False, True, True, False]
    apart = [("Reshape", ["x", "s"], ["h"], {}), ("Concat", ["h", "h"], ["g"], {"axis": 1}), ("Reshape", ["g", "wide"], ["y"], {})]
    assert size(model(tmp_path / "m", apart, wide=np.array([-1, 10]))).outputs == 10


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([("Softmax", ["x"], ["y"], {"axis": 0})], "mix"),
        ([("Gemm", ["x", "W"], ["y"], {"transA": 1})], "mix"),
        ([("Reshape", ["x", "u"], ["y"], {})], "mix"),
        ([("Reshape", ["x", "s"], ["y"], {})], "an output with other rows"),
        ([("Reshape", ["x", "s"], ["h"], {}), ("Add", ["x", "h"], ["y"], {})], "rows that do not fit"),
        ([("ReduceSum", ["x", "zero"], ["y"], {"keepdims": 1})], "other than rows reduced"),
        ([("ReduceSum", ["x"], ["y"], {"noop_with_empty_axes": 1})], "other than rows reduced"),
        ([("Add", ["x", "rows"], ["y"], {})], "differs between rows|columns that do not fit"),
        ([("Add", ["x", "deep"], ["y"], {})], "differs between rows|columns that do not fit"),
        ([("Clip", ["x", "row"], ["y"], {})], "differs between rows|columns that do not fit"),
        ([("Add", ["one", "one"], ["y"], {})], "rows that do not fit"),
        ([("Concat", ["row", "row"], ["h"], {"axis": 1}), ("Add", ["x", "h"], ["y"], {})], "no value"),
        ([("MatMul", ["x", "c"], ["y"], {})], "a product that does not fit"),
        ([("Exp", ["x"], ["y"], {}), ("Exp", ["x"], ["y"], {})], "made twice"),
        ([("Exp", ["x"], ["x"], {})], "made twice"),
        ([("Add", ["x", "row"], ["row"], {})], "made twice"),
        ([("Add", ["x", "row"], ["y"], {"axis": 0})], "an attribute that is none of none"),
        ([("Concat", ["x", "x"], ["y"], {"axis": 0})], "rows that do not fit"),
        ([("Gather", ["x", "i"], ["y"], {"axis": 0})], "other than columns taken"),
        ([("Softmax", ["x"], ["y", "z"], {})], "cannot be used so|too many values"),
    ],
)
def test_what_is_refused(tmp_path, nodes, said):
    constants = {"u": np.array([-1, 2]), "zero": np.array([0]), "rows": np.ones((2, 5), np.float32), "deep": np.ones((1, 2, 5), np.float32)}
    with pytest.raises(Unplayable, match=said):
        size(model(tmp_path / "model.onnx", nodes, **constants))


@pytest.mark.parametrize("shape", [["n", 7], ["n", 5, 1], [4, 5], [5], [-1, 5]])
def test_what_a_file_says_of_its_values_has_to_be_so(tmp_path, shape):
    """onnxruntime builds upon it."""
    path = model(tmp_path / "model.onnx", [("Exp", ["x"], ["h"], {}), ("Exp", ["h"], ["y"], {})])
    for said in (["n", 5], None, ["m", None], shape):
        whole = onnx.load(path)
        whole.graph.value_info.append(helper.make_tensor_value_info("h", TensorProto.FLOAT, said))
        (tmp_path / "said.onnx").write_bytes(whole.SerializeToString())
        if said is not shape:
            assert size(tmp_path / "said.onnx").outputs == 5
    with pytest.raises(Unplayable, match="'h' has another shape"):
        size(tmp_path / "said.onnx")
