# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The examples in docs/add_effect.md and docs/add_channel.md work as printed."""

from dataclasses import replace

from documented import ROOT, blocks, section
from known_effects import clean_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import CHANNELS
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS
from uwb_tdoa_tools.diagnosis.references import GroundTruth

pytestmark = pytest.mark.slow  # diagnoses whole flights


def written(text):
    """Return the names that the code of a page defines."""
    names = {"__name__": "worked_example"}
    for block in blocks(text, "python"):
        exec(block, names)
    return names


@pytest.fixture(scope="module")
def flight():
    return clean_flight(104, 40.0)


def test_an_effect_with_a_search_of_its_own(flight, monkeypatch):
    names = written(section("add_effect.md", "An effect with a search"))
    ripple = names["RangeRipple"]
    monkeypatch.setitem(EFFECTS, ripple.name, ripple)
    monkeypatch.setitem(DETECTORS, ripple.name, names["RangeRippleDetector"]())
    values = {"sine": 0.15, "cosine": -0.1, "wavelength": names["WAVELENGTHS"][9]}
    (found,) = attribute([ripple(values).inject(flight)], GroundTruth(), undeclared=False).effects
    assert found.name == "range_ripple" and found.values == pytest.approx(values, abs=0.02)
    assert attribute([flight], GroundTruth(), undeclared=False).effects == ()


def test_a_channel(flight, monkeypatch):
    names = written((ROOT / "docs" / "add_channel.md").read_text())
    offset = names["CompassOffset"]
    monkeypatch.setitem(EFFECTS, offset.name, offset)
    monkeypatch.setitem(CHANNELS, "heading", names["Heading"]())
    truth = flight.truth
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(truth))
    heading = Rotation.from_quat(truth.q).as_euler("ZYX")[:, 0] - 0.1 + noise
    seen = replace(flight, extra={"compass": {"t": truth.t, "heading": heading}})
    (found,) = attribute([seen], GroundTruth()).effects
    assert found.name == "compass_offset" and found.values["offset"] == pytest.approx(
        -0.1, abs=0.02
    )
