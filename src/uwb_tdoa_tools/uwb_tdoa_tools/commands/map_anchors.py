# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make a first map of anchors whose positions are unknown."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from uwb_tdoa_bias.common.errors import InputError

from .. import choices, cli, command_lines, options
from ..cli import option

DESCRIPTION = """Make a first map of anchors whose positions are unknown.

The data are flights, distances between anchors, or both. --survey names the few anchors that are known: two, far
apart, define the frame (z up). Ground truth is not used. Flights need TDOAs or ranges of all anchors, and an inertial
sensor, which settles what is up and which of two mirror images is right. Without an inertial sensor, give
--coordinates: heights of anchors, and a rough coordinate of one anchor off the line of the known ones.

The command writes a map only if one map alone explains the data, and if its standard deviations are below --accuracy.
Otherwise it prints what is open and what would settle it.

Writes anchors.yaml and anchors.csv (a map that is accepted), map.json (covariance, other maps) and map.png to --out.

Exit code: 0 a map; 1 the data leave the map open or contradict each other; 2 bad input."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "map_anchors",
        DESCRIPTION,
        "map_anchors flight_bag --survey two.yaml --out map/",
        "map_anchors first_bag second_bag --survey two.yaml --coordinates heights.csv --out map/",
        "map_anchors --survey three.yaml --distances laser.csv --coordinates side.csv --out map/",
        "map_anchors --survey three.yaml --distances radio.csv --delay-std 0.1 --out map/",
        options=[
            *options.recordings(nargs="*"),
            option(
                "--coordinates",
                metavar="FILE",
                help="CSV with columns anchor, axis, value, std: single coordinates of anchors, m; rough ones too",
            ),
            options.DISTANCES,
            option(
                "--delay-std",
                type=float,
                default=0.0,
                metavar="M",
                help=(
                    "m, standard deviation of the antenna delay of each anchor in --distances, if a radio "
                    "measured them (default 0: by laser)"
                ),
            ),
            option(
                "--trusted-std",
                type=float,
                default=choices.TRUSTED_STD,
                metavar="M",
                help="m, standard deviation of the coordinates in --survey (default %(default)s)",
            ),
            option(
                "--accuracy",
                type=float,
                default=choices.MAP_ACCURACY,
                metavar="M",
                help="m, largest 3D standard deviation of an anchor in a map that is written (default %(default)s)",
            ),
            option("--seed", type=int, default=0, metavar="N", help="of the search (default 0)"),
            options.out(),
        ],
    )


def _map_anchors(args: Namespace) -> int:
    from ..first_map import map_anchors
    from ..first_map.observations import given
    from ..first_map.verdict import as_dict, as_text, picture

    _check(args)
    reading = options.reading_of(args, truth=False)
    flights = reading.flights(args.flights)
    with cli.Progress("map_anchors", what="looking at the measurements") as progress:
        seen, frame = given(
            flights,
            args.survey,
            (args.coordinates, args.distances),
            (args.trusted_std, args.delay_std),
        )
        found = map_anchors(seen, args.accuracy, args.seed, progress)
    args.out.mkdir(parents=True, exist_ok=True)
    cli.write_json(args.out / "map.json", as_dict(found))
    picture(found, args.out / "map.png")
    cli.show(as_text(found))
    if found.why_not:
        cli.show(f"wrote map.json and map.png to {args.out}")
        return 1
    anchors = found.anchors(frame)
    anchors.to_yaml(args.out / "anchors.yaml")
    anchors.to_csv(args.out / "anchors.csv")
    cli.show(f"wrote anchors.yaml, anchors.csv, map.json and map.png to {args.out}")
    if args.flights:
        survey = "--survey", args.out / "anchors.yaml"
        words = [*options.words_of_reading(args), "--out", "localized/"]
        line = command_lines.tool("localize", *args.flights, *survey, *words)
        cli.show(f"next: {line}")
    return 0


def _check(args: Namespace) -> None:
    """Raise InputError for options that leave nothing to do, or have no meaning."""
    if args.survey is None:
        raise InputError("--survey: is missing; name the anchors that are known, two at least.")
    if not args.flights and args.distances is None:
        raise InputError("FLIGHT: is missing; give flights, or --distances between anchors.")
    for name, least in (("delay_std", 0.0), ("trusted_std", 1e-4), ("accuracy", 1e-3)):
        value = getattr(args, name)
        if not least <= value <= 100.0:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option}: {value:g} must be from {least:g} to 100 m.")
    if args.seed < 0:
        raise InputError(f"--seed: {args.seed} must be 0 or more.")


main = cli.executable(_map_anchors, parser)
