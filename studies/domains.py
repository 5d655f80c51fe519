# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""domains: test an effect beyond the data that it was fitted to.

The effect is a clock's drift, fitted to the first seconds of one flight. It corrects the other
flights, without the limits of its domain and with them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from studies.monitor import flights_of
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.scoring.metrics import Score

# s
FITTED = {
    "const1": ("const1-trial1-tdoa2", 40.0),
    "const3": ("const3-trial1-tdoa2", 60.0),
    "const4": ("const4-trial1-tdoa2-traj1", 40.0),
}
BLOCKED = "const4-trial3", "const4-trial5"  # their anchors change in flight


def beginning(flight, seconds):
    """The Flight up to some seconds after its first TDOA."""
    end = flight.tdoa.t[0] + seconds

    def part(stream):
        return type(stream)(*(column[stream.t < end] for column in vars(stream).values()))

    return replace(flight, tdoa=part(flight.tdoa), truth=part(flight.truth))


def figures(flight, effects):
    """(3D RMSE in the air, m, mean NEES) of the filter with an EffectSet."""
    done = run_offline(flight, None, Corrector(flight.anchors, effects))
    row = Score(flight.name, done.odometry, flight.truth, done.residuals).row()
    return row["rmse_3d"], row["nees_mean"]


def add_options(add):
    """The options of the study."""
    add("data", metavar="DATA", type=Path, help="folder of measured flights")


def run(args):
    """Print the table."""
    reference = GroundTruth()
    print(
        "| flight | fitted to | no correction: error, m, NEES | without domain | with domain "
        "|\n|---|---|---|---|---|"
    )
    for constellation, (name, seconds) in FITTED.items():
        flights = {flight.name: flight for flight in flights_of(args.data, [constellation])}
        fitted = reference.prepare(beginning(flights.pop(name), seconds))
        found = attribute(
            [fitted], reference, undeclared=False, kinds=["anchor_clock_drift"]
        ).effects
        models = (), tuple(replace(effect, domain={}) for effect in found), found
        means = []
        for flight in flights.values():
            if not flight.name.startswith(BLOCKED):
                row = [figures(flight, EffectSet(effects)) for effects in models]
                means.append([error for error, _ in row])
                cells = " | ".join(f"{error:.3f}, {nees:.1f}" for error, nees in row)
                print(f"| {flight.name} | {seconds:g} s of {name} | {cells} |", flush=True)
        print(
            f"| mean of {len(means)} | | "
            + " | ".join(f"{mean:.3f}" for mean in np.mean(means, axis=0))
            + " |",
            flush=True,
        )
