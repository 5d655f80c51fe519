"""Readers: each turns one kind of recording into a Flight.

`read_flight` recognizes the kind.
"""

from __future__ import annotations

from pathlib import Path
import shlex
from typing import TYPE_CHECKING
import zlib

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import read_head

from ..bags import is_bag
from .names import read_survey
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


__all__ = ["read_flight", "read_survey", "read_usd_log", "read_util_csv"]


def read_flight(
    path: str | Path,
    survey: str | Path | Anchors | None = None,
    namespace: str = "",
    salvage: bool = False,
    topics: dict[str, str] | None = None,
    truth: bool = True,
) -> Flight:
    """Flight of a recording of any known kind, told apart by content, not by name.

    path : micro-SD event log, UTIL CSV (plain or gzip), or ROS 2 bag (its directory or its .mcap or
        .db3 file).
    survey : path of a survey file (see `read_survey`) or Anchors. Logs and CSV files need it; a bag
        brings its own
        anchors, and a survey given with it replaces them.
    namespace, topics : where the tag's topics are in a bag, see `read_bag`.
    salvage : read a cut or damaged recording up to there, without records that are no numbers; the
        Flight's
        `meta["remarks"]` tell what is missing. Otherwise it is refused.
    truth : read the ground truth, where there is one.
    Raises InputError.
    """
    from ..bags.bag import (
        read_bag,
    )  # here, because bags need the rosbags library and the others do not

    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: does not exist; give a micro-SD log, a UTIL CSV file or a bag.")
    if is_bag(path):
        return read_bag(path, namespace, _anchors(survey), salvage, topics, truth)
    if path.is_dir():
        raise InputError(
            f"{path}: is a directory without metadata.yaml; give a bag directory or a file."
        )
    reader, anchors = reader_of(path), _anchors(survey)
    if anchors is None:
        raise InputError(
            f"{path}: does not say where the anchors are; give a survey file (--survey FILE)."
        )
    return reader(path, anchors, salvage, truth)


def _anchors(survey: str | Path | Anchors | None) -> Anchors | None:
    return read_survey(survey) if isinstance(survey, (str, Path)) else survey
