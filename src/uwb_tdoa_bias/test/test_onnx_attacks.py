"""Models that were made to run, hang or fill: each is refused at once, with the reason."""

import json
import time
import tracemalloc

import numpy as np
import pytest
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.limits import MODEL_BYTES

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

AT_ONCE = 2.0  # s of processor time
META = {"features": ["dx_a", "dy_a"], "offset": [0, 0], "scale": [1, 1], "clip": 1, "name": "attack"}
NODE = helper.make_node
SAME = NODE("Identity", ["x"], ["y"])
COLUMN = numpy_helper.from_array(np.ones((2, 1), np.float32), "column")


def model(*nodes, constants=(), width=2, meta=META, **more):
    """ModelProto whose output is that of the last node."""
    graph = helper.make_graph(
        nodes, "attack", [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", width])],
        [helper.make_tensor_value_info(nodes[-1].output[0], TensorProto.FLOAT, None)], constants,
    )  # fmt: skip
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8, **more)
    helper.set_model_props(made, {key: json.dumps(value) for key, value in meta.items()})
    return made


def doubling(count=30, *before):
    """A kilobyte that becomes 2^count columns."""
    return model(*before, *(NODE("Concat", [f"v{k}" if k or before else "x"] * 2, [f"v{k + 1}"], axis=1) for k in range(count)))


def looping():
    kinds = {"i": TensorProto.INT64, "go": TensorProto.BOOL, "last": TensorProto.FLOAT}
    inputs = [helper.make_tensor_value_info(name, kind, None) for name, kind in kinds.items()]
    outputs = [helper.make_tensor_value_info(name, kind, None) for name, kind in (("go", TensorProto.BOOL), ("next", TensorProto.FLOAT))]
    body = helper.make_graph([NODE("Add", ["last", "last"], ["next"])], "body", inputs, outputs)
    count = numpy_helper.from_array(np.array(2**62), "count")
    return model(NODE("Loop", ["count", "", "x"], ["y"], body=body), constants=[count])


def branching():
    branch = helper.make_graph([NODE("Exp", ["x"], ["z"])], "branch", [], [helper.make_tensor_value_info("z", TensorProto.FLOAT, None)])
    return model(NODE("Identity", ["x"], ["y"], then_branch=branch, else_branch=branch))


def read_elsewhere():
    """The weights are bytes of a file of the user."""
    weights = onnx.TensorProto(name="column", data_type=TensorProto.FLOAT, dims=[2, 1], data_location=TensorProto.EXTERNAL)
    weights.external_data.add(key="location", value="../../etc/passwd")
    return model(NODE("MatMul", ["x", "column"], ["y"]), constants=[weights])


def read_elsewhere_in_a_node():
    weights = read_elsewhere().graph.initializer[0]
    return model(NODE("Constant", [], ["column"], value=weights), NODE("MatMul", ["x", "column"], ["y"]))


def recursive():
    function = helper.make_function(
        "own", "Twice", ["x"], ["y"], [NODE("Twice", ["x"], ["y"], domain="own")], [helper.make_opsetid("own", 1)]
    )
    return model(NODE("Twice", ["x"], ["y"], domain="own"), functions=[function])


def sparse():
    made = model(SAME)
    values, at = numpy_helper.from_array(np.ones(1, np.float32), "huge"), numpy_helper.from_array(np.zeros((1, 2), np.int64), "at")
    made.graph.sparse_initializer.append(helper.make_sparse_tensor(values, at, [2**20, 2**20]))
    return made


def claiming(*dims):
    return model(NODE("MatMul", ["x", "column"], ["y"]), constants=[onnx.TensorProto(name="column", data_type=1, dims=dims, raw_data=b"")])


def busy():
    """The same weights a thousand times."""
    weights = numpy_helper.from_array(np.zeros((500, 500), np.float32), "weights")
    nodes = [NODE("Concat", ["x"] * 250, ["v0"], axis=1)]
    return model(*nodes, *(NODE("MatMul", [f"v{k}", "weights"], [f"v{k + 1}"]) for k in range(1000)), constants=[weights])


def long():
    return model(*(NODE("Identity", [f"v{k}" if k else "x"], [f"v{k + 1}"]) for k in range(20_000)))


