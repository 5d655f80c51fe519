"""Record ROS topics to a bag, for those who have no `ros2 bag record`."""

from __future__ import annotations

from functools import partial
import sys
from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.errors import InputError

from .. import cli
from ..bags.files import STORAGES
from ..live.record import record
from ..live.session import PACKAGE
from ..outputs import OutputBag, OutputFile

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Callable
    from pathlib import Path

DESCRIPTION = """Record ROS topics to a bag, like `ros2 bag record`, until SIGINT (Ctrl-C) or SIGTERM.

Topics are found as they appear; each is subscribed to with the strongest QoS that all its publishers offer. Messages
are stored as they come, with the time of their arrival. The bag appears when the recording ends. With --rerun, odometry,
uwb/residual, uwb/anchors and uwb/tdoa, if they are recorded, are written for the viewer Rerun then, too.
"""


def parser() -> ArgumentParser:
    """Its options."""
    made = cli.parser(
        "record",
        DESCRIPTION,
        "record -o run.bag odometry uwb/residual",
        "record -o everything.bag -a",
        "record -o run.bag --rerun run.rrd odometry uwb/residual uwb/anchors uwb/tdoa",
    )
    made.add_argument("topics", nargs="*", metavar="TOPIC", help="topics to record")
    made.add_argument(
        "-a", "--all", action="store_true", help="record all topics, except hidden ones"
    )
    made.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="BAG",
        type=OutputBag,
        help="the bag to write, a new directory",
    )
    made.add_argument("--package", **PACKAGE)
    made.add_argument("-s", "--storage", choices=STORAGES, default="mcap", help="default: mcap")
    made.add_argument(
        "--rerun",
        metavar="FILE",
        type=OutputFile,
        help="write a recording for the viewer Rerun, too (.rrd; needs pip install rerun-sdk)",
    )
    return made


def _record(args: Namespace) -> int:
    if bool(args.topics) == args.all:
        raise InputError(
            "topics: name the topics to record, or give --all for all of them, not both."
        )
    say = partial(cli.say, "record")
    rerun = _rerun_of(args, say)
    recorded = record(args.topics, args.output, args.storage, args.ros_arguments, say, args.package)
    for topic, count in sorted(recorded.counts.items()):
        cli.show(f"{topic}: {count} messages")
    cli.show(f"{sum(recorded.counts.values())} messages -> {args.output}")
    if recorded.error is not None:
        raise recorded.error
    if rerun:
        from ..localizing.pictures import write_recorded

        write_recorded(rerun, args.output)
    if recorded.missing:
        say(f"no message came on {', '.join(recorded.missing)}")
        return 1
    return 0


def _rerun_of(args: Namespace, say: Callable[[str], object]) -> Path | None:
    """See options.rerun_of.

    What it imports takes a third of a second, in which messages would pass.
    """
    if not args.rerun:
        return None
    from .. import options

    return options.rerun_of(args, 1, say)


main = cli.executable(_record, parser, ros=True)

if __name__ == "__main__":
    sys.exit(main())
