# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Complete bags whose metadata.yaml is missing, or does not fit to the files beside it.

metadata.yaml of sound bags is lost, or names files that were renamed, unpacked or packed by hand. What the files hold
decides. The files stay unchanged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
import re
from typing import Any

import yaml

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.limits import Budget, most_unpacked

from . import DATA, ROS_2, ZSTD, integrity
from .mcap import Damaged, zstd
from .salvage import as_written
from .write_ahead import BESIDE

METADATA = "metadata.yaml"
STORAGES = {"mcap": ".mcap", "sqlite3": ".db3"}  # storage_identifier: suffix of its data files
_BLOCK = 1 << 20  # bytes per read


def completed(path: Path, folder: Path) -> tuple[Path, list[str]]:
    """Return a bag that rosbags can open, and sentences on what its metadata.yaml lacked.

    Parameters
    ----------
    path : Path
        Bag directory, or one data file, packed or not.
    folder : Path
        Empty folder for a completed bag. Without a need for it, `path` itself is returned.

    Raises
    ------
    Damaged, InputError
        If a file is missing, or cannot be unpacked, or if metadata.yaml cannot be read.
    """
    if path.is_file():
        fits = not _is_packed(path) and path.suffix == STORAGES[_storage(path)]
        return (path, []) if fits else (_made(path, [path], folder), [])
    if not (path / METADATA).is_file():
        files = data_files(path)
        return _made(path, files, folder), [
            f"there is no metadata.yaml; read without it: {_names(files)}."
        ]
    information = integrity.metadata(path)
    files, remarks = _files_of(path, information)
    fits = [file.name for file in files] == _listed(information)
    known = information["storage_identifier"] in STORAGES
    if fits and known and not integrity.is_compressed(information):
        return path, []
    if not known:
        remarks.append(
            f"metadata.yaml names the storage {information['storage_identifier']!r}: what the "
            "files hold decides."
        )
    for file in files:
        if _is_packed(file) == integrity.is_compressed(information):
            integrity.check_sum(file, information)
    return _with_metadata(path, files, information, folder), remarks


def data_files(folder: Path) -> list[Path]:
    """Return the data files in a folder, by content or name, packed or not, in the order of names.

    The order is that of the numbers that rosbag2 gives to the parts of a bag.
    """
    inside = [
        file
        for file in folder.iterdir()
        if file.is_file() and file.name != METADATA and not file.name.endswith(BESIDE)
    ]
    return sorted((file for file in inside if _is_data(file)), key=_in_order)


def _in_order(file: Path) -> tuple[str, int, str]:
    numbered = re.match(r"(.*)_(\d+)\.", file.name)
    return (numbered[1], int(numbered[2]), file.name) if numbered else (file.name, -1, file.name)


def _names(files: Iterable[Path]) -> str:
    return " and ".join(file.name for file in files)


def _listed(information: dict[str, Any]) -> list[str]:
    return [Path(name).name for name in information["relative_file_paths"]]


def _is_data(file: Path) -> bool:
    with file.open("rb") as opened:
        known = opened.read(16).startswith((*ROS_2, ZSTD))
    return known or DATA.fullmatch(file.name) is not None


def _is_packed(file: Path) -> bool:
    with file.open("rb") as opened:
        return opened.read(len(ZSTD)) == ZSTD


def _storage(file: Path) -> str:
    """Return the storage_identifier of a data file that is not packed."""
    return "mcap" if integrity.is_mcap(file) else "sqlite3"


