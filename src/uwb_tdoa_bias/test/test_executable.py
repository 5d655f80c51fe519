# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start of executables, and their end when they are interrupted before they have begun."""

import os
from signal import SIGINT
import sys

from programs import python, start
import pytest

from uwb_tdoa_bias.common import executable as module
from uwb_tdoa_bias.common.executable import executable, node_executable

SLOW = """
import time
print("in", flush=True)
try:
    time.sleep(600)
except BaseException:  # as some libraries do
    time.sleep(600)
"""
LOSSY = """
import ctypes, time
def work():
    print("in", flush=True)
    time.sleep(600)
def main():
    try:
        ctypes.CFUNCTYPE(None)(work)()  # C code loses the interrupt: it comes again
        time.sleep(600)
    except KeyboardInterrupt:
        return 7
"""
START = (
    "import sys; from uwb_tdoa_bias.common.executable import executable; "
    "sys.exit(executable('{}')())"
)


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Return write(name, text), which writes a module that this and other processes can import."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", ":".join([str(tmp_path), *sys.path]))
    return lambda name, text: (tmp_path / f"{name}.py").write_text(text)


def test_what_main_returns_is_returned(write):
    write("weigh", "def main(*arguments): return 3 + len(arguments)")
    assert executable("weigh")() == 3 and executable("weigh")(["heavy"]) == 4


def test_an_import_that_takes_long_is_said(write, monkeypatch, capsys):
    waits = (
        "import sys, time\nend = time.monotonic() + 120.0\nwhile 'starting' not in "
        "sys.stderr.getvalue() and time.monotonic() < end: pass\n"
    )
    write("takes_long", waits + "def main(): return 0")
    monkeypatch.setattr(module, "SAID", 0.01)
    assert executable("takes_long")() == 0
    assert capsys.readouterr().err == "takes_long: starting\n"


@pytest.mark.parametrize("module, code", [(SLOW, 130), (LOSSY, 7)])
def test_an_interrupt_is_quiet_while_it_imports_and_then_the_affair_of_main(write, module, code):
    write("module", module)
    process = start("-c", START.format("module"))
    assert process.stdout.readline() == "in\n"
    process.send_signal(SIGINT)
    assert process.communicate(timeout=120) == ("", "") and process.returncode == code


COMPILES = """
import signal
from uwb_tdoa_bias.common.executable import interrupt
signal.signal(signal.SIGINT, lambda number, frame: interrupt(number, frame, compiling=True))
def work():
    print("in", flush=True)
    try:
        signal.pause()
    except BaseException as error:  # as numba does: it becomes another error
        raise RuntimeError("lowering") from error
work.__globals__["__name__"] = "numba.core.lowering"
work()
"""


def test_an_interrupt_while_numba_compiles_for_a_node_ends_it_quietly():
    process = start("-c", COMPILES)
    assert process.stdout.readline() == "in\n"
    process.send_signal(SIGINT)
    assert process.communicate(timeout=120) == ("", "") and process.returncode == 130


@pytest.mark.parametrize(
    ("missing", "remedy"),
    [
        ("rclpy_is_gone_msgs", "source ROS 2 Jazzy and the built workspace"),
        ("nowhere", "install it with pip"),
    ],
)
def test_what_is_not_installed_is_told_in_one_sentence(write, capsys, missing, remedy):
    write("needy", f"import {missing}.part")
    assert executable("needy")() == 2
    error = capsys.readouterr().err
    assert error.startswith(f"needy: error: the Python package {missing} is missing; {remedy}")
    assert error.count("\n") == 1


def test_a_part_of_ours_that_is_missing_is_a_defect():
    with pytest.raises(ModuleNotFoundError):
        executable("uwb_tdoa_bias.nowhere")()


@pytest.mark.parametrize("variable, usual", [("OMP_NUM_THREADS", "1"), ("NUMBA_OPT", "2")])
@pytest.mark.parametrize("given", [None, "3"])
@pytest.mark.parametrize("start", [executable, node_executable])
def test_libraries_take_one_thread_and_compile_quickly_unless_the_user_says_more(
    write, monkeypatch, start, given, variable, usual
):
    name, kept = f"tells_{variable}_{given}_{start.__name__}", given or usual
    write(name, f"import os\nseen = os.environ['{variable}']\ndef main(): return seen")
    monkeypatch.setenv(variable, given) if given else monkeypatch.delenv(variable, raising=False)
    # The variable is set before the module is imported.
    assert start(name)() == kept


@pytest.mark.parametrize("late", [False, True])
def test_a_folder_of_recordings_does_not_say_how_libraries_behave(
    write, tmp_path, monkeypatch, late
):
    """The present folder must not configure the libraries.

    matplotlib reads its settings from the folder in which it is imported. They can exhaust the
    memory or start LaTeX. numba reads its cache and modules from there. Most commands import
    matplotlib late, in the folder of the user.
    """
    pytest.importorskip("matplotlib")
    (tmp_path / "matplotlibrc").write_text("savefig.dpi: 100000\ntext.usetex: True\n")
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\n")
    monkeypatch.chdir(tmp_path)
    imports = "import os, matplotlib, numba"
    write(
        "draws",
        ("" if late else f"{imports}\n") + f"def main():\n    {imports}\n"
        "    print(matplotlib.rcParams['savefig.dpi'], numba.config.DISABLE_JIT, os.getcwd())",
    )
    kept = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    done = python("-c", START.format("draws"), env=kept)
    assert done.stdout == f"figure 0 {tmp_path}\n", done.stderr
