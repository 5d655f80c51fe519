"""Whether errors of anchors are as large as `diagnose` says, on recordings on which nothing was
chosen: a table of docs/diagnosis.md.

python src/uwb_tdoa_tools/test/deviations_table.py DATA
"""

import argparse
from dataclasses import replace
from pathlib import Path

from known_effects import clean_flight
import numpy as np

from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.readers.inputs import Reading

UTIL = "util/const{}-tdoa2.csv.gz"
SETS = {
    "const1": ["util/const1-trial1-tdoa3.csv.gz", UTIL.format("1-trial2"), UTIL.format("1-trial3")],
    "const3": [UTIL.format(f"3-trial{k}") for k in (2, 3, 4)],
    "const4": [
        f"util/const4-trial{k}.csv.gz"
        for k in ("1-tdoa2-traj2", "3-tdoa2-traj2", "3-tdoa2-traj3", "5-tdoa2-traj1")
    ],
    "0425": [
        f"flights/0425/{name}"
        for name in ("TDOA2/0425-traj10", "TDOA3/0425-traj17", "TDOA2/0425-traj3")
    ],
    "0426": [f"flights/0426/0426-traj{k}" for k in (7, 13, 2)],
    "simulated": [510, 511, 512, 513],
}
OFF, FIRST, SECONDS = (
    (0.05, 0.1, 0.2),
    700,
    60.0,
)  # m, that each coordinate is put off by; seed of the first recording of a set; s
KINDS = "anchor_position", "anchor_delay"


def normalised(flight, std, seed):
    """{effect: (errors over stated deviations (n,), over those of the fit alone (n,))} of what is
    found in a Flight whose anchors are put off by std, m. What the survey and the delays should be
    is what came with the flight, and zero.
    """
    off = std * np.random.default_rng(seed).standard_normal((len(flight.anchors), 3))
    shaken = replace(flight, anchors=flight.anchors.at(flight.anchors.positions + off))
    found = attribute([shaken], GroundTruth(), undeclared=False).selection
    true = {
        f"{i}.{axis}": -off[row, k]
        for row, i in enumerate(flight.anchors.ids)
        for k, axis in enumerate("xyz")
    }
    stated, alone = (
        found.fit,
        found.only(found.chosen).fit,
    )  # the second is fitted anew: without the deviations that hold
    out = {}
    for kind in KINDS:
        rows = [k for k, column in enumerate(stated.columns) if column.effect == (kind,)]
        error = stated.beta[rows] - np.array([true.get(stated.columns[k].key, 0.0) for k in rows])
        out[kind] = tuple(error / np.sqrt(np.diag(fit.cov))[rows] for fit in (stated, alone))
    return out


def root(several):
    """Root mean square of arrays together; NaN of none."""
    together = np.concatenate(several)
    return float(np.sqrt(np.mean(together**2))) if len(together) else np.nan


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("data", type=Path)
    data = arguments.parse_args().data
    print(
        (
            "| recordings | off by, m | coordinates: fit alone | as stated | each | delays: fit "
            "alone | as stated |\n|---|"
        )
        + 6 * "---:|"
    )
    for name, recordings in SETS.items():
        flights = [
            clean_flight(one, SECONDS)
            if name == "simulated"
            else Reading(data / "surveys").one(data / one)
            for one in recordings
        ]
        for std in OFF:
            told = [normalised(flight, std, FIRST + k) for k, flight in enumerate(flights)]
            stated, alone = (
                {kind: [one[kind][k] for one in told] for kind in KINDS} for k in range(2)
            )
            each = [f"{root([one]):.2f}" for one in stated[KINDS[0]] if len(one)]
            cells = [
                root(alone[KINDS[0]]),
                root(stated[KINDS[0]]),
                " - ".join(sorted({min(each), max(each)})),
                root(alone[KINDS[1]]),
                root(stated[KINDS[1]]),
            ]
            print(
                f"| {name} | {std} | "
                + " | ".join(cell if isinstance(cell, str) else f"{cell:.2f}" for cell in cells)
                + " |",
                flush=True,
            )


if __name__ == "__main__":
    main()
