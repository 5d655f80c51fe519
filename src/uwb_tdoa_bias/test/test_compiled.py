import os

import pytest

from uwb_tdoa_bias.foundation import compiled


@pytest.fixture
def named(tmp_path, monkeypatch):
    """A folder that NUMBA_CACHE_DIR names; the user's own is another."""
    compiled._is_ours.cache_clear()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "named"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "named"


def test_the_named_folder_is_used_whether_it_is_there_or_not(named):
    assert compiled._base() == named
    compiled._is_ours.cache_clear()
    named.mkdir(mode=0o755)
    assert compiled._base() == named


def test_compiled_code_is_not_read_where_others_may_put_it(named, capsys, monkeypatch):
    named.mkdir()
    named.chmod(0o777)
    assert compiled._base() == named.parent / "uwb_tdoa"
    assert compiled._base() == named.parent / "uwb_tdoa"
    assert capsys.readouterr().err.count(f"others may write to {named}; {named.parent / 'uwb_tdoa'} is used") == 1
    named.chmod(0o755)
    compiled._is_ours.cache_clear()
    monkeypatch.setattr(os, "stat", lambda _: os.stat_result((0o40755, 0, 0, 1, os.getuid() + 1, 0, 0, 0, 0, 0)))  # somebody else's
    assert not compiled._is_ours(str(named), "another")
