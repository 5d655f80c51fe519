"""Health of TDOAs: of pairs and of anchors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array

from .figures import APART, FEWEST, figures, rows_by_value

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .base import Figures
    from .radio import RadioResidual

STRONGEST = 10


def health(parts: Sequence[RadioResidual]) -> Figures:
    """{"pairs", "anchors", "cross_correlation"} of the residuals of TDOAs of some flights in the
    air.
    """
    ids = parts[0].samples.anchors.ids
    t, r, a, b = (np.concatenate(column) for column in zip(*map(_columns, enumerate(parts))))
    pairs, each = [], []
    label = a * len(ids) + b
    for number, mine in rows_by_value(label):
        pairs.append({"pair": _name(number, ids), **figures(t[mine], r[mine])})
    for row, anchor in enumerate(ids.tolist()):
        late = np.concatenate([r[b == row], -r[a == row]])
        if len(late):
            each.append({"anchor": anchor, **figures(None, late)})
    return {"pairs": pairs, "anchors": each, "cross_correlation": _crossed(t, r, label, ids)}


def _name(label: int, ids: np.ndarray) -> str:
    """A pair "1-2" by its number among anchors with these ids."""
    return "-".join(str(ids[row]) for row in divmod(label, len(ids)))


def _columns(
    numbered: tuple[int, RadioResidual],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    number, part = numbered
    rows, samples = part.airborne, part.samples
    return samples.t[rows] + APART * number, part.residual[rows], samples.a[rows], samples.b[rows]


def _crossed(
    t: np.ndarray, r: np.ndarray, label: np.ndarray, anchors: np.ndarray
) -> list[dict[str, Any]]:
    """The strongest correlations between half-second means of two pairs: [{"pairs",
    "correlation"}].
    """
    cell = np.unique((t * 2.0).astype(int), return_inverse=True)[1]
    together = np.unique(np.stack([label, cell]), axis=1)[
        0
    ]  # once for every cell in which a pair was heard
    often, times = np.unique(together, return_counts=True)
    rows = np.isin(label, often[times > FEWEST])  # nothing is said of the others
    r, cell = r[rows], cell[rows]
    if not len(r):
        return []
    labels, place = np.unique(label[rows], return_inverse=True)
    shape = (cell.max() + 1, len(labels))
    at = cell * len(labels) + place
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    mean = np.bincount(at, r, shape[0] * shape[1]).reshape(shape) / np.maximum(count, 1)
    heard = csr_array(count > 0, dtype=float)
    together = (heard.T @ heard).tocoo()  # half seconds in which two pairs were heard
    often = np.flatnonzero((together.data > FEWEST) & (together.row > together.col))
    out: list[dict[str, Any]] = []
    for i, k in sorted(zip(together.row[often].tolist(), together.col[often].tolist())):
        both = (count[:, i] > 0) & (count[:, k] > 0)
        if mean[both, i].std() > 0.0 and mean[both, k].std() > 0.0:
            rho = float(np.corrcoef(mean[both, i], mean[both, k])[0, 1])
            names = [_name(x, anchors) for x in (labels[k], labels[i])]
            out.append({"pairs": names, "correlation": round(rho, 3)})
    return sorted(out, key=lambda item: -abs(item["correlation"]))[:STRONGEST]
