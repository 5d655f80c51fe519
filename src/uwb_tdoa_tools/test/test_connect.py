"""docs/connect.md as a new user follows it: the files it speaks of, and its commands in their order."""

from importlib import import_module
import re
import subprocess

from documented import ROOT
import numpy as np
import pytest
import yaml

from uwb_tdoa_tools.readers import read_survey
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.constellations import facing

PAGE = (ROOT / "docs" / "connect.md").read_text()
LATE = 0.3  # m, anchor 3


def section(heading):
    return PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]


def blocks(text, language=""):
    """Contents of the fenced blocks of a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [content for name, content in found if name == language]


def run(script, *but):
    """Run the commands of a block as the shell would split it, in this process; not those of the names in `but`."""
    stub = "run() { shift; printf '%s\\0' \"$@\"; echo; }; "
    told = subprocess.run(
        ["bash", "-ec", stub + script.replace("./dev run", "run")], capture_output=True, text=True, check=True
    )
    for line in told.stdout.splitlines():
        name, *words = line.split("\0")[:-1]
        if name not in but:
            assert import_module(f"uwb_tdoa_tools.commands.{name}").main(words) == 0, (name, words)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder with the anchors.yaml of the page, and recordings as another tool writes them."""
    monkeypatch.chdir(tmp_path)
    walk = section("From a CSV file and a tape measure to a diagnosed flight")
    (tmp_path / "anchors.yaml").write_text(*blocks(walk, "yaml"))
    taped = read_survey("anchors.yaml")
    rng = np.random.default_rng(1)
    positions = taped.positions + 0.02 * rng.normal(size=(8, 3))
    true = facing(positions, (3.5, 4.0, 1.5), inverted=positions[:, 2] > 1.5)
    for seed, day in enumerate(("monday", "tuesday")):
        rates = dict(duration=40.0, imu_rate=200.0, truth_rate=50.0)
        config = SimulationConfig(seed=seed, anchors=true, anchor_delay_std=0.03, yaw="rotating", **rates)
        write_tables(simulate(config), tmp_path / day)
    return walk


def write_tables(flight, stem):
    """In milliseconds, millimetres, degrees/s and g, with the ids the other way round, and anchor 3 late."""
    tdoa, imu, truth = flight.tdoa, flight.imu, flight.truth
    late = LATE * (tdoa.b == 3) - LATE * (tdoa.a == 3)
    tables = {
        "ranging": ("t_ms,to,from,diff_mm", [1e3 * tdoa.t, tdoa.b, tdoa.a, 1e3 * (tdoa.d + late)]),
        "imu": ("t_ms,gx,gy,gz,ax,ay,az", [1e3 * imu.t, np.rad2deg(imu.gyro), imu.accel / 9.81]),
        "mocap": ("t_ms,x,y,z", [1e3 * truth.t, 1e3 * truth.p]),
    }
    for name, (header, columns) in tables.items():
        rows = np.column_stack(columns)
        np.savetxt(f"{stem}_{name}.csv", rows, fmt="%.9g", delimiter=",", header=header, comments="")


def test_the_recording_becomes_a_bag_of_the_same_numbers(desk):
    convert, *_ = blocks(desk)
    run(convert)
    bag = import_module("uwb_tdoa_tools.readers").read_flight("monday.bag")
    assert len(bag.anchors) == 8 and len(bag.imu) == 8000 and len(bag.truth) == 2000
    assert np.median(np.linalg.norm(bag.imu.accel, axis=1)) == pytest.approx(9.81, abs=0.2)
    p = np.array([np.interp(bag.tdoa.t, bag.truth.t, column) for column in bag.truth.p.T]).T
    rows = bag.anchors.index(bag.tdoa.a), bag.anchors.index(bag.tdoa.b)
    to_a, to_b = (np.linalg.norm(p - bag.anchors.positions[k], axis=1) for k in rows)
    assert np.median(np.abs(bag.tdoa.d - (to_b - to_a))) < 0.2


@pytest.mark.slow
def test_the_way_to_a_diagnosed_flight(desk, tmp_path, capsys):
    convert, judge, without_truth = blocks(desk)
    run(convert)
    capsys.readouterr()
    run(judge)
    out = capsys.readouterr().out
    assert "monday: OK" in out and "antenna delay of anchor 3" in out
    effects = yaml.safe_load((tmp_path / "diagnosis" / "effects.yaml").read_text())["effects"]
    assert effects["anchor_delay"]["values"]["3"] == pytest.approx(LATE, abs=0.1)
    uncorrected, corrected = errors(out)
    assert corrected < uncorrected
    run(without_truth)


def errors(out):
    """3D errors, m, in the lines of `evaluate`, in their order."""
    return [float(line.split()[4]) for line in out.splitlines() if re.match(r"(mon|tues)day_ranging ", line)]


def test_the_page_names_every_column_and_unit():
    columns = import_module("uwb_tdoa_tools.readers.columns")
    walk = section("From a CSV file and a tape measure to a diagnosed flight")
    for name, units in columns.UNITS.items():
        stem, _, axis = name.rpartition("_")
        assert f"`{name}`" in walk or (axis in "yz" and f"`{stem}_x`" in walk) or name.startswith("pose_q"), name
        assert all(unit in walk for unit in units), name
