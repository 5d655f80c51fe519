# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Models that execute code, hang or exhaust memory: each is refused at once, with the reason."""

import json
import os
import resource

import numpy as np
from programs import python
import pytest

from uwb_tdoa_bias.common.errors import MODEL_BYTES, MODEL_SECONDS, InputError
from uwb_tdoa_bias.correction import trial
from uwb_tdoa_bias.correction.model import Network

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

START = 2.0  # s of processor time that a trial needs before it loads the model
META = {
    "features": ["dx_a", "dy_a"],
    "offset": [0, 0],
    "scale": [1, 1],
    "clip": 1,
    "name": "attack",
}
NODE = helper.make_node
SAME = NODE("Identity", ["x"], ["y"])
COLUMN = numpy_helper.from_array(np.ones((2, 1), np.float32), "column")


def model(*nodes, constants=(), width=2, meta=META, **more):
    """Return a ModelProto. Its output is the output of the last node."""
    graph = helper.make_graph(
        nodes,
        "attack",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", width])],
        [helper.make_tensor_value_info(nodes[-1].output[0], TensorProto.FLOAT, None)],
        constants,
    )
    made = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8, **more
    )
    helper.set_model_props(made, {key: json.dumps(value) for key, value in meta.items()})
    return made


def doubling():
    """Return a model of one kilobyte that computes 2^30 columns."""
    nodes = (NODE("Concat", [f"v{k}" if k else "x"] * 2, [f"v{k + 1}"], axis=1) for k in range(30))
    return model(*nodes)


def looping():
    kinds = {"i": TensorProto.INT64, "go": TensorProto.BOOL, "last": TensorProto.FLOAT}
    inputs = [
        helper.make_tensor_value_info(name, kind, None if name == "last" else [])
        for name, kind in kinds.items()
    ]
    outputs = [
        helper.make_tensor_value_info(name, kind, None)
        for name, kind in (("go", TensorProto.BOOL), ("next", TensorProto.FLOAT))
    ]
    body = helper.make_graph([NODE("Add", ["last", "last"], ["next"])], "body", inputs, outputs)
    count = numpy_helper.from_array(np.array(2**62), "count")
    return model(NODE("Loop", ["count", "", "x"], ["y"], body=body), constants=[count])


def read_elsewhere(file="../../etc/passwd"):
    """Return a model that reads its weights from a file of the user."""
    weights = onnx.TensorProto(
        name="column", data_type=TensorProto.FLOAT, dims=[2, 1], data_location=TensorProto.EXTERNAL
    )
    weights.external_data.add(key="location", value=file)
    return model(NODE("MatMul", ["x", "column"], ["y"]), constants=[weights])


def recursive():
    function = helper.make_function(
        "own",
        "Twice",
        ["x"],
        ["y"],
        [NODE("Twice", ["x"], ["y"], domain="own")],
        [helper.make_opsetid("own", 1)],
    )
    made = model(NODE("Twice", ["x"], ["y"], domain="own"), functions=[function])
    made.opset_import.add(domain="own", version=1)
    return made


def claiming(*dims):
    return model(
        NODE("MatMul", ["x", "column"], ["y"]),
        constants=[onnx.TensorProto(name="column", data_type=1, dims=dims, raw_data=b"")],
    )


def busy():
    """Return a model that applies the same weights a thousand times."""
    weights = numpy_helper.from_array(np.zeros((500, 500), np.float32), "weights")
    nodes = [NODE("Concat", ["x"] * 250, ["v0"], axis=1)]
    return model(
        *nodes,
        *(NODE("MatMul", [f"v{k}", "weights"], [f"v{k + 1}"]) for k in range(1000)),
        constants=[weights],
    )


def long():
    return model(*(NODE("Identity", [f"v{k}" if k else "x"], [f"v{k + 1}"]) for k in range(20_000)))


def branching_seldom():
    """Return a model with another branch for inputs above 1e6, which the trial does not try."""
    far, text = (
        numpy_helper.from_array(np.float32(1e6), "far"),
        helper.make_tensor_value_info("z", TensorProto.FLOAT, None),
    )
    then, other = (
        helper.make_graph([NODE(kind, ["x"], ["z"])], kind, [], [text])
        for kind in ("Exp", "Identity")
    )
    nodes = NODE("ReduceMax", ["x"], ["most"], keepdims=0), NODE("Greater", ["most", "far"], ["is"])
    return model(
        *nodes, NODE("If", ["is"], ["y"], then_branch=then, else_branch=other), constants=[far]
    )


