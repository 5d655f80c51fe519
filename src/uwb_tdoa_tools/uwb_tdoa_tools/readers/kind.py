"""Which kind of recording a file is that is no bag, recognised by what is in it, not by its name."""

from __future__ import annotations

from pathlib import Path
import shlex
from typing import TYPE_CHECKING
import zlib

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import read_head

from .usd_log import MAGIC, read_usd_log
from .util_csv import GZIP_MAGIC, is_util_csv, read_util_csv

if TYPE_CHECKING:
    from collections.abc import Callable

    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_bias.foundation.flight import Flight

ROS_1 = b"#ROSBAG V2.0"  # what a bag of ROS 1 begins with


def reader_of(path: Path) -> Callable[[Path, Anchors, bool, bool], Flight]:
    """What reads a file that is no bag. Raises InputError for one of no known kind."""
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
    first = head.split(b"\n", 1)[0]
    if is_util_csv(first.decode("utf-8", "replace")):
        return read_util_csv
    if head.startswith(ROS_1):
        raise InputError(
            f"{path}: is a bag of ROS 1: make a ROS 2 bag of it, rosbags-convert --src "
            f"{shlex.quote(str(path))} --dst NAME, or of messages that only their makers "
            "have CSV files for convert --columns."
        )
    raise InputError(
        f"{path}: is of no known kind (it starts with {head[:16]!r}); a micro-SD log starts "
        "with byte 0xBC, a UTIL CSV "
        "file with a header line with t_tdoa, and a bag is a directory with metadata.yaml."
    )
