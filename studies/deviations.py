# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""deviations: compare the errors of anchor positions with the standard deviations of `diagnose`.

No parameter was tuned on these recordings.
"""

from pathlib import Path

from known_effects import ANCHORS_FOUND, clean_flight, normalised, root

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
# m, that each coordinate is put off by; seed of the first recording of a set; s
OFF, FIRST, SECONDS = ((0.05, 0.1, 0.2), 700, 60.0)

METRES, OVER_DEVIATION = 0, 1  # places of errors in a result of `normalised`


def add_options(add):
    """The options of the study."""
    add("data", metavar="DATA", type=Path, help="folder of measured flights")


def run(args):
    """Print the table."""
    print(
        "| recordings | off by, m | coordinates: fit alone | as stated | each | delays: fit alone "
        "| as stated | coordinates of the search, m | applied, m | applied over stated |"
        "\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
    )
    positions, delays = ANCHORS_FOUND
    for name, recordings in SETS.items():
        flights = [
            clean_flight(one, SECONDS)
            if name == "simulated"
            else Reading(args.data / "surveys").one(args.data / one)
            for one in recordings
        ]
        for std in OFF:
            told = [normalised(flight, std, FIRST + k) for k, flight in enumerate(flights)]
            each = [
                f"{root([ratio]):.2f}"
                for ratio in (one[positions]["stated"][1] for one in told)
                if len(ratio)
            ]
            figures = [
                f"{_rms(told, positions, 'alone'):.2f}",
                f"{_rms(told, positions, 'stated'):.2f}",
                " - ".join(sorted({min(each), max(each)})),
                f"{_rms(told, delays, 'alone'):.2f}",
                f"{_rms(told, delays, 'stated'):.2f}",
                f"{_rms(told, positions, 'stated', METRES):.3f}",
                f"{_rms(told, positions, 'applied', METRES):.3f}",
                f"{_rms(told, positions, 'applied'):.2f}",
            ]
            print(f"| {name} | {std} | " + " | ".join(figures) + " |", flush=True)


def _rms(several, effect, fit, unit=OVER_DEVIATION):
    """Root mean square of the errors of an effect in a fit, over all results of `normalised`."""
    return root([one[effect][fit][unit] for one in several])
