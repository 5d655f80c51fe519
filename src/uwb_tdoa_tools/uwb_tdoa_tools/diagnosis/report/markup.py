"""Pieces of a page that holds everything itself, fits a phone, and prints."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from .style import STYLE

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence


def page(title: str, parts: Iterable[str]) -> str:
    """A document of parts."""
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        f'content="width=device-width, initial-scale=1"><title>{escape(title)}</title><style>{STYLE}</style></head>'
    )
    return f"{head}<body>{''.join(parts).replace('m/s^2', 'm/s²')}</body></html>\n"


def paragraphs(sentences: Iterable[str], kind: str = "") -> str:
    """Each sentence a paragraph."""
    return "".join(f"<p{_class(kind)}>{escape(sentence)}</p>" for sentence in sentences)


def section(title: str, *parts: str) -> str:
    """A part with a heading; nothing without parts."""
    content = "".join(parts)
    return f"<h2>{escape(title)}</h2>{content}" if content else ""


def folded(title: str, *parts: str) -> str:
    """A part that opens on a click."""
    content = "".join(parts)
    return f"<details><summary>{escape(title)}</summary>{content}</details>" if content else ""


def listing(items: Iterable[tuple[str, Iterable[str]]], ordered: bool = False) -> str:
    """A list of (markup, sentences in small print)."""
    name = "ol" if ordered else "ul"
    rows = "".join(f"<li>{large}{paragraphs(small, 'note')}</li>" for large, small in items)
    return f"<{name}>{rows}</{name}>" if rows else ""


def table(head: Sequence[object], rows: Sequence[Sequence[object]], numbers: Collection[int] = ()) -> str:
    """A table that scrolls sideways if it must. head : names; rows : of cells; numbers : places of columns offigures."""
    if not rows:
        return "<p>None.</p>"

    def cells(row: Iterable[object], tag: str) -> str:
        return "".join(
            f"<{tag}{_class('number' if k in numbers else '')}>{escape(str(c))}</{tag}>" for k, c in enumerate(row)
        )

    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{cells(head, "th")}</tr></thead><tbody>{body}</tbody></table></div>'


def stacked(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells of markup, whose rows are lists on a narrow screen."""
    body = "".join(
        "<tr>" + "".join(f'<td data-name="{escape(name)}">{cell}</td>' for name, cell in zip(head, row)) + "</tr>"
        for row in rows
    )
    names = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f'<div class="wide"><table class="stack"><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table></div>'


def bar(share: float) -> str:
    """A bar of a share of 8 em."""
    return f'<span class="bar" style="width:{8.0 * max(share, 0.0):.2f}em"></span>'


def grid(parts: Sequence[str]) -> str:
    """Parts side by side where there is room."""
    return f'<div class="grid">{"".join(parts)}</div>' if parts else ""


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