def spent():
    """Return the processor time of all processes that have ended, in s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


TOO_MUCH = "it takes more than 3 s or 256 MB|onnxruntime: .*(alloc|[Mm]emory|bfc_arena)|MemoryError"


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (doubling(), TOO_MUCH),
        (looping(), "operator 'Loop' is none of|" + TOO_MUCH),
        (branching_seldom(), "operator '(If|Greater)' is none of"),
        (read_elsewhere(), "onnxruntime: "),
        (recursive(), "onnxruntime: |" + TOO_MUCH),
        (model(NODE("Dropout", ["x"], ["y"])), "operator 'Dropout' is none of Abs, Add, .*Concat"),
        (model(NODE("\x1b[2J", ["x"], ["y"])), r"onnxruntime: "),
        (claiming(2**31, 2**31), "onnxruntime: "),
        (busy(), "a row takes .* ms, more than 5 ms|" + TOO_MUCH),
        (long(), "more than 2000 operators|" + TOO_MUCH),
        (model(SAME, width=2**40), TOO_MUCH),
    ],
)
def test_refused_at_once(tmp_path, made, said):
    path = tmp_path / "model.onnx"
    path.write_bytes(made.SerializeToString())
    before = spent()
    with pytest.raises(InputError, match=said) as refused:
        Network(path)
    assert spent() - before < START + MODEL_SECONDS + 1
    assert len(str(refused.value)) < 1000 and str(refused.value).isprintable()


def test_a_model_opens_no_file_in_its_trial(tmp_path, monkeypatch):
    """The weights of the model are in another file, which exists and has the right size.

    Such a model could read a file of the user. A pipe in place of the file would hang.
    """
    (tmp_path / "weights").write_bytes(np.ones(2, np.float32).tobytes())
    made = read_elsewhere("weights").SerializeToString()
    monkeypatch.chdir(tmp_path)
    options = trial.onnxruntime.SessionOptions()
    options.graph_optimization_level = trial.onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    # The attack works without the trial: bytes of the present folder become weights.
    assert trial.Session(made, options=options).run(np.ones((1, 2))) == 2.0
    for place in (tmp_path, "/"):
        monkeypatch.chdir(place)
        with pytest.raises(trial.Unplayable, match="onnxruntime: "):
            trial.tried_out(made)
            trial.tried_out.cache_clear()


@pytest.mark.parametrize(
    ("work", "said"),
    [
        ("bytearray(MODEL_MEMORY + (1 << 20))", "MemoryError"),
        ("bytearray(MODEL_MEMORY // 2)", ""),
        ("open('/etc/passwd')", "Too many open files"),
        ("open('planted', 'w')", "Too many open files"),
    ],
)
def test_what_a_trial_may_take(tmp_path, work, said):
    code = (
        "from uwb_tdoa_bias.correction.trial import MODEL_MEMORY, "
        f"_limit_this_process\n_limit_this_process()\n{work}"
    )
    done = python("-c", code, cwd=tmp_path)
    assert (
        (done.returncode == 1) == bool(said) and said in done.stderr and not any(tmp_path.iterdir())
    )


def test_a_trial_takes_no_module_of_the_present_folder(tmp_path, monkeypatch):
    for name in ("numpy", "json", "onnxruntime", "uwb_tdoa_bias", "sitecustomize", "usercustomize"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    monkeypatch.setenv("PYTHONPATH", os.pathsep)
    trial.tried_out.cache_clear()
    assert trial.tried_out(model(NODE("Elu", ["x"], ["y"])).SerializeToString()) is False
    assert not (tmp_path / "ran").exists()


def test_a_trial_without_an_end(monkeypatch):
    """A trial can hang on a busy machine, or if its process is stopped."""
    monkeypatch.setattr(trial, "MODEL_WAIT", 0.3)
    monkeypatch.setattr(trial, "START", "import time; time.sleep(60)")
    trial.tried_out.cache_clear()
    with pytest.raises(trial.Unplayable, match="no end of its trial after 0.3 s"):
        trial.tried_out(b"any")


def test_a_model_is_tried_once(monkeypatch):
    made = model(NODE("Elu", ["x"], ["h"]), NODE("Elu", ["h"], ["y"])).SerializeToString()
    trial.tried_out(made)
    monkeypatch.setattr(trial.subprocess, "run", None)
    assert trial.tried_out(made) is False


def test_a_name_goes_into_messages_and_tables(tmp_path):
    path = tmp_path / "model.onnx"
    made = model(
        NODE("MatMul", ["x", "column"], ["y"]),
        constants=[COLUMN],
        meta={**META, "name": "<b>\x1b[31m$\\frac$" + "x" * 10**5},
    )
    path.write_bytes(made.SerializeToString())
    name = Network(path).name
    assert name.startswith("_b___31m__frac_x") and len(name) == 100


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\xff" * 1_000_000, "onnxruntime: "),
        (b"", "is empty"),
        (bytes(MODEL_BYTES + 1), "more than 4000000 bytes"),
    ],
)
def test_bytes_that_are_no_model(tmp_path, content, said):
    (tmp_path / "model.onnx").write_bytes(content)
    with pytest.raises(InputError, match=said):
        Network(tmp_path / "model.onnx")
