# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The data that a new user has in the first hour.

The user has a recording in CSV files of another tool. Anchor positions are measured by tape with a
standard deviation of 10 cm. The ground truth is in a separate file. It is late, of another epoch,
or in another frame.

The tests evaluate each step on a hold-out flight, with the true ground truth. The error must fall,
or the step must have reported that its result is not to be used.
"""

from dataclasses import dataclass, replace
from pathlib import Path
import re

import numpy as np
from scipy.spatial.transform import Rotation
from walking import blocks, section, write_tables

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import command_lines
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.readers.inputs import Reading
from uwb_tdoa_tools.scoring.alignment import transform_truth
from uwb_tdoa_tools.scoring.evaluation import score_of
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

TAPE = 0.1  # m, standard deviation of each coordinate measured by tape
CLEAN = dict(trajectory="sines", imu_rate=100.0, truth_rate=50.0, bias=False)
# s, length of each flight. The steps need 30 s in the air.
SIMULATED, MEASURED = 40.0, 45.0
LATE, EPOCH = 0.4, 1.7e9  # s
TURNED = Rotation.from_euler("z", 8.0, degrees=True).as_matrix()
TRUTHS = {  # errors of a ground truth: functions of a Truth
    "in time": lambda truth: truth,
    "late": lambda truth: replace(truth, t=truth.t + LATE),
    "in another frame": lambda truth: transform_truth(truth, TURNED, np.array([0.5, -0.3, 0.0])),
    "z down, on another epoch": lambda truth: transform_truth(
        replace(truth, t=truth.t + EPOCH), np.diag([1.0, 1.0, -1.0]), np.zeros(3)
    ),
}
CALIBRATION = {"anchors": "anchors.yaml", "effects": "effects.yaml", "config": "ekf_node.yaml"}


@dataclass
class Hall:
    """Two Flights of an installation with true anchor positions, and a hold-out flight.

    tape : Anchors as measured by the user
    """

    flights: list
    judge: Flight
    tape: object

    def error(self, folder=None, anchors=None, **files):
        """Return the 3D RMSE of the hold-out flight, m.

        It uses the files of a calibration that exist in the folder.

        files : {"effects": name, ...}, instead of CALIBRATION
        """
        there = (
            {name: Path(folder) / file for name, file in (files or CALIBRATION).items()}
            if folder
            else {}
        )
        there = {name: file for name, file in there.items() if file.exists()}
        survey = read_survey(there["anchors"]) if "anchors" in there else anchors or self.tape
        effects = EffectSet.from_yaml(there["effects"]) if "effects" in there else None
        config = FilterConfig.from_yaml(there["config"]) if "config" in there else None
        return score_of(replace(self.judge, anchors=survey), FlightEstimator(config, effects))[
            0
        ].row()["rmse_3d"]


def off(positions, seed, exact=()):
    """Return positions with tape errors, (N, 3) m. exact : rows with ten times smaller errors."""
    noise = TAPE * np.random.default_rng(seed).standard_normal(positions.shape)
    noise[list(exact)] *= 0.1
    return positions + noise


def simulated(tape, exact=()):
    """Return a Hall with displaced and late anchors. tape : Anchors as measured by the user."""
    true = tape.at(off(tape.positions, 1, exact))
    rng = np.random.default_rng(2)
    late = AnchorDelay(
        {str(i): float(delay) for i, delay in zip(true.ids, 0.05 * rng.standard_normal(len(true)))}
    )
    flown = [
        late.inject(
            simulate(SimulationConfig(seed=seed, anchors=true, duration=SIMULATED, **CLEAN))
        )
        for seed in (11, 12, 13)
    ]
    return Hall(flown[:2], flown[2], tape)


def measured(folder):
    """Return the Hall of const1 in a folder of measured flights.

    The flights except the hold-out flight are cut to their first seconds.
    """
    flown = [
        Reading(folder / "surveys").one(folder / "util" / f"const1-trial{k}.csv.gz")
        for k in ("1-tdoa2", "2-tdoa2", "3-tdoa2")
    ]
    anchors = flown[0].anchors
    short = [between(flight, flight.tdoa.t[0], flight.tdoa.t[0] + MEASURED) for flight in flown[:2]]
    return Hall(short, flown[2], anchors.at(off(anchors.positions, 100, (0, 6))))


def at_desk(folder, monkeypatch):
    """Work in a folder, with the settings of ./dev run."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv(command_lines.RUN, "./dev run")
    return folder


WALK = section("csv.md", "From a CSV file and a tape measure to a diagnosed flight")


def recorded(hall, truth, name="in time"):
    """Write the recordings of a Hall as another tool, and return the commands to convert them.

    The commands come from the page. As it explains, missing sensors are left out.
    """
    for day, flight in zip(("monday", "tuesday"), hall.flights):
        write_tables(replace(flight, truth=TRUTHS[name](flight.truth) if truth else None), day)
    hall.tape.to_yaml("anchors.yaml")
    script, *_ = blocks(WALK)
    lacking = [("mocap", "pose_")] * (not truth) + [("imu", "(?:gyro|accel)_")] * (
        hall.judge.imu is None
    )
    for table, columns in lacking:
        script = re.sub(rf" \$\{{day\}}_{table}\.csv", "", script)
        script = re.sub(rf"^COLUMNS=\$COLUMNS,{columns}.*\n", "", script, flags=re.MULTILINE)
    return script


def said_on_the_way(capsys, step, before, after):
    """Print the errors before and after a step, for the documentation."""
    with capsys.disabled():
        print(f"{step}: {before:.3f} -> {after:.3f} m on a flight that took no part")


def written(path, text):
    """Write a text to a file and return its path."""
    Path(path).write_text(text)
    return path
