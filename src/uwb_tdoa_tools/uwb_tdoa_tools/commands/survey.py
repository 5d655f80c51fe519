# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Improve surveyed anchors by flights."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from .. import cli, command_lines, options, parallel

DESCRIPTION = """Improve a tape-measured survey, from flights alone.

Ground truth is not used. Shifts and delays of the anchors are estimated so that TDOAs or ranges agree with each other and
with the IMU (and with a range finder, if there is one). The coordinates that are known best define the frame: name some
with --trusted, or the anchors stay in place on average.

With the anchors.yaml and effects.yaml (--effects) of last week it starts from that calibration, lists the changes since,
and improves the rest.

Writes anchors.yaml and anchors.csv (for --survey, anchors_file and the rest), effects.yaml (delays of the
anchors, and how well all is known), ekf_node.yaml (noise of TDOAs that the filter should assume with them), survey.json
(covariance) and survey.png (before and after) to --out.

Exit code: 0 done; 1 ids, signs or units are wrong, the survey is of another room, or something else that other anchors might make
worse: they stay as given; 2 bad input."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "survey",
        DESCRIPTION,
        "survey flight_bag --survey tape.yaml --trusted 0 4 1.z 2.z --out surveyed/",
        (
            "survey first_bag second_bag third_bag --survey tape.csv --std 0.3 --height-std 0.05 "
            "--out surveyed/"
        ),
        "survey flight_bag --survey tape.yaml --unknown 5 --out surveyed/",
        (
            "survey flight_bag --survey tape.yaml --marks marks.yaml --distances laser.csv --out "
            "surveyed/"
        ),
        (
            "survey today_bag --survey surveyed/anchors.yaml --effects surveyed/effects.yaml "
            "--out today/"
        ),
        options=[
            *options.recordings(),
            *options.filtering(
                "effects.yaml: effects in the model already; the file of an earlier survey is the prior"
            ),
            options.PARAMETERS,
            *options.TAPE,
            *options.KNOWN,
            options.JOBS,
            options.out(),
        ],
    )


def _survey(args: Namespace) -> int:
    from uwb_tdoa_bias.effects import EffectSet

    from ..checking.check import nothing_comes_first, remark_on_surveys
    from ..diagnosis.noise import has_imu, write_parameters
    from ..diagnosis.self_calibration import self_calibrate
    from ..estimate import FlightEstimator
    from ..surveying.report import as_dict, as_text, picture, with_blocked

    out = args.out
    config, effects = options.filter_of(args)
    base, tape = effects or EffectSet(), options.tape_of(args, effects)
    reading, judge = options.reading_of(args), FlightEstimator(config, base)
    if not args.unknown and not nothing_comes_first(
        "survey",
        reading,
        args.flights,
        judge,
        max(tape.std, tape.height_std or 0.0),
    ):
        return 1
    jobs, over = parallel.workers_for(args, len(reading.find(args.flights)))
    flights = reading.flights(args.flights, None, jobs)
    remarks = remark_on_surveys([its for _, its in reading.find(args.flights)], flights)
    cli.say("survey", *remarks, *judge.remarks(flights[0].anchors))
    known = options.known_of(args, flights)
    with cli.Progress("survey") as progress:
        result = self_calibrate(
            flights, tape, base, config, known, lambda: progress("solving"), over
        )
        result = with_blocked(
            result, flights, config, lambda: progress("looking for what blocks anchors")
        )
    out.mkdir(parents=True, exist_ok=True)
    anchors = result.anchors
    anchors.to_yaml(out / "anchors.yaml")
    anchors.to_csv(out / "anchors.csv")
    result.effects.to_yaml(out / "effects.yaml")
    config_file = write_parameters(out / "ekf_node.yaml", result.tdoa_std, config, has_imu(flights))
    cli.write_json(out / "survey.json", as_dict(result))
    picture(result, out / "survey.png")
    cli.show(as_text(result))
    cli.show(
        "wrote anchors.yaml, anchors.csv, effects.yaml, ekf_node.yaml, survey.json and survey.png "
        f"to {out}"
    )
    if result.why_not is None:
        files = out / "anchors.yaml", out / "effects.yaml", config_file
        truth = all(flight.truth is not None for flight in flights)
        cli.show(
            "next: "
            f"{command_lines.evaluate_line(args.flights, *files, truth, options.words_of_reading(args))}"
        )
    return 0 if result.why_not is None else 1


main = cli.executable(_survey, parser)
