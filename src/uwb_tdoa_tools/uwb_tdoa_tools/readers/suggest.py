# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a first profile of a recording of others: what its tables seem to hold, and what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
import re
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.text import printable

from .by_profile import SINGLE, Foreign, as_number, open_recording
from .profile import RADIO, STREAMS, Source, load_profile, shipped
from .tables import CsvFiles, table_of

SAMPLE = 300  # messages of each table that are looked at
ENTRIES = 8  # of an array in each of them
LONGEST = 200  # characters of a path; longer ones are no name
SHOWN = 12  # fields of a table that is not recognized
FAST_TURN = 12.0  # rad/s; a larger reading of a gyroscope is in degrees/s
LONG = 200.0  # m; a UWB radio reaches less, so larger distances are in mm
# magnitude of the specific force in g and in m/s^2
GRAVITY_IN_G, GRAVITY_IN_SI = (0.7, 1.4), (7.0, 13.0)

# Names of fields, without the part before the last point.
ID = r"(anchor|to|dest|node|responder)?_?(id|addr|address)|mac_dest|uwb_id2|anchor|to"
RANGE = r"(meas_?|raw_?)?(range|distance|dist|dis)(_?(m|cm|mm|raw|meas))?"
TDOA = r".*(tdoa|ddoa|diff).*|data"
PAIRS = ("a", "b"), ("1", "2"), ("i", "j"), ("from", "to"), ("0", "1")
TIME = r"(t|time|stamp|timestamp)(_?(s|ms|us|ns))?"
# Names of whole paths.
GYRO = r"(.*(gyro|angular_velocity|ang_vel|rate).*?|w|g|.*[._]w)[._]?([xyz]|\[[012]\])"
ACCEL = r"(.*(acc|linear_acceleration|lin_acc).*?|a|.*[._]a)[._]?([xyz]|\[[012]\])"
PLACE = r"(.*(position|translation|location|pos|pose|p)[._])?([xyz]|\[[012]\])"
TRUTH = r"truth|mocap|vicon|vive|optitrack|qualisys|vrpn|gt_"
POSE = r"pose|tag_pos"  # of ground truth, or of an estimate
MISSING = {  # streams: lines on what to do without any of them
    RADIO: (
        "Missing: TDOAs or ranges. Write a source with topic and columns: anchor_a, anchor_b and",
        "tdoa, or anchor and range. If they are in an array of the message, add each: ARRAY.",
    ),
    ("gyro", "acc"): (
        "Missing: gyroscope and accelerometer. An estimate is possible without them.",
    ),
    ("pose",): ("Missing: ground truth. Only errors need it.",),
    ("anchors",): ("Missing: positions of the anchors. Give a survey with --survey.",),
}


@dataclass(frozen=True)
class Field:
    """A field of a table.

    Attributes
    ----------
    path : as in a profile.
    each : the array that it lies in, or "".
    values : (n,) numbers of some messages, NaN for texts.
    """

    path: str
    each: str
    values: np.ndarray

    @property
    def name(self) -> str:
        """Return the last part of the path, in small letters."""
        return self.path.rpartition(".")[2].lower()


@dataclass
class Suggestion:
    """A source of a first profile.

    Attributes
    ----------
    columns : {our column: their field, with unit}.
    each : path of the array.
    comments : sentences on what decided.
    doubtful : whether it is only written as a comment.
    """

    columns: dict[str, str]
    each: str = ""
    comments: list[str] = field(default_factory=list)
    doubtful: bool = False


def suggest(paths: Sequence[Path], salvage: bool = False) -> tuple[str, list[str]]:
    """Return the text of a first profile, and the names of shipped profiles that fit.

    Raises InputError.
    """
    types = {kind: text for name in shipped() for kind, text in load_profile(name).types.items()}
    with open_recording(paths, types, salvage) as tables:
        fitting = [name for name in shipped() if _fits(name, tables)]
        lines = [
            "# A first profile. Check each line, then give it with --profile (docs/recordings.md)."
        ]
        lines += [f"# The shipped profile {name} fits: --profile {name}" for name in fitting]
        lines += ["about: a first profile", "sources:"]
        found: set[str] = set()
        left = []
        for table in sorted(tables.types):
            suggestions = _suggestions(tables, table)
            for one in suggestions:
                streams = {
                    stream for stream, known in STREAMS.items() if known.keys() & one.columns.keys()
                }
                one.doubtful |= bool(streams & found & {*SINGLE})
                lines += _lines(tables, table, one)
                found |= set() if one.doubtful else streams
            if not suggestions:
                left.append(_unrecognized(tables, table))
        missing = [MISSING[streams] for streams in MISSING if not found & {*streams}]
        lines += [*(f"# {line}" for some in missing for line in some), *left]
    return "".join(f"{printable(line)}\n" for line in lines), fitting


