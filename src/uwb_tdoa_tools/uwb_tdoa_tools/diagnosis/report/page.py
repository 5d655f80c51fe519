# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write the report: one HTML page without external files."""

from __future__ import annotations

import re

from jinja2 import Environment, PackageLoader, StrictUndefined

from uwb_tdoa_bias.effects import EFFECTS

from ..result import Diagnosis
from . import curves, entries, maps, tables, verdict

TERMS = {
    "UWB": "ultra-wideband: the radio that anchors and tag speak.",
    "TDOA": (
        "time difference of arrival: how much farther one anchor is from the tag than another, in "
        "metres."
    ),
    "TDOAs": (
        "time differences of arrival: how much farther one anchor is from the tag than another, "
        "in metres."
    ),
    "TDoA2": "a protocol in which each anchor is heard against the one before it in a fixed order.",
    "TDoA3": "a protocol in which anchors send at random, and each is heard against many others.",
    "IMU": "inertial measurement unit: gyroscope and accelerometer.",
    "RMSE": "root mean square error: large errors count more than small ones.",
    "3D": "in space: x, y and z together.",
    "NIS": "normalised innovation squared: how far measurements are from what the filter expects, 1 "
    "if it judges "
    "itself rightly, more if it is too sure.",
    "NEES": "normalised estimation error squared: the same for the estimated position, 3 if the "
    "filter judges itself "
    "rightly.",
    "elevation": (
        "angle above the horizontal at which the tag sees the anchor; in the tag: in the frame of "
        "the tag; in the anchor: at which the anchor sees the tag, in the frame of the anchor."
    ),
    "bearing": (
        "angle about the vertical, from the x axis, at which the tag sees the anchor; in the tag "
        "and in the anchor: as of elevation."
    ),
    "NLOS": (
        "non-line-of-sight: something stands between anchor and tag, and a later path is taken "
        "for the direct one."
    ),
    "MEMS": "micro-electro-mechanical system: the kind of sensor on a chip that an IMU is made of.",
    "YAML": "the text format of effects.yaml.",
    "JSON": "the text format of diagnosis.json.",
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


def meanings(text: str) -> dict[str, str]:
    """Return {term: meaning} of the TERMS and effects in a text.

    A plural is explained by its singular.
    """
    effects = {
        name: f"{effect.row.physics}."
        for name, effect in EFFECTS.items()
        if re.search(rf"\b{name}\b", text)
    }
    found = {name.lower() for name in re.findall(r"\w+", " ".join([text, *effects.values()]))}
    out = {name: meaning for name, meaning in TERMS.items() if name.lower() in found}
    if "TDOA" in out:
        out.pop("TDOAs", None)
    return {**out, **effects}


# Names and texts in a recording are not trusted, so everything except template markup is escaped.
_TEMPLATES = Environment(
    loader=PackageLoader(__package__),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.globals |= {
    "curves": curves,
    "entries": entries,
    "maps": maps,
    "meanings": meanings,
    "tables": tables,
    "verdict": verdict,
}
