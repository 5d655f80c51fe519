# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The examples in docs/add_effect.md and docs/add_channel.md work as printed."""

from dataclasses import replace
from pathlib import Path
import re

from known_effects import clean_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels import CHANNELS
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS
from uwb_tdoa_tools.diagnosis.references import GroundTruth

pytestmark = pytest.mark.slow  # diagnoses whole flights

DOCS = Path(__file__).resolve().parents[3] / "docs"


def written(page, heading=""):
    """Return the names that the code on a page defines, optionally only below one heading."""
    text = (DOCS / page).read_text()
    if heading:
        text = text.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    names = {"__name__": "worked_example"}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, page, "exec"), names)
    return names


@pytest.fixture(scope="module")
def flight():
    return clean_flight(104, 40.0)


def test_an_effect_with_a_search_of_its_own(flight, monkeypatch):
    names = written("add_effect.md", "An effect with a search")
    ripple = names["RangeRipple"]
    monkeypatch.setitem(EFFECTS, ripple.name, ripple)
    monkeypatch.setitem(DETECTORS, ripple.name, names["RangeRippleDetector"]())
    wavelength = names["WAVELENGTHS"][9]
    put_in = ripple({"sine": 0.15, "cosine": -0.1, "wavelength": wavelength})
    attribution = attribute([put_in.inject(flight)], GroundTruth(), undeclared=False)
    (found,) = attribution.effects
    assert found.name == "range_ripple" and found.values["wavelength"] == pytest.approx(wavelength)
    assert found.values["sine"] == pytest.approx(0.15, abs=0.02)
    assert found.values["cosine"] == pytest.approx(-0.1, abs=0.02)
    assert attribute([flight], GroundTruth(), undeclared=False).effects == ()


def test_a_channel(flight, monkeypatch, tmp_path):
    names = written("add_channel.md")
    offset = names["CompassOffset"]
    monkeypatch.setitem(EFFECTS, offset.name, offset)
    monkeypatch.setitem(CHANNELS, "heading", names["Heading"]())
    truth = flight.truth
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(truth))
    stream = {
        "t": truth.t,
        "heading": Rotation.from_quat(truth.q).as_euler("ZYX")[:, 0] - 0.1 + noise,
    }
    seen = replace(flight, extra={"compass": stream})
    attribution = attribute([seen], GroundTruth())
    assert [effect.name for effect in attribution.effects] == ["compass_offset"]
    assert attribution.effects[0].values["offset"] == pytest.approx(-0.1, abs=0.02)
    EffectSet(attribution.effects).to_yaml(tmp_path / "effects.yaml")
    assert EffectSet.from_yaml(tmp_path / "effects.yaml").effects == attribution.effects
