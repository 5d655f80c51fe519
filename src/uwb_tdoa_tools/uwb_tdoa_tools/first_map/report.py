# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A first map as figures, text and a picture."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.files import write_filled

if TYPE_CHECKING:
    from pathlib import Path

    from .verdict import FirstMap

CHI2_95 = 5.99  # of two coordinates


def as_dict(found: FirstMap) -> dict[str, Any]:
    """Return the figures for JSON."""
    return {
        "accepted": not found.why_not,
        "why_not": found.why_not,
        "anchors": {
            str(i): {
                "position": found.positions[row].tolist(),
                "std": found.std[row].tolist(),
                "trusted": found.trusted[row].tolist(),
                "others": [other[row].tolist() for other in found.others],
            }
            for row, i in enumerate(found.ids)
        },
        "covariance": found.covariance.tolist(),
        "lasting_std": found.lasting,
    }


def as_text(found: FirstMap) -> str:
    """Return a table of the anchors, and the verdict."""
    lines = [f"{'anchor':>6}  {'position [m]':>24}  {'std [m]':>18}"]
    for row, i in enumerate(found.ids):
        position = "".join(f"{value:8.2f}" for value in found.positions[row])
        std = "".join(f"{value:6.2f}" for value in found.std[row])
        mark = "  trusted" if found.trusted[row].all() else ""
        lines.append(f"{i:>6}  {position}  {std}{mark}")
    if found.why_not:
        lines.append(f"no map: {found.why_not}")
    else:
        off = np.linalg.norm(found.std[~found.trusted.all(axis=1)], axis=1)
        lines.append(
            f"{len(off)} anchors are known to {np.median(off):.2f} m (median), {off.max():.2f} m at "
            "most: a first map; heights and distances make it better"
        )
    return "\n".join(lines)


def picture(found: FirstMap, path: str | Path) -> None:
    """Draw the map from above and from the side, with ellipses of 95 % and other maps."""
    from matplotlib.figure import Figure  # takes a second to import
    from matplotlib.patches import Ellipse

    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    for ax, axes in zip(figure.subplots(1, 2), ([0, 1], [0, 2])):
        for other in found.others:
            ax.plot(*other[:, axes].T, "x", color="tab:red", ms=7)
        for row, i in enumerate(found.ids):
            place = found.positions[row, axes]
            columns = [3 * row + axis for axis in axes]
            values, vectors = np.linalg.eigh(found.covariance[np.ix_(columns, columns)])
            width, height = 2.0 * np.sqrt(CHI2_95 * np.maximum(values, 0.0))
            angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
            ax.add_patch(
                Ellipse(tuple(place), width, height, angle=angle, fc="none", ec="tab:blue")
            )
            ax.plot(*place, "s" if found.trusted[row].all() else "o", color="tab:blue", ms=5)
            ax.annotate(str(i), place, textcoords="offset points", xytext=(6, 6))
        side = axes[1] == 2
        ax.set(
            xlabel="x [m]",
            ylabel="z [m]" if side else "y [m]",
            title="from the side" if side else "from above",
        )
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.25)
    state = f"not accepted; red: {len(found.others)} other maps" if found.why_not else "accepted"
    figure.suptitle(f"first map: {state}; squares: trusted; ellipses: 95 %")
    write_filled(path, partial(figure.savefig, dpi=110))
