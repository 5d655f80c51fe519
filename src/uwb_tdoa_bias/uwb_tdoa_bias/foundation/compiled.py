"""numba's njit with an on-disk cache that never runs yesterday's code.

numba's own cache notices a change in the file of a compiled function, but not in the files of the functions it calls.
Here every state of the sources has a cache folder of its own.
"""

from contextlib import contextmanager
from functools import lru_cache
import hashlib
import os
from pathlib import Path
import stat
import sys


@contextmanager
def _hidden(*names):
    """Packages that are not imported yet seem not to be installed."""
    hidden = [name for name in names if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        for name in hidden:
            del sys.modules[name]


# numba imports these only to see whether they are there, which takes a fifth of a second of a node's start: for products of matrices
# in compiled code, of which there are none here, and for coverage of it.
with _hidden("scipy", "coverage"):
    from numba import config, njit
    import numba.np.arraymath  # noqa: F401

config.CACHE_LOCATOR_CLASSES = ""  # numba would import those that a .numba_config.yaml in the present folder names


def compiled(function):
    """Decorator: compile `function`, which may call others below its folder and of the foundation, and cache it."""
    return _compiled(function)


def contracted(function):
    """The same, with x * y + z as one operation where the processor has it: twice as fast in large sums of products, and other
    in the last digit from one kind of processor to another."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function, **options):
    before = config.CACHE_DIR
    config.CACHE_DIR = str(_base() / _digest(Path(function.__code__.co_filename).parent))
    try:
        return njit(error_model="numpy", cache=True, **options)(function)
    finally:
        config.CACHE_DIR = before


def _base():
    """NUMBA_CACHE_DIR if set, else the user's cache folder."""
    home, named = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", os.environ.get("NUMBA_CACHE_DIR")
    own = Path(home) / "uwb_tdoa"
    return Path(named) if named and _is_ours(named, own) else own


@lru_cache(maxsize=None)
def _is_ours(folder, instead):
    """Whether nobody else may have put compiled code into a folder, which would be run; says so if not, and what is used instead."""
    if not os.path.exists(folder):
        return True
    found = os.stat(folder)
    if found.st_uid in (os.getuid(), 0) and not found.st_mode & stat.S_IWOTH:
        return True
    print(f"NUMBA_CACHE_DIR: others may write to {folder}; {instead} is used; name a folder of your own.", file=sys.stderr)
    return False


@lru_cache(maxsize=None)
def _digest(folder):
    """Name of the present state of the sources below `folder` and beside this file."""
    digest = hashlib.sha256()
    for source in sorted({*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")}):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]
