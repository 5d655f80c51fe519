"""Numpy .npz files from anywhere: what their headers claim is compared with the file before memory
is taken for it.
"""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING
from zipfile import BadZipFile, ZipFile
import zlib

import numpy as np

from .errors import InputError
from .files import open_file
from .limits import ARRAYS_BYTES, Budget

if TYPE_CHECKING:
    from pathlib import Path
    from zipfile import ZipInfo


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
