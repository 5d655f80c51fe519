# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compiled code is executed, so it is never read from a folder that another user may write to."""

import ast
import gc
import importlib
import os
from pathlib import Path
import sys
from types import SimpleNamespace

import numpy as np
from programs import python
import pytest

from uwb_tdoa_bias.common import compiled, executable
from uwb_tdoa_bias.common.files import TEMPORARY

SOURCES = Path(__file__).resolve().parents[2]
NAME = "0123"  # of one state of the sources


@pytest.fixture
def named(tmp_path, monkeypatch):
    """Return the folder in NUMBA_CACHE_DIR. The default folder of the user is another."""
    (tmp_path / "between").mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "between" / "named"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "between" / "named"


def place():
    compiled._place.cache_clear()
    return compiled._place(NAME)


def is_temporary(folder):
    return folder.name.startswith(TEMPORARY) and folder.stat().st_mode & 0o777 == 0o700


def foreign(monkeypatch, *paths):
    """Make files appear to belong to another user."""
    plain = os.stat

    def changed(path, *a, **k):
        found = plain(path, *a, **k)
        return (
            os.stat_result((*found[:4], os.getuid() + 1, *found[5:]))
            if str(path) in map(str, paths)
            else found
        )

    monkeypatch.setattr(os, "stat", changed)


def test_the_named_folder_is_used_and_made_for_the_user_alone(named):
    assert place() == named / NAME
    assert (named / NAME).stat().st_mode & 0o777 == 0o700
    named.chmod(0o755)
    assert place() == named / NAME


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o757, 0o775, 0o755])
def test_a_folder_into_which_others_get_is_not_used(named, capsys, mode):
    """Another user may have put files into it."""
    (named / NAME).mkdir(parents=True)
    (named / NAME).chmod(mode)
    assert is_temporary(place())
    assert (
        f"others may write to {named / NAME}; a temporary folder is used" in capsys.readouterr().err
    )


def test_what_belongs_to_somebody_else_is_not_used(named, monkeypatch):
    (named / NAME).mkdir(parents=True, mode=0o700)
    foreign(monkeypatch, (named / NAME).resolve())
    assert is_temporary(place())


@pytest.mark.parametrize("mode, used", [(0o777, False), (0o775, False), (0o1777, True)])
def test_a_parent_in_which_others_may_rename_is_not_used(named, mode, used):
    """They could put a folder of theirs in its place."""
    named.parent.chmod(mode)
    assert (place() == named / NAME) == used


def test_a_parent_of_another_user_is_not_used(named, monkeypatch):
    named.mkdir(mode=0o700)
    foreign(monkeypatch, named.parent.resolve())
    assert is_temporary(place())


def test_without_a_home_a_temporary_folder_is_used(monkeypatch):
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as without HOME and user name
    assert is_temporary(place())


@pytest.mark.parametrize("variables", [{"NUMBA_CACHE_DIR": "cache"}, {"XDG_CACHE_HOME": "cache"}])
def test_no_folder_of_the_present_folder_is_used(named, monkeypatch, capsys, variables):
    """Unpacked archives keep their modes and belong to the user, so they may hold planted code."""
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(named.parent)
    assert is_temporary(place()) and not any(named.parent.iterdir())
    assert "the present folder may be another's, and holds" in capsys.readouterr().err


def test_where_nothing_can_be_kept_there_is_a_temporary_folder(named, capsys):
    named.write_text("no folder")
    assert is_temporary(place()) and "nothing can be kept" in capsys.readouterr().err


def test_no_compiled_function_unpacks_an_argument_by_a_bare_name():
    """Check every compiled function for assignments such as `x, cost = places`.

    After them, numba 0.68 may lose in-place changes of arrays (`x[0] -= step`). `places.x` works.
    """
    unpacked, looked = [], 0
    for path in SOURCES.glob("uwb_tdoa_*/uwb_tdoa_*/**/*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef) and any(
                ast.unparse(by) == "compiled" for by in function.decorator_list
            ):
                looked += 1
                names = {argument.arg for argument in function.args.args}
                for node in ast.walk(function):
                    if (
                        isinstance(node, ast.Assign)
                        and isinstance(node.targets[0], ast.Tuple)
                        and ast.unparse(node.value) in names
                    ):
                        unpacked.append(f"{path.relative_to(SOURCES)}:{node.lineno}")
    assert looked > 200 and not unpacked


def test_a_link_is_followed_once_and_the_default_is_the_cache_of_the_user(named, monkeypatch):
    true = named.parents[1] / "true"
    true.mkdir()
    named.symlink_to(true)
    assert place() == true / NAME
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert place() == named.parents[1] / "uwb_tdoa" / NAME


CALLER = """
from uwb_tdoa_probe.{folder} import code
from uwb_tdoa_probe.{folder}.code import twice
from uwb_tdoa_bias.common.compiled import compiled

@compiled
def by_name(x):
    return twice(x)

@compiled
def by_module(x):
    return code.twice(x)

@compiled
def by_constant(x):
    return x + code.SHIFT
"""
CODE = """
from uwb_tdoa_bias.common.compiled import compiled
SHIFT = {shift}

@compiled
def twice(x):
    return {factor} * x
"""