def _fits(name: str, tables: Foreign) -> bool:
    """Return whether a shipped profile finds TDOAs or ranges."""
    sources = [source for source in load_profile(name).sources if {*RADIO} & {*source.columns}]
    return any(_has(tables, table, source) for table in tables.types for source in sources)


def _has(tables: Foreign, table: str, source: Source) -> bool:
    if not isinstance(tables, CsvFiles):
        return source.match(table, tables.types[table]) is not None
    named = source.match(table_of(table), tables.types[table]) is not None
    return named and {path for path, _ in source.columns.values()} <= {*tables.fields(table)}


def _lines(tables: Foreign, table: str, one: Suggestion) -> list[str]:
    """Return the lines of a source."""
    topic = table_of(table) if isinstance(tables, CsvFiles) else table
    lines = [
        f'  - topic: "{topic}" # {tables.types[table]}',
        *(f"    # {comment}" for comment in one.comments),
        *([f"    each: {one.each}"] if one.each else []),
        "    columns:",
        *(f'      {ours}: "{theirs}"' for ours, theirs in one.columns.items()),
    ]
    return [f"#{line}" for line in lines] if one.doubtful else lines


def _unrecognized(tables: Foreign, table: str) -> str:
    names = tables.fields(table)
    listed = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
    return f"# Not recognized: {table}, {tables.types[table]}, with {listed or 'unknown fields'}."


def _suggestions(tables: Foreign, table: str) -> list[Suggestion]:
    """Return the sources that a table seems to have."""
    try:
        records = [record for _, _, record in islice(tables.messages([table]), SAMPLE)]
    except InputError:
        return []
    if not records:
        return []
    fields = _fields(records, tables.fields(table))
    made = [*_tdoas(fields), *_inertial(fields), *_anchors(fields), *_poses(table, fields)]
    if not any(one.columns.keys() & {"tdoa"} for one in made):
        made += _ranges(fields)
    if isinstance(tables, CsvFiles):
        time = _time(fields)
        for one in made:
            one.columns = {**time, **one.columns}
    return made


def _fields(records: Sequence[Any], names: Sequence[str]) -> list[Field]:
    """Return the fields of a table with their values in some records."""
    paths: dict[str, str] = {}
    for record in records:  # an array may be empty in the first
        paths |= record.paths() if hasattr(record, "paths") else dict.fromkeys(names, "")
    out = []
    for path, each in paths.items():
        if len(path) > LONGEST:
            continue
        values = []
        for record in records:
            for index in range(ENTRIES) if each else (None,):
                try:
                    number = as_number(record.value(path, index))
                except (KeyError, IndexError):
                    break
                values.append(np.nan if number is None else number)
        out.append(Field(path, each, np.array(values)))
    return out


def _named(fields: Sequence[Field], pattern: str) -> list[Field]:
    return [one for one in fields if re.fullmatch(pattern, one.name, re.IGNORECASE)]


def _time(fields: Sequence[Field]) -> dict[str, str]:
    for one in fields:
        match = re.fullmatch(TIME, one.path, re.IGNORECASE)
        if match:
            return {"time": f"{one.path}:{(match[3] or 's').lower()}"}
    return {}


def _beside(one: Field, other: Field) -> bool:
    """Return whether two fields belong to the same record."""
    return one.each == other.each and one.path.rpartition(".")[0] == other.path.rpartition(".")[0]


def _tdoas(fields: Sequence[Field]) -> list[Suggestion]:
    for one in _named(fields, TDOA):
        others = [other for other in fields if other is not one and _beside(one, other)]
        for first, second in PAIRS:
            ids = [
                _named(others, rf"(anchor|node|id|uwb)?_?(id)?_?{end}(_?id)?")
                for end in (first, second)
            ]
            if all(ids):
                unit, why = _length("TDOA", one)
                why.append(
                    "Sign: distance to anchor_b minus distance to anchor_a. Otherwise write a minus."
                )
                columns = {"anchor_a": ids[0][0].path, "anchor_b": ids[1][0].path}
                return [Suggestion({**columns, "tdoa": one.path + unit}, one.each, why)]
    return []


