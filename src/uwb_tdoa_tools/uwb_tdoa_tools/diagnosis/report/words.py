# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Explain terms that a reader may not know."""

from __future__ import annotations

import re

from uwb_tdoa_bias.effects import EFFECTS

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
    "NLOS": (
        "non-line-of-sight: something stands between anchor and tag, and a later path is taken "
        "for the direct one."
    ),
    "MEMS": "micro-electro-mechanical system: the kind of sensor on a chip that an IMU is made of.",
    "YAML": "the text format of effects.yaml.",
    "JSON": "the text format of diagnosis.json.",
}


def used(text: str) -> dict[str, str]:
    """Return {term: meaning} of the TERMS and effects in a text.

    A plural is explained by its singular.
    """
    effects = {
        name: f"{effect.physics}."
        for name, effect in EFFECTS.items()
        if re.search(rf"\b{name}\b", text)
    }
    found = {name.lower() for name in re.findall(r"\w+", " ".join([text, *effects.values()]))}
    out = {name: meaning for name, meaning in TERMS.items() if name.lower() in found}
    if "TDOA" in out:
        out.pop("TDOAs", None)
    return {**out, **effects}
