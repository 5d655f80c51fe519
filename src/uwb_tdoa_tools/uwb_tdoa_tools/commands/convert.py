"""Convert a recording to a ROS 2 bag."""

from __future__ import annotations

from dataclasses import asdict
import json
import math
import sys
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from .. import cli, options
from ..choices import COLUMNS, STREAMS
from ..outputs import OutputBag
from ..parallel import Progress

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Iterable

    from uwb_tdoa_bias.common.flight import Flight

    from ..readers.names import NamedAnchors

DESCRIPTION = """Convert a recorded flight to a ROS 2 bag.

IN is a Crazyflie micro-SD event log (versions 1 and 2), a UTIL CSV file (plain or gzip), a bag, or, with --columns, one
CSV file or several of any other tool (cells divided by commas, semicolons or tabs; anchors by ids or by the names that
the survey has for them; records with empty cells are left out and counted). The new bag has imu/data, uwb/tdoa,
uwb/anchors, ground_truth/pose and /tf_static. It appears only when it is complete.
"""


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "convert",
        DESCRIPTION,
        "convert 0425-traj1 --survey anchor_0425.txt --out 0425-traj1.bag",
        (
            "convert const1-trial1-tdoa2.csv.gz --survey anchor_const1.csv --out const1.bag "
            "--storage sqlite3"
        ),
        "convert flight.log --survey anchors.yaml --out flight.bag --force --json",
        "convert cut.log --survey anchors.yaml --salvage --out flight.bag",
        (
            "convert theirs.bag --topic uwb/tdoa=/dwm/tdoa --topic imu/data=/fcu/imu --survey "
            "anchors.yaml --out our.bag"
        ),
        "convert ranging.csv --columns time=t_ms:ms,anchor_a=from,anchor_b=to,tdoa=diff_mm:mm "
        "--survey anchors.yaml "
        "--out our.bag",
        "convert ranging.csv mocap.csv --columns "
        "time=t,anchor_a=from,anchor_b=to,tdoa=d,pose_x=x,pose_y=y,pose_z=z "
        "--time-offset truth=-0.4 --survey anchors.csv --out our.bag",
    )
    made.add_argument(
        "input", metavar="IN", nargs="+", help="the recording; its kind is found by its content"
    )
    made.add_argument("--columns", metavar="MAP", help=COLUMNS)
    options.add_reading(made)
    options.add_align(made)
    made.add_argument(
        "--time-offset",
        dest="offsets",
        action="append",
        default=[],
        metavar="SENSOR=SECONDS",
        help=(
            f"add this to the stamps of a sensor with another clock: {', '.join((*STREAMS, *SENSORS))}; "
            "may be repeated"
        ),
    )
    made.add_argument(
        "--out",
        metavar="BAG",
        type=OutputBag,
        required=True,
        help="the bag to write, a new directory",
    )
    options.add_bag(made)
    made.add_argument("--json", action="store_true", help="print the summary as JSON")
    return made


def _convert(args: Namespace) -> None:
    from ..bags.convert import convert, shifted
    from ..scoring.evaluation import on_one_clock

    offsets = _offsets(args.offsets)
    named = _named(args)
    with Progress("convert", what="reading and writing"):
        made = convert(
            lambda: on_one_clock(shifted(_read(args, named), offsets), args.align),
            args.out,
            args.storage,
            args.force,
        )
    if args.json:
        cli.show(json.dumps(asdict(made), indent=2, default=str))
        return
    cli.show(
        f"{made.flight}: {made.end - made.start:.1f} s, "
        f"{made.meta.get('protocol', 'protocol unknown')}"
    )
    if named and named.ids:
        cli.show(
            "  ids in the bag: "
            + ", ".join(f"{name} is {number}" for name, number in named.ids.items())
        )
    for remark in made.meta.get("remarks", ()):
        cli.show(f"  {remark}")
    for topic, count in made.messages.items():
        cli.show(f"  {topic}: {count}")
    for name, count in made.left_out.items():
        cli.show(f"  {name}: {count} events left out, a bag has no place for them")
    for topic, falls in made.meta.get("reordered", {}).items():
        cli.show(f"  {topic}: sorted, its stamps fell {falls} times")
    if made.tdoa_unknown_anchor:
        cli.show(
            f"  {made.tdoa_unknown_anchor} measurements name an anchor that the survey does "
            "not have"
        )
    cli.show(f"  -> {args.out}")
    for sentence in made.apart:
        cli.say("convert", sentence)


def _offsets(texts: Iterable[str]) -> dict[str, float]:
    """Return {sensor: s} of "SENSOR=SECONDS" texts. Raises InputError."""
    from ..bags.convert import SENSORS

    offsets = {}
    for text in texts:
        sensor, given, seconds = text.partition("=")
        try:
            offset = float(seconds)
        except ValueError:
            offset = math.nan
        if not given or sensor not in SENSORS or sensor in offsets or not abs(offset) < 1e11:
            raise InputError(
                f"--time-offset: {text!r} is not SENSOR=SECONDS, where SENSOR, once, is one "
                f"of {', '.join(SENSORS)}."
            )
        offsets[sensor] = offset
    return offsets


def _named(args: Namespace) -> NamedAnchors | None:
    """NamedAnchors anchors for --columns, or None. Raises InputError."""
    from ..readers.names import read_named_anchors

    if args.columns and not args.survey:
        raise InputError(
            "--columns: CSV files do not say where the anchors are; give a survey file "
            "(--survey FILE)."
        )
    return read_named_anchors(args.survey) if args.columns else None


def _read(args: Namespace, named: NamedAnchors | None) -> Flight:
    """The Flight."""
    from ..readers import columns

    if args.columns:
        options.refuse(
            args,
            ("namespace", "topics"),
            "says where topics are in bags, and --columns is of CSV files",
        )
        assert named is not None  # as `_named` has seen to it
        return columns.read_columns(
            args.input, columns.parse_columns(args.columns), named, args.salvage
        )
    if len(args.input) > 1:
        raise InputError(
            f"IN: {len(args.input)} recordings are given; convert one by one, or name --columns."
        )
    return options.reading_of(args).one(args.input[0])


main = cli.executable(_convert, parser)

if __name__ == "__main__":
    sys.exit(main())
