"""ROS 2 bags: read, write, convert."""

from __future__ import annotations

from pathlib import Path

ROS_2 = b"\x89MCAP0\r\n", b"SQLite format 3\0"  # first bytes of the files of a bag


def is_bag(path: str | Path) -> bool:
    """Return whether a path is a bag.

    A bag is a .mcap or .db3 file, or a directory with such a file or metadata.yaml.
    """
    path = Path(path)
    if path.is_dir():
        return (
            any(path.glob("metadata.yaml")) or any(path.glob("*.mcap")) or any(path.glob("*.db3"))
        )
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(16).startswith(ROS_2)
