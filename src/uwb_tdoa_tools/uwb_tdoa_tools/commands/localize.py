# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate where the tag was, and how far that can be trusted."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from .. import cli, options, parallel
from ..cli import OutputFile, option, positive

DESCRIPTION = """Where the tag was: trajectories of recordings, without ground truth, which is not read.

Runs bias correction and filter as the nodes would, or smooths. Writes for each recording to --out: NAME.tum (for evo), NAME.csv (with
velocities and standard deviations) and NAME.png (from above, from the side, over time, with three standard deviations); with --bag
NAME_bag (nav_msgs/Odometry), with --residuals what is left of each TDOA, as a table and as a picture per pair of anchors; with --zones
which anchors were heard where, and how well: a table and a map. NAME_stays.csv has the visits to the --areas, and where the tag was parked
(for 60 s or longer); of several tags, and with --areas, tags.png has all paths.

It says how far each trajectory is to be believed, and what would make it better. good: the position is within what is stated for 95 %
of the time; doubtful: the filter was lost, or restarted, or many TDOAs contradict it; bad: check finds an error, or there is none.

Exit code: 0 all are good, 1 some are not, 2 bad input."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "localize",
        DESCRIPTION,
        "localize flight_bag --out out/",
        "localize flight.log --survey anchors.yaml --smooth --residuals --out out/",
        (
            "localize flights/ --survey calibrated/anchors.yaml --effects calibrated/effects.yaml "
            "--config calibrated/ekf_node.yaml --out out/"
        ),
        "localize flight_bag --bag --json located.json --out out/",
        "localize hall_bag --zones 20 --out out/",
        "localize tag1_bag tag2_bag --areas areas.yaml --out out/",
        options=[
            *options.recordings(),
            *options.ESTIMATOR,
            option("--bag", action="store_true", help="write the odometry as a bag, too"),
            option(
                "--residuals",
                action="store_true",
                help="write what is left of each TDOA, too: a table, and a picture",
            ),
            option(
                "--zones",
                metavar="M",
                type=positive,
                help="write who is heard in squares of that size, and how well, too: a table, and a map",
            ),
            option(
                "--areas",
                metavar="FILE",
                help="YAML file of named areas, name: [[x, y], ...] in m: write when the tag enters and leaves",
            ),
            option("--json", metavar="FILE", type=OutputFile, help="write all figures"),
            options.JOBS,
            options.out(),
        ],
    )


def _localize(args: Namespace) -> int:
    from ..localizing import areas
    from ..localizing.localize import Localizer, all_good, check_names

    out = args.out
    named = areas.read_areas(args.areas) if args.areas else {}
    estimator = options.estimator_of(args)
    reading = options.reading_of(args, truth=False)
    found = reading.find(args.flights)
    check_names(found)
    out.mkdir(parents=True, exist_ok=True)
    cli.show(f"correcting with: {estimator.correction}")
    located = []
    localizer = Localizer(
        reading, estimator, out, args.bag, args.residuals, args.zones, args.effects, named
    )
    for one in parallel.over(localizer, found, args.jobs):
        located.append(one)
        first, *others = one.assessment.sentences()
        others += areas.sentences(one.stays)
        cli.show(f"{one.flight}: {first}", *(f"  {sentence}" for sentence in others))
        cli.show(f"  wrote {', '.join(path.name for path in one.written)} to {out}")
    if len(located) > 1 or named:
        areas.draw_tracks(
            out / "tags.png", {one.flight: (one.track, one.stays) for one in located}, named
        )
        cli.show(f"wrote tags.png to {out}")
    cli.write_json(args.json, {"flights": [one.as_dict() for one in located]})
    return int(not all_good(located))


main = cli.executable(_localize, parser)
