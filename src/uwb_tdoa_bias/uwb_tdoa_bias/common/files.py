# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read and write files safely: size limits, atomic writes, .npz arrays, temporary folders."""

from __future__ import annotations

import atexit
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
import io
import math
import os
from pathlib import Path
import secrets
import stat
import tempfile
from typing import Any, BinaryIO
from zipfile import BadZipFile, ZipFile, ZipInfo
import zlib

import numpy as np

from .errors import ARRAYS_BYTES, RECORDING_BYTES, Budget, InputError

TEMPORARY = "uwb_tdoa_temporary_"  # prefix of the project's temporary folders
STREAMS = "/dev/stdout", "/dev/stderr"  # links that the user redirects
NO_WAIT = getattr(os, "O_NONBLOCK", 0)  # a pipe without a writer would block; Windows has none
_KEPT: list[
    tuple[Path, Path, os.stat_result, bool]
] = []  # of `protected_inputs`: path, resolved path, state, whether it is a bag


def read_bytes(path: str | Path, most: int = RECORDING_BYTES, what: str = "recording") -> bytes:
    """Return the content of a file.

    Raises InputError if it cannot be read, is empty, or has more than `most` bytes.

    what : words for the expected file, for messages
    """
    content = read_head(path, most + 1, what)
    Budget(path).spend("bytes", len(content), most)
    return content


def read_head(path: str | Path, size: int, what: str = "recording") -> bytes:
    """Return the first `size` bytes of a file; raise InputError if it is unreadable or empty.

    what : words for the expected file, for messages
    """
    try:
        with open_file(path) as file:
            content = b"".join(_blocks(file, size))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a {what}."
        ) from error
    if not content:
        raise InputError(f"{path}: is empty (0 bytes); copy the {what} again.")
    return content


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, in every locale; otherwise as `write_bytes`.

    Some arguments and file names hold bytes that Python could not decode. They are written unchanged
    if they are UTF-8, else as U+FFFD.
    """
    try:
        content = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # lone surrogates that come from no file name
        content = text.encode("utf-8", "replace")
    write_bytes(path, content.decode("utf-8", "replace").encode("utf-8"))


def write_filled(path: str | Path, fill: Callable[[BinaryIO], object]) -> None:
    """Write a binary file that `fill` fills; otherwise as `write_bytes`.

    fill : callable of a binary file
    """
    buffer = io.BytesIO()
    fill(buffer)
    write_bytes(path, buffer.getvalue())


def write_picture(path: str | Path, figure: Any, dpi: int = 110) -> None:
    """Write a Figure of matplotlib in the format that the path ends with; otherwise as `write_bytes`.

    Other paths, such as /dev/stdout, get a PNG.
    """
    suffix = Path(path).suffix[1:].lower()
    kind = suffix if suffix in figure.canvas.get_supported_filetypes() else "png"
    write_filled(path, lambda file: figure.savefig(file, dpi=dpi, format=kind))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically: readers see the old content or the new one, never a part.

    The content goes to a temporary file in the same folder, which then takes the name. The new file
    keeps the permissions of a replaced one. Two kinds are written in place: paths that are no regular
    file, e.g. /dev/stdout, and files in a folder that is not writable.
    Raises OSError, and InputError as `refuse_output`.
    """
    refuse_output(path)
    path = Path(path)
    if path.exists() and (
        path.is_symlink() or not (path.is_file() and os.access(path.parent, os.W_OK))
    ):
        path.write_bytes(content)
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
def protected_inputs(inputs: Iterable[Path]) -> Iterator[None]:
    """Protect some files and folders, and their content: inside the block no output overwrites them.

    `refuse_output` refuses them.
    """
    before = _KEPT[:]
    _KEPT.extend(
        (path, path.resolve(), path.stat(), (path / "metadata.yaml").exists()) for path in inputs
    )
    try:
        yield
    finally:
        _KEPT[:] = before


def refuse_output(path: str | Path) -> None:
    """Raise InputError if writing to a path would follow a link, or change an input or a bag.

    A link may lead to any file. STREAMS are exempt. `protected_inputs` sets the inputs.
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


def open_file(path: str | Path) -> BinaryIO:
    """Return a file opened for reading.

    Raises OSError, and InputError for a pipe or a device, where reading would block forever.
    """
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | NO_WAIT))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputError(f"{path}: is a pipe, a device or a folder; give a file.")
    return file


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Give a folder that is removed when the block ends."""
    with tempfile.TemporaryDirectory(prefix=TEMPORARY) as name:
        yield Path(name)


def new_folder_until_exit() -> Path:
    """Return a new temporary folder that is removed when this process ends.

    Each call makes another one. It is for files that outlive a `with` block.
    """
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(temporary_folder())


def _blocks(file: BinaryIO, size: int) -> Iterator[bytes]:
    """Yield the first `size` bytes of an open file in blocks.

    A single read would allocate `size` bytes at once.
    """
    while size > 0 and (block := file.read(min(size, 1 << 24))):
        size -= len(block)
        yield block


def read_arrays(
    path: str | Path, kinds: dict[str, str], what: str, remedy: str
) -> dict[str, np.ndarray]:
    """Return {name: array} of an .npz file that `numpy.savez` wrote; nothing is unpickled.

    Raises InputError, also if a floating-point array holds NaN.

    Parameters
    ----------
    kinds : {name: permitted letters of `dtype.kind`}
    what : words for the expected file, for messages
    remedy : words on how to make such a file, for messages
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
                name: _array(name, file.read(member), kinds[name])
                for name, member in members.items()
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


def _array(name: str, data: bytes, kinds: str) -> np.ndarray:
    """Return the array of a member of an .npz file; its size is checked before memory is taken."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):  # numpy writes others for very long headers only
        raise ValueError(f"{name} is of format {version}")
    try:
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:  # numpy parses it as Python, with many exceptions
        raise ValueError(f"{name} has a header that cannot be read ({error})") from error
    if dtype.hasobject or dtype.kind not in kinds:
        raise ValueError(f"{name} holds {dtype}")
    size, rest = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if min(shape, default=0) < 0 or size != rest:
        raise ValueError(f"{name} claims {size} bytes, {rest} are there")
    array: np.ndarray = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    if dtype.kind == "f" and np.isnan(array).any():
        raise ValueError(f"{name} holds NaN")
    if dtype.kind == "U":
        characters = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(dtype.byteorder))
        if (characters > 0x10FFFF).any():
            raise ValueError(f"{name} holds no text")
    return array
