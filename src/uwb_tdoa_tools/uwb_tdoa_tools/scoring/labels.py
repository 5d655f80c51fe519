"""Labels of anchors in pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.patheffects import withStroke
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.axes import Axes

TOGETHER = 0.35  # m; anchors that are nearer to each other in a picture have one label
SIZE, FEW = 10.0, 20  # points, of the letters of so many labels at most; of more they are smaller
MOST = 80  # anchors that have labels: more could not be read
AROUND = (
    (1, 1),
    (-1, 1),
    (1, -1),
    (-1, -1),
    (0, 1),
    (0, -1),
    (1, 0),
    (-1, 0),
)  # where a label may be, as seen from its anchor
_WIDE, _HIGH = 0.62, 1.15  # of the size of the letters: a letter, and a line


def labels(ids: Sequence[int], places: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (label, (2,) m) of ids at places (n, 2) m; those that would cover each other have one."""
    left = list(range(len(ids)))
    while left:
        here = [k for k in left if np.linalg.norm(places[k] - places[left[0]]) < TOGETHER]
        yield ", ".join(str(ids[k]) for k in here), places[here].max(axis=0)
        left = [k for k in left if k not in here]


def put_labels(
    ax: Axes, ids: Sequence[int], places: np.ndarray, avoided: np.ndarray, colour: str = "k"
) -> None:
    """Write ids beside places (n, 2) m: each label where it covers no place, none of the avoided
    (m, 2) m, no other label and no edge of the axes, as far as there is room. The figure must have
    its layout.
    """
    if len(ids) > MOST:
        return
    pixel, frame = ax.figure.dpi / 72.0, ax.get_window_extent()
    dots, taken = ax.transData.transform(np.vstack([places, avoided])), np.empty((0, 4))
    size = SIZE if len(ids) <= FEW else 0.75 * SIZE
    for text, at in labels(ids, places):
        x, y = ax.transData.transform(at)
        half = 0.5 * pixel * size * np.array([_WIDE * len(text), _HIGH])
        best, chosen = np.inf, AROUND[0]
        for side in AROUND:
            centre = np.array([x, y]) + np.array(side) * (half + 4.0 * pixel)
            box = np.concatenate([centre - half, centre + half])
            over = (
                np.maximum(
                    np.minimum(taken[:, 2:], box[2:]) - np.maximum(taken[:, :2], box[:2]), 0.0
                )
                .prod(axis=1)
                .sum()
            )
            hit = np.sum((np.abs(dots - centre) < half + 3.0 * pixel).all(axis=1))
            out = (
                np.maximum(box[2:] - [frame.x1, frame.y1], 0.0).sum()
                + np.maximum([frame.x0, frame.y0] - box[:2], 0.0).sum()
            )
            cost = over + 50.0 * hit + 20.0 * out
            if cost < best:
                best, chosen, placed = cost, side, box
        taken = np.vstack([taken, placed])
        shift = np.array(chosen) * (half / pixel + 4.0)
        ax.annotate(
            text,
            (float(at[0]), float(at[1])),
            xytext=tuple(shift),
            textcoords="offset points",
            fontsize=size,
            color=colour,
            ha="center",
            va="center",
            zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="w")],
        )
