# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share, and the values that they give.

parser = cli.parser(..., options=[*options.recordings(), *options.ESTIMATOR, options.JOBS])
reading, (config, effects) = options.reading_of(args), options.filter_of(args)
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.safe_yaml import parse_yaml
from uwb_tdoa_bias.common.sensors import SENSORS

from . import choices
from .choices import ALIGN, NONE, STORAGES
from .cli import Option, OutputFolder, option
from .parallel import whole_number

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig

    from .diagnosis.constraints import Distance, Mark
    from .diagnosis.self_calibration import Tape
    from .estimate import FlightEstimator
    from .readers import inputs

TOPICS = (  # that are read from bags
    "uwb/tdoa",
    "uwb/anchors",
    "imu/data",
    *(topic for sensor in SENSORS.values() for topic, _ in sensor.topics),
    "ground_truth/pose",
    "odometry",
)


READING = (
    option("--survey", metavar="S", help=choices.SURVEY),
    option("--namespace", default="", metavar="NS", help="of the tag's topics in bags, e.g. tag1"),
    option(
        "--topic",
        dest="topics",
        action="append",
        default=[],
        metavar="OURS=THEIRS",
        help="a topic of bags that has another name there, e.g. uwb/tdoa=/my/tdoa; may be repeated",
    ),
    option("--profile", metavar="P", help=choices.PROFILE),
    option(
        "--tag", default="", metavar="ID", help="of a recording with several tags, with --profile"
    ),
    option(
        "--salvage",
        action="store_true",
        help="leave out invalid numbers, and read logs and CSV files up to where they are cut",
    ),
)
PARAMETERS = option(
    "-p",
    dest="parameters",
    metavar="NAME:=VALUE",
    action="append",
    default=[],
    help="one filter parameter, before --config",
)
MODEL = option("--model", metavar="FILE", help="ONNX file of `train` or `export` to correct with")
BAG = (
    option("--storage", choices=STORAGES, default="mcap", help="kind of bag (default: mcap)"),
    option("--force", action="store_true", help="replace an existing bag"),
)
HOLDOUT = option(
    "--holdout", nargs="+", default=[], metavar="FLIGHT", help="flights to judge on, not to fit"
)
TAPE = (  # how well anchors are known
    option(
        "--std",
        type=float,
        metavar="M",
        help=f"m, standard deviation of a coordinate as given (default {choices.TAPE_STD:g})",
    ),
    option(
        "--height-std",
        type=float,
        metavar="M",
        help="m, the same of heights, which are easier to measure",
    ),
    option(
        "--trusted",
        nargs="+",
        default=[],
        metavar="A",
        help="anchors (3) or coordinates (3.z) that are known well",
    ),
    option(
        "--trusted-std",
        type=float,
        metavar="M",
        help=f"m, how well those are known (default {choices.TRUSTED_STD:g})",
    ),
    option(
        "--unknown",
        nargs="+",
        default=[],
        metavar="A",
        help="anchors whose position is not known at all",
    ),
)
# fields of Tape, which the covariance of the last calibration replaces
OF_TAPE = "std", "height_std", "trusted", "trusted_std"
DISTANCES = option(
    "--distances",
    metavar="FILE",
    help="CSV with columns a, b, distance, std: measured distances between anchors, m",
)
KNOWN = (
    option(
        "--marks",
        metavar="FILE",
        help="YAML: measured places where the tag stood or passed, and when (docs/calibration.md)",
    ),
    DISTANCES,
)
JOBS = option(  # of tools that run over many flights
    "--jobs",
    metavar="N",
    type=whole_number,
    help="flights at once (default: as many as there are cores)",
)


def recordings(nargs: str = "+") -> tuple[Option, ...]:
    """Return FLIGHT... and the options of reading."""
    return option("flights", nargs=nargs, metavar="FLIGHT", help=choices.RECORDINGS), *READING


def filtering(
    effects: str = "effects.yaml to correct the TDOAs with, before the filter",
) -> tuple[Option, ...]:
    """Return --effects, with this help, --config and --without."""
    return (
        option("--effects", metavar="FILE", help=effects),
        option(
            "--config", metavar="FILE", help="filter parameters, as for ekf_node (ekf_node.yaml)"
        ),
        option(
            "--without",
            metavar="SENSOR",
            action="append",
            default=[],
            choices=tuple(SENSORS),
            help=f"not to be used though it is there: {', '.join(SENSORS)}; may be repeated",
        ),
    )


ESTIMATOR = (
    *filtering("effects.yaml: systematic effects to correct for"),
    MODEL,
    option("--no-bias", action="store_true", help="correct for nothing, whatever else is given"),
    PARAMETERS,
    option(
        "--smooth", action="store_true", help="smooth: use later measurements for each estimate too"
    ),
)


def most(default: int) -> Option:
    """Return --most: the largest number of TDOAs to learn from."""
    return option(
        "--most",
        metavar="N",
        type=whole_number,
        default=default,
        help=(
            "TDOAs to hold at most, by which memory and time are bounded: of flights with more, "
            "some are drawn (default %(default)s)"
        ),
    )


def align(judges: bool = False) -> Option:
    """Return --align: none or time; for tools that judge by ground truth, frame too.

    judges : whether the tool only scores with the ground truth; a tool that learns from it must not
        move its frame
    """
    text = (
        "ground truth on another clock (another epoch): none refuses it (default), time estimates "
        "the offset"
    )
    if judges:
        text = (
            "move the ground truth onto the estimate before the evaluation: none (default); time, "
            "its stamps; frame, its frame too, rotated and shifted (as evo -a, without scale). "
            "The result is printed in any case, with the error of each"
        )
    return option("--align", choices=ALIGN if judges else ALIGN[:2], default=NONE, help=text)


