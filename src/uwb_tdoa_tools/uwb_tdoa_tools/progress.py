"""Telling that long work goes on: on a terminal in one line, elsewhere in a line every few seconds."""

import sys
import time

EVERY = 4.0  # s between two lines where there is no terminal
OFTEN = 0.2  # s between two changes of the line on a terminal


class Progress:
    """Call it with what is being done, as often as you like; as a context it clears its line at the end."""

    def __init__(self, name, stream=None):
        """name : what the lines begin with; stream : where to, default stderr."""
        self._name, self._stream = name, stream or sys.stderr
        self._live = self._stream.isatty()
        self._start = self._last = time.monotonic()
        self._width = 0

    def __call__(self, what):
        now = time.monotonic()
        if now - self._last < (OFTEN if self._live else EVERY):
            return
        self._last = now
        line = f"{self._name}: {what}, {now - self._start:.0f} s"
        if self._live:
            print("\r" + line.ljust(self._width), end="", file=self._stream, flush=True)
            self._width = len(line)
        else:
            print(line, file=self._stream, flush=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._live and self._width:
            print("\r" + " " * self._width + "\r", end="", file=self._stream, flush=True)
