# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""demo: the loop of `./dev demo` over many seeds, by the filter without ROS."""

from pathlib import Path
from tempfile import TemporaryDirectory
import time

from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_tools import cli, parallel
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.report.entries import entries
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.flying import loop
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.scoring.evaluation import score_of
from uwb_tdoa_tools.scoring.gains import gain
from uwb_tdoa_tools.simulation.inject import hidden_effect

HARM = -0.05  # smallest gain that is no harm


def looped(seed):
    """Row of a seed: true effect, effects found, errors of the third flight, m, and time, s."""
    began = time.monotonic()
    with TemporaryDirectory() as folder:
        bags = loop.record(seed, Path(folder))
        diagnosis = diagnose(loop.read(bags[:2]))
        onnx = Path(folder) / "bias.onnx"
        written = loop.write_correction(onnx, diagnosis)
        (third,) = loop.read(bags[2:])
        models = (None, load_network(onnx) if written else None)
        errors = [rmse(third, model) for model in models]
    found = [entry.title for entry in entries(diagnosis) if entry.added]
    held = [effect.label for effect in written.effects] if written else []
    return {
        "seed": seed,
        "really": hidden_effect(seed, third.anchors).label,
        "found": found,
        "added": list(dict.fromkeys(held)),
        "without": errors[0],
        "with": errors[1],
        "seconds": time.monotonic() - began,
    }


def rmse(flight, model):
    """3D RMSE of a Flight that a Model corrects, m."""
    return float(score_of(flight, FlightEstimator(network=model))[0].row()["rmse_3d"])


def add_options(add):
    """The options of the study."""
    add("--seeds", metavar="N", type=parallel.whole_number, default=20, help="1 to N (default 20)")
    add("--jobs", metavar="N", type=parallel.whole_number, help="seeds at once")
    add("--json", metavar="FILE", type=OutputFile, help="write the rows")


def run(args):
    """Print the table, and how many errors fall and rise."""
    rows = []
    print(
        "| seed | really | added | 3D RMSE without, cm | with, cm | change |\n|---:|---|---|---:|---:|---:|"
    )
    for row in parallel.over(looped, range(1, args.seeds + 1), args.jobs, unit="seed"):
        rows.append(row)
        cells = [
            row["seed"],
            row["really"],
            ", ".join(row["added"]) or "nothing",
            f"{100.0 * row['without']:.1f}",
            f"{100.0 * row['with']:.1f}",
            f"{-100.0 * gain(row['without'], row['with']):+.0f} %",
        ]
        cli.show(f"| {' | '.join(map(str, cells))} |")
    gains = [gain(row["without"], row["with"]) for row in rows]
    fell, harmed = sum(one > 0.0 for one in gains), sum(one < HARM for one in gains)
    cli.show(
        f"\nThe error falls in {fell} of {len(rows)} halls, and rises by more than "
        f"{-HARM:.0%} in {harmed}."
    )
    if args.json:
        cli.write_json(args.json, {"rows": rows})
