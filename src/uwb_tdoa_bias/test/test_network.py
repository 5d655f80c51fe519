# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import json

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.network import Network, load_network
from uwb_tdoa_bias.effects import Samples

known_answer = pytest.importorskip("known_answer")


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    return known_answer.write(tmp_path_factory.mktemp("model"))


ANCHORS = Anchors.from_positions([[5, 0, 1], [-3, 2, 3], [0, -400, 2]])


def samples(p, q, a, b):
    n = len(p)
    return Samples(
        np.zeros(n), np.array(a), np.array(b), np.array(p, float), np.array(q, float), ANCHORS
    )


def batch(n=50):
    random = np.random.default_rng(3)
    q = random.normal(size=(n, 4))
    a = random.integers(0, 2, n)
    return samples(
        random.uniform(-2, 2, (n, 3)), q / np.linalg.norm(q, axis=1, keepdims=True), a, 1 - a
    )


def expected(s):
    """By hand: rotate the vector to anchor b into the body frame with x y z w written out as a
    matrix.
    """
    out = []
    for p, (x, y, z, w), a, b in zip(s.p, s.q, s.a, s.b):
        to_world = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        seen = to_world.T @ (ANCHORS.positions[b] - p)
        elevation = np.arctan2(seen[2], np.hypot(seen[0], seen[1]))
        out.append(known_answer.known_answer(elevation, ANCHORS.positions[a][0] - p[0]))
    return np.array(out)


def test_predicts_what_is_computed_by_hand(network_file):
    s = batch()
    bias, std, known = Network(network_file).predict(s)
    np.testing.assert_allclose(bias, expected(s), atol=1e-6)  # the model computes in float32
    assert np.ptp(bias) > 0.1  # an answer that says something
    np.testing.assert_array_equal(std, 0.0)
    np.testing.assert_array_equal(known, 1.0)


def test_output_is_clipped(network_file):
    far = samples([[-80.0, 0, 0], [80.0, 0, 0]], [[0, 0, 0, 1]] * 2, [0, 0], [1, 1])
    np.testing.assert_array_equal(Network(network_file).predict(far)[0], [1.0, -1.0])


def test_unknown_attitude_gives_nan(network_file):
    s = samples([[0, 0, 1]] * 2, [[np.nan] * 4, [0, 0, 0, 1]], [0, 0], [1, 1])
    np.testing.assert_array_equal(np.isnan(Network(network_file).predict(s)[0]), [True, False])


def changed(tmp_path, **meta):
    """The model with other metadata; None removes an entry."""
    model = known_answer.make()
    for entry in list(model.metadata_props):
        if entry.key in meta:
            model.metadata_props.remove(entry)
    for key, value in meta.items():
        if value is not None:
            model.metadata_props.add(key=key, value=value)
    path = tmp_path / "changed.onnx"
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize(
    ("meta", "named"),
    [
        ({"features": None}, "features"),
        ({"clip": None}, "clip"),
        ({"name": None}, "name"),
        ({"offset": "not json"}, "offset"),
        ({"clip": '"wide"'}, "clip"),
        ({"features": json.dumps(["elevation_T_b", "distance"])}, "features (names out of"),
        ({"features": json.dumps(["dx_a"])}, "1 features"),
        ({"offset": "[0.0]"}, "1 offsets"),
        ({"scale": "[1.0, 1.0, 1.0]"}, "3 scales"),
        ({"scale": "[0.0, 4.0]"}, "no scale may be 0"),
        ({"validity": '{"distance": [0, 1, 1]}', "fade_std": "0.3"}, "distance"),
        ({"validity": '{"x": [0, 1, 0]}', "fade_std": "0.3"}, "margin above 0"),
        ({"validity": '{"x": [0, 1, 1]}'}, "fade_std"),
        ({"largest_yaw_std": '"wide"'}, "wide"),
        ({"share": "1.5"}, "share must be between 0 and 1"),
        ({"offset": "[NaN, 0.0]"}, "finite"),
        ({"clip": "-1"}, "clip must be above 0"),
        ({"clip": "NaN"}, "clip must be above 0"),
        ({"validity": "[1]", "fade_std": "1"}, "metadata"),
        ({"validity": '{"x": [0, 1, 1]}', "fade_std": "Infinity"}, "fade_std"),
        ({"offset": "[" * 10_000}, "metadata"),
    ],
)
def test_wrong_metadata_are_refused_by_name(tmp_path, meta, named):
    path = changed(tmp_path, **meta)
    with pytest.raises(InputError) as error:
        Network(path)
    assert named in str(error.value) and str(path) in str(error.value)


