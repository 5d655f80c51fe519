"""The first hour of a new user, by the commands of the documentation word for word, and what came of it.

A recording in CSV files of another tool, a survey by tape that is good to 10 cm, ground truth in a file of its own: late, on another epoch,
in another frame. After each step that claims to help, a flight that took no part is judged by what the user has in hand then, with the
true ground truth: the error is smaller, or the step has said that nothing is to be used.
"""

from dataclasses import dataclass, replace
from pathlib import Path
import re
import shlex

import numpy as np
import pytest
from recordings import log_bytes
from scipy.spatial.transform import Rotation
from walking import blocks, commands, main, run, section, write_tables

from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_bias.foundation.survey import read_survey
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import command_lines
from uwb_tdoa_tools.localizing.estimate import Estimator
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.alignment import moved_frame
from uwb_tdoa_tools.scoring.evaluation import score_of
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

TAPE = 0.1  # m, standard deviation of each coordinate
CLEAN = dict(trajectory="sines", duration=60.0, imu_rate=200.0, truth_rate=50.0, bias=False)
LATE, EPOCH = 0.4, 1.7e9  # s
TURNED = Rotation.from_euler("z", 8.0, degrees=True).as_matrix()
TRUTHS = {  # what may be wrong with a ground truth: function of a Truth
    "in time": lambda truth: truth,
    "late": lambda truth: replace(truth, t=truth.t + LATE),
    "in another frame": lambda truth: moved_frame(truth, TURNED, np.array([0.5, -0.3, 0.0])),
    "on another epoch": lambda truth: replace(truth, t=truth.t + EPOCH),
    "z down, on another epoch": lambda truth: moved_frame(replace(truth, t=truth.t + EPOCH), np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
}
CALIBRATION = {"anchors": "anchors.yaml", "effects": "effects.yaml", "config": "ekf_node.yaml"}


@dataclass
class Hall:
    """Two Flights of an installation whose anchors are as they are, and another one that judges; tape : Anchors as somebody measured them."""

    flights: list
    judge: Flight
    tape: object

    def error(self, folder=None, anchors=None, **files):
        """m, 3D RMSE of the flight that judges, with the files of a calibration that are there in a folder. files : {"effects": name, ...}, in
        place of CALIBRATION."""
        there = {name: Path(folder) / file for name, file in (files or CALIBRATION).items()} if folder else {}
        there = {name: file for name, file in there.items() if file.exists()}
        survey = read_survey(there["anchors"]) if "anchors" in there else anchors or self.tape
        effects = EffectSet.from_yaml(there["effects"]) if "effects" in there else None
        config = FilterConfig.from_yaml(there["config"]) if "config" in there else None
        return score_of(replace(self.judge, anchors=survey), Estimator(config, effects))[0].row()["rmse_3d"]


def off(positions, seed, exact=()):
    """(N, 3) m, positions as a tape says them. exact : rows that are measured well."""
    noise = TAPE * np.random.default_rng(seed).standard_normal(positions.shape)
    noise[list(exact)] *= 0.1
    return positions + noise


def simulated(tape, exact=()):
    """The Hall of a tape: anchors that stand elsewhere, and are late."""
    true = tape.at(off(tape.positions, 1, exact))
    rng = np.random.default_rng(2)
    late = AnchorDelay({str(i): float(delay) for i, delay in zip(true.ids, 0.05 * rng.standard_normal(len(true)))})
    flown = [late.inject(simulate(SimulationConfig(seed=seed, anchors=true, **CLEAN))) for seed in (11, 12, 13)]
    return Hall(flown[:2], flown[2], tape)


@pytest.fixture
def measured(shared_data):
    """The Hall of const1."""
    folder = shared_data / "util"
    flown = [Reading(shared_data / "surveys").one(folder / f"const1-trial{k}.csv.gz") for k in ("1-tdoa2", "2-tdoa2", "3-tdoa2")]
    anchors = flown[0].anchors
    return Hall(flown[:2], flown[2], anchors.at(off(anchors.positions, 100, (0, 6))))


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A folder to work in, for somebody who starts things with ./dev run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(command_lines.RUN, "./dev run")
    return tmp_path


WALK = section("connect.md", "From a CSV file and a tape measure to a diagnosed flight")


def recorded(hall, truth, name="in time"):
    """The commands of the page that convert a Hall's recordings, once these are there as another tool writes them; without what is not
    there, as the page says."""
    for day, flight in zip(("monday", "tuesday"), hall.flights):
        write_tables(replace(flight, truth=TRUTHS[name](flight.truth) if truth else None), day)
    hall.tape.to_yaml("anchors.yaml")
    script, *_ = blocks(WALK)
    lacking = [("mocap", "pose_")] * (not truth) + [("imu", "(?:gyro|accel)_")] * (hall.judge.imu is None)
    for table, columns in lacking:
        script = re.sub(rf" \$\{{day\}}_{table}\.csv", "", script)
        script = re.sub(rf"^COLUMNS=\$COLUMNS,{columns}.*\n", "", script, flags=re.MULTILINE)
    return script


def said_on_the_way(capsys, step, before, after):
    """Tell what a step has brought, for the documentation."""
    with capsys.disabled():
        print(f"{step}: {before:.3f} -> {after:.3f} m on a flight that took no part")


# --- with ground truth ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "name"),
    [*(("simulated", name) for name in TRUTHS), ("measured", "late"), ("measured", "in another frame"), ("measured", "z down, on another epoch")],
)
def test_from_csv_and_tape_to_a_diagnosed_flight(desk, capsys, request, source, name):
    """convert, check, evaluate, diagnose, evaluate: docs/connect.md."""
    if source == "simulated":
        hall = simulated(read_survey(_written("anchors.yaml", *blocks(WALK, "yaml"))))
    else:
        hall = request.getfixturevalue("measured")
    script = recorded(hall, True, name)
    if "epoch" in name:  # convert refuses it, and says what to add
        assert [main(*command) for command in commands(script)] == [2, 2]
        assert capsys.readouterr().err.count("on another clock than the TDOAs") == 2
        script = script.replace("--out", "--align time --out")
    run(script)
    capsys.readouterr()
    judging = blocks(WALK)[1]
    before = hall.error()
    run(judging)
    printed = capsys.readouterr()
    after = hall.error("diagnosis")
    said_on_the_way(capsys, f"{source}, truth {name}", before, after)
    effects = EffectSet.from_yaml("diagnosis/effects.yaml")
    assert not any(effect.name.endswith("time_offset") for effect in effects.effects)
    if len(effects):
        assert after < before
    else:
        assert "nothing" in printed.out
    assert after <= before
    said = printed.out + printed.err
    if name == "late":
        assert "late" in said or "apart" in said
    if "frame" in name or "z down" in name:
        assert "in another frame" in said or "the frame of the truth is turned" in said


