# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Functions of arrays that effects use beside numpy, for numbers and for symbols alike.

An effect states its equation once, for arrays of numbers. `export` calls the same code with
symbolic arrays, and records the equation. numpy's functions take both kinds by themselves. The
functions below do so where numpy's do not: for conversions, compiled functions, and functions that
are polynomials between given places. All tables of measurements are Stamped. Parts of scipy that
take long to import, and that nodes rarely need, are imported at their first use.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np


class Stamped:
    """Arrays of one length with stamps t (n,), s."""

    t: np.ndarray

    def __len__(self) -> int:
        return len(self.t)


def numbers_of(values: Any) -> np.ndarray:
    """Return values as an array of floats; [NaN] if they are no numbers."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.array([np.nan])


class SymbolicArray(ABC):
    """An array of symbols, one row per measurement, that records what is computed of it."""

    @abstractmethod
    def filled(self, kernel: Callable[..., Any], shape: tuple[int, ...], inputs: Any) -> Any:
        """Return what `filled` returns, recorded."""

    @abstractmethod
    def piecewise(
        self, function: Callable[[np.ndarray], np.ndarray], breaks: np.ndarray, degree: int
    ) -> Any:
        """Return what `piecewise` returns, recorded."""

    @abstractmethod
    def played(self, model: Any) -> Any:
        """Return the output (n, outputs) of a Session for this input (n, width), recorded."""


def floats(values: Any) -> Any:
    """Return values as an array of float; a SymbolicArray stays as it is."""
    return values if isinstance(values, SymbolicArray) else np.asarray(values, dtype=float)


def filled(kernel: Callable[..., Any], shape: tuple[int, ...], *inputs: Any) -> Any:
    """Return the array of a shape that a compiled function writes to its last argument.

    inputs : the other arguments; arrays are passed on in contiguous form
    """
    for value in inputs:
        if isinstance(value, SymbolicArray):
            return value.filled(kernel, shape, inputs)
    out = np.empty(shape)
    kernel(
        *(np.ascontiguousarray(one) if isinstance(one, np.ndarray) else one for one in inputs), out
    )
    return out


def piecewise(
    function: Callable[[np.ndarray], np.ndarray], x: Any, breaks: np.ndarray, degree: int
) -> Any:
    """Return function(x) of a continuous piecewise polynomial, which is constant beyond its breaks.

    function : of (m * n,) values, m for each row of x in turn, to (m * n,)
    x : (n,); breaks : (k,), rising, where pieces meet, ends included; degree : of the pieces
    """
    if isinstance(x, SymbolicArray):
        return x.piecewise(function, breaks, degree)
    return function(x)


class LazyModule:
    """A stand-in for a module that is imported when an attribute is used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


interpolate = LazyModule("scipy.interpolate")
rotations = LazyModule("scipy.spatial.transform")
