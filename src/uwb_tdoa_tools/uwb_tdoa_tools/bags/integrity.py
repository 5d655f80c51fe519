# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the files of a bag before they are used."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import sqlite3
from typing import Any
from urllib.parse import quote
import zlib

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.limits import MESSAGE_BYTES, Budget, most_unpacked
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from . import mcap
from .mcap import Damaged, zstd

# in the custom data of the bag: CRC-32 of the data file, 8 hexadecimal digits
CHECKSUM_KEY = "uwb_tdoa_tools.crc32"
NO_CHECKSUM = "--------"
_BLOCK = 1 << 20  # bytes per read
_STEPS = 20_000  # instructions of SQLite between checks of the time: some milliseconds
_PLAIN_SCHEMA = re.compile(
    r"CREATE\s+(TABLE|INDEX)\s[^()]*\([\w\s,\"'`\[\]]*\)\s*", re.IGNORECASE
)  # without inner brackets nothing is computed
# else a Ctrl-C in a callback of SQLite is lost (common/executable.py)
sqlite3.enable_callback_tracebacks(True)
_TYPES = (  # columns of an SQLite bag and their types
    ("messages", {"timestamp": "integer", "topic_id": "integer", "data": "blob"}),
    ("topics", {"id": "integer", "name": "text", "type": "text", "serialization_format": "text"}),
)


def check(path: str | Path) -> None:
    """Check the files of a bag.

    The check covers the checksums in MCAP files and in metadata.yaml (`write_checksums`). It also
    covers the structure of SQLite files, and the entries of metadata.yaml. Files that are compressed as
    a whole must be unpacked before (`completion.completed`).

    Parameters
    ----------
    path : str or Path
        Bag directory or data file.

    Raises
    ------
    Damaged
        If a file is damaged.
    InputError
        If metadata.yaml cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        return check_data(path)
    information = metadata(path)
    for file in data_files(path, information):
        if not file.is_file():
            raise Damaged(f"{file.name} is missing")
        check_sum(file, information)
        check_data(file, packed_messages=information["compression_mode"] == "message")


def check_sum(file: Path, information: dict[str, Any]) -> None:
    """Raise Damaged if the content of metadata.yaml has another checksum of a data file."""
    stored = information["custom_data"].get(CHECKSUM_KEY, NO_CHECKSUM)
    if stored != NO_CHECKSUM and _checksum(file) != stored:
        raise Damaged(
            f"the checksum of {file.name} in metadata.yaml is {stored}, but it has {_checksum(file)}"
        )


def data_files(path: Path, information: dict[str, Any]) -> list[Path]:
    """Return the paths of the data files of a bag directory."""
    return [path / Path(name).name for name in information["relative_file_paths"]]


def is_compressed(information: dict[str, Any]) -> bool:
    """Return whether rosbag2 has compressed whole data files."""
    return information["compression_mode"] == "file"


def metadata(path: Path) -> dict[str, Any]:
    """Return the content of metadata.yaml with the needed entries of the right type.

    Raises
    ------
    Damaged, InputError
        If an entry is missing or wrong.
    """
    content = read_yaml(path / "metadata.yaml")
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise Damaged("metadata.yaml has no rosbag2_bagfile_information")
    information = {"compression_mode": "", "custom_data": None, "files": [], **information}
    information["custom_data"] = information["custom_data"] or {}
    # rosbag2 writes "", "none", "FILE" or "MESSAGE".
    if isinstance(information["compression_mode"], str):
        information["compression_mode"] = (
            information["compression_mode"].lower().replace("none", "")
        )
    kinds = {
        "version": int,
        "message_count": int,
        "relative_file_paths": list,
        "topics_with_message_count": list,
        "custom_data": dict,
        "storage_identifier": str,
        "duration": dict,
        "starting_time": dict,
        "compression_mode": str,
        "files": list,
    }
    for name, kind in kinds.items():
        if type(information.get(name)) is not kind:
            raise Damaged(f"metadata.yaml: {name} is {information.get(name)!r}")
    seen = set()
    for name in information["relative_file_paths"]:
        if not isinstance(name, str) or not Path(name).name or Path(name).name in seen:
            raise Damaged(
                f"metadata.yaml: relative_file_paths: {name!r} is no file, or is there twice"
            )
        seen.add(Path(name).name)
    for name, key in (("duration", "nanoseconds"), ("starting_time", "nanoseconds_since_epoch")):
        if type(information[name].get(key)) is not int:
            raise Damaged(f"metadata.yaml: {name} is {information[name]!r}")
    for entry in information["topics_with_message_count"]:
        count = entry.get("message_count") if isinstance(entry, dict) else None
        if type(count) is not int or count < 0:
            raise Damaged(f"metadata.yaml: message_count of a topic is {count!r}")
    return information


def write_checksums(path: str | Path) -> None:
    """Write the checksums of a bag that rosbags has just written.

    Its metadata must hold CHECKSUM_KEY: NO_CHECKSUM.
    """
    (data,) = (file for file in Path(path).iterdir() if file.name != "metadata.yaml")
    if data.suffix == ".mcap":
        mcap.fill_checksums(data)
    file = Path(path) / "metadata.yaml"
    text = file.read_text(encoding="utf-8")
    sealed = re.sub(
        rf"({re.escape(CHECKSUM_KEY)}: *['\"]?){NO_CHECKSUM}", rf"\g<1>{_checksum(data)}", text
    )
    assert sealed != text
    write_text(file, sealed)


def open_sqlite(file: str | Path) -> sqlite3.Connection:
    """Open an SQLite file for reading, even a cut one.

    Views, virtual tables, checks and expressions are refused because they may take forever. Pages that
    share children may do so too. Each query therefore ends when the time limit of the file is reached.

    Raises
    ------
    Damaged
        If the file has anything but plain tables and indexes.
    """
    connection = sqlite3.connect(
        f"file:{quote(str(Path(file).absolute()))}?mode=ro&immutable=1", uri=True
    )
    connection.set_progress_handler(Budget(file, Path(file).stat().st_size).is_late, _STEPS)
    try:
        connection.execute("PRAGMA writable_schema=ON")  # else SQLite reads no page of a cut file
        for name, text in connection.execute(
            "SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"
        ):
            if not _PLAIN_SCHEMA.fullmatch(text):
                raise Damaged(f"{name} in it is no table and no index of columns")
        return connection
    except (sqlite3.Error, UnicodeDecodeError, TypeError) as error:
        raise as_damaged(error) from error


def is_mcap(file: Path) -> bool:
    """Return whether a data file is MCAP by its first bytes. Otherwise it must be SQLite."""
    with file.open("rb") as opened:
        return opened.read(len(mcap.MAGIC)) == mcap.MAGIC


def check_data(file: Path, packed_messages: bool = False) -> None:
    """Check one data file, see `check`."""
    if is_mcap(file):
        mcap.check(file)
        contents = (
            content[22:] for kind, content in mcap.intact_records(file) if kind == mcap.MESSAGE
        )
    else:
        _check_sqlite(file)
        contents = (data for _, _, _, data in sqlite_messages(file))
    left = most_unpacked(file.stat().st_size)
    for content in contents if packed_messages else ():
        most = min(MESSAGE_BYTES, left)
        try:
            size = len(zstd.ZstdDecompressor().decompress(content, most + 1))
        except (zstd.ZstdError, TypeError) as error:
            raise Damaged(f"a message cannot be unpacked ({error})") from error
        if size > most:
            raise Damaged(
                f"its messages unpack to more than {MESSAGE_BYTES} bytes each, or are too many"
            )
        left -= size


def sqlite_messages(file: Path) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield (id, topic id, stamp, data) of an SQLite file in the order of ids.

    Raises
    ------
    Damaged
        Where the file is damaged.
    """
    connection, last = open_sqlite(file), None
    budget = Budget(file, file.stat().st_size)
    connection.set_progress_handler(budget.is_late, _STEPS)
    query = (
        f"SELECT id, topic_id, timestamp, iif(length(data) <= {MESSAGE_BYTES}, data, NULL) FROM "
        "messages ORDER BY id"
    )
    try:
        for row in connection.execute(query):
            if last is not None and not row[0] > last:
                raise Damaged("its messages go round in a circle")
            last = row[0]
            yield row
            budget.restart()  # the time of the caller does not count
    except (sqlite3.Error, UnicodeDecodeError, TypeError) as error:
        raise as_damaged(error) from error
    finally:
        connection.close()


