"""How much of a file is read at most, whoever wrote it: every limit of every reader, and the one
exception that names the limit.

A reader compares what a header claims with these limits, and with the file, before it takes memory
or does work. Limits are far above what is needed: a flight of an hour has 300 MB as a log, our YAML
files have some kB, models of `train` 60 kB.
"""

from __future__ import annotations

from collections import Counter
import time
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

# Processor time for one file: enough for the slowest reader on a machine that is four times slower
# than ours.
SECONDS, SECONDS_PER_BYTE = 4.0, 2e-6

# Whole files, bytes.
RECORDING_BYTES = 1 << 30  # micro-SD log, or CSV as it lies on the disc
CSV_BYTES = 200_000_000  # text of a recording; ten minutes of the full UTIL schema
CSV_CELLS = 16_000_000  # of it
TABLE_BYTES = 50_000_000  # CSV of other tools
TABLE_CELLS = 8_000_000  # of a recording in it: a quarter of an hour at 1 kHz
SMALL_TABLE_CELLS = 400_000  # of other tables, whose rows become objects
ROW_CHARACTERS = 100_000  # of one row of any CSV
SURVEY_BYTES = YAML_BYTES = 2_000_000  # 10 000 anchors with their orientations have 1 200 000
MODEL_BYTES = 4_000_000  # ONNX: a million weights
ARRAYS_BYTES = 100_000_000  # of all arrays of an .npz file, unpacked; four million cells have 20 MB

MAP_MARKERS = 5_000  # of a position bias map: memory takes their number squared, time cubed

NAME_LENGTH = 100  # characters of a flight, a model, ...
LINE_LENGTH = 2_000  # characters of a sentence that is printed or logged

# of a micro-SD log: event types, and variables of all of them; the firmware has some 20 and 100
USD_TYPES, USD_VARIABLES = (1_000, 10_000)
FOLDER_ENTRIES, FOLDER_DEPTH = 100_000, 20  # that are looked at for recordings

# YAML.
YAML_NODES, YAML_DEPTH = 200_000, 20

# ONNX: of the process that tries a model out, beside what its libraries take. A model of
# `train` takes 0.02 s and 3 MB.
MODEL_SECONDS, MODEL_MEMORY = 3, 256 << 20  # processor time; bytes
MODEL_WAIT = 60.0  # s until its end, on a busy machine too
MODEL_ROW_SECONDS = 0.005  # of processor time for a row that comes alone
# operators that are executed: onnxruntime takes 0.2 s to load so many, but 4 s for 10 000
MODEL_NODES = 2_000

# Bags.
CHUNK_BYTES = 256 << 20  # of MCAP, unpacked; rosbag2 makes chunks of 0.75 MB
MESSAGE_BYTES = 64 << 20  # of any topic: an image, a cloud of points
READ_BYTES = 2 << 20  # of a message that is taken apart: 10 000 anchors
# of the text that defines a message type; those of ROS have up to 15 kB
DEFINITION_BYTES = 64 << 10
FILE_BYTES = 8 << 30  # of all data files that are unpacked
UNPACKED_FREE, UNPACKED_RATIO = 16 << 20, 100  # see `most_unpacked`


class TooMuch(InputError):
    """A file, or a folder, holds more than is read of it. The message names the limit."""


class Budget:
    """What may still be spent on one file, or folder.

    budget = Budget(path)
    budget.spend("cells", len(row), TABLE_CELLS)        # raises TooMuch, also when the time is up
    """

    def __init__(self, path: str | Path, size: int = 0) -> None:
        """path : for messages; size : bytes of the file, which give more time."""
        self._path, self._spent, self._seconds = (
            path,
            Counter[str](),
            SECONDS + SECONDS_PER_BYTE * size,
        )
        self.restart()

    def restart(self) -> None:
        """Give all of the time again."""
        self._until = time.thread_time() + self._seconds

    def spend(self, what: str, count: int, most: int) -> None:
        """Count some more of what there may be `most` of. Raises TooMuch."""
        self._spent[what] += count
        if self._spent[what] > most:
            raise TooMuch(
                f"{self._path}: has more than {most} {what}; give another file, or split it."
            )
        self.check_time()

    def check_time(self) -> None:
        """Raise TooMuch when the time is up."""
        if self.is_late():
            raise TooMuch(
                f"{self._path}: takes more than {self._seconds:.1f} s of processor time to "
                "read; give another file, or split it."
            )

    def is_late(self) -> bool:
        """Whether the time is up."""
        return time.thread_time() > self._until


def most_unpacked(packed: int, most: int = FILE_BYTES) -> int:
    """Bytes that so many packed ones may become, all together: recordings shrink to a third, bombs
    to a thousandth and less.
    """
    return min(most, UNPACKED_FREE + UNPACKED_RATIO * packed)
