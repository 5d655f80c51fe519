# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""numba's njit with an on-disk cache that follows every change of the code.

numba's own cache notices a change in the file of a compiled function. It does not notice changes
in the files of the functions that it calls. Here the name of a cache file is a digest of all code
and constants that the function reaches. Equal code shares it wherever it is installed: a second
installation compiles nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
import gc
import hashlib
import os
from pathlib import Path
import stat
import sys
import time
from types import CodeType, ModuleType
from typing import Any, TypeVar

import numpy as np

from . import executable  # it also imports numba in another folder
from .files import new_folder_until_exit


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
SAY_EVERY = 10.0  # s
# Share of the time that passes until all functions are typed; the rest links and optimizes (`check`
# of a flight). Below BUSY of a core, other programs use the machine.
BEFORE_LINKING, BUSY = 0.7, 0.6
# Machine code also depends on these. numba names the version of Python in its files.
VERSIONS = f"{numba.__version__} {np.__version__}"
PACKAGES = __name__.partition("_bias")[0]  # how the names of our packages begin
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
        return ""  # the name of the file has the digest of the code


class _Files(caching.CompileResultCacheImpl):
    """Name the files of a function by a digest of what it reaches."""

    _locator_classes = [_Locator]

    def __init__(self, function: Callable[..., Any]) -> None:
        self._digest = _digest(function)
        super().__init__(function)

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return f"{super().get_filename_base(fullname, abiflags)}-{self._digest}"


class _Cache(caching.FunctionCache):
    """Open the files at the first call, when all that the function reaches is defined."""

    _impl_class = _Files

    def __init__(self, function: Callable[..., Any]) -> None:
        self._py_func = function
        self._opened = False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if not self._opened:
            before = config.CACHE_DIR  # type: ignore[attr-defined]  # numba adds its settings at import
            config.CACHE_DIR = str(_place("code"))  # type: ignore[attr-defined]  # as above
            try:
                super().__init__(self._py_func)
            finally:
                config.CACHE_DIR = before  # type: ignore[attr-defined]  # as above
            self._opened = True
        return super().load_overload(sig, target_context)


def compiled(function: Function) -> Function:
    """Compile a function with numba and cache it on disk; a decorator.

    The function may call compiled functions of all packages. It may read their constants by name.
    """
    made: Any = njit(error_model="numpy")(function)
    made._cache = _Cache(function)
    setattr(made, callees.OURS, True)
    _FUNCTIONS.append(made)
    return made


