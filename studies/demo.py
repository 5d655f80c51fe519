# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""demo: the loop of `./dev demo` over many seeds, by the filter without ROS."""

from pathlib import Path
from tempfile import TemporaryDirectory
import time

from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.report.entries import entries
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.flying import demo
from uwb_tdoa_tools.scoring.evaluation import score_of
from uwb_tdoa_tools.scoring.metrics import gain
from uwb_tdoa_tools.simulation.inject import hidden_effect

from . import table

HARM = -0.05  # smallest gain that is no harm


def looped(seed):
    """Row of a seed: true effect, effects found, errors of the third flight, m, and time, s."""
    began = time.monotonic()
    with TemporaryDirectory() as folder:
        bags = demo.record(seed, Path(folder))
        diagnosis = diagnose(demo.read(bags[:2]))
        onnx = Path(folder) / "bias.onnx"
        written = demo.write_correction(onnx, diagnosis)
        (third,) = demo.read(bags[2:])
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
    table.add_options(add, draws=20, first=1)


def run(args):
    """Print the table, and how many errors fall and rise."""
    gains = []
    numbers = "3D RMSE without, cm", "with, cm", "change"
    cli.show(table.head("seed", "really", "added", *numbers, texts=3))
    for row in table.results(looped, table.seeds(args), args):
        gains.append(gain(row["without"], row["with"]))
        errors = [f"{100.0 * row[key]:.1f}" for key in ("without", "with")]
        added = ", ".join(row["added"]) or "nothing"
        change = f"{-100.0 * gains[-1]:+.0f} %"
        cli.show(table.line([row["seed"], row["really"], added, *errors, change]))
    fell, harmed = sum(one > 0.0 for one in gains), sum(one < HARM for one in gains)
    cli.show(
        f"\nThe error falls in {fell} of {len(gains)} halls, and rises by more than "
        f"{-HARM:.0%} in {harmed}."
    )
