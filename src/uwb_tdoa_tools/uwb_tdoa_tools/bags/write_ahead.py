# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Merge the logs of SQLite files that the recorder did not close.

A -wal file holds transactions that are missing in the file (sqlite.org/walformat.html). A -journal file
holds pages that an unfinished transaction has overwritten. SQLite merges both in a copy of the bag.
"""

from __future__ import annotations

from pathlib import Path
import shutil
import sqlite3
import struct

from .mcap import Damaged

LOG, INDEX, JOURNAL = "-wal", "-shm", "-journal"  # suffixes of files next to the database file
BESIDE = LOG, INDEX, JOURNAL
HEADER, FRAME_HEADER = 32, 24  # bytes, of a log and of each frame


def unclosed(path: Path) -> list[Path]:
    """Return the SQLite files of a bag with a log or a journal that is not empty.

    path : directory or file
    """
    files = [path] if path.is_file() else sorted(path.glob("*.db3"))
    return [file for file in files if _left(file)]


def merged_copy(path: Path, folder: Path) -> tuple[Path, list[str]]:
    """Copy a bag to a folder and merge its logs into the copy.

    Parameters
    ----------
    path : Path
        Bag with `unclosed` files. It stays unchanged.
    folder : Path

    Returns
    -------
    path : Path
        The copy.
    lost : list of str
        What could not be merged, a sentence for each damaged log.

    Raises
    ------
    Damaged
        If a log cannot be merged.
    """
    whole = folder / path.name
    if path.is_dir():
        whole.mkdir()
        files = [one for one in path.iterdir() if one.is_file() and not one.name.endswith(INDEX)]
    else:
        files = [path, *_left(path)]
    for file in files:  # without permissions: the copies are written
        shutil.copyfile(file, whole / file.name if path.is_dir() else folder / file.name)
    lost = [sentence for file in unclosed(whole) if (sentence := _merge(file))]
    return whole, lost


def _left(file: Path) -> list[Path]:
    """Return the logs and journals of a file that are not empty."""
    beside = (file.with_name(file.name + end) for end in (LOG, JOURNAL))
    return [one for one in beside if one.is_file() and one.stat().st_size]


def _merge(file: Path) -> str:
    """Merge the readable part of the log into the file, and undo an unfinished transaction.

    Returns a sentence on finished transactions that are damaged, else "". Raises Damaged if SQLite
    cannot merge.
    """
    size = sum(one.stat().st_size for one in (file, *_left(file)))
    try:
        connection = sqlite3.connect(file, isolation_level=None)
        try:
            (pages,), (page_size,) = (
                connection.execute(f"PRAGMA {what}").fetchone()
                for what in ("page_count", "page_size")
            )
            # a damaged header: SQLite would create a file of that size
            if pages * page_size > size:
                raise Damaged(
                    f"{file.name} claims {pages} pages of {page_size} bytes, more than there are"
                )
            # both -1 without a log; SQLite takes a log to end before a damaged frame
            _busy, frames, merged = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            written = max(frames, _written(file.with_name(file.name + LOG), page_size))
            connection.execute("PRAGMA journal_mode=DELETE")  # then no log and no journal stays
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise Damaged(f"the log or journal of {file.name} cannot be merged: {error}") from error
    if merged >= written:
        return ""
    return (
        f"{file.name}{LOG}: {written - merged} of {written} frames are damaged; what they held is "
        "missing"
    )


def _written(log: Path, page_size: int) -> int:
    """Return the number of frames of a log up to the last that ends a transaction, -1 without any.

    Frames of a transaction that was not finished, and older ones, which have other salts, do not
    count. Behind a damaged header all count. Source: sqlite.org/walformat.html, sections 4.1 to 4.3.
    """
    if not log.is_file():
        return -1
    last, count = -1, log.stat().st_size // (FRAME_HEADER + page_size)
    with log.open("rb") as file:
        header = file.read(HEADER)
        if not _is_sound(header):
            return count
        salts = header[16:24]
        for number in range(1, 1 + count):
            head = file.read(FRAME_HEADER)
            if len(head) < FRAME_HEADER or head[8:16] != salts:
                break
            (pages_after,) = struct.unpack(">I", head[4:8])  # 0 within a transaction
            last = number if pages_after else last
            file.seek(page_size, 1)
    return last


def _is_sound(header: bytes) -> bool:
    """Return whether the header of a log has the checksum that it states."""
    if len(header) < HEADER:
        return False
    order = ">" if header[3] & 1 else "<"  # the last bit of the magic number
    words = struct.unpack(f"{order}6I", header[:24])
    first = second = 0
    for k in range(0, 6, 2):
        first = (first + words[k] + second) & 0xFFFFFFFF
        second = (second + words[k + 1] + first) & 0xFFFFFFFF
    return (first, second) == struct.unpack(">2I", header[24:])