def _ranges(fields: Sequence[Field]) -> list[Suggestion]:
    for one in _named(fields, RANGE):
        ids = [other for other in _named(fields, ID) if _beside(one, other)]
        if ids:
            unit, why = _length("range", one)
            columns = {"anchor": ids[-1].path, "range": one.path + unit}
            return [Suggestion(columns, one.each, why)]
    return []


def _length(what: str, one: Field) -> tuple[str, list[str]]:
    """Return the unit of lengths, and why."""
    known = np.abs(one.values[np.isfinite(one.values)])
    typical = float(np.median(known)) if len(known) else 0.0
    unit = "mm" if one.name.endswith("mm") or typical > LONG else "m"
    return f":{unit}", [f"The median {what} is {typical:.3g}, taken as {unit}."]


def _vector(fields: Sequence[Field], pattern: str, each: str = "") -> list[Field]:
    """Return x, y and z of a vector by the names of their paths; empty if there are not three."""
    by_axis: dict[str, Field] = {}
    for one in fields:
        match = re.fullmatch(pattern, one.path, re.IGNORECASE)
        if match and one.each == each:
            axis = match[3].lower().strip("[]").translate(str.maketrans("012", "xyz"))
            by_axis.setdefault(axis, one)
    return [by_axis[axis] for axis in "xyz"] if len(by_axis) == 3 else []


def _inertial(fields: Sequence[Field]) -> list[Suggestion]:
    gyro, accel = _vector(fields, GYRO), _vector(fields, ACCEL)
    if not gyro or not accel:
        return []
    rate = max(float(np.nanmax(np.abs(one.values), initial=0.0)) for one in gyro)
    force = float(np.nanmedian(np.linalg.norm([one.values for one in accel], axis=0)))
    in_g = GRAVITY_IN_G[0] < force < GRAVITY_IN_G[1]
    units = ("deg/s" if rate > FAST_TURN else "rad/s"), ("g" if in_g else "m/s^2")
    why = [
        f"The largest rate is {rate:.3g}, taken as {units[0]}.",
        f"The median specific force is {force:.3g}, taken as {units[1]}.",
        "Axes: x forward, y left, z up. With body: frd y points to the right, z down.",
    ]
    if not in_g and not GRAVITY_IN_SI[0] < force < GRAVITY_IN_SI[1]:
        why.append("That is not gravity: use a stream that still has it.")
    columns = {f"gyro_{axis}": f"{one.path}:{units[0]}" for axis, one in zip("xyz", gyro)}
    columns |= {f"accel_{axis}": f"{one.path}:{units[1]}" for axis, one in zip("xyz", accel)}
    return [Suggestion(columns, comments=why)]


def _anchors(fields: Sequence[Field]) -> list[Suggestion]:
    """Return positions with ids, each in an entry of an array."""
    for each in dict.fromkeys(one.each for one in fields if one.each):
        place = _vector(fields, PLACE, each)
        ids = [one for one in _named(fields, ID) if one.each == each]
        if place and ids:
            columns = {"anchor_id": ids[0].path}
            columns |= {f"anchor_{axis}": one.path for axis, one in zip("xyz", place)}
            return [Suggestion(columns, each, ["Positions of anchors, by their ids."])]
    return []


def _poses(table: str, fields: Sequence[Field]) -> list[Suggestion]:
    """Return a position that a name calls ground truth, or a doubtful one."""
    for pattern in (TRUTH, POSE):
        in_table = re.search(pattern, table, re.IGNORECASE)
        likely = [one for one in fields if in_table or re.search(pattern, one.path, re.IGNORECASE)]
        place = _vector(likely, PLACE)
        if place:
            break
    else:
        return []
    columns = {f"pose_{axis}": one.path for axis, one in zip("xyz", place)}
    paths = {one.path for one in fields}
    stem = re.sub(r"(position|translation)\.x$", "", place[0].path)
    for part in ("orientation", "rotation"):
        attitude = {f"pose_q{k}": f"{stem}{part}.{k}" for k in "xyzw"}
        if {*attitude.values()} <= paths:
            columns |= attitude
    doubtful = pattern == POSE
    why = [
        "A position that may be an estimate. Only ground truth belongs here."
        if doubtful
        else "Ground truth by its name, in the frame of the anchors."
    ]
    return [Suggestion(columns, comments=why, doubtful=doubtful)]