def gathering(index):
    return model(NODE("Gather", ["x", "i"], ["y"], axis=1), constants=[numpy_helper.from_array(np.array([index]), "i")])


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (doubling(), "more than 100000 numbers for each row"),
        (doubling(24, NODE("Elu", ["x"], ["v0"])), "more than 100000 numbers for each row"),
        (model(NODE("Elu", ["x"], ["h"]), *looping().graph.node, constants=looping().graph.initializer), "a graph within a graph"),
        (model(NODE("Elu", ["x"], ["h"]), NODE("Expand", ["h", "shape"], ["y"])), "operator 'Expand' is none of"),
        (model(NODE("Elu", ["x"], ["h"]), read_elsewhere().graph.node[0], constants=read_elsewhere().graph.initializer), "numbers are elsewhere"),
        (model(NODE("Softmax", ["x"], ["y"], axis=0)), "rows of the input that mix"),
        (model(NODE("Elu", ["x"], ["y"], alpha="x")), "onnxruntime: "),
        (looping(), "a graph within a graph"),
        (branching(), "a graph within a graph"),
        (read_elsewhere(), "a tensor whose numbers are elsewhere"),
        (read_elsewhere_in_a_node(), "a tensor whose numbers are elsewhere"),
        (recursive(), "functions or sparse constants"),
        (sparse(), "functions or sparse constants"),
        (model(NODE("Inverse", ["x"], ["y"], domain="com.microsoft")), "an operator that is none of ONNX"),
        (model(NODE("Expand", ["x", "shape"], ["y"])), "operator 'Expand' is none of Identity, Abs, .*Concat"),
        (model(NODE("Tile", ["x", "shape"], ["y"])), "operator 'Tile' is none of"),
        (model(NODE("Pad", ["x", "shape"], ["y"])), "operator 'Pad' is none of"),
        (model(NODE("ConstantOfShape", ["shape"], ["y"])), "operator 'ConstantOfShape' is none of"),
        (model(NODE("\x1b[2J", ["x"], ["y"])), r"operator .\\x1b\[2J. is none of"),
        (model(NODE("__class__", ["x"], ["y"])), "operator '__class__' is none of"),
        (claiming(2**31, 2**31), "numbers are elsewhere|cannot reshape"),
        (claiming(2, 0), "cannot be played"),
        (claiming(0, 2**62), "cannot be played"),
        (busy(), "more than 2000000 additions and multiplications"),
        (long(), "more than 2000 nodes"),
        (model(SAME, width=2**40), "more than 100000 numbers"),
        (model(SAME, width=-1), "no column"),
        (model(NODE("Add", [], ["y"])), "less than two operands"),
        (model(NODE("Exp", [], ["y"])), "'Exp' cannot be used so"),
        (model(NODE("Constant", [], ["y"])), "'Constant' cannot be used so"),
        (model(NODE("LeakyRelu", ["x"], ["y"], alpha="x")), "onnxruntime: "),
        (gathering(-1), "other than columns taken"),
        (gathering(2), "other than columns taken"),
        (model(NODE("Sum", ["x"] * 20_000, ["y"])), "or 2000 operations"),
    ],
)  # fmt: skip
def test_refused_at_once(tmp_path, made, said):
    path = tmp_path / "model.onnx"
    path.write_bytes(made.SerializeToString())
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(InputError, match=said):
        Network(path)
    assert time.process_time() - began < AT_ONCE and tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\xff" * 1_000_000, "a number of more than 64 bits"),
        (b"\x3a\x80\x80\x80\x80" + b"\xff" * 1_000_000, "a number of more than 64 bits"),
        (b"\x08\x01" * (MODEL_BYTES // 2), "a field twice"),
        (bytes(MODEL_BYTES + 1), "more than 4000000 bytes"),
        (b"\x0a" + b"\xf5" + 8 * b"\xff" + b"\x01", "no protocol buffer"),  # a length of -11: backwards to itself
    ],
)
def test_bytes_without_end(tmp_path, content, said):
    (tmp_path / "model.onnx").write_bytes(content)
    began = time.process_time()
    with pytest.raises(InputError, match=said):
        Network(tmp_path / "model.onnx")
    assert time.process_time() - began < AT_ONCE


def test_what_one_reader_takes_for_another_operator_than_the_next_is_refused(tmp_path):
    """Of a field that comes twice protobuf takes the last, and others the first: what is checked is not what is played."""
    content = model(NODE("Elu", ["x"], ["y"])).SerializeToString()
    node = NODE("Elu", ["x"], ["y"]).SerializeToString()
    twice = node + NODE("Exp", [], []).SerializeToString()
    graph = onnx.load_model_from_string(content).graph.SerializeToString()
    forged = graph.replace(bytes([10, len(node)]) + node, bytes([10, len(twice)]) + twice)
    size = lambda n: bytes([n & 127 | 128, n >> 7]) if n > 127 else bytes([n])  # noqa: E731
    forged = content.replace(b"\x3a" + size(len(graph)) + graph, b"\x3a" + size(len(forged)) + forged)
    assert onnx.load_model_from_string(forged).graph.node[0].op_type == "Exp"
    (tmp_path / "model.onnx").write_bytes(forged)
    with pytest.raises(InputError, match="a field twice"):
        Network(tmp_path / "model.onnx")


def test_a_name_goes_into_messages_and_tables(tmp_path):
    path = tmp_path / "model.onnx"
    made = model(NODE("MatMul", ["x", "column"], ["y"]), constants=[COLUMN], meta={**META, "name": "<b>\x1b[31m$\\frac$" + "x" * 10**5})
    path.write_bytes(made.SerializeToString())
    name = Network(path).name
    assert name.startswith("_b___31m__frac_x") and len(name) == 100