def _check_sqlite(file: Path) -> None:
    connection = open_sqlite(file)
    try:
        connection.execute("PRAGMA writable_schema=OFF")
        problems = [row[0] for row in connection.execute("PRAGMA integrity_check(1)")]
        (page_size,) = connection.execute("PRAGMA page_size").fetchone()
        cut = (
            file.stat().st_size % page_size
        )  # which SQLite passes over where it needs no such page
        if cut:
            raise Damaged(f"its last page has {cut} bytes instead of {page_size}")
        if problems != ["ok"]:
            raise Damaged(
                " ".join(str(problems[0]).split())
                if problems
                else "its integrity cannot be checked"
            )
        for table, columns in _TYPES:
            wrong = " OR ".join(f"typeof({name}) <> '{kind}'" for name, kind in columns.items())
            wrong += f" OR length({[*columns][-1]}) > {MESSAGE_BYTES}"
            count = connection.execute(f"SELECT count(*) FROM {table} WHERE {wrong}").fetchone()[0]
            if count:
                raise Damaged(
                    f"{count} rows of {table} hold text where numbers belong, or the other "
                    "way round, or are too long"
                )
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise as_damaged(error) from error
    finally:
        connection.close()


def as_damaged(error: Exception) -> Damaged:
    """Convert an error of SQLite. A query at its time limit is called interrupted."""
    return Damaged(
        "it takes longer to read than a file of its size may"
        if "interrupted" in str(error)
        else str(error)
    )


def _checksum(file: Path) -> str:
    total = 0
    with file.open("rb") as opened:
        while block := opened.read(_BLOCK):
            total = zlib.crc32(block, total)
    return f"{total:08x}"
