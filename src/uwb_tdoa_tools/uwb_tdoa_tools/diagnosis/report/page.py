# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write the report: one HTML page without external files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined

from . import anchors, curves, entries, maps, next_flight, reasons, tables, verdict, words

if TYPE_CHECKING:
    from ..result import Diagnosis

# Names and texts in a recording are not trusted, so everything except template markup is escaped.
_TEMPLATES = Environment(
    loader=PackageLoader(__package__),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.globals |= {
    "anchors": anchors,
    "curves": curves,
    "entries": entries,
    "maps": maps,
    "next_flight": next_flight,
    "reasons": reasons,
    "tables": tables,
    "verdict": verdict,
    "words": words,
}


def html(diagnosis: Diagnosis, template: str = "page") -> str:
    """Return the HTML page of a Diagnosis.

    It shows verdict, advice, worth of each effect, map, errors, undetermined parameters, and
    details.

    template : name in the folder `templates`: the page or a part
    """
    names = ", ".join(flight.name for flight in diagnosis.flights)
    found = entries.entries(diagnosis)
    text = _TEMPLATES.get_template(f"{template}.html").render(
        diagnosis=diagnosis, found=found, names=names
    )
    return text.replace("m/s^2", "m/s²")
