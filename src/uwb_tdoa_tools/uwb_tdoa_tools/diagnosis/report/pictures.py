# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw pictures for the page. The import takes a second, because it loads matplotlib."""

from __future__ import annotations

import base64
import io
from typing import Any, NamedTuple

from matplotlib.figure import Figure
import matplotlib.pyplot as plt

# Distinct for colour-blind readers (Okabe and Ito); purple and yellow are darker than in the
# original.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a8437f", "#e69f00", "#56b4e9", "#000000", "#8c8c00")
AFTER, FOUND, _, REGION, BEFORE = COLOURS[:5]
WIDTH = 4.4  # in, of a picture with letters that are readable on a phone
SHARP = 130  # dots per inch of raster parts

_STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
}


class Picture(NamedTuple):
    """A picture embedded in the page.

    alt : text alternative; source : data URL; caption : how to read it, or ""
    """

    alt: str
    source: str
    caption: str = ""


def drawing(height: float, **options: Any) -> tuple[Figure, Any]:
    """Return (Figure, axes).

    height : in; options : as of plt.subplots
    """
    with plt.rc_context(_STYLE):
        return plt.subplots(figsize=(WIDTH, height), layout="constrained", **options)


def embedded(figure: Figure, alt: str, caption: str = "") -> Picture:
    """Return the Picture of a Figure, and close the Figure.

    alt, caption : as of Picture
    """
    file = io.BytesIO()
    with plt.rc_context(_STYLE):
        figure.savefig(file, format="svg", dpi=SHARP, metadata={"Date": None})
    plt.close(figure)
    image = base64.b64encode(file.getvalue()).decode()
    return Picture(alt, f"data:image/svg+xml;base64,{image}", caption)
