# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Products of dense matrices, or of scipy's sparse matrices if most entries are 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csr_array, hstack, issparse

Matrix = Any  # np.ndarray, or a sparse array of scipy


def stacked(columns: Sequence[Any], n: int) -> Matrix:
    """Return a sparse matrix (n, k) of columns, each a pair (rows, values) or an array (n,)."""
    pairs = [
        column if isinstance(column, tuple) else (np.flatnonzero(column), column[column != 0.0])
        for column in columns
    ]
    ends = np.cumsum([0, *(len(rows) for rows, _ in pairs)])
    rows, values = (
        np.concatenate([np.empty(0, kind), *(pair[k] for pair in pairs)])
        for k, kind in enumerate((np.int64, float))
    )
    return csc_array((values, rows, ends), shape=(n, len(columns)))


def dense(x: Matrix) -> np.ndarray:
    """Return a matrix as an array."""
    return x.toarray() if issparse(x) else x


def weighted(x: Matrix, weights: np.ndarray) -> Matrix:
    """Return the rows of x (n, k) times weights (n,)."""
    return x.multiply(weights[:, None]).tocsc() if issparse(x) else x * weights[:, None]


def product(x: Matrix, y: Matrix) -> np.ndarray:
    """Return x' y of two matrices (n, k) and (n, m), as an array (k, m)."""
    return dense(x.T @ y)


def counts(x: Matrix, axis: int) -> np.ndarray:
    """Return the number of nonzero entries of x along an axis."""
    return (x != 0.0).sum(axis=axis)


def sums_by(label: np.ndarray, x: Matrix, labels: int) -> np.ndarray:
    """Return the sums of the rows of x (n, k) by label, (labels, k).

    label : (n,) int, 0 to labels - 1
    """
    if issparse(x):
        members = csr_array(
            (np.ones(len(label)), (label, np.arange(len(label)))), shape=(labels, len(label))
        )
        return dense(members @ x)
    return np.stack([np.bincount(label, column, labels) for column in x.T], axis=1)


def beside_each_other(several: Sequence[Matrix]) -> Matrix:
    """Return several matrices joined by columns."""
    return (
        hstack(several, format="csc")
        if any(map(issparse, several))
        else np.concatenate(several, axis=1)
    )


def each_times(x: Matrix, functions: np.ndarray) -> Matrix:
    """Return each column of x (n, k) times each of `functions` (n, m), (n, k m)."""
    if issparse(x):
        return beside_each_other([weighted(x, function) for function in functions.T])
    return (x[:, :, None] * functions[:, None, :]).reshape(len(x), -1)
