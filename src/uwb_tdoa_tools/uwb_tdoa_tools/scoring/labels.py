"""Labels of anchors in pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

TOGETHER = 0.35  # m; anchors that are nearer to each other in a picture have one label


def labels(ids: Sequence[int], places: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (label, (2,) m) of ids at places (n, 2) m; those that would cover each other have one."""
    left = list(range(len(ids)))
    while left:
        here = [k for k in left if np.linalg.norm(places[k] - places[left[0]]) < TOGETHER]
        yield ", ".join(str(ids[k]) for k in here), places[here].max(axis=0)
        left = [k for k in left if k not in here]
