# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The log of a node, with a limit that no peer can exceed."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

from ..common.text import line_of

if TYPE_CHECKING:
    from types import CodeType

    from rclpy.impl.rcutils_logger import RcutilsLogger

# Lines that one statement of the program may write at once, and s until it may write one more.
BURST, REFILL = (200, 10.0)


class Log:
    """A logger of rclpy with printable lines of bounded length, and a limit per statement.

    Each statement of the program writes BURST lines at once, then one per REFILL seconds. A peer that
    triggers one statement often cannot hide the others.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        # {statement: (lines left, s of the last line, lines left out since)}
        self._left: dict[tuple[CodeType, int], tuple[float, float, int]] = {}

    def info(self, text: str) -> None:
        """Log as rclpy does; each severity needs its own line of code there."""
        if line := self._line(text):
            self._logger.info(line)

    def warning(self, text: str) -> None:
        """Log as rclpy does."""
        if line := self._line(text):
            self._logger.warning(line)

    def error(self, text: str) -> None:
        """Log as rclpy does."""
        if line := self._line(text):
            self._logger.error(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def _line(self, text: str) -> str | None:
        """Return the line to write for a text, or None."""
        frame, now = sys._getframe(2), time.monotonic()
        key = frame.f_code, frame.f_lineno
        left, when, hidden = self._left.get(key, (BURST, now, 0))
        left = min(BURST, left + (now - when) / REFILL)
        self._left[key] = (left, now, hidden + 1) if left < 1.0 else (left - 1.0, now, 0)
        if left < 1.0:
            return None
        return line_of(text) + (f" ({hidden} such lines were left out before)" if hidden else "")