def test_takes_nothing_out_before_the_yaw_is_known(tmp_path):
    network, s = Network(changed(tmp_path, largest_yaw_std="1.0")), batch(3)
    plain = network.predict(s)[0]
    assert (plain != 0.0).all()
    bias, std, known = network.predict(replace(s, yaw_std=np.array([0.0, 1.0, 1.1])))
    np.testing.assert_array_equal(bias, [*plain[:2], 0.0])
    np.testing.assert_array_equal(std, [0.0, 0.0, abs(plain[2])])
    np.testing.assert_array_equal(known, [1.0, 1.0, 0.0])


def test_takes_out_the_share_that_is_borne_out_and_counts_the_rest_as_uncertainty(
    network_file, tmp_path
):
    whole, part = (
        Network(network_file).predict(batch(5)),
        Network(changed(tmp_path, share="0.75")).predict(batch(5)),
    )
    np.testing.assert_allclose(part[0], 0.75 * whole[0])
    np.testing.assert_allclose(part[1], np.hypot(whole[1], 0.25 * np.abs(whole[0])))


def test_fades_beyond_what_it_knows(network_file, tmp_path):
    network = Network(
        changed(
            tmp_path, validity='{"z": [0.0, 2.0, 1.0], "up_x": [-0.2, 0.2, 0.5]}', fade_std="0.3"
        )
    )
    tilted = [0.0, np.sin(0.25), 0.0, np.cos(0.25)]  # up_x = sin(0.5)
    s = samples(
        [[1, 0, 0.0], [1, 0, 2.0], [1, 0, 2.4], [1, 0, -1.0], [1, 0, 9.0], [1, 0, 1.0]],
        [[0, 0, 0, 1]] * 5 + [tilted],
        [0] * 6,
        [1] * 6,
    )
    plain, (bias, std, known) = Network(network_file).predict(s)[0], network.predict(s)
    trust = np.array([1.0, 1.0, 0.6, 0.0, 0.0, 1.0 - (np.sin(0.5) - 0.2) / 0.5])
    np.testing.assert_allclose(known, trust, atol=1e-12)
    np.testing.assert_allclose(bias, trust * plain, atol=1e-9)
    np.testing.assert_allclose(std, 0.3 * np.sqrt(1.0 - trust**2), atol=1e-9)


def test_missing_file_and_no_model(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        Network(tmp_path / "nowhere.onnx")
    text = tmp_path / "text.onnx"
    text.write_text("I am no model")
    with pytest.raises(InputError, match="cannot be played as an ONNX model"):
        Network(text)


def test_a_model_is_named_by_its_file(network_file):
    assert load_network("") is None and load_network(None) is None
    assert load_network(str(network_file)).name == "known_answer"
    with pytest.raises(InputError, match="other.onnx does not exist"):
        load_network("other.onnx")


def otherwise(tmp_path, nodes, constants=(), inputs=(("features", 1, ["n", 2]),)):
    """A model with the metadata of the known answer and other insides."""
    onnx = pytest.importorskip("onnx")
    made, helper = known_answer.make(), onnx.helper
    graph = helper.make_graph(
        [helper.make_node(*node[:3], **(node[3] if len(node) > 3 else {})) for node in nodes],
        "other",
        [helper.make_tensor_value_info(*one) for one in inputs],
        [helper.make_tensor_value_info("bias", 1, None)],
        [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in constants],
    )
    made.graph.CopyFrom(graph)
    path = tmp_path / "other.onnx"
    path.write_bytes(made.SerializeToString())
    return path


WIDE = ("weight", np.ones((2, 4), np.float32))


@pytest.mark.parametrize(
    ("nodes", "constants", "named"),
    [
        ([("MatMul", ["features", "weight"], ["bias"])], [WIDE], "gives (n, 4)"),
        ([("ReduceSum", ["features"], ["bias"], {"keepdims": 0})], [], "an output with other rows"),
        (
            [("Reshape", ["features", "shape"], ["bias"])],
            [("shape", np.array([7, 2], np.int64))],
            "cannot be played",
        ),
        (
            [("Div", ["features", "zero"], ["bias"])],
            [("zero", np.zeros(2, np.float32))],
            "no finite numbers",
        ),
    ],
)
def test_a_model_that_gives_no_rows_of_numbers_is_refused_when_it_is_loaded(
    tmp_path, nodes, constants, named
):
    with pytest.raises(InputError) as error:
        Network(otherwise(tmp_path, nodes, constants))
    assert named in str(error.value)


def test_a_model_with_two_inputs_is_refused(tmp_path):
    inputs = (("features", 1, ["n", 2]), ("more", 1, ["n", 2]))
    path = otherwise(tmp_path, [("Add", ["features", "more"], ["bias"])], inputs=inputs)
    with pytest.raises(InputError, match="more than one input or output"):
        Network(path)