def digests(tmp_path, monkeypatch, version, shift=1.0, factor=2.0, folder="area"):
    """Return the digests of three functions of a version, which reach another module."""
    monkeypatch.syspath_prepend(tmp_path / version)
    for name in [name for name in sys.modules if name.startswith("uwb_tdoa_probe")]:
        monkeypatch.delitem(sys.modules, name)
    place = tmp_path / version / "uwb_tdoa_probe" / folder
    place.mkdir(parents=True)
    (place / "code.py").write_text(CODE.format(shift=shift, factor=factor))
    (place / "caller.py").write_text(CALLER.format(folder=folder))
    functions = vars(importlib.import_module(f"uwb_tdoa_probe.{folder}.caller"))
    names = "by_name", "by_module", "by_constant"
    return {name: compiled._digest(functions[name].py_func) for name in names}


def test_the_name_of_a_cache_file_depends_on_all_that_the_function_reaches(tmp_path, monkeypatch):
    before = digests(tmp_path, monkeypatch, "one")
    assert len(set(before.values())) == 3
    assert digests(tmp_path, monkeypatch, "equal") == before

    other_call = digests(tmp_path, monkeypatch, "two", factor=3.0)
    assert [name for name in before if other_call[name] != before[name]] == ["by_name", "by_module"]
    other_constant = digests(tmp_path, monkeypatch, "three", shift=2.0)
    assert [name for name in before if other_constant[name] != before[name]] == ["by_constant"]

    # A file that names another module would not load.
    moved = digests(tmp_path, monkeypatch, "moved", folder="elsewhere")
    assert not set(moved.values()) & set(before.values())
    monkeypatch.setattr(compiled, "VERSIONS", "0.99 3.0")
    assert not set(digests(tmp_path, monkeypatch, "four").values()) & set(before.values())


def test_a_function_of_another_folder_that_changed_is_compiled_anew(tmp_path):
    """Run one program twice with one cache; the called function changes in between."""
    package = tmp_path / "uwb_tdoa_probe" / "one"
    package.mkdir(parents=True)
    (package / "caller.py").write_text(CALLER.format(folder="one"))
    program = (
        "from uwb_tdoa_probe.one.caller import by_name, by_module, by_constant as c;"
        "print(by_name(1.0), by_module(1.0), c(1.0), sum(by_name.stats.cache_hits.values()))"
    )
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    printed = []
    for shift, factor in ((1.0, 2.0), (1.0, 2.0), (4.0, 3.0)):
        (package / "code.py").write_text(CODE.format(shift=shift, factor=factor))
        environment = {**os.environ, **cache, "PYTHONPATH": paths}
        printed.append(python("-c", program, env=environment, check=True).stdout.split())
    assert printed == [
        ["2.0", "2.0", "2.0", "0"],
        ["2.0", "2.0", "2.0", "1"],
        ["3.0", "3.0", "5.0", "0"],
    ]


@pytest.fixture
def listener(tmp_path, monkeypatch):
    """Return a _Listener with an empty cache that prints whenever it may."""
    monkeypatch.setattr(compiled, "_place", lambda _: tmp_path)
    monkeypatch.setattr(compiled, "SAY_EVERY", -1.0)
    return compiled._Listener()


@pytest.mark.parametrize("kept", [False, True])
def test_an_empty_cache_is_announced_before_the_first_compilation(listener, tmp_path, capsys, kept):
    if kept:
        (tmp_path / "function.nbi").touch()
    for _ in range(2):
        listener.on_start(None)
        listener.on_end(None)
    printed = capsys.readouterr().err.splitlines()
    assert ("about a minute" in printed[0]) != kept
    assert sum("about a minute" in line for line in printed) == (not kept)


def test_the_printed_share_never_falls(listener, capsys, monkeypatch):
    done, open_ = SimpleNamespace(signatures=[1]), SimpleNamespace(signatures=[])
    for functions in ([done, open_], [done, open_, open_], [done, done, open_]):
        monkeypatch.setattr(compiled, "_FUNCTIONS", functions)
        listener._tell()
    shares = [line.split()[5] for line in capsys.readouterr().err.splitlines()]
    assert shares == ["50%,", "50%,", "67%,"]


def test_a_compilation_tells_how_long_it_takes_and_whether_the_machine_is_busy(
    listener, capsys, monkeypatch
):
    """The share is that of typed functions; linking them takes the rest of the time."""
    done, open_ = SimpleNamespace(signatures=[1]), SimpleNamespace(signatures=[])
    monkeypatch.setattr(compiled, "_FUNCTIONS", [done, open_])
    clocks = iter([(0.0, 0.0), (35.0, 35.0), (40.0, 40.0), (90.0, 50.0)])
    monkeypatch.setattr(compiled, "_clocks", lambda: np.array(next(clocks)))
    listener._since = compiled._clocks()
    for _ in range(3):
        listener._tell()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "compiling, which is done once: 50%, 35 s, about 65 s left"
    assert lines[1].endswith(", 40 s, about 60 s left")  # of 100 s
    assert lines[2].endswith(", about 10 s left; the machine is busy and gives this 56% of a core")


def test_lines_of_progress_show_a_compilation(listener, capsys, monkeypatch):
    monkeypatch.setattr(executable.COMPILING, "shown", True)
    monkeypatch.setattr(executable.COMPILING, "text", "")
    listener.on_start(None)
    assert executable.COMPILING.text.startswith("compiling, which is done once: ")
    listener.on_end(None)
    assert executable.COMPILING.text == ""
    assert "which is done once: " not in capsys.readouterr().err


def test_garbage_is_collected_as_before_after_a_compilation():
    before, listener = gc.get_threshold(), compiled._Listener()
    listener.on_start(None)
    listener.on_start(None)  # a function that the first one calls
    listener.on_end(None)
    assert gc.get_threshold() == executable.COLLECT
    listener.on_end(None)
    assert gc.get_threshold() == before
