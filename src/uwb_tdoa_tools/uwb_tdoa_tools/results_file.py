# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Keep the results of long work in a file, a line of JSON each: interrupted work continues there.

    with ResultsFile(path, {"seed": 1}) as done:            # the settings, besides the keys
        for key in (key for key in keys if key not in done):
            done[key] = work(key)
        results = [done[key] for key in keys]

The first line holds the settings, each other line {"key": ..., "result": ...}. Results stay in the
file; memory holds only the places of the lines.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
import hashlib
import json
import os
from pathlib import Path
import sys
from typing import Any

from tqdm import tqdm

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_bytes, refuse_output
from uwb_tdoa_bias.common.limits import FOLDER_ENTRIES, Budget
from uwb_tdoa_bias.common.text import written_by

from .parallel import Item, Made, MapFunction

BEGIN = b'{"asked"'
LINE = 64 << 20  # bytes of one result


class ResultsFile:
    """Results by keys (texts), in the file `path`, which is made if needed.

    Results are values for JSON, without NaN.
    """

    def __init__(self, path: str | Path, asked: dict[str, Any]) -> None:
        """Open the file.

        Parameters
        ----------
        asked : dict
            Settings, for JSON: all that results depend on besides their keys.

        Raises
        ------
        InputError
            If the file holds other content, or results of another version or other settings.
        """
        self._path = Path(path)
        self._places: dict[str, int] = {}  # of the lines, by their keys
        asked = json.loads(json.dumps({"written_by": written_by(), **asked}))
        if not self._path.absolute().parent.is_dir():
            raise InputError(f"{path}: its directory does not exist; make it first.")
        refuse_output(path)
        if self._path.exists() and not self._path.is_file():
            raise self._foreign()
        self._file = open(self._path, "a+b")
        try:
            self._begin(asked)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, asked: dict[str, Any]) -> None:
        self._file.seek(0)
        first = self._file.readline(LINE)
        if not first.endswith(b"\n"):  # new, or not even its first line was written
            if not (first.startswith(BEGIN) or BEGIN.startswith(first)):
                raise self._foreign()
            self._file.truncate(0)
            self._append({"asked": asked})
            return
        before = self._parsed(first).get("asked")
        if not isinstance(before, dict):
            raise self._foreign()
        different = sorted(key for key in {*before, *asked} if before.get(key) != asked.get(key))
        if different:
            raise InputError(
                f"{self._path}: its results were made with another {' and '.join(different)}; "
                "ask for the same, or name another file."
            )
        budget = Budget(self._path, os.fstat(self._file.fileno()).st_size)
        while line := self._file.readline(LINE):
            budget.check_time()
            place = self._file.tell() - len(line)
            if len(line) == LINE:
                raise self._foreign()
            if not line.endswith(b"\n"):  # cut by the interruption
                self._file.truncate(place)
                break
            content = self._parsed(line)
            if set(content) != {"key", "result"} or not isinstance(content["key"], str):
                raise self._foreign()
            self._places[content["key"]] = place

    def __contains__(self, key: str) -> bool:
        return key in self._places

    def __getitem__(self, key: str) -> Any:
        self._file.seek(self._places[key])
        return self._parsed(self._file.readline())["result"]

    def read(self, key: str, parse: Callable[[Any], Made]) -> Made:
        """Return parse(result); raise InputError if that fails.

        Anybody may have written the file.
        """
        try:
            return parse(self[key])
        except (
            AssertionError,
            AttributeError,
            IndexError,
            KeyError,
            OverflowError,
            TypeError,
            ValueError,
        ):
            raise self._foreign() from None

    def __setitem__(self, key: str, result: object) -> None:
        self._places[key] = self._append({"key": key, "result": result})

    def keys_done(
        self,
        keys: Sequence[str],
        items: Sequence[Item],
        make: Callable[[Iterable[Item]], Iterable[object]],
        unit: str,
    ) -> Iterator[str]:
        """Yield the keys in order, each when its result is in the file.

        Parameters
        ----------
        keys, items : sequence
            Keys, and the items from which `make` computes their results.
        make : callable
            make(items) yields the results of the missing items, in order.
        unit : str
            Name of the items, in words.
        """
        missing = {key: item for key, item in zip(keys, items) if key not in self}
        if len(missing) < len(items):
            tqdm.write(
                (
                    f"{self._path} holds {len(items) - len(missing)} of {len(items)} {unit}; "
                    "going on with the others"
                ),
                sys.stderr,
            )
        made = iter(make(missing.values()))
        for key in keys:
            if key not in self:
                self[key] = next(made)
            yield key
        next(made, None)  # to its end, so that its processes are kept

    def __enter__(self) -> ResultsFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _append(self, content: dict[str, Any]) -> int:
        """Write a line at the end, and return its place."""
        place = self._file.seek(0, os.SEEK_END)
        self._file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
        self._file.flush()
        return place

    def _parsed(self, line: bytes) -> dict[str, Any]:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise self._foreign()
        return content

    def _foreign(self) -> InputError:
        return InputError(
            f"{self._path}: holds something else than results of this tool; name another file."
        )


def resumed(over: MapFunction, done: ResultsFile) -> MapFunction:
    """Return a map function as `parallel.over` that takes present results from a ResultsFile.

    Missing results are computed by `over` and kept in the file. The key is the name of the function
    and the place of the item.
    """

    def over_missing(function: Callable[[Item], Made], items: Iterable[Item]) -> Iterator[Made]:
        name, items = getattr(function, "func", function).__name__, list(items)
        keys = [f"{name} {place}" for place in range(len(items))]
        for key in done.keys_done(keys, items, partial(over, function), "parts"):
            yield done[key]

    return over_missing


def fingerprint_of(path: str | Path | None) -> str:
    """Return a text that changes if a file, or a folder of files, changes; "None" for None.

    Raises OSError and InputError.
    """
    if path is None:
        return "None"
    path = Path(path).absolute()
    files, budget = [path], Budget(path)
    for inside in path.iterdir() if path.is_dir() else ():
        budget.spend("entries", 1, FOLDER_ENTRIES)
        files.append(inside)
    return (
        f"{path} {sum(file.stat().st_size for file in files if file.is_file())} "
        f"{max(file.stat().st_mtime_ns for file in files)}"
    )


def settings_of(
    args: Namespace, besides: Iterable[str] = (), files: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the settings of a command, {option: value} for JSON. Raises OSError.

    Parameters
    ----------
    besides : iterable of str
        Options without influence on the results.
    files : iterable of str
        Options that name files whose content counts.
    """
    given = {name: value for name, value in vars(args).items() if name not in besides}
    asked = {
        name: str(value) if isinstance(value, Path) else value for name, value in given.items()
    }
    named = {
        name: Path(asked[name]) for name in files if asked[name] and Path(asked[name]).is_file()
    }
    return asked | {
        name: hashlib.sha256(read_bytes(path, what="file")).hexdigest()[:16]
        for name, path in named.items()
    }
