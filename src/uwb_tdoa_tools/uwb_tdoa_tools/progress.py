"""Telling that long work goes on: on a terminal in one line, by tqdm; elsewhere in a line every few
seconds, which tqdm cannot.

with Progress("diagnose") as progress:                       # what is done is printed by a thread of its own
    progress("looking at ids")
with Progress("evaluate", total=22, unit="flight") as progress:
    progress.update()                                        # one more is done
"""

from __future__ import annotations

import sys
from threading import Event, Thread
import time
from typing import TYPE_CHECKING, TextIO, TypeVar

from tqdm import tqdm

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

Item = TypeVar("Item")

FIRST, EVERY = 0.5, 4.0  # s until the first line where there is no terminal, and between two
OFTEN = 0.5  # s between two changes of the line on a terminal


class Progress:
    """As a context, says what is being done, how much of it is done, and for how long, until it
    ends; whatever takes shorter than FIRST says nothing. Call it with what is being done, as often
    as you like.
    """

    def __init__(
        self,
        name: str = "",
        total: int | None = None,
        unit: str = "",
        stream: TextIO | None = None,
        what: str = "",
    ) -> None:
        """name : what the lines begin with; total : of what is to be done, in `unit`, or None;
        stream : where to, default stderr; what : what is done first.
        """
        self._name, self._total, self._unit, self._stream = name, total, unit, stream
        self._what, self._done, self._ended = what, 0, Event()

    def __call__(self, what: str) -> None:
        self._what = what

    def update(self) -> None:
        """Count another unit as done."""
        self._done += 1
        if self._bar is not None and self._total is not None:
            self._bar.update()

    def over(self, items: Iterable[Item], what: str) -> Iterator[Item]:
        """Generator of items, which tells how many of them are done."""
        items = list(items)
        for done, item in enumerate(items):
            self(f"{what}, {done} of {len(items)} done")
            yield item
        self(f"{what} done, finishing")

    def __enter__(self) -> Progress:
        stream = self._stream or sys.stderr
        self._start, self._bar = time.monotonic(), None
        if stream.isatty():
            form = (
                {"bar_format": "{desc}"}
                if self._total is None
                else {"desc": self._name or None, "unit": self._unit}
            )
            self._bar = tqdm(total=self._total, file=stream, leave=False, **form)
        self._thread = Thread(target=self._tell, args=(stream,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()

    def _tell(self, stream: TextIO) -> None:
        """Until the end, in a thread of its own."""
        pause = FIRST if self._bar is None else OFTEN
        while not self._ended.wait(pause):
            if self._bar is None:
                pause = EVERY
                print(self._line(), file=stream, flush=True)
            elif self._total is None:
                self._bar.set_description_str(self._line())
            else:
                self._bar.refresh()

    def _line(self) -> str:
        share = f"{self._done} of {self._total} {self._unit}s done" if self._total else ""
        parts = filter(None, (self._what, share, f"{time.monotonic() - self._start:.0f} s"))
        return f"{self._name}: " * bool(self._name) + ", ".join(parts)
