# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The walks of a new user: commands of the pages in their order, as they are printed.

Anchor positions are measured by tape with a standard deviation of 10 cm. Each step is judged on a
hold-out flight with its true path. The error must fall, or the step must have reported that its
result is not to be used.
"""

from dataclasses import dataclass, replace
from pathlib import Path
import re
import shlex
import shutil

from documented import blocks, main, run, section, tools
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import command_lines
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.evaluation import score_of, transform_truth
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.slow

TAPE = 0.1  # m, standard deviation of each coordinate measured by tape
TURNED = Rotation.from_euler("z", 8.0, degrees=True).as_matrix()
HEADS = {
    "ranging": "t_ms,to,from,diff_mm",
    "imu": "t_ms,gx,gy,gz,ax,ay,az",
    "mocap": "t_ms,x,y,z",
}
WALK = section("csv.md", "From a CSV file and a tape measure to a diagnosed flight")


@dataclass
class Hall:
    """Flights of an installation with true anchor positions, a hold-out flight, and a tape."""

    flights: list
    judge: Flight
    tape: object

    def error(self, folder=None):
        """Return the 3D RMSE of the hold-out flight, m, with the files of a calibration if any."""
        anchors, effects, config = self.tape, None, None
        if folder and Path(folder, "anchors.yaml").exists():
            anchors = read_survey(Path(folder, "anchors.yaml"))
        if folder and Path(folder, "effects.yaml").exists():
            effects = EffectSet.from_yaml(Path(folder, "effects.yaml"))
        if folder and Path(folder, "ekf_node.yaml").exists():
            config = FilterConfig.from_yaml(Path(folder, "ekf_node.yaml"))
        estimator = FlightEstimator(config, effects)
        return score_of(replace(self.judge, anchors=anchors), estimator)[0].row()["rmse_3d"]


def taped(anchors, seed, exact=()):
    """Return Anchors with tape errors. exact : rows with ten times smaller errors."""
    noise = TAPE * np.random.default_rng(seed).standard_normal(anchors.positions.shape)
    noise[list(exact)] *= 0.1
    return anchors.at(anchors.positions + noise)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Work in a folder with the anchors.yaml of the page, with the settings of ./dev run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(command_lines.RUN, "./dev run")
    Path("anchors.yaml").write_text(*blocks(WALK, "yaml"))


@pytest.fixture
def simulated(desk, request):
    """Return a Hall with displaced and late anchors. A test may give the rate of TDOAs, Hz."""
    tape = read_survey("anchors.yaml")
    true = taped(tape, 1)
    delays = 0.05 * np.random.default_rng(2).standard_normal(len(true))
    late = AnchorDelay({str(i): float(delay) for i, delay in zip(true.ids, delays)})
    settings = dict(duration=40.0, imu_rate=100.0, truth_rate=50.0, bias=False)  # quadrotor, sines
    settings["tdoa_rate"] = getattr(request, "param", None)
    flown = [
        late.inject(simulate(SimulationConfig(seed=seed, anchors=true, **settings)))
        for seed in (11, 12, 13)
    ]
    return Hall(flown[:2], flown[2], tape)


@pytest.fixture
def measured(desk, shared_data):
    """Return the Hall of const1. The flights except the hold-out flight are cut to 45 s."""
    files = [shared_data / "util" / f"const1-trial{k}-tdoa2.csv.gz" for k in (1, 2, 3)]
    flown = [Reading(shared_data / "surveys").one(file) for file in files]
    short = [between(flight, flight.tdoa.t[0], flight.tdoa.t[0] + 45.0) for flight in flown[:2]]
    hall = Hall(short, flown[2], taped(flown[0].anchors, 100, (0, 6)))
    hall.tape.to_yaml("anchors.yaml")
    return hall


def write_tables(hall, change):
    """Write two days as CSV files of another tool: ms, mm, deg/s, g, and ids in opposite order.

    change : function of the true path of a flight, {t, p}
    """
    for day, flight in zip(("monday", "tuesday"), hall.flights):
        tdoa, imu, truth = flight.tdoa, flight.imu, change(flight.truth)
        tables = {"ranging": [1e3 * tdoa.t, tdoa.b, tdoa.a, 1e3 * tdoa.d]}
        tables["mocap"] = [1e3 * truth.t, 1e3 * truth.p]
        if imu is not None:
            tables["imu"] = [1e3 * imu.t, np.rad2deg(imu.gyro), imu.accel / 9.81]
        for name, columns in tables.items():
            table = np.column_stack(columns)
            head = HEADS[name]
            np.savetxt(f"{day}_{name}.csv", table, "%.12g", ",", header=head, comments="")


def assert_better(hall, folder, said, code=0):
    """Compare the errors of the hold-out flight. Run the printed lines; files of nodes exist."""
    before, after = hall.error(), hall.error(folder)
    print(f"{folder}: {before:.3f} -> {after:.3f} m on a flight that took no part")
    assert after < before or (code == 1 and "nothing" in said and after == before)
    for line in re.findall(r"^ *(\./dev run uwb_tdoa_\w+ .*)$", said, re.MULTILINE):
        _, _, _, name, *words = shlex.split(line)
        if name.endswith("_node"):
            files = [word.partition(":=")[2] or word for word in words if ".yaml" in word]
            assert files and all(Path(file).is_file() for file in files), line
        else:
            assert main(name, words) in (0, 1), line


@pytest.mark.parametrize("simulated", [200.0], indirect=True)
def test_from_csv_to_a_diagnosed_flight(simulated, capsys):
    """The ground truth is in another frame."""
    convert, judge, *_ = blocks(WALK)
    write_tables(simulated, lambda truth: transform_truth(truth, TURNED, np.array([0.5, -0.3, 0])))
    run(convert)
    bag = Reading(None).one("monday_bag")
    assert len(bag.anchors) == 8 and len(bag.truth) == len(simulated.flights[0].truth)
    np.testing.assert_allclose(bag.imu.gyro, simulated.flights[0].imu.gyro, atol=1e-6)
    np.testing.assert_allclose(bag.tdoa.d, simulated.flights[0].tdoa.d, atol=1e-6)
    capsys.readouterr()
    run(judge)
    said = capsys.readouterr()
    assert "monday: OK" in said.out and "frame" in said.out + said.err
    assert_better(simulated, "diagnosis", said.out)


def test_measured_csv_whose_truth_is_upside_down_and_of_another_epoch(measured, capsys):
    """Convert refuses the recordings and prints the option to add. They have no inertial sensor."""
    convert, judge, *_ = blocks(WALK)
    convert = re.sub(r" \S*_imu\.csv|^.*gyro_x.*\n", "", convert, flags=re.MULTILINE)
    write_tables(
        measured,
        lambda truth: transform_truth(
            replace(truth, t=truth.t + 1.7e9), np.diag([1.0, 1.0, -1.0]), np.zeros(3)
        ),
    )
    run(convert, (2,))
    assert capsys.readouterr().err.count("on another clock than the TDOAs") == 2
    run(convert.replace("--out", "--align time --out"))
    run(judge, (0, 1))  # before its frame is corrected, evaluate finds that it has diverged
    said = capsys.readouterr()
    assert "the frame of the truth is turned" in said.out or "in another frame" in said.out
    assert_better(measured, "diagnosis", said.out)


def test_the_four_steps_of_the_guide(simulated, capsys):
    """check, calibrate, diagnose, survey, localize."""
    write_bag(simulated.flights[0], "FLIGHT.log")
    shutil.copy("anchors.yaml", "SURVEY.txt")
    ran = []
    for name, words in tools("".join(blocks(section("guide.md", "Four steps")))):
        if (
            name not in ("check", "calibrate", "diagnose", "survey", "localize")
            or "--live" in words
        ):
            continue
        capsys.readouterr()
        code = main(name, words)
        ran.append(name)
        said = capsys.readouterr()
        assert code in (0, 1), said.err
        if "--out" in words and name != "localize":
            assert_better(simulated, words[words.index("--out") + 1], said.out + said.err, code)
    assert ran == ["check", "calibrate", "calibrate", "diagnose", "survey", "localize"]
    assert Path("localized/FLIGHT.tum").exists()


def test_from_tape_to_calibrated_without_ground_truth(measured, capsys):
    """docs/calibration.md in one command."""
    for name, flight in zip(("first", "second"), measured.flights):
        write_bag(replace(flight, truth=None), f"{name}_bag")
    _, command = tools(blocks(section("calibration.md", "In one command"))[0])
    code = main(*command)
    said = capsys.readouterr()
    assert_better(measured, "calibrated", said.out + said.err, code)
