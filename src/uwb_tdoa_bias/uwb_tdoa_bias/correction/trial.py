# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run a model first in a process with little time and memory that opens no file.

A model may come from anywhere, and 1 kB of it may unfold to terabytes. `tried_out` starts a
process that gets the bytes, limits itself, loads them with onnxruntime, and runs them. Only bytes
that pass this trial are loaded elsewhere. No trial covers all inputs of a model. Therefore all
operators that onnxruntime executes, by its own profile, must be in OPERATORS. None of them loops,
branches, or makes a shape out of numbers.
"""

from __future__ import annotations

from functools import lru_cache
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import time

import numpy as np

try:
    import resource
except ImportError:  # Windows limits no process
    resource = None  # type: ignore[assignment]  # None marks the missing module

from ..common.errors import MODEL_MEMORY, MODEL_NODES, MODEL_ROW_SECONDS, MODEL_SECONDS, MODEL_WAIT
from ..common.files import temporary_folder
from .session import BATCH, PACKED, Session, Unplayable, onnxruntime

OPERATORS = (
    "Abs Add And Atan Ceil Celu Clip Concat Constant Cos Div Elu Equal Erf Exp Floor Gather Gemm "
    "HardSigmoid Identity LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max Min Mul "
    "Neg Not Or Reciprocal ReduceMax ReduceSum Relu Reshape Selu Sigmoid Sign Sin Softmax Softplus "
    "Softsign Sqrt Sub Sum Tanh Where"
).split()
MEMORY = Path("/proc/self/status")  # names the memory of this process
START = (
    f"import json, sys; sys.path[:] = json.loads(sys.argv[1]); from {__name__} import main; main()"
)


@lru_cache(maxsize=4)
def tried_out(content: bytes) -> bool:
    """Return whether rows of a model must be run separately to give the same bits in any batch.

    Raises Unplayable if the content of an ONNX file fails the trial.
    """
    if resource is None or not MEMORY.exists():
        raise Unplayable("this system does not limit the memory of a trial; use it on Linux")
    path = [
        entry for entry in sys.path if os.path.isabs(entry)
    ]  # the process runs in an empty folder
    with temporary_folder() as folder:
        try:
            done = subprocess.run(
                [sys.executable, "-I", "-S", "-c", START, json.dumps(path)],
                input=content,
                capture_output=True,
                cwd=folder,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                timeout=MODEL_WAIT,
            )
        except subprocess.TimeoutExpired as error:
            raise Unplayable(f"no end of its trial after {MODEL_WAIT:g} s") from error
    if done.returncode < 0:
        raise Unplayable(
            f"it takes more than {MODEL_SECONDS} s or {MODEL_MEMORY >> 20} MB to load and play"
        )
    if done.returncode > 0:
        raise RuntimeError(done.stderr.decode(errors="replace"))
    alone, why = json.loads(done.stdout)
    if why:
        raise Unplayable(why)
    return bool(alone)


def main() -> None:
    """Judge the model on standard input, and write the result to standard output."""
    print(json.dumps(judge(sys.stdin.buffer.read())))


def judge(content: bytes) -> tuple[bool, str]:
    """Return (whether rows must be run separately, reason for refusal or "").

    Limits this process permanently, and writes to the present folder.
    """
    _limit_this_process()
    try:
        _refuse_operators(content)
        session = Session(content)
        _refuse_slow(session)
        session.alone |= not _is_the_same_in_any_batch(session)
    except Exception as error:  # any exception of a library, also for lack of memory
        return False, str(error) if isinstance(error, Unplayable) else repr(error)[:200]
    return session.alone, ""


def _limit_this_process() -> None:
    """Limit time and memory of this process; from now on it opens no file and leaves no dump."""
    memory = int(re.search(r"VmSize:\s+(\d+)", MEMORY.read_text("utf-8"))[1]) << 10  # type: ignore[index]  # found on Linux
    seconds = int(time.process_time()) + 1 + MODEL_SECONDS
    for limit, most in (
        ("AS", memory + MODEL_MEMORY),
        ("CPU", seconds),
        ("CORE", 0),
        ("FSIZE", MODEL_MEMORY),
    ):
        resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (most, most))
    _let_open(0)


def _let_open(count: int) -> None:
    """Allow this process to open `count` more files."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    free = os.open("/", os.O_PATH)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free + count, most))


def _refuse_operators(content: bytes) -> None:
    """Raise Unplayable unless all executed operators are in OPERATORS, without optimization."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.enable_profiling, options.profile_file_prefix = True, "profile"
    # One file: the profile, which is opened first. A model with weights in another file finds none.
    _let_open(1)
    session = Session(content, options=options)
    profile = session.end_profiling()
    _let_open(1)
    kinds = [
        event["args"]["op_name"]
        for event in json.loads(Path(profile).read_bytes())
        if event["cat"] == "Node"
    ]
    if len(kinds) > MODEL_NODES:
        raise Unplayable(f"more than {MODEL_NODES} operators")
    for kind in {*kinds} - {*OPERATORS}:
        raise Unplayable(f"operator {kind[:40]!r} is none of {', '.join(OPERATORS)}")


def _is_the_same_in_any_batch(session: Session) -> bool:
    """Return whether random rows give the same bits in all batches as separately.

    A sum over columns may not: onnxruntime adds in an order that depends on the address of the row.
    Models that mix rows, and models of one batch size, do not either.
    """
    x = np.random.default_rng(0).normal(size=(BATCH, session.width))
    try:
        expected = np.concatenate([session.run(row[None]) for row in x])
        batches = [slice(0, count) for count in range(PACKED, BATCH + 1, PACKED)] + [
            slice(None, None, -1)
        ]
        return all(
            np.array_equal(session.run(x[batch]), expected[batch], equal_nan=True)
            for batch in batches
        )
    except Unplayable:
        return False


def _refuse_slow(session: Session) -> None:
    """Raise Unplayable if a single row takes more than MODEL_ROW_SECONDS."""
    row = np.ones((1, session.width))
    began = time.process_time()
    for _ in range(PACKED):
        session.run(row)
    each = (time.process_time() - began) / PACKED
    if each > MODEL_ROW_SECONDS:
        raise Unplayable(
            f"a row takes {1e3 * each:.1f} ms, more than {1e3 * MODEL_ROW_SECONDS:g} ms"
        )
