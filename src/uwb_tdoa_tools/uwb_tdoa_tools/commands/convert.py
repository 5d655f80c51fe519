"""Convert a recording to a ROS 2 bag."""

import json
import sys

import numpy as np

from .. import cli
from ..readers import inputs
from ..bags.bag import check_output, write_bag
from ..bags.files import STORAGES
from ..readers import read_flight

DESCRIPTION = """Convert a recorded flight to a ROS 2 bag.

IN is a Crazyflie micro-SD event log (versions 1 and 2), a UTIL CSV file (plain or gzip), or a bag. The new bag has
imu/data, uwb/tdoa, uwb/anchors, ground_truth/pose and /tf_static. It appears only when it is complete.
"""


def main(argv=None):
    parser = cli.parser(
        "convert",
        DESCRIPTION,
        "convert 0425-traj1 --survey anchor_0425.txt --out 0425-traj1.bag",
        "convert const1-trial1-tdoa2.csv.gz --survey anchor_const1.csv --out const1.bag --storage sqlite3",
        "convert flight.log --survey anchors.yaml --out flight.bag --force --json",
    )
    parser.add_argument("input", metavar="IN", help="the recording; its kind is found by its content")
    parser.add_argument("--survey", metavar="S", help=inputs.SURVEY_HELP)
    parser.add_argument("--out", metavar="BAG", required=True, help="the bag to write, a new directory")
    parser.add_argument("--storage", choices=STORAGES, default="mcap", help="default: mcap")
    parser.add_argument("--force", action="store_true", help="replace an existing bag")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    return cli.run(convert, parser, argv)


def convert(args):
    """Convert as the parsed arguments say; raises InputError."""
    check_output(args.out, args.force)  # before the work, not after it
    flight = read_flight(args.input, inputs.survey_for(args.input, args.survey))
    counts = write_bag(flight, args.out, args.storage, args.force)
    streams = [stream for stream in (flight.tdoa, flight.imu, flight.truth) if stream is not None and len(stream)]
    known = (flight.anchors.index(flight.tdoa.a) >= 0) & (flight.anchors.index(flight.tdoa.b) >= 0)
    summary = {
        "flight": flight.name,
        "bag": args.out,
        "messages": counts,
        "start": min(float(stream.t[0]) for stream in streams),
        "end": max(float(stream.t[-1]) for stream in streams),
        "anchors": len(flight.anchors),
        "tdoa_unknown_anchor": int(np.count_nonzero(~known)),
        "left_out": {name: len(columns["t"]) for name, columns in flight.extra.items()},
        "meta": flight.meta,
    }
    if args.json:
        print(json.dumps(summary, indent=2, default=str))
        return
    print(
        f"{flight.name}: {summary['end'] - summary['start']:.1f} s, {flight.meta.get('protocol', 'protocol unknown')}"
    )
    for topic, count in counts.items():
        print(f"  {topic}: {count}")
    for name, count in summary["left_out"].items():
        print(f"  {name}: {count} events left out, a bag has no place for them")
    for topic, falls in flight.meta.get("reordered", {}).items():
        print(f"  {topic}: sorted, its stamps fell {falls} times")
    if summary["tdoa_unknown_anchor"]:
        print(f"  {summary['tdoa_unknown_anchor']} measurements name an anchor that the survey does not have")
    print(f"  -> {args.out}")


if __name__ == "__main__":
    sys.exit(main())
