"""Reading files whole, or their beginning, with a limit."""

from __future__ import annotations

from typing import BinaryIO, TYPE_CHECKING

from .errors import InputError
from .limits import RECORDING_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def read_bytes(path: str | Path, most: int = RECORDING_BYTES) -> bytes:
    """The content of a file; raises InputError if it cannot be read, is empty or has more than `most` bytes."""
    content = read_head(path, most + 1)
    if len(content) > most:
        raise InputError(f"{path}: has more than {most} bytes, more than are read of such a file; is it the right file?")
    return content


def read_head(path: str | Path, size: int) -> bytes:
    """The first bytes of a file; raises InputError as `read_bytes`."""
    try:
        with open(path, "rb") as file:
            content = b"".join(_blocks(file, size))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the path of a recording.") from error
    if not content:
        raise InputError(f"{path}: is empty (0 bytes); copy the recording again.")
    return content


def _blocks(file: BinaryIO, size: int) -> Iterator[bytes]:
    """The first bytes of an open file, block by block: one read would take the memory of `size` at once."""
    while size > 0 and (block := file.read(min(size, 1 << 24))):
        size -= len(block)
        yield block
