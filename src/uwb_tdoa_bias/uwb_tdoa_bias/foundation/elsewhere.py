"""Out of the present folder for a moment: libraries look there for their settings, and Python for modules, and a folder of
recordings may hold what anybody has put there."""

from __future__ import annotations

from contextlib import contextmanager
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def elsewhere() -> Iterator[None]:
    """In the root folder while the block lasts: what is imported or started in it finds nothing of the present folder."""
    here = os.open(".", os.O_PATH | os.O_DIRECTORY)  # also where its name is gone
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(here)
        os.close(here)
