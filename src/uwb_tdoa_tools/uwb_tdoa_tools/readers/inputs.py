# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find and read the recordings on a command line: files, folders, and their surveys."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import sys

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import FOLDER_DEPTH, FOLDER_ENTRIES, Budget, InputError, printable
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.common.sensors import LOCATING
from uwb_tdoa_bias.common.survey import as_named

from .. import parallel
from ..bags import BESIDE, is_bag, is_one_bag
from ..clock import apart, sentence_on
from . import read_by_profile, read_flight
from .profile import Profile

Recording = tuple[Path, str | Path | None]  # and its survey


_REPORTED: set[str | Path | None] = set()  # surveys whose use for bags was printed


def find_flights(paths: Iterable[str | Path], survey: str | Path | None = None) -> list[Recording]:
    """Return pairs (recording, survey or None), sorted within each folder.

    A given survey replaces the anchors in a bag, with a message. From a folder of surveys, the bag
    takes the fitting file, or keeps its own anchors.

    Raises InputError if a path has no recording, or if no survey fits.
    """
    found = []
    for path in map(Path, paths):
        if not path.exists():
            raise InputError(
                f"{path}: does not exist; give a recording or a folder that holds recordings."
            )
        inside = _recordings(path)
        if not inside:
            raise InputError(f"{path}: holds no recording; expected logs, CSV files or bags.")
        found += inside
    return [(path, _survey_of(path, survey)) for path in found]


def _survey_of(path: Path, survey: str | Path | None) -> str | Path | None:
    """Return the survey of a recording; None for a bag that keeps its own anchors.

    The choice for bags is printed on stderr, once per survey and process; None stands for surveys that
    do not fit.
    """
    if survey is None or not is_bag(path):
        return survey_for(path, survey)
    try:
        its_survey = survey_for(path, survey)
        sentence = (
            f"{path}: the anchors of {its_survey} count here, whatever anchors the bag holds; so "
            "in every bag that is read with it."
        )
    except InputError:
        its_survey = None
        sentence = (
            f"{path}: no survey in {survey} fits; the anchors that it holds count, as in "
            "other bags that none fits."
        )
    if its_survey not in _REPORTED:
        _REPORTED.add(its_survey)
        tqdm.write(printable(sentence), file=sys.stderr)
    return its_survey


def survey_for(path: str | Path, survey: str | Path | None) -> str | Path | None:
    """Return the survey of a recording; from a folder, the one whose KEY ends last in the path."""
    if survey is None or not Path(survey).is_dir():
        return survey
    keys = {
        file.stem.removeprefix("anchor_"): file for file in sorted(Path(survey).glob("anchor_?*"))
    }
    name = str(Path(path).resolve())
    fitting = sorted(
        (key for key in keys if key in name), key=lambda key: (name.rfind(key) + len(key), len(key))
    )
    if not fitting:
        raise InputError(
            f"{path}: no survey in {survey} fits: its path holds none of {', '.join(keys)}."
        )
    return keys[fitting[-1]]


def require_tdoas(flights: Iterable[Flight], what: str) -> None:
    """Raise InputError for a Flight without TDOAs; `what` names the step that needs them."""
    for flight in flights:
        if not len(flight.tdoa):
            raise InputError(
                f"{flight.name}: holds no TDOAs, which {what} needs; with ranges alone do "
                "check, evaluate, localize, survey, calibrate, and diagnose with ground "
                "truth or with nothing."
            )


def report_remarks(path: str | Path, remarks: Iterable[str]) -> None:
    """Print sentences on a recording on stderr, compatible with a progress bar."""
    for remark in remarks:
        tqdm.write(printable(f"{path}: {remark}"), file=sys.stderr)


