# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Session gives the outputs of the ONNX reference, with the same bits in every batch."""

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import numpy_helper  # noqa: E402
from onnx.reference import ReferenceEvaluator  # noqa: E402
from onnx_models import model  # noqa: E402

from uwb_tdoa_bias.correction import trial  # noqa: E402
from uwb_tdoa_bias.correction.session import BATCH, Session, Unplayable  # noqa: E402

ELEMENTWISE = "Add Sub Mul Div Max Min Sum".split()
OTHERS = "MatMul Gemm Gather Reshape Concat ReduceSum ReduceMax Clip Constant".split()
CONDITIONS = "Less LessOrEqual Equal And Or Not Where".split()  # of numbers or of booleans
UNARY = [kind for kind in trial.OPERATORS if kind not in (*ELEMENTWISE, *OTHERS, *CONDITIONS)]
ROW_OF_ITS_OWN = [("ReduceSum", ["x", "a"], ["y"], {"keepdims": 1})]  # of five numbers


def played(path):
    """Return the Session of a file after its trial, which runs in this process."""
    session = Session(path.read_bytes())
    session.alone |= not trial._is_the_same_in_any_batch(session)
    return session


def assert_plays(path, positive=False, atol=1e-6, seed=0):
    reference, random = ReferenceEvaluator(str(path)), np.random.default_rng(seed)
    session = played(path)
    whole, width = onnx.load(path), session.width
    assert session.meta == {entry.key: entry.value for entry in whole.metadata_props}
    name = whole.graph.input[0].name
    x = random.normal(size=(2 * BATCH + 3, width))
    x = np.abs(x) + 0.1 if positive else x
    (expected,) = reference.run(None, {name: x.astype(np.float32)})
    together = session.run(x)
    np.testing.assert_allclose(together, expected, rtol=2e-6, atol=atol)
    for n in (0, 1, 2, 3, 4, 5, 7, 16, BATCH - 1):
        for first in (0, 1, 6):
            # The same bits are required.
            np.testing.assert_array_equal(
                session.run(x[first : first + n]), together[first : first + n]
            )
    other = np.concatenate([x[:3], 100.0 * x[3:]])
    np.testing.assert_array_equal(session.run(other)[:3], together[:3])
    np.testing.assert_array_equal(session.run(x[::-1])[::-1], together)


@pytest.mark.parametrize("width", [5])
@pytest.mark.parametrize("kind", UNARY)
def test_operators_of_one_value(tmp_path, kind, width):
    path = model(tmp_path / "model.onnx", [(kind, ["x"], ["y"], {})], width)
    assert_plays(path, positive=kind in ("Log", "Sqrt", "Reciprocal"), atol=1e-5)


@pytest.mark.parametrize("other", ["one", "column"])
@pytest.mark.parametrize("kind", ELEMENTWISE)
def test_operators_of_two(tmp_path, kind, other):
    # Stay away from 0, so that a quotient is exact enough.
    nodes = [("Abs", ["column of x"], ["size"], {}), ("Add", ["size", "one"], ["column"], {})]
    nodes = [("MatMul", ["x", "C"], ["column of x"], {}), *nodes, (kind, ["x", other], ["y"], {})]
    assert_plays(model(tmp_path / "model.onnx", nodes), atol=1e-5)


@pytest.mark.parametrize("kind", CONDITIONS)
def test_conditions(tmp_path, kind):
    """A condition selects between two numbers by Where."""
    sides = [("Less", ["x", "low"], ["p"], {}), ("Less", ["high", "x"], ["q"], {})]
    inputs = {"Not": ["p"], "And": ["p", "q"], "Or": ["p", "q"], "Equal": ["x", "size"]}
    made = [("Abs", ["x"], ["size"], {}), *sides]
    if kind == "Where":
        made += [("Where", ["p", "low", "x"], ["y"], {})]
    else:
        made += [(kind, inputs.get(kind, ["x", "row"]), ["b"], {})]
        made += [("Where", ["b", "x", "one"], ["y"], {})]
    assert_plays(model(tmp_path / "model.onnx", made))


