"""What is read of an ONNX file is what protobuf reads of it, or it is refused."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import helper, numpy_helper  # noqa: E402
from onnx_models import CONSTANTS, model  # noqa: E402
from uwb_tdoa_bias.correction.graph_size import Unplayable, size_of  # noqa: E402
from uwb_tdoa_bias.correction.onnx_file import Unreadable, read_graph  # noqa: E402


def test_what_is_read(tmp_path):
    nodes = [("Gemm", ["x", "W", "c"], ["h"], {"alpha": 0.5, "transB": 0}), ("Gather", ["h", "i"], ["g"], {"axis": 1})]
    nodes += [("ReduceMax", ["g"], ["y"], {"axes": [-1], "keepdims": 1})]
    graph = read_graph(model(tmp_path / "model.onnx", nodes))
    assert [(node.kind, node.inputs, node.outputs, node.attributes) for node in graph.nodes] == nodes
    assert graph.inputs == [("x", [None, 5])] and graph.outputs == ["y"] and graph.meta == {"name": '"test"', "text": "ä"}
    for name, value in graph.constants.items():
        np.testing.assert_array_equal(value, CONSTANTS[name])
        assert value.dtype == CONSTANTS[name].dtype


def test_numbers_as_fields(tmp_path):
    path = model(tmp_path / "model.onnx", [("Add", ["x", "r"], ["h"], {}), ("Gather", ["h", "i"], ["y"], {"axis": 1})])
    whole = onnx.load(path)
    for tensor in whole.graph.initializer:
        values = numpy_helper.to_array(tensor)
        tensor.ClearField("raw_data")
        (tensor.float_data if values.dtype == np.float32 else tensor.int64_data).extend(values.tolist())
    path.write_bytes(whole.SerializeToString())
    np.testing.assert_array_equal(read_graph(path).constants["r"], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(read_graph(path).constants["i"], [4, 0, 0])


def forged(path, kind, name, data):
    """A model whose operator has an attribute of these bytes. What protobuf does not know in them it writes again."""
    whole = onnx.load(model(path, [(kind, ["x"], ["y"], {})], opset=11))
    whole.graph.node[0].attribute.append(onnx.AttributeProto.FromString(b"\x0a" + bytes([len(name)]) + name.encode() + data))
    path.write_bytes(whole.SerializeToString())
    return path, helper.get_attribute_value(onnx.load(path).graph.node[0].attribute[0])


def test_a_number_of_another_form_than_its_field_has(tmp_path):
    """Protobuf passes over it: axes that are read as [1] here would be none, which is all, in onnxruntime."""
    path, read = forged(tmp_path / "model.onnx", "ReduceSum", "axes", b"\xa0\x01\x07" + b"\x45\x81\x80\x80\x00")
    assert list(read) == []
    with pytest.raises(Unreadable):
        read_graph(path)
    path, read = forged(tmp_path / "model.onnx", "ReduceSum", "axes", b"\xa0\x01\x07" + b"\x42\x01\x01")
    assert list(read) == read_graph(path).nodes[0].attributes["axes"] == [1]
    path, read = forged(tmp_path / "model.onnx", "Elu", "alpha", b"\xa0\x01\x01" + b"\x12\x04\x00\x00\x80\x3f")
    assert read == 0.0
    with pytest.raises(Unreadable):
        read_graph(path)


@pytest.mark.parametrize("change", ["name", "attribute", "second form", "other form"])
def test_what_would_be_read_in_two_ways(tmp_path, change):
    whole = onnx.load(model(tmp_path / "model.onnx", [("Add", ["x", "r"], ["h"], {}), ("Concat", ["h"], ["y"], {"axis": 1})]))
    tensor, node = whole.graph.initializer[0], whole.graph.node[1]
    if change == "name":
        whole.graph.initializer.append(numpy_helper.from_array(np.zeros(5, np.float32), "r"))
    elif change == "attribute":
        node.attribute.append(helper.make_attribute("axis", 0))
    elif change == "second form":
        tensor.float_data.extend([0.0] * 5)
    else:
        tensor.ClearField("raw_data")
        tensor.int64_data.extend([0] * 5)
    (tmp_path / "model.onnx").write_bytes(whole.SerializeToString())
    with pytest.raises(Unreadable, match="a name twice|numbers are elsewhere"):
        read_graph(tmp_path / "model.onnx")


def test_an_input_without_a_shape(tmp_path):
    whole = onnx.load(model(tmp_path / "model.onnx", [("Exp", ["x"], ["y"], {})]))
    whole.graph.input[0].type.tensor_type.ClearField("shape")
    (tmp_path / "model.onnx").write_bytes(whole.SerializeToString())
    with pytest.raises(Unplayable):
        size_of(read_graph(tmp_path / "model.onnx"))


@pytest.mark.parametrize("data", [b"\x00", b"no model", b"\x3a\xff\xff\xff\xff\x0f"])
def test_what_is_no_model_is_unreadable(tmp_path, data):
    (tmp_path / "model.onnx").write_bytes(data)
    with pytest.raises(Unreadable):
        read_graph(tmp_path / "model.onnx")
