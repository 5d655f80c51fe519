"""numba's njit with an on-disk cache that never runs yesterday's code.

numba's own cache notices a change in the file of a compiled function, but not in the files of the
functions it calls. Here every state of the sources has a cache folder of its own.
"""

from __future__ import annotations

from contextlib import contextmanager
from functools import cache
import hashlib
import os
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING, Any, TypeVar

from . import executable  # noqa: F401  # imports numba in another folder
from .files import folder_of_process

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

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


# numba imports these only to see whether they are there, which takes a fifth of a second of a
# node's start: for products of matrices
# in compiled code, of which there are none here, and for coverage of it.
with _hidden("scipy", "coverage"):
    from numba import config, njit
    from numba.core import event
    import numba.np.arraymath  # noqa: F401

_FUNCTIONS: list[Any] = []  # all that are compiled when they are first called
SAY_EVERY = 4.0  # s
# one row of a structured array, whose fields compiled code reads and writes as attributes: Python
# knows no type of it
Record = Any
Function = TypeVar("Function", bound="Callable[..., Any]")

# numba would look into the present folder before it compiles anything
config._config_fname = "/dev/null/.numba_config.yaml"


def compiled(function: Function) -> Function:
    """Decorator: compile `function`, which may call others below its folder and of common/,
    and cache it.
    """
    before = config.CACHE_DIR  # type: ignore[attr-defined]  # numba puts its settings there while it is imported
    place = _place(_digest(Path(function.__code__.co_filename).parent))
    config.CACHE_DIR = str(place)  # type: ignore[attr-defined]  # as above
    try:
        _FUNCTIONS.append(njit(error_model="numpy", cache=True)(function))
        return _FUNCTIONS[-1]
    finally:
        config.CACHE_DIR = before  # type: ignore[attr-defined]  # as above


class _Listener(event.Listener):
    """Says on stderr, every few seconds, how much is compiled: where nothing is in the cache that
    takes a minute or two. The share is of the functions of all modules that are imported, nearly
    all of which the filter needs.
    """

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
            print(
                f"compiling, which is done once: {share:.0%}, {self._compiled:.0f} s",
                file=sys.stderr,
                flush=True,
            )


event.register("numba:compile", _Listener())


@cache
def _place(name: str) -> Path:
    """The folder `name` in NUMBA_CACHE_DIR, by default in the user's cache folder; a temporary one
    where others may have put compiled code there, which would be run.
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
    return folder_of_process()


def _is_ours_alone(folder: Path) -> bool:
    """Whether a folder belongs to the user, who alone gets into it."""
    found = folder.stat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o077


@cache
def _digest(folder: Path) -> str:
    """Name of the present state of the sources below `folder` and beside this file."""
    digest = hashlib.sha256()
    for source in sorted({*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]
