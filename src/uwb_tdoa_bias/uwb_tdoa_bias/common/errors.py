# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The two exceptions that programs report to the user in one sentence, limits of reading, and sanitized texts.

Every other exception is a defect and keeps its traceback.

The limits hold for files from any source. A reader compares the claims of a header with these
limits, and with the file. It does so before it takes memory or does work. The limits are far above
the need: a log of an hour has 300 MB, the project's YAML files have some kB, models of `train`
60 kB.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
import math
from pathlib import Path
import re
import time
from typing import Any


def number_of(value: Any) -> float:
    """Return a value or text as a number, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


class InputError(ValueError):
    """Bad input.

    The message is one sentence that names the field, the value and the remedy. Exit code 2.
    """


def refuse_others(where: str | Path, values: Iterable[Any], known: Iterable[str]) -> None:
    """Raise InputError for the first of some values that is not known."""
    names = [*known]
    other = [value for value in values if value not in names]
    if other:
        raise InputError(f"{where}: {repr(other[0])[:60]} is not one of {', '.join(names)}.")


class Failure(Exception):
    """A task that failed with good input.

    The message names what failed and where to look. Exit code 1.
    """


# s, and s per byte: processor time for one file. The limit suffices for the slowest reader on a
# machine four times slower than the development machine.
SECONDS, SECONDS_PER_BYTE = 4.0, 2e-6

# Whole files, bytes.
RECORDING_BYTES = 1 << 30  # micro-SD log, or CSV on the disc
TABLE_BYTES = 200_000_000  # text of a CSV; ten minutes of the full UTIL schema
TABLE_CELLS = 16_000_000  # cells of a recording in such a text
SMALL_TABLE_CELLS = 400_000  # of other tables, whose rows become objects
ROW_CHARACTERS = 100_000  # one row of any CSV
SURVEY_BYTES = YAML_BYTES = 2_000_000  # 10 000 anchors with orientations have 1 200 000
MODEL_BYTES = 4_000_000  # ONNX: a million weights
ARRAYS_BYTES = 100_000_000  # all arrays of an .npz file, unpacked; 4 million cells have 20 MB

MAP_MARKERS = 5_000  # of a position bias map: memory grows quadratically, time cubically

NAME_LENGTH = 100  # characters of a flight, a model, ...
LINE_LENGTH = 2_000  # characters of a sentence that is printed or logged

# Micro-SD log: event types, and variables of all types. The firmware has some 20 and 100.
USD_TYPES, USD_VARIABLES = (1_000, 10_000)
FOLDER_ENTRIES, FOLDER_DEPTH = 100_000, 20  # searched for recordings

# YAML.
YAML_NODES, YAML_DEPTH = 200_000, 20

# ONNX: limits of the process that tests a model, in addition to the needs of its libraries. A model
# of `train` takes 0.02 s and 3 MB.
MODEL_SECONDS, MODEL_MEMORY = 3, 256 << 20  # processor time; bytes
MODEL_WAIT = 60.0  # s until its end, even on a busy machine
MODEL_ROW_SECONDS = 0.005  # processor time of a single row
# Executed operators. onnxruntime takes 0.2 s to load 2000 operators, and 4 s for 10 000.
MODEL_NODES = 2_000

# Bags.
CHUNK_BYTES = 256 << 20  # MCAP chunk, unpacked; rosbag2 writes 0.75 MB
MESSAGE_BYTES = 64 << 20  # any topic, e.g. an image or a point cloud
READ_BYTES = 2 << 20  # a decoded message: 10 000 anchors
# Of the text that defines a message type. The texts of ROS have up to 15 kB.
DEFINITION_BYTES = 64 << 10
FILE_BYTES = 8 << 30  # all unpacked data files
UNPACKED_FREE, UNPACKED_RATIO = 16 << 20, 100  # see `most_unpacked`


class TooMuch(InputError):
    """A file or folder that exceeds a limit of reading. The message names the limit."""


class Budget:
    """What a reader may still spend on one file or folder.

    budget = Budget(path)
    budget.spend("cells", len(row), TABLE_CELLS)        # raises TooMuch, also when the time is up
    """

    def __init__(self, path: str | Path, size: int = 0) -> None:
        """Start the budget of a file.

        Parameters
        ----------
        path : for messages
        size : bytes of the file; the time limit grows with them
        """
        self._path = path
        self._spent = Counter[str]()
        self._seconds = SECONDS + SECONDS_PER_BYTE * size
        self.restart()

    def restart(self) -> None:
        """Restart the time limit."""
        self._until = time.thread_time() + self._seconds

    def spend(self, what: str, count: int, most: int) -> None:
        """Add a count to the sum of `what`; raise TooMuch above `most` or after the time limit."""
        self._spent[what] += count
        if self._spent[what] > most:
            raise TooMuch(
                f"{self._path}: has more than {most} {what}; give another file, or split it."
            )
        self.check_time()

    def check_time(self) -> None:
        """Raise TooMuch after the time limit."""
        if self.is_late():
            raise TooMuch(
                f"{self._path}: takes more than {self._seconds:.1f} s of processor time to "
                "read; give another file, or split it."
            )

    def is_late(self) -> bool:
        """Return whether the time limit has passed."""
        return time.thread_time() > self._until


def most_unpacked(packed: int, most: int = FILE_BYTES) -> int:
    """Return the number of bytes to which all `packed` bytes together may unpack.

    Recordings shrink to a third; decompression bombs shrink to a thousandth or less.
    """
    return min(most, UNPACKED_FREE + UNPACKED_RATIO * packed)


# Other characters can be commands to Markdown, HTML, a shell, a file system or the mathematics of
# matplotlib.
_OTHERS = re.compile(r"[^\w .,:;+=()#-]")


def printable(text: object) -> str:
    r"""Return a text in which all invisible characters are escaped, e.g. as \x1b.

    Invisible are line ends, escape sequences, marks that turn the writing direction, and halves of
    characters. A terminal displays the result and does nothing else.
    """
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape", "surrogatepass").decode()
        for one in str(text)
    )


def line_of(text: object) -> str:
    """Return one printable line of at most LINE_LENGTH characters; the middle is left out."""
    whole, half = str(text), LINE_LENGTH // 2
    line = printable(
        whole[:LINE_LENGTH] + whole[-LINE_LENGTH:] if len(whole) > 2 * LINE_LENGTH else whole
    )
    return line if len(line) <= LINE_LENGTH else f"{line[:half]} ... {line[-half:]}"


def sanitize(text: object) -> str:
    """Return a name without special meaning in any program.

    Characters other than letters, digits, space and .,:;+=()#- become _. The name is cut to
    NAME_LENGTH.
    """
    return _OTHERS.sub("_", str(text))[:NAME_LENGTH]


@cache
def version() -> str:
    """Return the version of the packages, e.g. "0.1.0"; "unknown" if they are not installed.

    colcon installs a distribution for each package, pip installs one for all.
    """
    from importlib import metadata  # the import takes 0.05 s

    for name in ("uwb_tdoa_bias", "uwb-tdoa"):
        with suppress(metadata.PackageNotFoundError):
            return metadata.version(name)
    return "unknown"


def written_by() -> str:
    """Return the program and version for the head of written files: "uwb_tdoa 0.1.0"."""
    return f"uwb_tdoa {version()}"
