# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert a recording to a ROS 2 bag."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
import json
from pathlib import Path

from uwb_tdoa_bias.common.errors import InputError, number_of
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.flight import STREAMS

from .. import cli, options
from ..choices import COLUMNS
from ..cli import OutputBag, OutputFile, option
from ..command_lines import tool

DESCRIPTION = """Convert a recorded flight to a ROS 2 bag.

IN is a Crazyflie micro-SD event log (versions 1 and 2), a UTIL CSV file (plain or gzip) or a bag. With --profile it is a
recording of any other tool: a bag of ROS 1 or ROS 2, a ULog, CSV files, several files or a folder of them. --columns is
the short form of a profile for CSV files (cells divided by commas, semicolons or tabs; anchors by ids or by the names
that the survey has for them). Records with empty cells are left out and counted. --suggest writes a first profile.
The new bag has imu/data, uwb/tdoa, uwb/anchors, ground_truth/pose and /tf_static. It appears only when it is complete.
"""

YOUR_SURVEY = "anchors.yaml"  # in a line to copy


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "convert",
        DESCRIPTION,
        "convert 0425-traj1 --survey anchor_0425.txt --out 0425-traj1_bag",
        (
            "convert const1-trial1-tdoa2.csv.gz --survey anchor_const1.csv --out const1_bag "
            "--storage sqlite3"
        ),
        "convert flight.log --survey anchors.yaml --out flight_bag --force --json",
        "convert cut.log --survey anchors.yaml --salvage --out flight_bag",
        (
            "convert theirs.bag --topic uwb/tdoa=/dwm/tdoa --topic imu/data=/fcu/imu --survey "
            "anchors.yaml --out our_bag"
        ),
        (
            "convert ranging.csv --columns time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff_mm:mm "
            "--survey anchors.yaml "
            "--out our_bag"
        ),
        (
            "convert ranging.csv mocap.csv --columns "
            "time=t,anchor_a=from,anchor_b=to,tdoa=d,pose_x=x,pose_y=y,pose_z=z "
            "--time-offset truth=-0.4 --survey anchors.csv --out our_bag"
        ),
        "convert theirs.bag --suggest profile.yaml",
        "convert theirs.bag --profile profile.yaml --survey anchors.yaml --out our_bag",
        "convert theirs.bag --profile dwm1001 --tag 5722 --out our_bag",
        options=[
            option(
                "input",
                metavar="IN",
                nargs="+",
                help="the recording; its kind is found by its content",
            ),
            option("--columns", metavar="MAP", help=COLUMNS),
            *options.READING,
            options.align(),
            option(
                "--time-offset",
                dest="offsets",
                action="append",
                default=[],
                metavar="SENSOR=SECONDS",
                help=(
                    f"add this to the stamps of a sensor with another clock: {', '.join(STREAMS)}; "
                    "may be repeated"
                ),
            ),
            option(
                "--out", metavar="BAG", type=OutputBag, help="the bag to write, a new directory"
            ),
            option(
                "--suggest",
                metavar="FILE",
                type=OutputFile,
                help="write a first profile of IN instead: what it seems to hold, and what is missing",
            ),
            *options.BAG,
            option("--json", action="store_true", help="print the summary as JSON"),
        ],
    )


def _convert(args: Namespace) -> None:
    if args.suggest:
        return _suggest(args)
    if not args.out:
        raise InputError("--out: is missing; give the path of the bag to write.")
    from ..converting import convert, described, shifted
    from ..readers.profile import Profile, parse_columns
    from ..scoring.evaluation import on_one_clock

    offsets = _offsets(args.offsets)
    reading = options.reading_of(args)
    if args.columns:
        because = "says where topics are in bags, and --columns is of CSV files"
        options.refuse(args, ("namespace", "topics"), because)
        options.refuse(args, ("profile",), "--columns is the short form of a profile")
        if not args.survey:
            raise InputError(
                "--columns: CSV files do not say where the anchors are; give a survey file "
                "(--survey FILE)."
            )
        reading = replace(reading, profile=Profile.of_columns(parse_columns(args.columns)))
    with cli.Progress("convert", what="reading and writing"):
        made = convert(
            lambda: on_one_clock(shifted(reading.one(*args.input), offsets), args.align),
            args.out,
            args.storage,
            args.force,
        )
    if args.json:
        cli.show(json.dumps(made, indent=2, default=str))
        return
    cli.show(*described(made))
    cli.show(f"  -> {args.out}")
    cli.say("convert", *made["apart"])


def _suggest(args: Namespace) -> None:
    """Write a first profile of IN."""
    from ..readers.profile import load_profile
    from ..readers.suggest import suggest

    text, fitting, problem, has_anchors = suggest([Path(path) for path in args.input], args.salvage)
    write_text(args.suggest, text)
    if problem:
        raise InputError(f"{args.suggest}: is written, and cannot be used yet: {problem}")
    for name in fitting:
        cli.show(f"the shipped profile {name} fits: {load_profile(name).about}")
    words = [*args.input, "--profile", fitting[0] if fitting else args.suggest]
    if args.survey or not has_anchors:
        words += ["--survey", args.survey or YOUR_SURVEY]
    cli.show(f"  -> {args.suggest}", f"next: {tool('convert', *words, '--out', 'our_bag')}")
    if YOUR_SURVEY in words:
        cli.show(f"{YOUR_SURVEY} is the file with the positions of your anchors (docs/csv.md)")


def _offsets(texts: list[str]) -> dict[str, float]:
    """Return {sensor: s} of "SENSOR=SECONDS" texts. Raises InputError."""
    offsets: dict[str, float] = {}
    for text in texts:
        sensor, given, seconds = text.partition("=")
        offset = number_of(seconds)
        if not given or sensor not in STREAMS or sensor in offsets or not abs(offset) < 1e11:
            raise InputError(
                f"--time-offset: {text!r} is not SENSOR=SECONDS, where SENSOR, once, is one "
                f"of {', '.join(STREAMS)}."
            )
        offsets[sensor] = offset
    return offsets


main = cli.executable(_convert, parser)
