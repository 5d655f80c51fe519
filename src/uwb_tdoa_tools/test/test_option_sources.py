# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""An option and a file give the same setting.

The option overrides the file, or is refused with a message. Nothing is ignored silently.
"""

from dataclasses import replace

from documented import main
import numpy as np
import pytest
import yaml

from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import EFFECTS, AnchorDelay, Covariance, EffectSet, TagLeverArm
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.commands.diagnose import UNUSED
from uwb_tdoa_tools.estimate import with_antenna
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

REFUSED = {  # (command, arguments, sentence): options with which it is refused
    (
        "convert",
        "a.csv --columns time=t,anchor_a=a,anchor_b=b,tdoa=d --survey right.yaml --out new.bag",
        "says where topics are in bags, and --columns is of CSV files",
    ): ("--topic uwb/tdoa=/x", "--namespace tag1"),
    (
        "evaluate",
        "flight.bag --odometry flight.bag",
        "has no part in an odometry that was recorded",
    ): ("--effects e.yaml", "--config c.yaml", "--model default", "-p loss:=huber", "--smooth"),
    (
        "survey",
        "flight.bag --effects effects.yaml --out out",
        "effects.yaml says how well each anchor is known, by its last calibration",
    ): ("--std 0.2", "--height-std 0.1", "--trusted 0", "--trusted-std 0.01"),
    ("demo", "--out out", "needs --flight"): ("--survey right.yaml",),
}
KNOWN = {
    "marks": "m.yaml",
    "distances": "d.csv",
    "odometry": "/vio",
    "plan_flight": "-3 3 -3 3 0 3",
}
REFUSED |= {
    (
        "diagnose",
        f"flight.bag --reference {reference} --out out",
        f"no part of it is used with --reference {reference}",
    ): [f"--{option.replace('_', '-')} {KNOWN[option]}" for option in options]
    for reference, options in UNUSED.items()
}


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A working directory with a bag whose anchors are wrong, a correct survey, and a calibration."""
    monkeypatch.chdir(tmp_path)
    settings = dict(duration=14.0, floor_time=1.0, tdoa_rate=200.0, imu_rate=100.0, bias=False)
    flight = simulate(SimulationConfig(seed=1, multipath=False, **settings))
    flight.anchors.to_yaml("right.yaml")
    off = 0.4 * np.random.default_rng(2).standard_normal(flight.anchors.positions.shape)
    flight = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    write_bag(flight, "flight.bag")
    keys = (("anchor_position", "0.x"), ("anchor_delay", "0"))
    effects = (
        EFFECTS["anchor_position"]({"0.x": 0.0}, {"0.x": 0.1}),
        AnchorDelay({"0": 0.0}, {"0": 0.1}),
    )
    EffectSet(effects, Covariance(keys, 0.01 * np.eye(2))).to_yaml("effects.yaml")
    (tmp_path / "a.csv").write_text("t,a,b,d\n0,1,2,0.1\n")
    return flight


def rmse(words):
    """Return the 3D RMSE of `evaluate`, m."""
    assert main("evaluate", ["flight.bag", "--no-bias", *words.split(), "--json", "out.json"]) == 0
    with open("out.json", encoding="utf-8") as file:
        return yaml.safe_load(file)["runs"][0]["rmse_3d"]


@pytest.mark.slow
def test_the_survey_overrides_the_bag_and_a_parameter_overrides_the_file(desk, capsys):
    given = rmse("--survey right.yaml")
    assert given < 0.5 * rmse("")
    assert "right.yaml count here, whatever anchors the bag holds" in capsys.readouterr().err
    with open("ekf_node.yaml", "w", encoding="utf-8") as file:
        yaml.safe_dump({"/**": {"ros__parameters": {"tdoa_std": 5.0}}}, file)
    of_file = "--survey right.yaml --config ekf_node.yaml"
    assert rmse(of_file) != given == rmse(f"{of_file} -p tdoa_std:=0.25")


def test_convert_puts_the_survey_into_the_bag(desk):
    right = read_survey("right.yaml").positions
    assert main("convert", ["flight.bag", "--survey", "right.yaml", "--out", "new.bag"]) == 0
    np.testing.assert_allclose(read_bag("new.bag").anchors.positions, right, atol=1e-9)


def test_the_arm_of_an_effect_counts_before_that_of_a_bag(desk):
    flight = replace(desk, meta={"antenna": [0.1, 0.0, 0.0]})
    own = EffectSet((TagLeverArm({"x": 0.0, "y": 0.2, "z": 0.0}),))
    assert with_antenna(own, flight) is own
    assert with_antenna(EffectSet(), flight).effects[0].values == {"x": 0.1, "y": 0.0, "z": 0.0}


def test_options_that_would_be_ignored_are_refused(desk, capsys):
    for (name, words, sentence), options in REFUSED.items():
        for more in options:
            assert main(name, [*words.split(), *more.split()]) == 2
            assert f"{more.split()[0]}: {sentence}" in capsys.readouterr().err
