# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the off-line filter over recordings, and write all of its numbers.

`study arm64` runs this file on two kinds of processors:

    python arm64_estimates.py CASES.json ESTIMATES.npz

CASES.json holds {case: {"recording", "survey", "effects", "model"}}, paths or null.
"""

import json
import os
import sys

import numpy as np

from uwb_tdoa_bias.common.files import temporary_folder, write_filled
from uwb_tdoa_bias.correction import trial
from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.readers.inputs import Reading

PATIENCE = 3600  # s, limit of the trial of a model and of each of its rows, which are emulated


def estimates(recording, survey, effects, model):
    """Return {name: array} of all outputs of the filter for a recording."""
    flight = Reading(survey).one(recording)
    held = EffectSet.from_yaml(effects) if effects else None
    run = FlightEstimator(effects=held, network=load_network(model))(flight)
    out = {f"odometry {name}": values for name, values in vars(run.odometry).items()}
    out |= {f"TDOA {name}": values for name, values in vars(run.residuals).items()}
    out |= {"TDOA bias": run.bias, "TDOA bias_std": run.bias_std}
    for sensor, rows in run.sensors.items():
        out |= {f"{sensor} {name}": rows[name] for name in rows.dtype.names}
    counts = [*run.counts.values(), run.recoveries]
    return out | {"counts": np.array(counts), "yaw_offset": np.array(run.yaw_offset)}


def tried_out(content):
    """Stand in for the trial of a model: an emulated process cannot start a Python of its kind.

    A copy of this process is tried instead, with the same limits but time.
    """
    reading, writing = os.pipe()
    with temporary_folder() as folder:
        child = os.fork()
        if not child:
            os.chdir(folder)  # onnxruntime writes its profile to the present folder
            trial.MODEL_SECONDS = trial.MODEL_ROW_SECONDS = PATIENCE
            os.write(writing, json.dumps(trial.judge(content)).encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as file:
            alone, why = json.load(file)
        os.waitpid(child, 0)
    if why:
        raise trial.Unplayable(why)
    return alone


def main(cases, path):
    """Write the estimates of all cases; the names of arrays begin with the case."""
    with open(cases, encoding="utf-8") as file:
        known = json.load(file)
    out = {}
    for case, given in known.items():
        print(f"arm64: {case}", file=sys.stderr, flush=True)
        out |= {f"{case}: {name}": values for name, values in estimates(**given).items()}
        write_filled(path, lambda file: np.savez(file, **out))


if __name__ == "__main__":
    trial.tried_out = tried_out
    main(*sys.argv[1:])
