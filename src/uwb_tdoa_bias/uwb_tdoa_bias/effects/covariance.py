"""How well the values of effects are known together: the prior of the next calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..foundation.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

ENTRIES = ("parameters", "matrix")


@dataclass(frozen=True, eq=False)
class Covariance:
    """keys : ((name of an effect, parameter), ...); matrix (k, k), of their values, units
    multiplied.
    """

    keys: tuple[tuple[str, ...], ...]
    matrix: np.ndarray

    def of(self, keys: Sequence[tuple[str, ...]]) -> tuple[np.ndarray, np.ndarray]:
        """(places (m,) of the keys that are in it among `keys`, matrix (m, m) of these)."""
        known = {key: row for row, key in enumerate(self.keys)}
        places = [place for place, key in enumerate(keys) if key in known]
        rows = [known[keys[place]] for place in places]
        return np.array(places, dtype=int), self.matrix[np.ix_(rows, rows)]

    def of_each_anchor(self) -> Covariance:
        """What it says of the parameters of each anchor together, anchor by anchor; nothing of what
        different ones have in common.
        """
        anchors = np.array([key[1].partition(".")[0] for key in self.keys])
        order = np.argsort(np.unique(anchors, return_inverse=True)[1], kind="stable")
        matrix = np.where(anchors[:, None] == anchors, self.matrix, 0.0)[np.ix_(order, order)]
        return Covariance(tuple(self.keys[place] for place in order), matrix)

    def without(self, anchors: Collection[str]) -> Covariance:
        """The Covariance of what is not of anchors with these ids (text)."""
        kept = [key for key in self.keys if key[1].partition(".")[0] not in anchors]
        return Covariance(tuple(kept), self.of(kept)[1])

    def as_dict(self) -> dict[str, list[str] | list[list[float]]]:
        """For YAML: the lower triangle, row by row, without the zeros that a row begins with."""
        first = [min(int(np.argmax(row != 0.0)), k) for k, row in enumerate(self.matrix)]
        rows = [
            [float(f"{value:.6g}") for value in row[begin : k + 1]]
            for k, (row, begin) in enumerate(zip(self.matrix, first))
        ]
        return {"parameters": [f"{name} {key}" for name, key in self.keys], "matrix": rows}

    @classmethod
    def from_dict(
        cls, content: Any, values: dict[str, dict[str, float]], where: str | Path
    ) -> Covariance:
        """What `as_dict` gives, of effects with `values` {name: {parameter: number}}. where : file,
        for messages. Raises InputError.
        """
        if not isinstance(content, dict) or set(content) != set(ENTRIES):
            raise InputError(
                f"{where}: covariance must hold {' and '.join(ENTRIES)}, as the tools write it."
            )
        names, rows = content["parameters"], content["matrix"]
        if not isinstance(names, list) or not isinstance(rows, list) or len(rows) != len(names):
            raise InputError(
                f"{where}: covariance: needs a row of the matrix for each of the parameters."
            )
        keys = tuple(tuple(str(name).split(" ", 1)) for name in names)
        for key in keys:
            if len(key) != 2 or key[1] not in values.get(key[0], {}) or keys.count(key) > 1:
                raise InputError(
                    f"{where}: covariance: {' '.join(key)!r} is no parameter above, or there twice."
                )
        matrix = np.zeros((len(keys), len(keys)))
        for k, row in enumerate(rows):
            numeric = isinstance(row, list) and all(
                isinstance(value, (int, float)) for value in row
            )
            if not numeric or not 1 <= len(row) <= k + 1:
                raise InputError(
                    f"{where}: covariance: row {k + 1} must be {k + 1} numbers, or fewer: "
                    "those before it are 0."
                )
            matrix[k, k + 1 - len(row) : k + 1] = matrix[k + 1 - len(row) : k + 1, k] = row
        scale = np.sqrt(np.diag(matrix).clip(min=1e-300))
        if not np.isfinite(matrix).all() or (
            len(keys) and np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] < -1e-3
        ):
            raise InputError(
                f"{where}: covariance: the matrix is none; it must be finite and positive "
                "semidefinite."
            )
        return cls(keys, matrix)
