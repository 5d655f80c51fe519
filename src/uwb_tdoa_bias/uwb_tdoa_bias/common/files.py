"""Read and write files: with limits, whole or not at all; arrays in .npz files; temporary folders."""

from __future__ import annotations

import atexit
from contextlib import ExitStack, contextmanager, suppress
import fcntl
import io
import math
import os
from pathlib import Path
import secrets
import shutil
import stat
import tempfile
import time
from typing import TYPE_CHECKING, BinaryIO
from zipfile import BadZipFile, ZipFile
import zlib

import numpy as np

from .errors import InputError
from .limits import ARRAYS_BYTES, RECORDING_BYTES, Budget

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path
    from zipfile import ZipInfo


TEMPORARY = "uwb_tdoa_temporary_"  # what the names of our temporary folders begin with
STREAMS = "/dev/stdout", "/dev/stderr"  # links to what the user has chosen
SETTLED = 60.0  # s after which a temporary folder that nobody holds is no longer needed
_KEPT: list[
    tuple[Path, Path, os.stat_result, bool]
] = []  # see `keeping`: path, the same without links, state, whether it is a bag


def read_bytes(path: str | Path, most: int = RECORDING_BYTES) -> bytes:
    """The content of a file; raises InputError if it cannot be read, is empty or has more than
    `most` bytes.
    """
    content = read_head(path, most + 1)
    Budget(path).spend("bytes", len(content), most)
    return content


def read_head(path: str | Path, size: int) -> bytes:
    """The first bytes of a file; raises InputError as `read_bytes`."""
    try:
        with open_file(path) as file:
            content = b"".join(_blocks(file, size))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a recording."
        ) from error
    if not content:
        raise InputError(f"{path}: is empty (0 bytes); copy the recording again.")
    return content


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, whatever the locale, as `write_bytes` does.

    Bytes that Python could not decode in an argument or a file name are written as they were, or as
    U+FFFD if they are no UTF-8.
    """
    try:
        content = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # halves of characters that come from no file name
        content = text.encode("utf-8", "replace")
    write_bytes(path, content.decode("utf-8", "replace").encode("utf-8"))


def write_filled(path: str | Path, fill: Callable[[BinaryIO], object]) -> None:
    """Write what `fill` writes to the binary file that it is given, as `write_bytes` does."""
    buffer = io.BytesIO()
    fill(buffer)
    write_bytes(path, buffer.getvalue())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole: readers see the old content or the new one, never a part. Raises OSError.

    The content goes to a temporary sibling, which then takes the name. A file that is replaced
    passes on its permissions. What is no regular file, as /dev/stdout, and a file whose folder
    takes no other, are written in place. Raises InputError as `refuse_output`.
    """
    refuse_output(path)
    path = Path(path)
    if path.exists() and (
        path.is_symlink() or not (path.is_file() and os.access(path.parent, os.W_OK))
    ):
        _write_in_place(path, content)
        return
    sibling = path.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        with open(sibling, "xb") as file:
            file.write(content)
        if path.exists():
            sibling.chmod(path.stat().st_mode & 0o7777)
        sibling.replace(path)
    except BaseException:
        sibling.unlink(missing_ok=True)
        raise


@contextmanager
def keeping(inputs: Iterable[Path]) -> Iterator[None]:
    """While the block lasts, `refuse_output` refuses these files and folders, and what is in them."""
    before = _KEPT[:]
    _KEPT.extend(
        (path, path.resolve(), path.stat(), (path / "metadata.yaml").exists()) for path in inputs
    )
    try:
        yield
    finally:
        _KEPT[:] = before


def refuse_output(path: str | Path) -> None:
    """Raise InputError where writing to a path would follow a link, which may lead to any file, or
    change what is read or a bag.
    """
    path = Path(path)
    if path.is_symlink() and str(path) not in STREAMS:
        raise InputError(
            f"{path}: is a link to {os.readlink(path)}; give the path it leads to, or another name."
        )
    where, state = path.resolve(), path.stat() if path.exists() else None
    for kept, its_place, its_state, is_bag in _KEPT:
        if state is not None and os.path.samestat(state, its_state):
            raise InputError(
                f"{path}: is {kept}, which is read, and would be overwritten; give another name."
            )
        if where.is_relative_to(its_place) and (state is not None or is_bag):
            raise InputError(f"{path}: lies in {kept}, which is read; give another place.")


