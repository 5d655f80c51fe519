"""Compiled code is read from no folder in which anybody else may have put it: what is there is run."""

import ast
import os
from pathlib import Path
import shutil

import pytest

from uwb_tdoa_bias.foundation import compiled

SOURCES = Path(__file__).resolve().parents[2]
NAME = "0123"  # of a state of the sources


@pytest.fixture
def named(tmp_path, monkeypatch):
    """A folder that NUMBA_CACHE_DIR names; the user's own is another."""
    (tmp_path / "between").mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "between" / "named"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "between" / "named"


def place():
    for function in (compiled._place, compiled._say):
        function.cache_clear()
    return compiled._place(NAME)


def foreign(monkeypatch, *paths):
    """Files that seem to belong to somebody else."""
    for name in ("stat", "lstat"):
        plain = getattr(os, name)
        of_another = lambda found: os.stat_result((*found[:4], os.getuid() + 1, *found[5:]))  # noqa: E731

        def changed(path, *a, plain=plain, **k):
            return of_another(plain(path)) if str(path) in map(str, paths) else plain(path, *a, **k)

        monkeypatch.setattr(os, name, changed)


def test_the_named_folder_is_used_and_made_for_the_user_alone(named):
    assert place() == named / NAME
    assert (named / NAME).stat().st_mode & 0o777 == 0o700
    named.chmod(0o755)
    assert place() == named / NAME


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o757])
@pytest.mark.parametrize("which", ["", NAME, f"{NAME}/module", f"{NAME}/module/planted.nbi"])
def test_what_others_may_write_to_is_not_used(named, capsys, mode, which):
    (named / NAME / "module").mkdir(parents=True)
    (named / NAME / "module" / "planted.nbi").write_bytes(b"")
    (named / which).chmod(mode)
    if which == "" and mode & 0o1000:  # as in /tmp: what is there and ours stays ours
        assert place() == named / NAME
        return
    own = named.parents[1] / "uwb_tdoa"
    assert place() == own / NAME
    assert f"others may write to {named}; {own} is used" in capsys.readouterr().err


def test_what_leads_to_a_folder_counts(named):
    named.parent.chmod(0o777)  # anybody may put another folder there
    assert place() == named.parents[1] / "uwb_tdoa" / NAME
    named.parent.chmod(0o1777)
    assert place() == named / NAME


def test_a_group_of_several_may_not_write_there(named, monkeypatch):
    named.mkdir()
    named.chmod(0o775)
    monkeypatch.setattr(compiled, "_is_alone", lambda _: False)
    assert place() == named.parents[1] / "uwb_tdoa" / NAME
    monkeypatch.setattr(compiled, "_is_alone", lambda _: True)
    assert place() == named / NAME


@pytest.mark.parametrize("which", ["", NAME, f"{NAME}/planted.nbi"])
def test_what_belongs_to_somebody_else_is_not_used(named, monkeypatch, which):
    (named / NAME).mkdir(parents=True)
    (named / NAME / "planted.nbi").write_bytes(b"")
    foreign(monkeypatch, named / which)
    assert place() == named.parents[1] / "uwb_tdoa" / NAME


def test_a_link_is_followed_once(named):
    true = named.parents[1] / "true"
    true.mkdir()
    named.symlink_to(true)
    assert place() == true / NAME


def test_without_any_folder_of_ones_own_there_is_a_temporary_one(named, monkeypatch, capsys):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    own = named.parents[1] / "uwb_tdoa"
    own.mkdir()
    own.chmod(0o777)
    found = place()
    assert found.is_relative_to(compiled._temporary()) and os.stat(found.parent).st_mode & 0o777 == 0o700
    assert f"others may write to {own}; a temporary folder is used" in capsys.readouterr().err
    shutil.rmtree(own)
    own.write_text("no folder")
    assert place() == found and "nothing can be kept" in capsys.readouterr().err


def test_no_compiled_function_unpacks_an_argument_by_a_bare_name():
    """numba 0.68 may lose what is changed in place of arrays in a tuple: `x, cost = places` and `x[0] -= step`. `places.x` is right."""
    unpacked, looked = [], 0
    for path in SOURCES.glob("uwb_tdoa_*/uwb_tdoa_*/**/*.py"):
        for function in ast.walk(ast.parse(path.read_text())):
            if isinstance(function, ast.FunctionDef) and any(ast.unparse(by) == "compiled" for by in function.decorator_list):
                looked += 1
                names = {argument.arg for argument in function.args.args}
                for node in ast.walk(function):
                    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple) and ast.unparse(node.value) in names:
                        unpacked.append(f"{path.relative_to(SOURCES)}:{node.lineno}")
    assert looked > 200 and not unpacked
