# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw pictures for the page. The import takes a second, because it loads matplotlib."""

from __future__ import annotations

import base64
from dataclasses import dataclass
import io
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
import matplotlib.pyplot as plt

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

# Distinct for colour-blind readers (Okabe and Ito); purple and yellow are darker than in the
# original.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a8437f", "#e69f00", "#56b4e9", "#000000", "#8c8c00")
AFTER, FOUND, _, REGION, BEFORE = COLOURS[:5]
# in, width of a picture with letters readable on a phone, and of a picture as wide as the page
WIDTH, FULL = (4.4, 10.6)
PIXELS = 96  # pixels per inch of a page
LIGHT = 40_000  # bytes, size up to which SVG is always used
SHARP = 130  # dots per inch of raster parts

_FONT = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def drawing(height: float, width: float = WIDTH, **options: Any) -> tuple[Figure, Any]:
    """Return (Figure, axes).

    height, width : in; options : as of plt.subplots
    """
    with plt.rc_context(_FONT):
        return plt.subplots(figsize=(width, height), layout="constrained", **options)


@dataclass(frozen=True)
class Picture:
    """A picture embedded in the page.

    alt : text alternative; source : data URL; width : pixels; caption : how to read it, or ""
    narrow : data URL for a narrow screen, or ""
    """

    alt: str
    source: str
    width: int
    caption: str = ""
    narrow: str = ""


def embedded(figure: Figure, alt: str, caption: str = "", narrow: Figure | None = None) -> Picture:
    """Return the Picture of a Figure, and close the Figure.

    The format is SVG, or PNG if the SVG is large and the PNG is smaller.

    alt, caption, narrow : as of Picture, with `narrow` as a Figure
    """
    return Picture(alt, *_source(figure), caption, "" if narrow is None else _source(narrow)[0])


def _source(figure: Figure) -> tuple[str, int]:
    """Return (data URL, width in pixels) of a Figure, and close it."""
    with plt.rc_context(_FONT):
        layout = figure.get_layout_engine()
        assert layout is not None  # `drawing` sets it
        layout.execute(figure)
        figure.set_layout_engine("none")  # the layout above serves both formats
        kinds = {
            "svg+xml": _drawn(figure, FigureCanvasSVG(figure).print_svg, metadata={"Date": None})
        }
        if len(kinds["svg+xml"]) > LIGHT:
            kinds["png"] = _drawn(figure, FigureCanvasAgg(figure).print_png)
    width = round(figure.get_figwidth() * PIXELS)
    plt.close(figure)
    kind = min(kinds, key=lambda name: len(kinds[name]))
    return f"data:image/{kind};base64,{base64.b64encode(kinds[kind]).decode()}", width


def _drawn(figure: Figure, draw: Callable[..., object], **options: Any) -> bytes:
    """Return the bytes that `draw`, a method of a canvas, writes.

    Figure.savefig would draw twice.
    """
    buffer = io.BytesIO()
    figure.set_dpi(SHARP)
    draw(buffer, **options)
    return buffer.getvalue()
