# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""vehicle: run both filters of the Crazyflie firmware over flights that took no part in a correction.

The flights of each survey are halved, in the given order. The effects and the network of one half correct the
other half. The network goes with the floor_multipath of the effects. With --build, a build of
`export --crazyflie` is tried on all flights instead.
"""

from pathlib import Path

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import temporary_folder
from uwb_tdoa_bias.correction.model import load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.floor import FloorMultipath
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools import choices, cli
from uwb_tdoa_tools.cli import OutputFolder
from uwb_tdoa_tools.exporting.c_code import stddev_of, write_crazyflie
from uwb_tdoa_tools.exporting.tracing import trace
from uwb_tdoa_tools.main import main
from uwb_tdoa_tools.readers import inputs

from . import table
from .firmware_filter import comparison, in_words


def add_options(add):
    """add : add_argument of a parser"""
    words = "TDoA2 logs with IMU and ground truth"
    add("flights", nargs="+", metavar="FLIGHT", help=words)
    add("--survey", required=True, metavar="S", help=choices.SURVEY)
    add("--firmware", required=True, metavar="DIR", help="checkout of crazyflie-firmware")
    words = "corrections of each half; what is there is not made again"
    add("--out", type=OutputFolder, metavar="DIR", help=words)
    add("--build", metavar="DIR", help="a build of export --crazyflie to try instead")
    add("--config", metavar="FILE", help="ekf_node.yaml of that export")


def halves(recordings):
    """Yield (name, training, held out) of recordings (path, survey): both halves of each survey."""
    for survey in dict.fromkeys(survey for _, survey in recordings):
        mine = [one for one in recordings if one[1] == survey]
        if len(mine) < 3:
            raise InputError(f"{survey}: {len(mine)} flights are too few; give three or more.")
        middle = (len(mine) + 1) // 2
        for number, held in enumerate((mine[middle:], mine[:middle])):
            rest = [one for one in mine if one not in held]
            yield f"{Path(survey).stem}-{number}", rest, held


def corrections(folder, training, survey):
    """{way: (EffectSet, Model or None)} and the FilterConfig that some recordings give."""
    given = [*(str(path) for path, _ in training), "--survey", str(survey)]
    effects, model = folder / "diagnosis", folder / "network"
    if not (effects / "effects.yaml").exists():
        main(["diagnose", *given, "--out", str(effects)])
    if not (model / "model.onnx").exists():
        main(["train", *given, "--model", "paper", "--out", str(model)])
    found = EffectSet.from_yaml(effects / "effects.yaml")
    floor = found.where(lambda effect: isinstance(effect, FloorMultipath))
    ways = {"effects": (found, None), "network": (floor, load_network(model / "model.onnx"))}
    return ways, FilterConfig.from_yaml(effects / "ekf_node.yaml")


def tried(args, flights):
    """The lines on the errors of both filters with --build on some Flights."""
    stddev = stddev_of(FilterConfig.from_yaml(args.config) if args.config else FilterConfig())
    errors = comparison(Path(args.build), Path(args.firmware), flights, stddev)
    return in_words(errors, [one.name for one in flights], stddev)


def run(args):
    """Print a row for each flight, correction and filter: 3D RMSE in the air, m."""
    reading = inputs.Reading(args.survey)
    if args.build:
        cli.show(tried(args, reading.flights(args.flights)))
        return
    if not args.out:
        raise InputError("--out: is missing, and so is --build; give one of them.")
    columns = "0.15 m", "stddev alone", "build"
    cli.show(table.head("flight", "correction", "filter", *columns, texts=3))
    errors = {}
    for name, training, held in halves(reading.find(args.flights)):
        flights = [reading.read(one) for one in held]
        ways, config = corrections(args.out / name, training, held[0][1])
        for way, given in ways.items():
            with temporary_folder() as build:
                write_crazyflie(build, trace(flights[0].anchors, *given), stddev_of(config))
                found = comparison(build, Path(args.firmware), flights, stddev_of(config))
            for kind, rows in found.items():
                errors.setdefault((way, kind), []).extend(rows)
                for flight, row in zip(flights, rows):
                    cells = [f"{error:.3f}" for error in row]
                    cli.show(table.line([flight.name, way, kind, *cells]))
    for words, rows in errors.items():
        cells = [f"{error:.3f}" for error in np.mean(rows, axis=0)]
        cli.show(table.line(["mean", *words, *cells]))
        _, alone, build = np.transpose(rows)
        cli.show(table.line(["worst", *words, "", "", f"{np.max(build / alone) - 1.0:+.0%}"]))
