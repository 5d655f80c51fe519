# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check and repair MCAP files record by record (https://mcap.dev/spec).

Sizes are compared with the file, or limited, before data are read or unpacked. The package `mcap`
(1.6) unpacks a chunk of any size, and does not compare the index with the chunks. It cannot add
the checksums that rosbags leaves out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import struct
import sys
from typing import BinaryIO
import zlib

import lz4.frame

from uwb_tdoa_bias.common.limits import CHUNK_BYTES, most_unpacked

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, DATA_END = (
    0x01,
    0x02,
    0x03,
    0x04,
    0x05,
    0x06,
    0x08,
    0x0F,
)
HEAD = 9  # bytes of a record before its content: opcode, size
_BLOCK = 1 << 20  # bytes per read


class Damaged(Exception):
    """Report damage of a file. The message does not name the file."""


@dataclass(frozen=True)
class Record:
    """Describe a record.

    Parameters
    ----------
    kind : int
        Opcode.
    start : int
        Byte of the opcode in the file.
    size : int
        Bytes of the content.
    """

    kind: int
    start: int
    size: int

    @property
    def content(self) -> int:
        """Return the first byte of the content."""
        return self.start + HEAD

    @property
    def end(self) -> int:
        """Return the first byte after the record."""
        return self.start + HEAD + self.size


def check(path: str | Path) -> None:
    """Check that records fill the file and that its checksums are right.

    Raises
    ------
    Damaged
        If they do not.
    """
    with open(path, "rb") as file:
        last = _size(file)
        if _read(file, 0, 8) != MAGIC:
            raise Damaged("it does not start as MCAP does")
        if last < 16 or _read(file, last - 8, 8) != MAGIC:
            raise Damaged("it does not end as MCAP does: the recording was cut")
        chunks: dict[int, tuple[int, bytes, int, int]] = {}
        footer, left = None, most_unpacked(last)
        begin: tuple[int, ...] = (0, 8)
        for record in records(file, 8, last - 8):
            if footer is not None:
                raise Damaged(f"byte {record.start}: a record follows the footer")
            if record.kind == HEADER:
                begin = (0, 8, record.end)  # writers differ in where the data begin
            elif record.kind == CHUNK:
                chunks[record.start] = _index_entry(file, record)
                left -= len(chunk_data(file, record, left))
            elif record.kind == CHUNK_INDEX:
                _check_index(file, record, chunks)
            elif record.kind == DATA_END:
                _check_sum(file, record, begin, record.start, 0)
            elif record.kind == FOOTER:
                footer = record
        if footer is None or footer.size != 20:
            raise Damaged("it has no footer")
        # The footer holds the start of the summary, 0 without one, and at byte 16 the checksum.
        (start,) = struct.unpack("<Q", _read(file, footer.content, 8))
        _check_sum(file, footer, (start or footer.start,), footer.content + 16, 16)


def intact_records(path: str | Path) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, content) of the readable schemas, channels and messages.

    A damaged chunk gives (CHUNK, b"").

    Raises
    ------
    Damaged
        Where no record follows.
    """
    with open(path, "rb") as file:
        last = _size(file)
        left = most_unpacked(last)
        if _read(file, 0, min(8, last)) != MAGIC:
            raise Damaged("it does not start as MCAP does")
        for record in records(file, 8, last):
            if record.kind in (SCHEMA, CHANNEL, MESSAGE):
                yield record.kind, _read(file, record.content, record.size)
            elif record.kind == CHUNK:
                try:
                    data = chunk_data(file, record, left)
                    left -= len(data)
                    yield from chunk_records(data)
                except Damaged:
                    yield CHUNK, b""
            elif record.kind in (DATA_END, FOOTER):
                return
        raise Damaged("it ends early")


def records(file: BinaryIO, start: int, end: int) -> Iterator[Record]:
    """Yield the records that fill file[start:end], bytes, `end` excluded.

    Raises
    ------
    Damaged
        If a record exceeds `end`, or has opcode 0.
    """
    while start < end:
        if start + HEAD > end:
            raise Damaged(f"byte {start}: it is cut within a record")
        kind, size = struct.unpack("<BQ", _read(file, start, HEAD))
        record = Record(kind, start, size)
        if kind == 0:
            raise Damaged(f"byte {start}: a record has opcode 0")
        if record.end > end:
            raise Damaged(
                f"byte {start}: a record claims {size} bytes, {end - start - HEAD} are there"
            )
        yield record
        start = record.end


def chunk_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, content) of the schemas, channels and messages in a chunk.

    Raises
    ------
    Damaged
        If a record does not fit.
    """
    at = 0
    while at < len(data):
        if at + HEAD > len(data):
            raise Damaged("a chunk is cut within a record")
        kind, size = struct.unpack_from("<BQ", data, at)
        at += HEAD
        if (
            size > len(data) - at
            or kind not in (SCHEMA, CHANNEL, MESSAGE)
            or (kind == MESSAGE and size < 22)
        ):
            raise Damaged(
                f"a chunk holds a record of kind {kind} and {size} bytes that does not fit"
            )
        yield kind, data[at : at + size]
        at += size