def _write_in_place(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)


def open_file(path: str | Path) -> BinaryIO:
    """An open file, to be read.

    Raises InputError for a pipe or a device, at which reading would wait for ever, and OSError.
    """
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputError(f"{path}: is a pipe, a device or a folder; give a file.")
    return file


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder that is removed when the block ends.

    If this process is killed, the next one of ours removes it.
    """
    for old in Path(tempfile.gettempdir()).glob(f"{TEMPORARY}*"):
        with suppress(OSError):  # of another user, in use, or gone
            if time.time() - old.lstat().st_mtime > SETTLED:
                with _held(old, fcntl.LOCK_EX):
                    shutil.rmtree(old)
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as name, _held(Path(name), fcntl.LOCK_SH):
        yield Path(name)


def folder_of_process() -> Path:
    """Such a folder that is removed when this process ends."""
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(temporary_folder())


@contextmanager
def _held(folder: Path, kind: int) -> Iterator[None]:
    """A lock on a folder of the user while the block lasts. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(descriptor).st_uid != os.getuid():
            raise PermissionError
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _blocks(file: BinaryIO, size: int) -> Iterator[bytes]:
    """The first bytes of an open file, block by block: one read would take the memory of `size` at
    once.
    """
    while size > 0 and (block := file.read(min(size, 1 << 24))):
        size -= len(block)
        yield block


def read_arrays(
    path: str | Path, kinds: dict[str, str], what: str, remedy: str
) -> dict[str, np.ndarray]:
    """{name: array} of an .npz file that `numpy.savez` wrote. Nothing is unpickled.

    kinds : {name: letters of `dtype.kind` that are right}; what, remedy : what the file should be,
        and how it is made.
    Raises InputError, also for floating-point numbers that are NaN.
    """
    try:
        with open_file(path) as opened, ZipFile(opened) as file:
            members = {name: _member(file, f"{name}.npy") for name in kinds}
            Budget(path).spend(
                "bytes of arrays",
                sum(member.file_size for member in members.values()),
                ARRAYS_BYTES,
            )
            return {
                name: _array(name, file, member, kinds[name]) for name, member in members.items()
            }
    except InputError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
    except (
        BadZipFile,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
        ValueError,
        zlib.error,
    ) as error:
        reason = str(error.args[0] if error.args else type(error).__name__)
    raise InputError(f"{path}: is no {what} ({' '.join(reason.split())}); {remedy}.")


def _member(file: ZipFile, name: str) -> ZipInfo:
    try:
        return file.getinfo(name)
    except KeyError:
        raise KeyError(f"it holds no {name}") from None


def _array(name: str, file: ZipFile, member: ZipInfo, kinds: str) -> np.ndarray:
    with file.open(member) as opened:
        data = opened.read(member.file_size + 1)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read_header:
        raise ValueError(f"{name} is of format {version}")
    try:
        shape, fortran, dtype = read_header[version](stream)
    except Exception as error:  # it is parsed as Python, which fails in many ways
        raise ValueError(f"{name} has a header that cannot be read ({error})") from error
    if dtype.hasobject or dtype.kind not in kinds:
        raise ValueError(f"{name} holds {dtype}")
    size, rest = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if min(shape, default=0) < 0 or size != rest:
        raise ValueError(f"{name} claims {size} bytes, {rest} are there")
    array = np.frombuffer(data, dtype, offset=stream.tell()) if size else np.empty(0, dtype)
    if dtype.kind == "f" and np.isnan(array).any():
        raise ValueError(f"{name} holds NaN")
    if dtype.kind == "U" and size:
        if (
            np.frombuffer(
                data, np.dtype(np.uint32).newbyteorder(dtype.byteorder), offset=stream.tell()
            ).max()
            > 0x10FFFF
        ):
            raise ValueError(f"{name} holds no text")
    return array.reshape(shape, order="F" if fortran else "C").copy()
