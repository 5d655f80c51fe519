"""Write the correction of TDOAs by effects and network as one file for other runtimes."""

from __future__ import annotations

from functools import partial
import sys
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EffectSet

from .. import cli, options
from ..outputs import OutputFile
from ..parallel import Progress
from ..readers import read_survey

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "export",
        "Write the correction of TDOAs by effects and network as one file, for the anchors of a "
        "survey.\n"
        "bias_node, evaluate and fly take bias.onnx in place of effects.yaml and network; so does "
        "any other ONNX runtime.\n"
        "What a file cannot hold is named on stderr, with its worth in metres. docs/export.md "
        "describes the files.",
        "export --survey anchors.yaml --effects effects.yaml --onnx bias.onnx",
        "export --survey anchors.yaml --effects effects.yaml --model model.onnx --onnx bias.onnx",
        "evaluate flight.bag --survey anchors.yaml --model bias.onnx",
    )
    add = made.add_argument
    add("--survey", metavar="S", required=True, help="anchors .yaml or survey (.txt, .csv)")
    add("--effects", metavar="FILE", help="effects.yaml, as diagnose, calibrate or train writes it")
    add("--model", metavar="FILE", help="ONNX bias network, as train writes it")
    add("--onnx", metavar="FILE", type=OutputFile, help="write the correction as an ONNX file")
    return made


def _export(args: Namespace) -> None:
    if not (args.effects or args.model):
        raise InputError("--effects: is missing, and so is --model; give one of them, or both.")
    if not args.onnx:
        raise InputError("--onnx: is missing; name the file to write.")
    from ..exporting.onnx_file import write_onnx  # imports onnx

    say = partial(cli.say, "export")
    anchors = read_survey(args.survey)
    effects = EffectSet.from_yaml(args.effects) if args.effects else None
    model = options.model_of(args, effects, say)
    with Progress("export", what="writing the equations"):
        traced = write_onnx(args.onnx, anchors, effects, model)
    for omitted in traced.left_out:
        say(str(omitted))
    name = traced.meta()["name"]
    cli.show(f"{name} for {len(anchors)} anchors in frame {anchors.frame} -> {args.onnx}")


main = cli.executable(_export, parser)

if __name__ == "__main__":
    sys.exit(main())
