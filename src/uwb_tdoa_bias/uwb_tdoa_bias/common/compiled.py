# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""numba's njit with an on-disk cache that follows every change of the sources.

numba's own cache notices a change in the file of a compiled function. It does not notice changes
in the files of the functions that it calls. Here every state of the sources has its own folder.
Equal sources share it wherever they are installed: a second installation compiles nothing.
"""

from __future__ import annotations

from contextlib import contextmanager
from functools import cache
import gc
import hashlib
import os
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from . import executable  # it also imports numba in another folder
from .files import new_folder_until_exit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numba.core.event import Event


@contextmanager
def _hidden(*names: str) -> Iterator[None]:
    """Let packages that are not imported yet appear as not installed inside the block."""
    hidden = [name for name in names if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]  # None marks a missing module
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# numba imports these packages only to test whether they exist, 0.2 s of a node's start. It needs
# scipy for matrix products in compiled code, and coverage to measure compiled code. The project
# does neither.
with _hidden("scipy", "coverage"):
    import numba
    from numba import config, njit
    from numba.core import caching, event
    import numba.np.arraymath  # noqa: F401

    from . import callees

_FUNCTIONS: list[Any] = []  # all compiled functions; numba compiles at the first call
SAY_EVERY = 4.0  # s
# Machine code also depends on these. numba names the version of Python in its files.
VERSIONS = f"{numba.__version__} {np.__version__}"
# One row of a structured array. Compiled code reads and writes its fields as attributes. Python
# has no type for it.
Record = Any
Function = TypeVar("Function", bound="Callable[..., Any]")

# numba would otherwise look for settings in the present folder before each compilation.
config._config_fname = "/dev/null/.numba_config.yaml"
callees.install()


class _Locator(caching.CacheImpl._locator_classes[0]):  # type: ignore[misc,valid-type]  # its name changes
    """Name the files of a function in config.CACHE_DIR without the path and time of its source."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return Path(py_file).parent.name

    def get_source_stamp(self) -> str:
        return ""  # the folder is that of one state of the sources


class _Files(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]


class _Cache(caching.FunctionCache):
    _impl_class = _Files


def compiled(function: Function) -> Function:
    """Compile a function with numba and cache it on disk; a decorator.

    The function may call compiled functions below its own folder and in common/. The cache is keyed
    by the sources of both.
    """
    before = config.CACHE_DIR  # type: ignore[attr-defined]  # numba adds its settings at import
    place = _place(_digest(Path(function.__code__.co_filename).parent))
    config.CACHE_DIR = str(place)  # type: ignore[attr-defined]  # as above
    try:
        made: Any = njit(error_model="numpy")(function)
        made._cache = _Cache(function)
        setattr(made, callees.OURS, True)
        _FUNCTIONS.append(made)
        return made
    finally:
        config.CACHE_DIR = before  # type: ignore[attr-defined]  # as above


class _Listener(event.Listener):
    """Print the progress of compilation to stderr every SAY_EVERY seconds.

    With an empty cache, compilation takes one to two minutes. The printed share counts the functions
    of all imported modules; the filter needs nearly all of them.
    """

    def __init__(self) -> None:
        self._compiled, self._depth, self._began = 0.0, 0, 0.0  # s
        self._collect = gc.get_threshold()

    def on_start(self, event: Event) -> None:
        if not self._depth:
            self._collect = gc.get_threshold()
            gc.set_threshold(*executable.COLLECT)
        self._began = self._began if self._depth else time.monotonic()
        self._depth += 1
        self._tell()

    def on_end(self, event: Event) -> None:
        self._tell()
        self._depth -= 1
        if not self._depth:
            gc.set_threshold(*self._collect)

    def _tell(self) -> None:
        now = time.monotonic()
        if now - self._began > SAY_EVERY:
            self._compiled, self._began = self._compiled + now - self._began, now
            share = sum(bool(each.signatures) for each in _FUNCTIONS) / len(_FUNCTIONS)
            print(
                f"compiling, which is done once: {share:.0%}, {self._compiled:.0f} s",
                file=sys.stderr,
                flush=True,
            )


event.register("numba:compile", _Listener())


@cache
def _place(name: str) -> Path:
    """Return the cache folder `name`.

    It lies in NUMBA_CACHE_DIR, by default in the user's cache folder. If other users may write there,
    they could plant code that this process runs. Then a temporary folder is returned.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    place = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(home, "uwb_tdoa")) / name
    try:
        if place.is_absolute():
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_ours_alone(place.resolve()):
                return place.resolve()
        why = (
            "others may write to"
            if place.is_absolute()
            else "the present folder may be another's, and holds"
        )
    except OSError as error:
        why = f"nothing can be kept ({error.strerror}) in"
    print(
        f"{why} {place}; a temporary folder is used: set NUMBA_CACHE_DIR to a folder of your own.",
        file=sys.stderr,
    )
    return new_folder_until_exit()


def _is_ours_alone(folder: Path) -> bool:
    """Return whether a folder belongs to the user and gives access to no other user."""
    if not hasattr(os, "getuid"):  # Windows gives each user a folder that others cannot write
        return True
    found = folder.stat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o077


@cache
def _digest(folder: Path) -> str:
    """Return a name for the present state of the sources below `folder` and beside this file.

    It also depends on VERSIONS.
    """
    digest = hashlib.sha256(VERSIONS.encode())
    for source in sorted({*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]
