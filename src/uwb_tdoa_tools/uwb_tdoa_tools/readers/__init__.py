# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Readers: each turns one kind of recording into a Flight.

`read_flight` recognizes the kind.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import re
import zlib

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_head
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import as_named

from ..bags import is_bag, is_ros_1
from ..command_lines import suggest_line
from .by_profile import read_by_profile
from .logs import MAGIC, is_util_csv, read_usd_log, read_util_csv
from .profile import load_profile
from .tables import GZIP_MAGIC, is_ulog


def reader_of(path: Path) -> Callable[[Path, Anchors, bool, bool], Flight]:
    """Return the reader of a file that is not a bag. Raise InputError for an unknown kind."""
    head = read_head(path, 1 << 16)
    if head[0] == MAGIC:
        return read_usd_log
    if head.startswith(GZIP_MAGIC):
        try:
            head = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, 1 << 16)
        except zlib.error as error:
            raise InputError(
                f"{path}: the gzip data is damaged ({error}); copy the file again."
            ) from error
    first = head.split(b"\n", 1)[0].decode("utf-8", "replace")
    if is_util_csv(first):
        return read_util_csv
    kind = _foreign_kind(path, first)
    if kind:
        raise InputError(
            f"{path}: is {kind}; it needs a profile (--profile NAME). This line names one that "
            f"fits, or writes a first one: {suggest_line(path)}"
        )
    raise InputError(
        f"{path}: is of no known kind (it starts with {head[:16]!r}); a micro-SD log starts "
        "with byte 0xBC, a CSV file with a line of names, a ULog with ULog, "
        "and a bag is a directory with metadata.yaml. A folder of files of another tool needs --profile."
    )


def _foreign_kind(path: Path, first: str) -> str:
    """Return what a recording of others is, or "" for anything else. `first` is its first line."""
    if is_ros_1(path):
        return "a bag of ROS 1"
    if is_ulog(path):
        return "a ULog of PX4"
    cells = re.split("[,;\t]", first)  # a table may lack a header
    return "a CSV file of another tool" if len(cells) > 1 and first.strip().isprintable() else ""


__all__ = [
    "load_profile",
    "read_by_profile",
    "read_flight",
    "read_usd_log",
    "read_util_csv",
]


def read_flight(
    path: str | Path,
    survey: str | Path | Anchors | None = None,
    namespace: str = "",
    salvage: bool = False,
    topics: dict[str, str] | None = None,
    truth: bool = True,
) -> Flight:
    """Read a recording of any known kind; its content decides, not its name.

    `read_by_profile` reads recordings of other kinds.

    Parameters
    ----------
    path : micro-SD event log, UTIL CSV (plain or gzip), or ROS 2 bag (directory, .mcap or .db3).
    survey : Anchors, or a survey file, see `read_named_anchors`. Logs and CSV files need it. In a bag it
        replaces the recorded anchors.
    namespace, topics : topics of the tag in a bag, see `read_bag`.
    salvage : read a damaged recording up to the damage and skip invalid records. `meta["remarks"]`
        lists what is missing. Otherwise a damaged recording is refused.
    truth : read the ground truth, if there is one.

    Raises InputError.
    """
    from ..bags.bag import read_bag  # only bags need the rosbags library

    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: does not exist; give a micro-SD log, a UTIL CSV file or a bag.")
    named = as_named(survey)
    anchors = None if named is None else named.anchors
    if is_bag(path):
        return read_bag(path, namespace, anchors, salvage, topics, truth)
    if path.is_dir():
        raise InputError(
            f"{path}: is a directory without metadata.yaml; give a bag directory or a file, or say "
            "with --profile how to read what is in it."
        )
    reader = reader_of(path)
    if anchors is None:
        raise InputError(
            f"{path}: does not say where the anchors are; give a survey file (--survey FILE)."
        )
    return reader(path, anchors, salvage, truth)
