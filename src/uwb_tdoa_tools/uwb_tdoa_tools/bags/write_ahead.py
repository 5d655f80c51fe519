"""SQLite files that the recorder did not close: what their -wal file holds is not yet in the file
itself (sqlite.org/walformat.html).
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from typing import TYPE_CHECKING

from .mcap import Damaged

if TYPE_CHECKING:
    from pathlib import Path

LOG, INDEX, JOURNAL = "-wal", "-shm", "-journal"  # beside a file, with its name before it
BESIDE = LOG, INDEX, JOURNAL
_HOT = bytes.fromhex("d9d505f920a163d7")  # a journal begins so while a transaction is not finished
_HEAD, _FRAME_HEAD = 32, 24  # bytes, of a log and of each frame in it


def unclosed(path: Path) -> list[Path]:
    """SQLite files of a bag, a directory or a file, with a log of their own that is not empty."""
    files = [path] if path.is_file() else sorted(path.glob("*.db3"))
    return [file for file in files if (log := _beside(file, LOG)).is_file() and log.stat().st_size]


def check_no_journal(path: Path) -> None:
    """Raise Damaged if a file of a bag has a transaction that was begun and neither finished nor
    undone.
    """
    for file in [path] if path.is_file() else sorted(path.glob("*.db3")):
        journal = _beside(file, JOURNAL)
        if journal.is_file():
            with journal.open("rb") as opened:
                if opened.read(len(_HOT)) == _HOT:
                    raise Damaged(
                        f"{journal.name} holds a transaction that was not finished: the "
                        "recorder was ended while it wrote"
                    )


def closed(path: Path, folder: Path) -> tuple[Path, str]:
    """(path of a copy of a bag, in a folder, whose files hold what their logs hold; what of the
    logs cannot be read, "" for nothing).

    path : a bag with `unclosed` files; nothing is changed there. Raises Damaged.
    """
    whole = folder / path.name
    if path.is_dir():
        whole.mkdir()
        for file in (
            one
            for one in path.iterdir()
            if one.is_file() and not one.name.endswith((INDEX, JOURNAL))
        ):
            shutil.copyfile(file, whole / file.name)  # without its permissions: we write to it
    else:
        shutil.copyfile(path, whole)
        shutil.copyfile(_beside(path, LOG), _beside(whole, LOG))
    problems = [_merge(whole / file.name if path.is_dir() else whole) for file in unclosed(path)]
    return whole, "; ".join(filter(None, problems))


def _merge(file: Path) -> str:
    """Put what is sound of the log of a file into the file.

    Returns what cannot be read, "" for nothing. Raises Damaged.
    """
    log = _beside(file, LOG)
    size, commits = file.stat().st_size + log.stat().st_size, _commits(log)
    try:
        connection = sqlite3.connect(file, isolation_level=None)
        try:
            (pages,), (of_page,) = (
                connection.execute(f"PRAGMA {what}").fetchone()
                for what in ("page_count", "page_size")
            )
            if pages * of_page > size:  # SQLite would make a file of that size
                raise Damaged(
                    f"{log.name} claims {pages} pages of {of_page} bytes, more than there are"
                )
            _, frames, merged = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            if merged < frames:
                raise Damaged(f"{log.name}: {frames - merged} of {frames} frames cannot be merged")
            connection.execute("PRAGMA journal_mode=DELETE")  # of which there is none then
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise Damaged(f"{log.name} cannot be merged: {error}") from error
    lost = sum(frame > frames for frame in commits)
    return f"{log.name}: {lost} of {len(commits)} transactions cannot be read" if lost else ""


def _commits(log: Path) -> list[int]:
    """Numbers, from 1, of the frames of a log that end a transaction, as the log itself says."""
    found = []
    with log.open("rb") as file:
        head = file.read(_HEAD)
        if len(head) < _HEAD:
            return []
        (of_page,), salt = struct.unpack_from(">I", head, 8), head[16:24]
        frames = (log.stat().st_size - _HEAD) // (_FRAME_HEAD + of_page)
        for number in range(1, frames + 1):
            file.seek(_HEAD + (number - 1) * (_FRAME_HEAD + of_page))
            frame = file.read(_FRAME_HEAD)
            if frame[8:16] == salt and frame[4:8] != bytes(
                4
            ):  # others are of a log that was used up before
                found.append(number)
    return found


def _beside(file: Path, end: str) -> Path:
    return file.with_name(file.name + end)
