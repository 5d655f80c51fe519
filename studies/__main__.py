# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev study NAME ...`: reproduce the figures of the documentation."""

import argparse
from importlib import import_module
import sys

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import cli

STUDIES = {  # name: (module, what it measures, page of docs/)
    "bench": ("bench.suite", "what the suite costs on this machine", "notebook/measured.md"),
    "calibrating": (
        "calibrating",
        "surveys with errors, calibrated without ground truth, judged on other flights",
        "notebook/calibration.md",
    ),
    "checking": (
        "checking",
        "mistakes put into flights, and what check reports of them",
        "notebook/checking.md",
    ),
    "crazyflie": (
        "crazyflie",
        "measured logs put through the radio link of a Crazyflie",
        "notebook/connect.md",
    ),
    "demo": ("demo", "the loop of the demo over seeds", "demo.md"),
    "diagnosis": (
        "diagnosis.figures",
        "effects put into flights and found again, and what corrections gain",
        "notebook/diagnosis.md",
    ),
    "faults": (
        "faults.figures",
        "faults of streams, surveys, nodes and clocks, played to the real nodes",
        "notebook/reliability.md",
    ),
    "first-map": (
        "first_map",
        "first maps of unknown anchors in simulated halls, and their errors",
        "notebook/first_map.md",
    ),
    "fly-faults": (
        "faults.flown",
        "faults of streams while a simulated vehicle flies by the estimate",
        "notebook/reliability.md",
    ),
    "fuzz": (
        "fuzz",
        "changed files of every kind, given to every reader",
        "notebook/reliability.md",
    ),
    "localizing": (
        "localizing",
        "verdicts of localize against ground truth",
        "notebook/localizing.md",
    ),
    "moved-anchors": (
        "moved_anchors",
        "anchors that were moved or exchanged, and who names them",
        "notebook/localizing.md",
    ),
    "plans": (
        "plans",
        "random rooms and halls, planned and solved by an independent solver",
        "notebook/planning.md",
    ),
    "rover": (
        "rover",
        "a simulated rover on wheels, and what diagnose finds on it",
        "notebook/rover.md",
    ),
    "situations": (
        "situations",
        "where a tag can be and what can happen to it, simulated",
        "notebook/reliability.md",
    ),
    "soak": (
        "bench.soak",
        "both nodes for hours: memory and lost messages",
        "notebook/reliability.md",
    ),
    "streaming": (
        "streaming",
        "measured flights calibrated as one stream, piece by piece",
        "notebook/calibration.md",
    ),
    "surveying": (
        "surveying",
        "surveys with errors, corrected from flights alone",
        "notebook/calibration.md",
    ),
    "users": (
        "users",
        "bodies, sensors, rates and errors of many users, beside two textbook estimators",
        "notebook/users.md",
    ),
    "vehicle": (
        "vehicle",
        "the filters of the Crazyflie firmware before and after a correction, on held-out flights",
        "notebook/export.md",
    ),
    "warehouse": (
        "warehouse",
        "starts, slow tags and walks in halls, and their cost",
        "notebook/warehouse.md",
    ),
}
DESCRIPTION = """Make the figures of the documentation anew. The suite needs nothing of this. DATA is a folder of
measured flights: flights/, util/, surveys/. `./dev study NAME --help` describes a study."""


def main(argv=None):
    """The executable. Returns the exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    if words and words[0] in STUDIES:
        return cli.run(module(words[0]).run, parser(words[0]), words[1:])
    return cli.run(_list, overview(), words[:1])


def module(name):
    """The module of a study: `add_options(add)` adds its options, `run(args)` runs it."""
    return import_module(f"studies.{STUDIES[name][0]}")


def parser(name):
    """The parser of a study."""
    study = module(name)
    made = argparse.ArgumentParser(
        prog=f"study {name}",
        description=study.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    study.add_options(made.add_argument)
    return made


def overview():
    """The parser without a study. Its help lists them."""
    lines = [f"  {name:14} {what} ({page})" for name, (_, what, page) in STUDIES.items()]
    made = cli.parser("study", "\n".join([DESCRIPTION, "", *lines]))
    made.add_argument("name", metavar="NAME", nargs="?", help="one of these")
    return made


def _list(args):
    if args.name is not None:
        raise InputError(f"{args.name}: no study has this name; ./dev study lists them.")
    overview().print_help()


if __name__ == "__main__":
    sys.exit(main())
