# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check recordings for mistakes of drivers, before anything else uses them."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError

from .. import cli, command_lines, options
from ..cli import OutputFile, option, positive

if TYPE_CHECKING:
    from argparse import ArgumentParser, Namespace
    from collections.abc import Iterator

    from ..checking.recording import Recording
    from ..readers.inputs import Reading

DESCRIPTION = """Check recordings, or live topics, against a survey, before anything else.

Finds what a driver, a survey or a clock may have got wrong: sign and unit of the TDOAs, ids of the anchors, the survey
of another room, units and axes of the IMU, stamps, rates, repeats, two senders, frames. The monitor of ekf_node runs over
the recording, too: it names anchors that were moved or exchanged, before it or on the way, by the survey, and with
--effects by the last calibration. Each finding has its evidence, and a line to copy. Where --survey is a folder, the survey
that fits is named, too. Ground truth is not needed, and not used. With --live it listens to the topics themselves, and also
says who publishes and hears them, and with which QoS.

Exit code: 0 nothing is wrong (there may be warnings), 1 there are errors, 2 bad input."""


def parser() -> ArgumentParser:
    """Its options."""
    return cli.parser(
        "check",
        DESCRIPTION,
        "check flight_bag",
        "check 0425-traj2 --survey anchor_0425.txt",
        "check flights/ --survey surveys/",
        "check flight_bag --survey surveyed_again.yaml --json findings.json",
        "check today_bag --survey surveyed/anchors.yaml --effects surveyed/effects.yaml",
        "check --live 60",
        "check --live 60 --namespace tag1 --survey anchors.yaml",
        "check tags_bag --topic uwb/tdoa=/tag1/tdoa --topic imu/data=/tag1/imu",
        options=[
            *options.recordings(nargs="*"),
            *options.filtering(
                "effects.yaml: what is calibrated; its covariance says how well anchors are known"
            ),
            option(
                "--live",
                metavar="S",
                type=positive,
                help="listen to live topics for S seconds instead",
            ),
            option("--json", metavar="FILE", type=OutputFile, help="write all findings"),
        ],
    )


def _check(args: Namespace) -> int:
    from uwb_tdoa_bias.common.survey import read_named_anchors

    from ..checking.check import as_dict, check, different_surveys, lines
    from ..estimate import FlightEstimator

    if bool(args.flights) == (args.live is not None):
        raise InputError("FLIGHT, --live: give recordings, or --live SECONDS, and not both.")
    reading, estimator = options.reading_of(args), FlightEstimator(*options.filter_of(args))
    surveys = Path(args.survey) if args.survey else None
    folder = sorted(surveys.glob("anchor_?*")) if surveys and surveys.is_dir() else []
    others = [(str(path), read_named_anchors(path).anchors) for path in folder]
    alone = None if others else surveys
    reports, recordings = [], []
    for recording, path, survey in _recordings(args, reading, alone):
        recordings.append(recording)
        remarks = estimator.remarks(recording.anchors)
        cli.say("check", *(f"{recording.name}: {remark}" for remark in remarks))
        line = command_lines.survey_line(path, survey, args.effects) if path else None
        reports.append(check(recording, others, estimator, line))
        cli.show(reports[-1].text())
    together = list(different_surveys(recordings))
    for finding in together:
        cli.show(*lines(finding))
    cli.write_json(args.json, as_dict(reports, together))
    return int(any(one.faulty for one in reports))


def _recordings(
    args: Namespace, reading: Reading, survey: str | Path | None
) -> Iterator[tuple[Recording, Path | None, str | Path | None]]:
    """Yield each Recording with its path and that of its survey; (Recording, None, None) if live.

    survey : path of the one survey, or None.
    """
    from ..checking.recording import read_live, read_recording

    if args.live is not None:
        yield read_live(reading, args.live, survey, partial(cli.say, "check")), None, None
    found = reading.find(args.flights)
    with cli.Progress("check", len(found), "flight") as progress:
        for path, its_survey in found:
            recording = read_recording(reading, path, its_survey)
            cli.say("check", *(f"{path}: {remark}" for remark in recording.remarks))
            yield recording, path, its_survey
            progress.update()


main = cli.executable(_check, parser)
