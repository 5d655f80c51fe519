"""Pictures inside of a page. Importing this takes a second: it loads the drawing library."""

from __future__ import annotations

import base64
from dataclasses import dataclass
import io
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG

from ...scoring.plots import plt

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

# Told apart by colour-blind eyes (Okabe and Ito); the purple and the yellow are darker than theirs.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a8437f", "#e69f00", "#56b4e9", "#000000", "#8c8c00")
AFTER, FOUND, _, REGION, BEFORE = COLOURS[:5]
# in, of one picture: so that its letters can be read on a phone; and of one as wide as the page
WIDTH, FULL = (4.4, 10.6)
PIXELS = 96  # of a page in an inch
LIGHT = 40_000  # bytes, of a picture that need not be smaller
SHARP = 130  # dots in an inch of what is drawn as dots

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
    """(Figure, axes), height and width in inches; options as of plt.subplots."""
    with plt.rc_context(_FONT):
        return plt.subplots(figsize=(width, height), layout="constrained", **options)


@dataclass(frozen=True)
class Picture:
    """alt : what it shows, for who cannot see it; source : data URL; width : pixels; caption : how
    to read it, if nothing else says so;
    narrow : data URL of the same for a narrow screen, or "".
    """

    alt: str
    source: str
    width: int
    caption: str = ""
    narrow: str = ""


def embedded(figure: Figure, alt: str, caption: str = "", narrow: Figure | None = None) -> Picture:
    """Picture of a drawn Figure, as SVG, or as PNG where that is smaller and it matters; the
    Figures are closed. Arguments as of Picture.
    """
    return Picture(alt, *_source(figure), caption, "" if narrow is None else _source(narrow)[0])


def _source(figure: Figure) -> tuple[str, int]:
    """(data URL, pixels of width) of a Figure, which is closed."""
    with plt.rc_context(_FONT):
        layout = figure.get_layout_engine()
        assert layout is not None  # of `drawing`
        layout.execute(figure)
        figure.set_layout_engine("none")  # is laid out now, once for both kinds
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
    """What `draw` of a canvas writes; Figure.savefig would draw all of it once before, for nothing."""
    buffer = io.BytesIO()
    figure.set_dpi(SHARP)
    draw(buffer, **options)
    return buffer.getvalue()
