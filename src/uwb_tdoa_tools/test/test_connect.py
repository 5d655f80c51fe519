# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""docs/csv.md as a new user follows it: its files, and its commands in their order."""

from importlib import import_module
import re

import numpy as np
import pytest
from walking import blocks, run, section, write_tables
import yaml

from uwb_tdoa_bias.effects import AnchorDelay
from uwb_tdoa_tools.readers import read_survey
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.rooms import facing

WALK = section("csv.md", "From a CSV file and a tape measure to a diagnosed flight")
LATE = 0.3  # m, anchor 3


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Return a folder with the anchors.yaml of the page, and recordings of another tool."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anchors.yaml").write_text(*blocks(WALK, "yaml"))
    taped = read_survey("anchors.yaml")
    rng = np.random.default_rng(1)
    positions = taped.positions + 0.02 * rng.normal(size=(8, 3))
    true = facing(positions, (3.5, 4.0, 1.5), inverted=positions[:, 2] > 1.5)
    late = AnchorDelay({"3": LATE})
    for seed, day in enumerate(("monday", "tuesday")):
        rates = dict(duration=40.0, imu_rate=100.0, truth_rate=50.0)
        config = SimulationConfig(
            seed=seed, anchors=true, anchor_delay_std=0.03, yaw="rotating", **rates
        )
        write_tables(late.inject(simulate(config)), tmp_path / day)


@pytest.mark.slow
def test_the_recording_becomes_a_bag_of_the_same_numbers(desk):
    convert, *_ = blocks(WALK)
    run(convert)
    bag = import_module("uwb_tdoa_tools.readers").read_flight("monday.bag")
    assert len(bag.anchors) == 8 and len(bag.imu) == 4000 and len(bag.truth) == 2000
    assert np.median(np.linalg.norm(bag.imu.accel, axis=1)) == pytest.approx(9.81, abs=0.2)
    p = np.array([np.interp(bag.tdoa.t, bag.truth.t, column) for column in bag.truth.p.T]).T
    rows = bag.anchors.index(bag.tdoa.a), bag.anchors.index(bag.tdoa.b)
    to_a, to_b = (np.linalg.norm(p - bag.anchors.positions[k], axis=1) for k in rows)
    assert np.median(np.abs(bag.tdoa.d - (to_b - to_a))) < 0.2


@pytest.mark.slow
def test_the_way_to_a_diagnosed_flight(desk, tmp_path, capsys):
    convert, judge, _ = blocks(WALK)
    run(convert)
    capsys.readouterr()
    run(judge)
    out = capsys.readouterr().out
    assert "monday: OK" in out and "anchor_delay: 3 = 0.3" in out
    effects = yaml.safe_load((tmp_path / "diagnosis" / "effects.yaml").read_text())["effects"]
    assert effects["anchor_delay"]["values"]["3"] == pytest.approx(LATE, abs=0.1)
    uncorrected, corrected = errors(out)
    assert corrected < uncorrected


def errors(out):
    """Return the 3D errors, m, in the lines of `evaluate`, in their order."""
    return [
        float(line.split()[4])
        for line in out.splitlines()
        if re.match(r"(mon|tues)day_ranging ", line)
    ]


def test_the_page_names_every_column_and_unit():
    columns = import_module("uwb_tdoa_tools.readers.profile")
    for name, units in columns.UNITS.items():
        stem, _, axis = name.rpartition("_")
        assert (
            f"`{name}`" in WALK
            or (axis in "yz" and f"`{stem}_x`" in WALK)
            or name.startswith("pose_q")
        ), name
        assert all(unit in WALK for unit in units), name