def _written(path, text):
    Path(path).write_text(text)
    return path


# --- without ground truth ---


def ended(name, words):
    """Exit code of a step that may say that nothing is to be used: 0 or 1."""
    code = main(name, words)
    assert code in (0, 1), (name, words)
    return code


@pytest.mark.slow
@pytest.mark.parametrize("source", ["simulated", "measured"])
def test_from_tape_to_calibrated_without_ground_truth(desk, capsys, request, source):
    """docs/calibration.md, in one command and step by step, and docs/localizing.md."""
    survey = read_survey(_written("anchors.yaml", *blocks(WALK, "yaml")))
    hall = simulated(survey, (0, 6)) if source == "simulated" else request.getfixturevalue("measured")
    run(recorded(hall, False))
    for day, name in (("monday", "first"), ("tuesday", "second")):
        Path(f"{day}.bag").rename(f"{name}.bag")
    Path("flight.bag").symlink_to("first.bag")
    before = hall.error()
    (quick, whole), *_ = [commands(text) for text in blocks(section("calibration.md", "In one command"))]
    assert main(*quick) == 0
    capsys.readouterr()
    code = ended(*whole)
    printed = capsys.readouterr()
    after = hall.error("calibrated")
    said_on_the_way(capsys, f"{source}, calibrate", before, after)
    if code:
        assert "nothing to use is written" in printed.err and after == before
    else:
        assert after < before
        _lines_run(printed.out)
    (checked,), (surveyed,) = (commands(blocks(section("calibration.md", heading))[0]) for heading in ("2. Fly, and check", "3. Survey"))
    assert main(*checked) in (0, 1)
    capsys.readouterr()
    code = ended(*surveyed)
    printed = capsys.readouterr()
    after = hall.error("surveyed")
    said_on_the_way(capsys, f"{source}, survey", before, after)
    assert "nothing is applied" in printed.out if code else after < before
    (located, *_) = commands(blocks(section("localizing.md", "Where the tag was"))[0])
    assert main(*located) in (0, 1) and Path("localized/flight.tum").exists()


def _lines_run(text):
    """Lines that a tool has printed to be copied run as they stand; those of nodes have files that can be read."""
    lines = re.findall(r"\./dev run uwb_tdoa_\w+ .*$", text, re.MULTILINE)
    assert len(lines) == 3
    for line in lines:
        _, _, _, name, *words = shlex.split(line)
        if name.endswith("_node"):
            files = [word.partition(":=")[2] or word for word in words if ".yaml" in word]
            assert files and all(Path(file).is_file() for file in files)
        else:
            assert main(name, words) in (0, 1), line


# --- README, from a log ---


def write_log(flight, path):
    """Write a Flight as a micro-SD log: deg/s and g."""
    rows = [("estTDOA", t, (int(a), int(b), d)) for t, a, b, d in zip(flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)]
    for name, values in (("estGyroscope", np.rad2deg(flight.imu.gyro)), ("estAcceleration", flight.imu.accel / 9.81)):
        rows += [(name, t, tuple(value)) for t, value in zip(flight.imu.t, values)]
    rows += [("estPose", t, (*p, *q)) for t, p, q in zip(flight.truth.t, flight.truth.p, flight.truth.q)]
    rows.sort(key=lambda row: row[1])
    Path(path).write_bytes(log_bytes([(name, round(1e6 * t), values) for name, t, values in rows]))


@pytest.mark.slow
def test_the_four_steps_of_the_readme(desk, capsys):
    """check, calibrate, diagnose, survey, localize: README.md, from a log and a survey."""
    hall = simulated(read_survey(_written("anchors.yaml", *blocks(WALK, "yaml"))))
    write_log(hall.flights[0], "FLIGHT.log")
    rows = [f"{i},{x:.3f},{y:.3f},{z:.3f}" for i, (x, y, z) in zip(hall.tape.ids, hall.tape.positions)]
    _written("SURVEY.txt", "\n".join(["id,x,y,z", *rows, ""]))
    steps = [command for text in blocks(section("README.md", "Four steps")) for command in commands(text)]
    steps = [(name, words) for name, words in steps if words and "--live" not in words and not name.endswith("_node")]
    assert [name for name, _ in steps] == ["check", "calibrate", "calibrate", "diagnose", "survey", "localize"]
    before = hall.error()
    for name, words in steps:
        code = ended(name, words)
        printed = capsys.readouterr()
        if "--out" not in words or name == "localize":
            continue
        after = hall.error(words[words.index("--out") + 1])
        said_on_the_way(capsys, f"README, {name}", before, after)
        assert after < before if code == 0 else "nothing" in printed.out + printed.err and after == before
    assert Path("localized/FLIGHT.tum").exists()
