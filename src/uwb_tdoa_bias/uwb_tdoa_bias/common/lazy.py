# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parts of scipy that are imported at their first use.

They take long to import, and nodes rarely need them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


class LazyModule:
    """A stand-in for a module that is imported when an attribute is used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


interpolate = LazyModule("scipy.interpolate")
rotations = LazyModule("scipy.spatial.transform")
