# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The driver of the diagnosis knows no effect, no channel and no detector by name."""

import ast
from pathlib import Path

import pytest

from uwb_tdoa_bias.effects import EFFECTS, LabelEffect
from uwb_tdoa_tools import diagnosis
from uwb_tdoa_tools.diagnosis.channels import CHANNELS
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS

FOLDER = Path(diagnosis.__file__).parent
# files that may know their own subject; the last two are about anchors and TDOAs only
ROOMS = ("channels", "detectors", "deviations.py", "self_calibration")
DRIVER = [path for path in FOLDER.rglob("*.py") if path.relative_to(FOLDER).parts[0] not in ROOMS]
CLASSES = {effect.__name__ for effect in EFFECTS.values()}


@pytest.mark.parametrize("path", DRIVER, ids=lambda path: str(path.relative_to(FOLDER)))
def test_no_name_of_an_effect_or_channel(path):
    tree = ast.parse(path.read_text())
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert not texts & {*EFFECTS, *CHANNELS} and not names & CLASSES


def test_a_detector_for_every_effect_that_no_regression_finds_and_that_is_not_of_the_numbers():
    physical = {
        name: effect for name, effect in EFFECTS.items() if not issubclass(effect, LabelEffect)
    }
    assert set(DETECTORS) == {name for name, effect in physical.items() if not effect.fitted}


@pytest.mark.parametrize("name", DETECTORS)
def test_a_detector_lies_in_the_module_of_the_family_of_its_effect(name):
    family = EFFECTS[name].__module__.rpartition(".")[2]
    assert type(DETECTORS[name]).__module__.endswith(f".detectors.{family}")


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_acts_on_channels_that_exist(name):
    assert set(EFFECTS[name].channels) <= set(CHANNELS)
