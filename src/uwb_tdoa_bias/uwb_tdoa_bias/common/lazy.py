"""Parts of scipy that take long to import and that a node hardly ever needs: imported when
something of them is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType


class LazyModule:
    """Stands for a module."""

    def __init__(self, load: Callable[[], ModuleType]) -> None:
        """load() imports and returns it."""
        self._load = load

    def __getattr__(self, name: str) -> Any:
        return getattr(self._load(), name)


@LazyModule
def interpolate() -> ModuleType:
    """scipy.interpolate"""
    from scipy import interpolate as module

    return module


@LazyModule
def rotations() -> ModuleType:
    """scipy.spatial.transform"""
    from scipy.spatial import transform as module

    return module
