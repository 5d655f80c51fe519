"""What a tape plays is what the reference of ONNX and onnxruntime say; and what it refuses."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from onnx.reference import ReferenceEvaluator  # noqa: E402
from random_samples import random_samples  # noqa: E402
from uwb_tdoa_bias.correction import tape as tapes  # noqa: E402
from uwb_tdoa_bias.correction.features import NAMES, everything  # noqa: E402
from uwb_tdoa_bias.correction.network import MODELS, Network  # noqa: E402
from uwb_tdoa_bias.correction.onnx_file import Unreadable, read_graph  # noqa: E402
from uwb_tdoa_bias.correction.session import Session  # noqa: E402
from uwb_tdoa_bias.correction.tape import BATCH, OF_RUNTIME, Tape, Unplayable  # noqa: E402

COLUMN = np.array([[0.5], [-1.0], [2.0], [0.25], [1.5]], np.float32)
WEIGHTS = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)


def model(path, nodes, width=5, **constants):
    """Write a graph of (kind, inputs, outputs, attributes); its input is "x", its output the last node's."""
    made = [helper.make_node(kind, inputs, outputs, **more) for kind, inputs, outputs, more in nodes]
    graph = helper.make_graph(
        made, "test", [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", width])],
        [helper.make_tensor_value_info(nodes[-1][2][0], TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )  # fmt: skip
    whole = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(whole, {"name": '"test"', "text": "ä"})
    path.write_bytes(whole.SerializeToString())
    return path


def assert_plays(path, positive=False, atol=1e-6):
    graph, reference = read_graph(path), ReferenceEvaluator(str(path))
    tape = Tape(graph)
    session = Session(graph.content, tape)
    assert tape.complete
    assert tape.meta == {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert [name for name, _ in tape.inputs] == list(reference.input_names)
    random = np.random.default_rng(0)
    for n in (0, 1, 2, 3, BATCH, 2 * BATCH + 1):
        x = random.normal(size=(n, tape.width))
        x = np.abs(x) + 0.1 if positive else x
        if n:
            (expected,) = reference.run(None, {tape.inputs[0][0]: x.astype(np.float32)})
            for other in (expected, session.run(x)):
                np.testing.assert_allclose(tape.run(x), other, rtol=2e-6, atol=atol)
        assert tape.run(x).shape == (n, tape.outputs)
    together = tape.run(x)
    np.testing.assert_array_equal(together, np.concatenate([tape.run(row[None]) for row in x]))  # to the bit


@pytest.mark.parametrize("name", ["default", "known_answer"])
def test_the_models_that_are_shipped(name):
    assert_plays(MODELS / f"{name}.onnx")


@pytest.mark.parametrize("kind", tapes.UNARY)
def test_operators_of_one_value(tmp_path, kind):
    assert_plays(model(tmp_path / "model.onnx", [(kind, ["x"], ["y"], {})]), positive=kind in ("Log", "Sqrt"))


@pytest.mark.parametrize("other", ["x", "one", "row", "column"])
@pytest.mark.parametrize("kind", tapes.BINARY)
def test_operators_of_two(tmp_path, kind, other):
    nodes = [("Abs", ["column of x"], ["a"], {}), (kind, ["x", "a" if other == "column" else other], ["y"], {})]
    nodes = [("MatMul", ["x", "weights"], ["column of x"], {}), *nodes]
    constants = {"one": np.float32([1.5]), "row": np.float32([[1, 2, 0.5, -1, 3]]), "weights": COLUMN}
    assert_plays(model(tmp_path / "model.onnx", nodes, **constants), atol=1e-5)


@pytest.mark.parametrize(
    "nodes",
    [
        [("Gemm", ["x", "W", "c"], ["y"], {})],
        [("Gemm", ["x", "WT", "c"], ["y"], {"transB": 1})],
        [("Sum", ["x", "x", "r"], ["y"], {})],
        [("Gather", ["x", "i"], ["y"], {"axis": 1})],
        [
            ("Reshape", ["x", "s"], ["y"], {}), ("ReduceMax", ["y"], ["z"], {"axes": [1], "keepdims": 1}),
            ("Reshape", ["z", "t"], ["u"], {}),
        ],
        [("ReduceSum", ["x", "a"], ["y"], {"keepdims": 1}), ("Concat", ["y", "x", "y"], ["z"], {"axis": 1})],
        [("MatMul", ["x", "W"], ["h"], {}), ("Tanh", ["h"], ["g"], {}), ("MatMul", ["g", "WT"], ["y"], {})],
        [("LeakyRelu", ["x"], ["y"], {}), ("LeakyRelu", ["y"], ["z"], {"alpha": 0.5})],
        [("Clip", ["x", "low", "high"], ["y"], {}), ("Clip", ["y", "", "low"], ["z"], {}), ("Clip", ["z"], ["u"], {})],
        [("Constant", [], ["k"], {"value": numpy_helper.from_array(np.float32([0.5]), "k")}), ("Mul", ["x", "k"], ["y"], {})],
    ],
)
def test_what_models_are_made_of(tmp_path, nodes):
    constants = {
        "W": WEIGHTS, "WT": np.ascontiguousarray(WEIGHTS.T), "c": np.arange(7, dtype=np.float32), "r": np.float32([1, 2, 3, 4, 5]),
        "i": np.array([4, 0, 0]), "s": np.array([-1, 1]), "t": np.array([-1, 5]), "a": np.array([1]),
        "low": np.float32([-0.5]), "high": np.float32([0.75]),
    }  # fmt: skip
    assert_plays(model(tmp_path / "model.onnx", nodes, **constants))


@pytest.mark.parametrize(
    "nodes",
    [
        [("Softmax", ["x"], ["y"], {"axis": 0})],
        [("LeakyRelu", ["x"], ["y"], {"alpha": 2.0})],
        [("Gemm", ["x", "W"], ["y"], {"alpha": 2.0})],
        [("Reshape", ["x", "s"], ["y"], {})],
        [("ReduceSum", ["x", "a"], ["y"], {"keepdims": 1})],
        [("Add", ["x", "rows"], ["y"], {})],
    ],
)
def test_what_a_tape_does_not_know_is_refused(tmp_path, nodes):
    constants = {"W": WEIGHTS, "s": np.array([-1, 2]), "a": np.array([0]), "rows": np.ones((2, 5), np.float32)}
    with pytest.raises(Unplayable):
        Tape(read_graph(model(tmp_path / "model.onnx", nodes, **constants)))


def test_exponentials_are_those_of_float32():
    x = np.linspace(-39.9, 87.9, 10_001).astype(np.float32)
    out = np.empty_like(x)
    tapes._exponentials(x, out)
    np.testing.assert_allclose(out, np.exp(x.astype(float)), rtol=3e-7)
    special = np.array([-np.inf, -50.0, np.nan], np.float32)
    tapes._exponentials(special, out[:3])
    np.testing.assert_array_equal(out[:3], [0.0, 0.0, np.nan])


@pytest.mark.parametrize("kind", OF_RUNTIME)
def test_operators_that_onnxruntime_plays(tmp_path, kind):
    nodes = [("MatMul", ["x", "W"], ["h"], {}), (kind, ["h"], ["g"], {}), ("Concat", ["g", "x"], ["z"], {"axis": 1}), ("MatMul", ["z", "C"], ["y"], {})]
    path = model(tmp_path / "model.onnx", nodes, W=WEIGHTS, C=np.ones((12, 2), np.float32))
    graph, reference = read_graph(path), ReferenceEvaluator(str(path))
    tape, x = Tape(graph), np.random.default_rng(0).normal(size=(2 * BATCH + 1, 5)).astype(np.float32)
    assert not tape.complete and tape.outputs == 2
    session = Session(graph.content, tape)
    np.testing.assert_allclose(session.run(x), reference.run(None, {tape.inputs[0][0]: x})[0], rtol=1e-5, atol=1e-5)
    assert session.run(x[:0]).shape == (0, 2)


def test_a_network_of_such_an_operator_predicts(tmp_path):
    meta = {"features": '["dx_a"]', "offset": "[0.0]", "scale": "[1.0]", "clip": "1.0", "name": '"elu"'}
    path = model(tmp_path / "elu.onnx", [("Elu", ["x"], ["y"], {})], width=1)
    whole = onnx.load(path)
    helper.set_model_props(whole, meta)
    path.write_bytes(whole.SerializeToString())
    network, samples = Network(path), random_samples(50)
    (column,) = [k for k, name in enumerate(NAMES) if name == "dx_a"]
    feature = everything(samples)[:, column]
    np.testing.assert_allclose(network.predict(samples)[0], np.clip(np.where(feature > 0.0, feature, np.expm1(feature)), -1.0, 1.0), atol=1e-6)


@pytest.mark.parametrize("data", [b"\x00", b"no model", b"\x3a\xff\xff\xff\xff\x0f"])
def test_what_is_no_model_is_unreadable(tmp_path, data):
    (tmp_path / "model.onnx").write_bytes(data)
    with pytest.raises(Unreadable):
        read_graph(tmp_path / "model.onnx")
