"""inject: add a declared effect to a recorded or simulated flight."""

import sys

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..readers import inputs
from ..bags.bag import check_output, write_bag
from ..bags.files import STORAGES
from ..readers import read_flight

DESCRIPTION = """Add a declared effect to a flight, and write the flight that would have been recorded with it as a
ROS 2 bag.

A value is PARAMETER=NUMBER, as in effects.yaml; a number alone is for the effect's first parameter. --list shows
them."""


def main(argv=None):
    """The executable."""
    parser = cli.parser(
        "inject",
        DESCRIPTION,
        "inject 0425-traj2 --survey anchor_0425.txt --effect anchor_delay --value 3=0.3 --out late.bag",
        "inject flight.bag --effect tag_lever_arm --value x=0.05 z=0.1 --out arm.bag",
        "inject flight.bag --effect nlos --value 2.delay=0.4 2.start=20 2.end=35 --out blocked.bag",
        "inject --list",
    )
    parser.add_argument("flight", metavar="FLIGHT", nargs="?", help="a raw log, a UTIL CSV file or a bag")
    parser.add_argument("--list", action="store_true", help="list effects, parameters and units, and do nothing else")
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
    parser.add_argument("--namespace", default="", help="of the topics in a bag, e.g. tag1")
    parser.add_argument("--effect", metavar="NAME", choices=EFFECTS, help="the effect to add")
    parser.add_argument("--value", metavar="KEY=NUMBER", nargs="+", default=[], help="its parameters")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of effects that are random (default: 0)")
    parser.add_argument("--out", metavar="BAG", help="the bag to write: a new directory")
    parser.add_argument("--storage", choices=STORAGES, default="mcap", help="default: mcap")
    parser.add_argument("--force", action="store_true", help="replace an existing bag")
    return cli.run(_inject, parser, argv)


def parse_effect(name, values):
    """The Effect `name` with `values`, a list of texts "KEY=NUMBER", "KEY:NUMBER" or "NUMBER". Raises InputError."""
    kind, parameters = EFFECTS[name], {}
    for text in ",".join(values).split(","):
        key, found, number = text.replace(":", "=").strip().rpartition("=")
        key = key.strip() if found else kind.example
        if key in parameters:
            raise InputError(f"--value: {name}: {key} is given twice.")
        parameters[key] = number
    return kind(parameters, source="injected")


def _inject(args):
    if args.list:
        print(_catalogue())
        return
    for option in ("flight", "effect", "value", "out"):
        if not getattr(args, option):
            raise InputError(f"{option}: is missing; see inject --help.")
    effect = parse_effect(args.effect, args.value)
    check_output(args.out, args.force)  # before the work, not after it
    flight = read_flight(args.flight, inputs.survey_for(args.flight, args.survey), args.namespace)
    write_bag(effect.inject(flight, np.random.default_rng(args.seed)), args.out, args.storage, args.force)
    told = ", ".join(f"{key} = {value:g}" for key, value in effect.values.items())
    print(f"{flight.name}: added {effect.name} ({told}, in {effect.unit}) -> {args.out}")


def _catalogue():
    lines = []
    for name, effect in EFFECTS.items():
        lines.append(f"{name:20s} e.g. {effect.example}=NUMBER ({effect.unit}): {effect.physics}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
