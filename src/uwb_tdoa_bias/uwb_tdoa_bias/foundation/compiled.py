"""numba's njit with an on-disk cache that never runs yesterday's code.

numba's own cache notices a change in the file of a compiled function, but not in the files of the functions it calls.
Here every state of the sources has a cache folder of its own.
"""

from __future__ import annotations

import atexit
from contextlib import contextmanager
from functools import lru_cache
import grp
import hashlib
import os
from pathlib import Path
import pwd
import shutil
import stat
import sys
import tempfile
import time
from typing import Any, TYPE_CHECKING, TypeVar

from .elsewhere import elsewhere

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from os import stat_result
    from numba.core.event import Event


@contextmanager
def _hidden(*names: str) -> Iterator[None]:
    """Packages that are not imported yet seem not to be installed."""
    hidden = [name for name in names if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None says that it is not there
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# numba imports these only to see whether they are there, which takes a fifth of a second of a node's start: for products of matrices
# in compiled code, of which there are none here, and for coverage of it.
with _hidden("scipy", "coverage"), elsewhere():
    from numba import config, njit
    from numba.core import event
    import numba.np.arraymath  # noqa: F401

_FUNCTIONS: list[Any] = []  # all that are compiled when they are first called
SAY_EVERY = 4.0  # s
Record = Any  # one row of a structured array, whose fields compiled code reads and writes as attributes: Python knows no type of it
Function = TypeVar("Function", bound="Callable[..., Any]")

config._config_fname = "/dev/null/.numba_config.yaml"  # numba would look into the present folder before it compiles anything


def compiled(function: Function) -> Function:
    """Decorator: compile `function`, which may call others below its folder and of the foundation, and cache it."""
    before = config.CACHE_DIR  # type: ignore[attr-defined]  # numba puts its settings there while it is imported
    place = _place(_digest(Path(function.__code__.co_filename).parent))
    config.CACHE_DIR = str(place)  # type: ignore[attr-defined]  # as above
    try:
        _FUNCTIONS.append(njit(error_model="numpy", cache=True)(function))
        return _FUNCTIONS[-1]
    finally:
        config.CACHE_DIR = before  # type: ignore[attr-defined]  # as above


class _Listener(event.Listener):
    """Says on stderr, every few seconds, how much is compiled: where nothing is in the cache that takes a minute or two. The share is of
    the functions of all modules that are imported, nearly all of which the filter needs."""

    def __init__(self) -> None:
        self._compiled, self._depth, self._began = 0.0, 0, 0.0  # s

    def on_start(self, event: Event) -> None:
        self._began = self._began if self._depth else time.monotonic()
        self._depth += 1
        self._tell()

    def on_end(self, event: Event) -> None:
        self._tell()
        self._depth -= 1

    def _tell(self) -> None:
        now = time.monotonic()
        if now - self._began > SAY_EVERY:
            self._compiled, self._began = self._compiled + now - self._began, now
            share = sum(bool(each.signatures) for each in _FUNCTIONS) / len(_FUNCTIONS)
            print(f"compiling, which is done once: {share:.0%}, {self._compiled:.0f} s", file=sys.stderr, flush=True)


event.register("numba:compile", _Listener())


@lru_cache(maxsize=None)
def _place(name: str) -> Path:
    """The folder `name` in NUMBA_CACHE_DIR if set, else in the user's cache folder: the first in which nobody else may have put
    compiled code, which would be run; else a temporary one."""
    home, named = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", os.environ.get("NUMBA_CACHE_DIR")
    own = str(Path(home) / "uwb_tdoa")
    for base, instead in ((named, own), (own, "a temporary folder")):
        if base:
            try:
                os.makedirs(Path(base) / name, mode=0o700, exist_ok=True)
                if _is_ours(found := (Path(base) / name).resolve()):
                    return found
                why = "others may write to"
            except OSError as error:
                why = f"nothing can be kept ({error.strerror}) in"
            _say(f"{'NUMBA_CACHE_DIR: ' * (base == named)}{why} {base}; {instead} is used; name a folder of your own.")
    return Path(_temporary()) / name


def _is_ours(folder: Path) -> bool:
    """Whether nobody else may write, or have written, to an absolute folder, to what is in it, or to what leads to it."""
    own, above = os.stat(folder), [os.stat(parent) for parent in folder.parents]
    within = [os.lstat(os.path.join(at, name)) for at, *names in os.walk(folder) for name in (*names[0], *names[1])]
    if {found.st_uid for found in (own, *above, *within)} - {os.getuid(), 0}:
        return False
    writable = [own, *(found for found in above if not found.st_mode & stat.S_ISVTX)]
    writable += within if own.st_mode & (stat.S_IXGRP | stat.S_IXOTH) else []  # else nobody gets there
    return not any(map(_others_may_write, writable))


def _others_may_write(found: stat_result) -> bool:
    """By the mode of a file or folder, where a group that the user alone is in does not count."""
    return bool(found.st_mode & stat.S_IWOTH or found.st_mode & stat.S_IWGRP and not _is_alone(found.st_gid))


@lru_cache(maxsize=None)
def _is_alone(gid: int) -> bool:
    try:
        user, group = pwd.getpwuid(os.getuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    return user.pw_gid == gid and group.gr_name == user.pw_name and not {*group.gr_mem} - {user.pw_name}


@lru_cache(maxsize=None)
def _temporary() -> str:
    folder = tempfile.mkdtemp(prefix="uwb_tdoa_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@lru_cache(maxsize=None)
def _say(text: str) -> None:
    print(text, file=sys.stderr)


@lru_cache(maxsize=None)
def _digest(folder: Path) -> str:
    """Name of the present state of the sources below `folder` and beside this file."""
    digest = hashlib.sha256()
    for source in sorted({*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]
