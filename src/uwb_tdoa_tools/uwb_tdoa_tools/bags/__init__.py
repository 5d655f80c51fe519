"""ROS 2 bags: read, write, convert."""

from __future__ import annotations

from pathlib import Path

ROS_2 = b"\x89MCAP0\r\n", b"SQLite format 3\0"  # what a file of a bag begins with


def is_bag(path: str | Path) -> bool:
    """Whether a path is meant as a bag: a directory with metadata.yaml, .mcap or .db3 files, or
    such a file.
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
