"""The log of a node, which no peer can fill."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

from ..common.text import line_of

if TYPE_CHECKING:
    from types import CodeType

    from rclpy.impl.rcutils_logger import RcutilsLogger

# lines that one statement of the program may write at once, and s until it may write one more
BURST, REFILL = (200, 10.0)


class Log:
    """A logger of rclpy whose lines are printable and of a bounded length. Each statement of the
    program writes BURST of them at once, then one in REFILL seconds: whoever makes one statement
    write hides no other.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        # Of each statement: the lines that it may write, since when (s), and how many were left out
        # before.
        self._left: dict[tuple[CodeType, int], tuple[float, float, int]] = {}

    def info(self, text: str) -> None:
        """Of rclpy, which allows one severity for each line of code; so do these."""
        if line := self._line(text):
            self._logger.info(line)

    def warning(self, text: str) -> None:
        """Of rclpy."""
        if line := self._line(text):
            self._logger.warning(line)

    def error(self, text: str) -> None:
        """Of rclpy."""
        if line := self._line(text):
            self._logger.error(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def _line(self, text: str) -> str | None:
        """What is written of a text, or None."""
        frame, now = sys._getframe(2), time.monotonic()
        key = frame.f_code, frame.f_lineno
        left, when, hidden = self._left.get(key, (BURST, now, 0))
        left = min(BURST, left + (now - when) / REFILL)
        self._left[key] = (left, now, hidden + 1) if left < 1.0 else (left - 1.0, now, 0)
        if left < 1.0:
            return None
        return line_of(text) + (f" ({hidden} such lines were left out before)" if hidden else "")