@dataclass(frozen=True)
class Reading:
    """Options of reading recordings. Can be pickled.

    Attributes
    ----------
    survey : survey file, folder of surveys, or None.
    namespace : of the topics of the tag in bags.
    topics : {our name of a topic: its name in the bags}.
    salvage : read damaged recordings up to the damage.
    truth : read the ground truth, if there is one.
    profile : Profile of recordings of others; None for recordings of known kinds. With a profile each path
        is one recording: a file, or a folder of files that belong together.
    tag : id of the tag, if such a recording has several.
    """

    survey: str | Path | None = None
    namespace: str = ""
    topics: dict[str, str] = field(default_factory=dict)
    salvage: bool = False
    truth: bool = True
    profile: Profile | None = None
    tag: str = ""

    def find(self, paths: Iterable[str | Path]) -> list[Recording]:
        """Return pairs (recording, survey or None), see `find_flights`; empty without paths.

        Raises InputError if topics are given but no recording is a bag.
        """
        if self.profile:
            return [(path, survey_for(path, self.survey)) for path in map(Path, paths)]
        found = find_flights(paths, self.survey)
        if found and not any(is_bag(path) for path, _ in found):
            self._refuse_topics(found[0][0])
        return found

    def _refuse_topics(self, path: Path) -> None:
        for option, given in (("--namespace", self.namespace), ("--topic", self.topics)):
            if given:
                raise InputError(
                    f"{option}: says where topics are in bags, and {path} is none; leave it out."
                )

    def read(self, recording: Recording) -> Flight:
        """Read the Flight of a pair (recording, survey or None); print missing parts on stderr.

        Raises InputError.
        """
        path, survey = recording
        flight = self.flight([path], survey)
        report_remarks(path, flight.meta.get("remarks", ()))
        beside = {
            name: stream.t
            for name in ("tdoa", "imu", *SENSOR_NAMES)
            if (stream := getattr(flight, name)) is not None
        }
        report_remarks(path, (f"{sentence_on(*one)}." for one in apart(beside)))
        return flight

    def flight(self, paths: Sequence[str | Path], survey: str | Path | Anchors | None) -> Flight:
        """Return the Flight of one recording; with a profile it may have several files.

        Raises InputError.
        """
        if self.profile:
            return read_by_profile(
                paths,
                self.profile,
                as_named(survey),
                self.tag,
                self.namespace,
                self.salvage,
                self.truth,
            )
        return read_flight(paths[0], survey, self.namespace, self.salvage, self.topics, self.truth)

    def one(self, *paths: str | Path) -> Flight:
        """Read the Flight of one recording; with a profile it may have several files.

        Raises InputError.
        """
        path = Path(paths[0])
        if self.profile:
            return self.flight(paths, survey_for(path, self.survey))
        if len(paths) > 1:
            raise InputError(
                f"IN: {len(paths)} recordings are given; convert one by one, or name --columns "
                "or --profile."
            )
        if path.exists() and not is_bag(path):
            self._refuse_topics(path)
        return self.read((path, _survey_of(path, self.survey)))

    def flights(
        self,
        paths: Iterable[str | Path],
        most: int | None = None,
        jobs: int | None = 1,
    ) -> list[Flight]:
        """Read the Flights of recordings and folders, with a progress bar.

        Parameters
        ----------
        most : largest total number of TDOAs and ranges, except for the first flight. Above it,
            whole flights are drawn at random, with a fixed seed. This bounds memory and time.
        jobs : see `parallel.over`.
        """
        found, count = self.find(paths), 0
        read: dict[int, Flight] = {}
        order = (
            range(len(found))
            if most is None
            else np.random.default_rng(0).permutation(len(found)).tolist()
        )
        for flight, number in zip(
            parallel.over(self.read, [found[number] for number in order], jobs), order
        ):
            count += len(flight.tdoa) + sum(len(getattr(flight, name) or ()) for name in LOCATING)
            if most is not None and read and count > most:
                tqdm.write(
                    f"{len(read)} of {len(found)} flights, drawn at random, are taken: all "
                    f"would hold more than {most} TDOAs (--most); "
                    "evaluate judges on all of them",
                    sys.stderr,
                )
                break
            read[number] = flight
        return [read[number] for number in sorted(read)]


def _recordings(path: Path) -> list[Path]:
    """Return the recordings in a folder at any depth, or the path itself if it is one.

    Bags that are single files may lie in a folder. Files that SQLite leaves next to them do not
    count. A folder with several links to it is searched once.
    """
    budget, seen, found = Budget(path), set(), []

    def look(path: Path, depth: int) -> None:
        if path.is_file() or (path.is_dir() and is_one_bag(path)):
            found.append(path)
        elif path.is_dir() and (place := path.stat()[1:3]) not in seen:
            seen.add(place)
            if depth > FOLDER_DEPTH:
                budget.spend("levels of folders", depth, FOLDER_DEPTH)
            for inside in sorted(path.iterdir()):
                budget.spend("entries", 1, FOLDER_ENTRIES)
                if not inside.name.startswith(".") and not inside.name.endswith(BESIDE):
                    look(inside, depth + 1)

    look(path, 0)
    return found
