"""Merge the logs of SQLite files that the recorder did not close.

A -wal file holds transactions that are missing in the file (sqlite.org/walformat.html). A -journal file
holds pages that an unfinished transaction has overwritten. SQLite merges both in a copy of the bag.
"""

from __future__ import annotations

import shutil
import sqlite3
from typing import TYPE_CHECKING

from .mcap import Damaged

if TYPE_CHECKING:
    from pathlib import Path

LOG, INDEX, JOURNAL = "-wal", "-shm", "-journal"  # suffixes of files next to the database file
BESIDE = LOG, INDEX, JOURNAL


def unclosed(path: Path) -> list[Path]:
    """Return the SQLite files of a bag with a log or a journal that is not empty.

    path : directory or file
    """
    files = [path] if path.is_file() else sorted(path.glob("*.db3"))
    return [file for file in files if _left(file)]


def merged_copy(path: Path, folder: Path) -> Path:
    """Copy a bag to a folder, merge its logs into the copy, and return its path.

    Parameters
    ----------
    path : Path
        Bag with `unclosed` files. It stays unchanged.
    folder : Path

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
    for file in unclosed(whole):
        _merge(file)
    return whole


def _left(file: Path) -> list[Path]:
    """Return the logs and journals of a file that are not empty."""
    beside = (file.with_name(file.name + end) for end in (LOG, JOURNAL))
    return [one for one in beside if one.is_file() and one.stat().st_size]


def _merge(file: Path) -> None:
    """Merge the readable part of the log into the file, and undo an unfinished transaction.

    Raises
    ------
    Damaged
        If the log is damaged.
    """
    size = sum(one.stat().st_size for one in (file, *_left(file)))
    try:
        connection = sqlite3.connect(file, isolation_level=None)
        try:
            (pages,), (of_page,) = (
                connection.execute(f"PRAGMA {what}").fetchone()
                for what in ("page_count", "page_size")
            )
            if pages * of_page > size:  # SQLite would create a file of that size
                raise Damaged(
                    f"{file.name} claims {pages} pages of {of_page} bytes, more than there are"
                )
            _, frames, merged = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            if merged < frames:
                raise Damaged(f"{file.name}{LOG}: {frames - merged} of {frames} frames are lost")
            connection.execute("PRAGMA journal_mode=DELETE")  # then no journal stays
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise Damaged(f"what lies beside {file.name} cannot be merged: {error}") from error
