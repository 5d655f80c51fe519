# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A correction that needs orientations of anchors is named where the survey has none."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools import calibrating, diagnosis
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands import calibrate, check, diagnose, evaluate, export, localize, survey
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

LACKING = "antenna_pattern needs orientations of anchors, and the survey has none: "
PATTERN = EFFECTS["antenna_pattern"]({"anchor": 0.1})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a flight and its anchors, without orientations, and effects."""
    out = tmp_path_factory.mktemp("orientations")
    flight = simulate(SimulationConfig(duration=16.0, tdoa_rate=200.0, imu_rate=200.0))
    bare = Anchors.from_positions(flight.anchors.positions, flight.anchors.ids)
    write_bag(replace(flight, anchors=bare), out / "flight.bag")
    bare.to_yaml(out / "anchors.yaml")
    EffectSet((PATTERN,)).to_yaml(out / "effects.yaml")
    return out


def stop(*_, **__):
    raise InputError("here the long part begins")


@pytest.mark.parametrize(
    "command, arguments",
    [
        (check, ["flight.bag"]),
        (evaluate, ["flight.bag"]),
        (localize, ["flight.bag", "--out", "out"]),
        (calibrate, ["flight.bag", "--out", "out"]),
        (diagnose, ["flight.bag", "--out", "out"]),
        (survey, ["flight.bag", "--out", "out"]),
        (export, ["--survey", "anchors.yaml", "--onnx", "bias.onnx"]),
    ],
)
def test_a_command_names_the_effect_that_is_not_corrected(
    folder, command, arguments, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(diagnosis, "diagnose", stop)
    monkeypatch.setattr(calibrating, "with_truth", stop)
    monkeypatch.setattr("uwb_tdoa_tools.diagnosis.self_calibration.self_calibrate", stop)
    command.main([*arguments, "--effects", "effects.yaml"])
    out, err = capsys.readouterr()
    assert (out + err).count(LACKING) == 1
    assert (out + err).count("Survey the stands, or diagnose without it.") == 1


def test_only_the_anchors_without_an_orientation_are_named():
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    anchors = Anchors(np.arange(4), np.eye(4, 3), turned, "map")
    estimator = FlightEstimator(effects=EffectSet((PATTERN,)))
    assert estimator.remarks(anchors) == []
    turned[[1, 3]] = np.nan
    (remark,) = estimator.remarks(Anchors(np.arange(4), np.eye(4, 3), turned, "map"))
    assert "the survey has none of anchors 1 and 3: " in remark
    of_tag = EffectSet((EFFECTS["antenna_pattern"]({"tag": 0.1}),))
    for effects in (EffectSet(), of_tag):
        assert FlightEstimator(effects=effects).remarks(Anchors.from_positions(np.eye(4, 3))) == []