def chunk_data(file: BinaryIO, record: Record, most: int = CHUNK_BYTES) -> bytes:
    """Return the unpacked content of a chunk of at most `most` bytes.

    Raises
    ------
    Damaged
        If its size or its checksum is wrong.
    """
    size, crc, compression, packed_at, packed_size = _chunk(file, record)
    if size > min(most, CHUNK_BYTES):
        raise Damaged(
            f"byte {record.start}: a chunk claims {size} bytes, more than {min(most, CHUNK_BYTES)}"
        )
    data = _read(file, packed_at, packed_size)
    try:
        if compression == b"lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
        elif compression == b"zstd":
            data = zstd.ZstdDecompressor().decompress(data, size + 1)
        elif compression:
            raise Damaged(f"byte {record.start}: compression {compression[:20]!r} is not known")
    except (RuntimeError, EOFError, zstd.ZstdError) as error:
        raise Damaged(f"byte {record.start}: a chunk cannot be unpacked ({error})") from error
    if len(data) != size:
        raise Damaged(f"byte {record.start}: a chunk does not hold the {size} bytes it claims")
    if crc and zlib.crc32(data) != crc:
        raise Damaged(f"byte {record.start}: the checksum of a chunk is wrong")
    return data


def fill_checksums(path: str | Path) -> None:
    """Write the checksums of chunks, data and summary that rosbags leaves at zero."""
    with open(path, "r+b") as file:
        last = _size(file)
        found = list(records(file, 8, last - 8))
        for record in found:
            if record.kind == CHUNK:
                _write_uint32(file, record.content + 24, zlib.crc32(chunk_data(file, record)))
        for record in found:  # after the checksums of the chunks
            if record.kind == DATA_END:
                _write_uint32(file, record.content, _checksum(file, 0, record.start))
            elif record.kind == FOOTER:
                (start,) = struct.unpack("<Q", _read(file, record.content, 8))
                _write_uint32(
                    file,
                    record.content + 16,
                    _checksum(file, start or record.start, record.content + 16),
                )


def _chunk(file: BinaryIO, record: Record) -> tuple[int, int, bytes, int, int]:
    """Return (unpacked size, checksum or 0, compression, first packed byte, packed size)."""
    if record.size < 40:
        raise Damaged(f"byte {record.start}: a chunk has {record.size} bytes, too few")
    _, _, size, crc, length = struct.unpack("<QQQII", _read(file, record.content, 32))
    if length > record.size - 40:
        raise Damaged(
            f"byte {record.start}: the compression of a chunk has a name of {length} bytes"
        )
    name = _read(file, record.content + 32, length)
    (packed,) = struct.unpack("<Q", _read(file, record.content + 32 + length, 8))
    at = record.content + 40 + length
    if at + packed != record.end:
        raise Damaged(f"byte {record.start}: a chunk does not end where it should")
    return size, crc, name, at, packed


def _index_entry(file: BinaryIO, record: Record) -> tuple[int, bytes, int, int]:
    """Return (start, record size, compression, packed size, unpacked size) of a chunk."""
    size, _, compression, _, packed = _chunk(file, record)
    return record.end - record.start, compression, packed, size


def _check_index(
    file: BinaryIO, record: Record, chunks: dict[int, tuple[int, bytes, int, int]]
) -> None:
    """Raise Damaged unless an index entry describes one of the chunks."""
    data = _read(file, record.content, record.size)
    try:
        start, length, offsets = struct.unpack_from("<QQI", data, 16)
        (name,) = struct.unpack_from("<I", data, 44 + offsets)
        compression = data[48 + offsets : 48 + offsets + name]
        packed, size = struct.unpack_from("<QQ", data, 48 + offsets + name)
    except struct.error:
        raise Damaged(f"byte {record.start}: an entry of the index is cut") from None
    if chunks.get(start) != (length, compression, packed, size):
        raise Damaged(f"byte {record.start}: an entry of the index does not fit to any chunk")


def _check_sum(file: BinaryIO, record: Record, starts: tuple[int, ...], last: int, at: int) -> None:
    """Raise Damaged for a wrong checksum at `at`.

    It must be 0, or belong to the file from one of the starts to `last`.
    """
    (stored,) = struct.unpack("<I", _read(file, record.content + at, 4))
    if stored and not any(
        _checksum(file, first, last) == stored for first in starts if first <= last
    ):
        raise Damaged(f"byte {record.start}: the checksum of the bytes before it is wrong")


def _checksum(file: BinaryIO, first: int, last: int) -> int:
    total = 0
    for start in range(first, last, _BLOCK):
        total = zlib.crc32(_read(file, start, min(_BLOCK, last - start)), total)
    return total


def _read(file: BinaryIO, start: int, size: int) -> bytes:
    file.seek(start)
    data = file.read(size)
    if len(data) != size:
        raise Damaged(f"byte {start}: it ends early")
    return data


def _write_uint32(file: BinaryIO, at: int, number: int) -> None:
    file.seek(at)
    file.write(struct.pack("<I", number))


def _size(file: BinaryIO) -> int:
    return Path(file.name).stat().st_size
