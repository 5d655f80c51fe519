# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ROS bags: read, write, convert."""

from __future__ import annotations

from pathlib import Path
import re

from uwb_tdoa_bias.common.files import read_head

MCAP, SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"  # first bytes of the files of a bag
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of a file that rosbag2 has packed
ROS_1 = b"#ROSBAG V2.0"  # first bytes of a bag of ROS 1
METADATA = "metadata.yaml"
LOG, INDEX, JOURNAL = "-wal", "-shm", "-journal"  # ends of the names of files that SQLite leaves
BESIDE = LOG, INDEX, JOURNAL
DATA = re.compile(r"(.+?)(?:_(\d+))?\.(?:mcap|db3)(?:\.zstd)?")  # names of data files


def is_bag(path: str | Path) -> bool:
    """Return whether a path is a bag of ROS 2.

    A bag is a .mcap or .db3 file, packed with zstd or not, or a directory with such a file or metadata.yaml.
    """
    path = Path(path)
    if path.is_dir():
        return (path / METADATA).exists() or any(_named_as_data(path))
    if not path.is_file() or not path.stat().st_size:
        return False
    head = read_head(path, 16)
    return head.startswith((MCAP, SQLITE)) or (
        head.startswith(ZSTD) and bool(DATA.fullmatch(path.name))
    )


def is_ros_1(path: str | Path) -> bool:
    """Return whether a path is a bag of ROS 1."""
    path = Path(path)
    return path.is_file() and path.stat().st_size > 0 and read_head(path, 12) == ROS_1


def is_one_bag(folder: Path) -> bool:
    """Return whether the files in a folder are one bag: by metadata.yaml, or by names NAME_0.mcap, NAME_1.mcap, ..."""
    if (folder / METADATA).exists():
        return True
    names = _named_as_data(folder)
    return len(names) > 1 and len({match[1] for match in names}) == 1


def data_files(folder: Path) -> list[Path]:
    """Return the data files in a folder, by content or name, in the order of rosbag2's numbers."""

    def order(file: Path) -> tuple[str, int]:
        match = DATA.fullmatch(file.name)
        return (match[1], int(match[2] or -1)) if match else (file.name, -1)

    files = (file for file in folder.iterdir() if file.is_file() and not file.name.endswith(BESIDE))
    return sorted((file for file in files if is_bag(file) or DATA.fullmatch(file.name)), key=order)


def _named_as_data(folder: Path) -> list[re.Match[str]]:
    return [match for file in folder.iterdir() if (match := DATA.fullmatch(file.name))]
