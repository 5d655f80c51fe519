# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parts of scipy that are imported at their first use.

They take long to import, and nodes rarely need them.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any


class LazyModule:
    """A stand-in for a module that is imported when an attribute is used."""

    def __init__(self, load: Callable[[], ModuleType]) -> None:
        """Set `load`, a function that imports and returns the module."""
        self._load = load

    def __getattr__(self, name: str) -> Any:
        return getattr(self._load(), name)


@LazyModule
def interpolate() -> ModuleType:
    """Import scipy.interpolate."""
    from scipy import interpolate as module

    return module


@LazyModule
def rotations() -> ModuleType:
    """Import scipy.spatial.transform."""
    from scipy.spatial import transform as module

    return module