def _files_of(path: Path, information: dict[str, Any]) -> tuple[list[Path], list[str]]:
    """Return the data files that metadata.yaml lists, wherever they are now, and remarks.

    A file may have been packed or unpacked by hand. If all others are renamed, their number must be
    as listed. Raises Damaged for a missing file.
    """
    found: dict[str, Path] = {}
    for name in _listed(information):
        others = name.removesuffix(".zstd"), f"{name}.zstd"
        there = [path / each for each in (name, *others) if (path / each).is_file()]
        if there:
            found[name] = there[0]
    missing = [name for name in _listed(information) if name not in found]
    left = [file for file in data_files(path) if file not in found.values()]
    if missing and len(missing) != len(left):
        raise Damaged(f"{missing[0]} is missing")
    found |= dict(zip(missing, left))
    remarks = [
        f"metadata.yaml names {name}: {found[name].name} is read in its place."
        for name in _listed(information)
        if found[name].name != name
    ]
    return [found[name] for name in _listed(information)], remarks


def _made(path: Path, files: list[Path], folder: Path) -> Path:
    """Return a bag of files without metadata.yaml, made in a folder. Raises Damaged."""
    if not files:
        raise Damaged("there is no data file in it")
    information: dict[str, Any] = {"version": 9, "custom_data": {}}
    made = _with_metadata(path, files, information, folder)
    counts: Counter[tuple[str, str]] = Counter()
    first, last, packed = 2**63, 0, False
    for file in integrity.data_files(made, integrity.metadata(made)):
        integrity.check_data(file)
        for connection, stamp, data in as_written(file, Counter()):
            counts[connection.topic, connection.msgtype] += 1
            first, last = min(first, stamp), max(last, stamp)
            packed = data[: len(ZSTD)] == ZSTD
    information = integrity.metadata(made) | {
        "compression_mode": "message" if packed else "",
        "compression_format": "zstd" if packed else "",
        "message_count": counts.total(),
        "starting_time": {"nanoseconds_since_epoch": min(first, last)},
        "duration": {"nanoseconds": max(last - first, 0)},
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": "",
                },
                "message_count": count,
            }
            for (topic, msgtype), count in counts.items()
        ],
    }
    _write(made, information)
    return made


def _with_metadata(
    path: Path, files: list[Path], information: dict[str, Any], folder: Path
) -> Path:
    """Return a bag in a folder: the files, unpacked or as links, and metadata.yaml for them."""
    budget, room = Budget(path, _size(files)), most_unpacked(_size(files))
    places = []
    for file in files:
        place = folder / (file.name.removesuffix(".zstd") if _is_packed(file) else file.name)
        if _is_packed(file):
            _unpack(file, place, budget, room)
        else:
            place.symlink_to(file.absolute())
        places.append(place)
    kinds = {_storage(place) for place in places}
    if len(kinds) > 1:
        raise Damaged(f"{_names(files)} are of different kinds, MCAP and SQLite")
    by_file = information.get("compression_mode") == "file"
    custom = {**information["custom_data"]}
    custom.pop(integrity.CHECKSUM_KEY, None)
    empty = {
        "message_count": 0,
        "starting_time": {"nanoseconds_since_epoch": 0},
        "duration": {"nanoseconds": 0},
        "topics_with_message_count": [],
        "compression_mode": "",
        "compression_format": "",
    }
    changed = {
        "relative_file_paths": [place.name for place in places],
        "storage_identifier": next(iter(kinds)),
        "files": [],
        "custom_data": custom,
        **({"compression_mode": "", "compression_format": ""} if by_file else {}),
    }
    _write(folder, {**empty, **information, **changed})
    return folder


def _size(files: Iterable[Path]) -> int:
    return sum(file.stat().st_size for file in files)


def _unpack(file: Path, place: Path, budget: Budget, most: int) -> None:
    try:
        with zstd.open(file, "rb") as source, open(place, "wb") as target:
            while block := source.read(_BLOCK):
                budget.spend("bytes when its files are unpacked", len(block), most)
                target.write(block)
    except (zstd.ZstdError, EOFError) as error:
        raise Damaged(f"{file.name} cannot be unpacked ({error})") from error


def _write(folder: Path, information: dict[str, Any]) -> None:
    content = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
    write_text(folder / METADATA, content)