@pytest.mark.parametrize(
    "nodes",
    [
        [("Gemm", ["x", "W", "c"], ["y"], {})],
        [("Gemm", ["x", "WT", "c"], ["y"], {"transB": 1, "alpha": 0.5, "beta": 2.0})],
        [
            ("Gemm", ["x", "W", "c"], ["h"], {}),
            ("Relu", ["h"], ["g"], {}),
            ("Gemm", ["g", "WT"], ["y"], {}),
        ],
        [("Sum", ["x", "x", "r"], ["y"], {})],
        [("Gather", ["x", "i"], ["y"], {"axis": 1})],
        [
            ("Reshape", ["x", "s"], ["y"], {}),
            ("ReduceMax", ["y"], ["z"], {"axes": [1], "keepdims": 1}),
            ("Reshape", ["z", "t"], ["u"], {}),
        ],
        [
            ("ReduceSum", ["x", "a"], ["y"], {"keepdims": 1}),
            ("Concat", ["y", "x", "y"], ["z"], {"axis": 1}),
        ],
        [
            ("MatMul", ["x", "W"], ["h"], {}),
            ("Tanh", ["h"], ["g"], {}),
            ("MatMul", ["g", "WT"], ["y"], {}),
        ],
        [("LeakyRelu", ["x"], ["y"], {}), ("LeakyRelu", ["y"], ["z"], {"alpha": 2.0})],
        [
            ("Clip", ["x", "low", "high"], ["y"], {}),
            ("Clip", ["y", "", "low"], ["z"], {}),
            ("Clip", ["z"], ["u"], {}),
        ],
        [
            ("Constant", [], ["k"], {"value": numpy_helper.from_array(np.float32([0.5]), "k")}),
            ("Mul", ["x", "k"], ["y"], {}),
        ],
        [  # The bits of this sum depend on the place of a row in memory.
            ("Reshape", ["x", "s"], ["h"], {}),
            ("MatMul", ["h", "d"], ["g"], {}),
            ("Sin", ["g"], ["f"], {}),
            ("ReduceSum", ["f", "a"], ["e"], {"keepdims": 1}),
            ("Reshape", ["e", "t"], ["y"], {}),
        ],
    ],
)
def test_what_models_are_made_of(tmp_path, nodes):
    assert_plays(
        model(tmp_path / "model.onnx", nodes, d=np.float32([[1, 2, 3, 4, 5, 6, 7]])), atol=1e-5
    )


@pytest.mark.parametrize(("width", "columns"), [(3, 1), (14, 7), (200, 129)])
def test_products_of_any_size(tmp_path, width, columns):
    nodes = [("MatMul", ["x", "weights"], ["h"], {}), ("Tanh", ["h"], ["y"], {})]
    weights = np.random.default_rng(columns).normal(size=(width, columns)).astype(np.float32)
    assert_plays(model(tmp_path / "model.onnx", nodes, width, weights=weights), atol=1e-4)


def test_a_model_for_one_row_at_a_time(tmp_path):
    assert_plays(model(tmp_path / "model.onnx", [("MatMul", ["x", "C"], ["y"], {})], batch=1))


@pytest.mark.parametrize("width", [1, 3, 4, 5, 7, 8, 14, 33])
def test_which_rows_are_played_by_themselves(tmp_path, width):
    """The bits of a sum depend on the start of the row in memory.

    Rows of up to 4 numbers, or of a multiple of 4, are exceptions.
    """
    assert played(model(tmp_path / "model.onnx", ROW_OF_ITS_OWN, width)).alone == (
        width > 4 and width % 4 != 0
    )


@pytest.mark.parametrize(
    "nodes",
    [
        [("Softmax", ["x"], ["y"], {"axis": 0})],
        [
            ("Reshape", ["x", "s"], ["h"], {}),
            ("Softmax", ["h"], ["g"], {"axis": 0}),
            ("Reshape", ["g", "t"], ["y"], {}),
        ],
    ],
)
def test_rows_that_mix_are_played_apart(tmp_path, nodes):
    session = played(model(tmp_path / "model.onnx", nodes))
    x = np.random.default_rng(0).normal(size=(9, 5))
    assert session.alone
    np.testing.assert_array_equal(session.run(x)[4:5], session.run(x[4:5]))


@pytest.mark.parametrize(
    "nodes",
    [
        [("Gemm", ["x", "W"], ["y"], {"transA": 1})],
        [("Reshape", ["x", "s"], ["y"], {})],
        [("ReduceSum", ["x", "zero"], ["y"], {"keepdims": 1})],
        [("ReduceSum", ["x"], ["y"], {"keepdims": 0})],
        [("Reshape", ["x", "s"], ["h"], {}), ("Add", ["x", "h"], ["y"], {})],
        [("MatMul", ["x", "c"], ["y"], {})],
        [("Concat", ["x", "x"], ["y"], {"axis": 0})],
    ],
)
def test_what_gives_other_rows_than_it_gets_is_refused(tmp_path, nodes):
    with pytest.raises(Unplayable):
        played(model(tmp_path / "model.onnx", nodes, zero=np.array([0]))).run(np.zeros((8, 5)))
