# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compiled code is executed, so it is never read from a folder that another user may write to."""

import ast
import gc
import os
from pathlib import Path

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


def test_each_state_of_the_sources_and_of_what_compiles_them_has_a_folder(tmp_path, monkeypatch):
    for name, text in (("one", "x = 1"), ("same", "x = 1"), ("other", "x = 2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "code.py").write_text(text)

    def name(folder):
        compiled._digest.cache_clear()
        return compiled._digest(tmp_path / folder)

    assert name("one") == name("same") != name("other")
    before = name("one")
    monkeypatch.setattr(compiled, "VERSIONS", "0.99 3.0")
    assert name("one") != before


def test_garbage_is_collected_as_before_after_a_compilation():
    before, listener = gc.get_threshold(), compiled._Listener()
    listener.on_start(None)
    listener.on_start(None)  # a function that the first one calls
    listener.on_end(None)
    assert gc.get_threshold() == executable.COLLECT
    listener.on_end(None)
    assert gc.get_threshold() == before
