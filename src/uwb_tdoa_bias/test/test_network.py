# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.correction.model import Network, load_network
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
    """Compute the bias by hand, with the vector to anchor b in the body frame."""
    to_b = ANCHORS.positions[s.b] - s.p
    x, y, z = Rotation.from_quat(s.q).inv().apply(to_b).T
    dx = ANCHORS.positions[s.a][:, 0] - s.p[:, 0]
    return known_answer.known_answer(np.arctan2(z, np.hypot(x, y)), dx)


def test_predicts_what_is_computed_by_hand(network_file):
    s = batch()
    bias, std, known = Network(network_file).predict(s)
    np.testing.assert_allclose(bias, expected(s), atol=1e-6)  # the model computes in float32
    assert np.ptp(bias) > 0.1  # The bias varies, so the comparison is meaningful.
    np.testing.assert_array_equal(std, 0.0)
    np.testing.assert_array_equal(known, 1.0)


def test_output_is_clipped_and_nan_without_the_attitude_it_needs(network_file):
    p, q = [[-80.0, 0, 0], [80.0, 0, 0], [0, 0, 1]], [[0, 0, 0, 1]] * 2 + [[np.nan] * 4]
    found = Network(network_file).predict(samples(p, q, [0] * 3, [1] * 3))[0]
    np.testing.assert_array_equal(found, [1.0, -1.0, np.nan])


def changed(tmp_path, **meta):
    """Write the model with other metadata and return its path. None removes an entry."""
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
        ({"validity": '{"dx_a": [0, 1, 0]}', "fade_std": "0.3"}, "margin above 0"),
        ({"validity": '{"dx_a": [0, 1, 1]}'}, "fade_std"),
        ({"largest_yaw_std": '"wide"'}, "wide"),
        ({"share": "1.5"}, "share must be between 0 and 1"),
        ({"offset": "[NaN, 0.0]"}, "finite"),
        ({"clip": "-1"}, "clip must be above 0"),
        ({"clip": "NaN"}, "clip must be above 0"),
        ({"validity": "[1]", "fade_std": "1"}, "metadata"),
        ({"validity": '{"dx_a": [0, 1, 1]}', "fade_std": "Infinity"}, "fade_std"),
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
            tmp_path,
            validity='{"dz_a": [-1.0, 1.0, 1.0], "up_x": [-0.2, 0.2, 0.5]}',
            fade_std="0.3",
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


def test_a_model_is_named_by_its_file(network_file, tmp_path):
    assert load_network("") is None and load_network(None) is None
    assert load_network(str(network_file)).name == "known_answer"
    with pytest.raises(InputError, match="nowhere.onnx does not exist"):
        load_network(tmp_path / "nowhere.onnx")
    (tmp_path / "text.onnx").write_text("I am no model")
    with pytest.raises(InputError, match="cannot be played as an ONNX model"):
        load_network(tmp_path / "text.onnx")


def otherwise(tmp_path, nodes, constants, inputs):
    """Write a model with the metadata of the known answer and another graph."""
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
        ([("Add", ["features", "more"], ["bias"])], [], "more than one input or output"),
    ],
)
def test_a_model_of_another_form_is_refused_when_it_is_loaded(tmp_path, nodes, constants, named):
    inputs = [(name, 1, ["n", 2]) for name in ("features", "more") if name in str(nodes)]
    with pytest.raises(InputError) as error:
        Network(otherwise(tmp_path, nodes, constants, inputs))
    assert named in str(error.value)
