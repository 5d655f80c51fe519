# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write the correction of TDOAs by effects and network as one file for other runtimes."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from uwb_tdoa_bias.common.errors import InputError

from .. import cli
from ..cli import OutputFileInFolder, OutputFolder, option


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "export",
        (
            "Write the correction of TDOAs by effects and network as one file, for the anchors of a "
            "survey.\n"
            "bias_node, evaluate and fly take bias.onnx in place of effects.yaml and network; so does "
            "any other ONNX runtime.\n"
            "What a file cannot hold is named on stderr, with its worth in metres. docs/export.md "
            "describes the files."
        ),
        "export --survey anchors.yaml --effects effects.yaml --onnx bias.onnx",
        "export --survey anchors.yaml --effects effects.yaml --model model.onnx --onnx bias.onnx",
        "export --survey anchors.yaml --effects effects.yaml --c correction/",
        "export --survey anchors.yaml --effects effects.yaml --config ekf_node.yaml --crazyflie crazyflie/",
        options=[
            option(
                "--survey", metavar="S", required=True, help="anchors .yaml or survey (.txt, .csv)"
            ),
            option(
                "--effects",
                metavar="FILE",
                help="effects.yaml, as diagnose, calibrate or train writes it",
            ),
            option("--model", metavar="FILE", help="ONNX bias network, as train writes it"),
            option(
                "--onnx",
                metavar="FILE",
                type=OutputFileInFolder,
                help="write the correction as an ONNX file",
            ),
            option(
                "--c",
                metavar="DIR",
                type=OutputFolder,
                help="write it as C99: uwb_bias.h and uwb_bias.c",
            ),
            option(
                "--crazyflie",
                metavar="DIR",
                type=OutputFolder,
                help="write it as an out-of-tree build of the Crazyflie firmware",
            ),
            option(
                "--config",
                metavar="FILE",
                help="ekf_node.yaml of diagnose or calibrate: the noise for --crazyflie",
            ),
        ],
    )


def _export(args: Namespace) -> None:
    from uwb_tdoa_bias.common.survey import read_named_anchors
    from uwb_tdoa_bias.correction.corrector import orientation_remarks
    from uwb_tdoa_bias.correction.model import load_network
    from uwb_tdoa_bias.effects import EffectSet

    if not (args.effects or args.model):
        raise InputError("--effects: is missing, and so is --model; give one of them, or both.")
    if not (args.onnx or args.c or args.crazyflie):
        raise InputError("--onnx, --c, --crazyflie: all are missing; name what to write.")
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..exporting import c_code
    from ..exporting.onnx_file import write_onnx  # imports onnx
    from ..exporting.tracing import trace

    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    stddev = c_code.stddev_of(config)
    say = partial(cli.say, "export")
    anchors = read_named_anchors(args.survey).anchors
    effects = EffectSet.from_yaml(args.effects) if args.effects else None
    model = load_network(args.model)
    given = anchors, effects, model
    with cli.Progress("export", what="writing the equations"):
        traced = write_onnx(args.onnx, *given) if args.onnx else trace(*given)
        if args.c:
            c_code.write_c(args.c, traced)
        not_flown = c_code.write_crazyflie(args.crazyflie, traced, stddev) if args.crazyflie else ()
    say(*orientation_remarks(*given), *traced.left_out)
    say(*(f"{args.crazyflie}: {omitted}" for omitted in not_flown))
    name = traced.meta()["name"]
    for made in filter(None, (args.onnx, args.c, args.crazyflie)):
        cli.show(f"{name} for {len(anchors)} anchors in frame {anchors.frame} -> {made}")
    if args.crazyflie:
        say(f"{args.crazyflie}: not tried on flights; docs/crazyflie.md says how to.")


main = cli.executable(_export, parser)
