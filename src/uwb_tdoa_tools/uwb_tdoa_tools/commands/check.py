"""check: what a driver may have got wrong, found in a recording before anything else is done with it."""

from pathlib import Path
import sys

from tqdm import tqdm

from .. import cli, options
from ..checking import report
from ..checking.check import check, different_surveys
from ..checking.recording import read_recording
from ..readers import read_survey

DESCRIPTION = """Check recordings against a survey, before anything else.

Finds what a driver, a survey or a clock may have got wrong: sign and unit of the TDOAs, ids of the anchors, the survey
of another room, units and axes of the IMU, stamps, rates, repeats, two senders, frames. Each finding has its evidence,
and a line to copy. Where --survey is a folder, the survey that fits is named, too. Ground truth is not needed, and not
used.

Exit code: 0 nothing is wrong (there may be warnings), 1 there are errors, 2 bad input."""


def main(argv=None):
    """The executable. Returns the exit code."""
    return cli.run(_check, parser(), argv)


def parser():
    """Its options."""
    made = cli.parser(
        "check",
        DESCRIPTION,
        "check flight.bag",
        "check 0425-traj2 --survey anchor_0425.txt",
        "check flights/ --survey surveys/",
        "check flight.bag --survey surveyed_again.yaml --json findings.json",
        "check tags.bag --topic uwb/tdoa=/tag1/tdoa --topic imu/data=/tag1/imu",
    )
    options.add_recordings(made)
    made.add_argument("--json", metavar="FILE", help="write all findings")
    return made


def _check(args):
    cli.check_folders(args.json)
    reading = options.reading_of(args)
    surveys = Path(args.survey) if args.survey else None
    others = _surveys(surveys) if surveys and surveys.is_dir() else []
    alone = None if others else surveys  # one survey is for bags too, which bring their own otherwise
    reports, recordings = [], []
    for path, survey in tqdm(reading.find(args.flights), desc="checking", unit="flight", disable=None, leave=False):
        recordings.append(read_recording(reading, path, survey or alone))
        for remark in recordings[-1].remarks:
            cli.say("check", f"{path}: {remark}")
        reports.append(check(recordings[-1], others))
        tqdm.write(report.text(reports[-1]))
    together = list(different_surveys(recordings))
    for finding in together:
        print("\n".join(report.lines(finding)))
    if args.json:
        cli.write_json(args.json, report.as_dict(reports, together))
    return int(any(one.faulty for one in reports))


def _surveys(folder):
    """[(path, Anchors)] of a folder of surveys."""
    return [(str(path), read_survey(path)) for path in sorted(folder.glob("anchor_?*"))]


if __name__ == "__main__":
    sys.exit(main())