class _Listener(event.Listener):
    """Report that a compilation begins, its share, and about how long it still takes.

    With an empty cache, compilation takes one to two minutes. The share counts the functions of all
    imported modules; the filter needs nearly all of them. Lines of progress show the report; without
    any, it is printed to stderr every SAY_EVERY seconds.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._spent, self._since = np.zeros(2), _clocks()  # s: elapsed, and of the processor
        self._said = self._whole = 0.0  # s: elapsed at the last report, and expected in all
        self._share = 0.0  # reported last; more modules make it smaller, which would irritate
        self._collect = gc.get_threshold()

    def on_start(self, event: event.Event) -> None:
        if not self._depth:
            if not self._spent.any() and not any(_place("code").rglob("*.nbi")):
                text = "compiling the filter, which is done once and takes about a minute"
                print(text, file=sys.stderr, flush=True)
            self._collect, self._since = gc.get_threshold(), _clocks()
            gc.set_threshold(*executable.COLLECT)
        self._depth += 1
        self._tell()

    def on_end(self, event: event.Event) -> None:
        self._tell()
        self._depth -= 1
        if not self._depth:
            gc.set_threshold(*self._collect)
            executable.COMPILING.text = ""

    def _tell(self) -> None:
        now = _clocks()
        self._spent, self._since = self._spent + now - self._since, now
        elapsed, used = self._spent
        if elapsed - self._said < SAY_EVERY:
            return
        self._said = elapsed
        share = sum(bool(each.signatures) for each in _FUNCTIONS) / len(_FUNCTIONS)
        if share > self._share:
            self._share, self._whole = share, elapsed / (BEFORE_LINKING * share)
        left = max(self._whole - elapsed, 0.0)
        about = f"{left / 60.0:.0f} min" if left > 120.0 else f"{left:.0f} s"
        done = f"{self._share:.0%}, {elapsed:.0f} s, about {about} left"
        text = f"compiling, which is done once: {done}"
        if used < BUSY * elapsed:
            text += f"; the machine is busy and gives this {used / elapsed:.0%} of a core"
        executable.COMPILING.text = text
        if not executable.COMPILING.shown:
            print(text, file=sys.stderr, flush=True)


def _clocks() -> np.ndarray:
    return np.array([time.monotonic(), time.thread_time()])


event.register("numba:compile", _Listener())


@cache
def _place(name: str) -> Path:
    """Return the cache folder `name`.

    It lies in NUMBA_CACHE_DIR, by default in the user's cache folder. If other users may write there,
    or may put another folder in its place, they could plant code that this process runs. Then a
    temporary folder is returned.
    """
    home = os.environ.get("XDG_CACHE_HOME") or Path(os.path.expanduser("~"), ".cache")
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
    """Return whether only the user can enter a folder, and no other user can replace it."""
    if not hasattr(os, "getuid"):  # Windows gives each user a folder that others cannot write
        return True
    found = folder.stat()
    return (
        found.st_uid == os.getuid()
        and not found.st_mode & 0o077
        and all(_keeps_its_folders(parent.stat()) for parent in folder.parents)
    )


def _keeps_its_folders(found: os.stat_result) -> bool:
    """Return whether only the user and root can rename what a folder holds."""
    by_others = found.st_mode & 0o022 and not found.st_mode & stat.S_ISVTX
    return found.st_uid in (0, os.getuid()) and not by_others


def _digest(function: Callable[..., Any]) -> str:
    """Return a name for all code and constants that a function reaches, and for VERSIONS."""
    reached, found = {function}, [function]
    digest = hashlib.sha256()
    for one in found:  # grows
        own, called = _content(one)
        digest.update(own)
        new = [other for other in called if other not in reached]
        reached.update(new)
        found.extend(new)
    return digest.hexdigest()[:16]


@cache
def _content(function: Callable[..., Any]) -> tuple[bytes, list[Callable[..., Any]]]:
    """Return a digest of the code of a function and its constants, and the functions it calls."""
    # a file names modules, to load what it holds
    texts = [VERSIONS, function.__module__, function.__qualname__, repr(function.__defaults__)]
    names, called = set[str](), []
    codes = [function.__code__]
    for code in codes:  # grows by the code of comprehensions
        codes.extend(constant for constant in code.co_consts if isinstance(constant, CodeType))
        plain = [constant for constant in code.co_consts if not isinstance(constant, CodeType)]
        texts.append(repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, plain)))
        names.update(code.co_names)
    read = dict(function.__globals__)
    read.update(
        zip(
            function.__code__.co_freevars,
            (each.cell_contents for each in function.__closure__ or ()),
        )
    )
    names.update(function.__code__.co_freevars)
    values = [(name, read[name]) for name in sorted(names & set(read))]
    for name, value in values:  # grows by what our modules hold
        if isinstance(value, ModuleType):
            if value.__name__.startswith(PACKAGES):
                inside = vars(value)
                values.extend((f"{name}.{key}", inside[key]) for key in sorted(names & set(inside)))
        elif hasattr(value, "py_func"):
            called.append(value.py_func)
        elif isinstance(value, np.ndarray):
            texts.append(f"{name} {value.dtype} {value.shape} {value.tobytes().hex()}")
        else:  # a number, a class with fields, or a function of another package
            fields = getattr(value, "_fields", "")
            kind = getattr(value, "__qualname__", repr(value))
            texts.append(f"{name} {getattr(value, '__module__', '')} {kind} {fields}")
    return hashlib.sha256("\0".join(texts).encode()).digest(), called