def out(required: bool = True) -> Option:
    """Return --out, a folder for everything that the command writes."""
    return option(
        "--out",
        metavar="DIR",
        type=OutputFolder,
        required=required,
        help="where to write; made if it is not there",
    )


def reading_of(args: Namespace, truth: bool = True) -> inputs.Reading:
    """Return the Reading for these options. truth : as in Reading. Raises InputError."""
    from .readers import inputs, profile

    topics = {}
    for text in args.topics:
        ours, given, theirs = text.partition("=")
        if not given or ours not in TOPICS or not theirs.strip("/") or ours in topics:
            raise InputError(
                f"--topic: {text!r} is not OURS=THEIRS, where OURS, once, is one of "
                f"{', '.join(TOPICS)}."
            )
        topics[ours] = theirs
    if args.profile:
        refuse(args, ("topics",), "the profile names the topics")
    elif args.tag:
        raise InputError("--tag: chooses a tag of a recording that is read with --profile.")
    loaded = profile.load_profile(args.profile) if args.profile else None
    return inputs.Reading(
        args.survey, args.namespace, topics, args.salvage, truth, loaded, args.tag
    )


def words_of_reading(args: Namespace) -> tuple[str, ...]:
    """Return the words of a command line that read recordings as `reading_of`, without --survey."""
    words = ["--namespace", args.namespace] if args.namespace else []
    words += [word for topic in args.topics for word in ("--topic", topic)]
    words += ["--profile", args.profile] if args.profile else []
    words += ["--tag", args.tag] if args.tag else []
    return (*words, *["--salvage"][: args.salvage])


def filter_of(args: Namespace) -> tuple[FilterConfig, EffectSet | None]:
    """Return the FilterConfig of --config, -p and --without, and the EffectSet of --effects or None.

    Raises InputError.
    """
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.core.config import FilterConfig

    config = FilterConfig.from_yaml(args.config) if args.config else FilterConfig()
    switched_off = [f"use_{stream}:=false" for stream in args.without]
    config = with_parameters(config, [*getattr(args, "parameters", ()), *switched_off])
    return config, EffectSet.from_yaml(args.effects) if args.effects else None


def estimator_of(args: Namespace) -> FlightEstimator:
    """Return the FlightEstimator for these options. Raises InputError."""
    from uwb_tdoa_bias.correction.model import load_network

    from .estimate import FlightEstimator

    config, effects = filter_of(args)
    if args.no_bias:
        return FlightEstimator(config, smoothed=args.smooth)
    return FlightEstimator(config, effects, load_network(args.model), args.smooth)


def given(args: Namespace, name: str) -> bool:
    """Return whether the user gave the option of that name."""
    value = getattr(args, name)
    return value is not False and value not in (None, "", [])


def refuse(args: Namespace, names: Iterable[str], because: str) -> None:
    """Raise InputError for the first given option that has no effect here."""
    for name in names:
        if given(args, name):
            option = {"parameters": "-p", "topics": "--topic"}.get(
                name, f"--{name.replace('_', '-')}"
            )
            raise InputError(f"{option}: {because}; leave it out.")


def check_holdout(fitted: Iterable[str | Path], held: Iterable[str | Path]) -> None:
    """Raise InputError if a flight, by its name or its path, is both fitted and held out."""
    shared = set(fitted) & set(held)
    if shared:
        raise InputError(
            f"--holdout: {min(map(str, shared))} is also a FLIGHT to fit; leave it out of one "
            "of them."
        )


def tape_of(args: Namespace, effects: EffectSet | None) -> Tape:
    """Return the Tape for these options. Raises InputError.

    effects : EffectSet of --effects, or None. Its covariance of the anchors excludes the options of Tape.
    """
    from .diagnosis.self_calibration import Tape

    if effects is not None and effects.covariance is not None:
        refuse(
            args,
            OF_TAPE,
            f"{args.effects} says how well each anchor is known, by its last calibration",
        )
    return Tape(
        **{name: getattr(args, name) for name in OF_TAPE if given(args, name)},
        unknown=tuple(args.unknown),
    )


def known_of(args: Namespace, flights: Sequence[Flight]) -> tuple[Mark | Distance, ...]:
    """Return the constraints on Flights as a tuple. Raises InputError."""
    from .surveying.report import read_distances, read_marks

    out: list[Mark | Distance] = []
    out += [] if args.marks is None else read_marks(args.marks, flights)
    out += [] if args.distances is None else read_distances(args.distances, flights[0].anchors)
    return tuple(out)


def with_parameters(config: FilterConfig, texts: Iterable[str]) -> FilterConfig:
    """Return a FilterConfig with the values of texts "name:=value". Raises InputError."""
    return replace(config, **dict(map(_parameter, texts)))


def _parameter(text: str) -> tuple[str, Any]:
    """Return (name, value) of "name:=value"."""
    from uwb_tdoa_ekf.core.config import FilterConfig

    name, assigned, value = text.partition(":=")
    names = [field.name for field in fields(FilterConfig)]
    if not assigned or name not in names:
        raise InputError(f"-p {text}: write NAME:=VALUE, where NAME is one of {', '.join(names)}.")
    return name, parse_yaml(value, f"-p {text}")
