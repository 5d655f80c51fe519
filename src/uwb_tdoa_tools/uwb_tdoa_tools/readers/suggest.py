# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a first profile of a recording of others: what its tables seem to hold, and what is missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
import re
import shlex

import numpy as np

from uwb_tdoa_bias.common.errors import InputError, printable
from uwb_tdoa_bias.common.files import read_head

from ..command_lines import suggest_line
from .by_profile import SINGLE, as_time, files_of, open_recording
from .profile import LENGTH, RADIO, STREAMS, TIME, UNITS, Source, as_text, load_profile, shipped
from .tables import CsvFiles, Foreign

SAMPLE = 3000  # messages of each table that are looked at
LONGEST = 200  # characters of a path; longer ones are no name
SHOWN = 12  # fields of a table that is not recognized
MOST_ANCHORS = 64  # different ids in a column of a table without names
RISING = 0.95  # share of steps that are not back in time, in its stamps
FEWEST_COLUMNS = 3  # of pairs or anchors with a column each
FAST_TURN = 12.0  # rad/s; a larger reading of a gyroscope is in degrees/s
LONG, VERY_LONG = 100.0, 450.0  # m; larger distances are in cm, and in mm
# magnitude of the specific force
GRAVITY = {"g": (0.7, 1.4), "m/s^2": (7.0, 13.0), "mg": (7e2, 1.4e3), "mm/s^2": (7e3, 1.3e4)}
# s between two stamps at most: of any sensor, and of an IMU or in whole numbers
LONG_STEP, USUAL_STEP = 2.0, 0.5
CALENDAR = 1e9, 4e9  # s since 1970

# Names of fields, without the part before the last point.
ID = r"(anchor|to|dest|node|responder)?_?(id|addr|address)|mac_dest|uwb_id2|anchor|to"
RANGE = r"(meas_?|raw_?)?(range|distance|dist|dis)(_?(m|cm|mm|raw|meas))?|[dr]|value"
TDOA = r".*(tdoa|ddoa|diff|delta).*|data|d|value"
PAIRS = ("a", "b"), ("1", "2"), ("i", "j"), ("from", "to"), ("src", "dst"), ("0", "1")
TIME_NAME = (
    r"(.*[_ ])?(ts?|time|stamp|timestamp|epoch|elapsed|clock|utc|[mun]?secs?|seconds?|date"
    r"|(milli|micro|nano)s)"
)
# Names of whole paths.
UNIT = r"[ _(\[]+([numk]?s|[cm]?m|ft|ticks|m?g|deg/s|rad/s|dps|m/s\^?2)[)\]]?"  # at the end
SECONDS = r"(.*?)_?(s|secs?|seconds?)"
UNIT_OF_FRACTION = {"n": "ns", "nano": "ns", "u": "us", "micro": "us", "m": "ms", "milli": "ms"}
FRACTION = r"(.*?)_?(n|nano|u|micro|m|milli)_?(s|secs?|seconds?)"
PAIR, SINGLE_ANCHOR = r"(.*?)(\d+)(\D+)(\d+)", r"(.*?)(\d+)(\D*)"
DISTANCE = (
    r"(.*[._])?(.*(range|dist|uwb|anchor).*|[dra]_?)"  # beginning of a column for each anchor
)
# A word that may name a kind of rows, and a word that does
WORD, SENSOR = r"[A-Za-z_]{2,}", r"tdoa|imu|gyro|acc|range|twr|rssi|baro|pose|mag|uwb"
DAY, CLOCK = r"\d{4}[-/]\d\d?[-/]\d\d?", r"\d\d?:\d\d:\d\d.*"
GYRO = r"(.*(gyro|angular_velocity|ang_vel|rate).*?|w|g|.*[._]w)[._ ]?([xyz]|\[[012]\])"
ACCEL = r"(.*(acc|linear_acceleration|lin_acc).*?|a|.*[._]a)[._ ]?([xyz]|\[[012]\])"
TRUTH = r"truth|mocap|vicon|vive|optitrack|qualisys|vrpn|gt_"
PLACE = rf"(.*(position|translation|location|pos|pose|p|{TRUTH})[._]|p)?([xyz]|\[[012]\])"
ATTITUDE = r"(.*[._])?(?:q|quat|quaternion|orientation|rotation|rot)[._ ]?([xyzw])"
POSE = r"pose|tag_pos"  # of ground truth, or of an estimate
# Columns of `ros2 topic echo --csv` by the number of columns: our names by place
ECHOED = {
    40: {16: "gyro_x", 17: "gyro_y", 18: "gyro_z", 28: "accel_x", 29: "accel_y", 30: "accel_z"},
    10: {3: "pose.x", 4: "pose.y", 5: "pose.z"},
}
SIGN = "Sign: distance to anchor_b minus distance to anchor_a. Otherwise write a minus."
BY_VALUES = "The names of the columns say nothing, so their values decided. Check them."
NO_TIME = (
    "no column with the time is recognized; write time: COLUMN:UNIT (s, ms, us or ns) under columns. "
    "A text such as 2024-03-31 01:59:45.123 is in s."
)
WRITE_RADIO = "under columns which column is anchor_a, anchor_b and tdoa, or anchor and range."
NO_RADIO = f"no TDOAs or ranges are recognized; write {WRITE_RADIO}"
MISSING = {  # streams: lines on what to do without any of them
    RADIO: (
        f"Missing: TDOAs or ranges. Write {WRITE_RADIO}",
        "If they are in an array of the message, add each: ARRAY.",
    ),
    ("gyro", "acc"): (
        "Missing: gyroscope and accelerometer. An estimate is possible without them.",
    ),
    ("pose",): ("Missing: ground truth. Only errors need it.",),
    ("anchors",): ("Missing: positions of the anchors. Give a survey with --survey.",),
}
# Files of arrays, by their first bytes
NO_TEXTS = {
    b"PK\x03\x04": "a zip file, as Excel and numpy (.npz) write",
    b"\x93NUMPY": "an array of numpy",
    b"MATLAB": "a file of MATLAB",
    b"\x89HDF": "an HDF5 file",
    b"PAR1": "a Parquet file",
}
# Texts that are no tables: what they are, their pattern, and a line that makes a table of them
_ROWS = 'BEGIN {print "t,anchor,range,anchor_x,anchor_y,anchor_z"} '
TEXTS = {
    "lec": (
        r"\bDIST,\d+,AN0,",
        f"awk '{_ROWS}match($0, /[, ]*DIST,/) {{t = substr($0, 1, RSTART - 1); "
        "n = split(substr($0, RSTART), p, /[, ]+/); for (i = 1; i < n; i++) if (p[i] ~ /^AN[0-9]+$/) "
        'print t "," p[i+1] "," p[i+5] "," p[i+2] "," p[i+3] "," p[i+4]}' + "'",
    ),
    "les": (
        r"\b[0-9A-F]{4}\[[^]]*\]=",
        f"awk '{_ROWS}match($0, /[, ]*[0-9A-F][0-9A-F][0-9A-F][0-9A-F]\\[/) "
        "{t = substr($0, 1, RSTART - 1); n = split(substr($0, RSTART), w, /[ ]+/); "
        "for (i = 1; i <= n; i++) if (w[i] ~ /]=/) {split(w[i], p, /[][=]+/); "
        'print t "," p[1] "," p[3] "," p[2]}}' + "'",
    ),
}


@dataclass(frozen=True)
class Field:
    """A field of a table.

    Attributes
    ----------
    path : as in a profile.
    each : the array that it lies in, or "".
    values : (n,) numbers of some messages, NaN for texts.
    texts : their texts.
    alias : the name that its values suggest, where tables have no names.
    """

    path: str
    each: str
    values: np.ndarray
    texts: list[str]
    alias: str = ""

    @property
    def is_whole(self) -> bool:
        """Return whether all values are whole numbers."""
        return len(self.values) > 0 and not np.any(self.values % 1.0)

    @property
    def known(self) -> str:
        """Return the path, or the alias, without a unit."""
        return re.sub(f"{UNIT}$", "", self.alias or self.path)

    @property
    def name(self) -> str:
        """Return the last part of it, in small letters."""
        return self.known.rpartition(".")[2].lower()

    @property
    def unit(self) -> str:
        """Return the unit in the path, or ""."""
        found = re.search(f"{UNIT}$", self.path)
        return found[1].replace("dps", "deg/s") if found else ""


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


def suggest(paths: Sequence[Path], salvage: bool = False) -> tuple[str, list[str], str, bool]:
    """Return a first profile, and what is known of it.

    Returns
    -------
    text : of the profile.
    fitting : names of the shipped profiles that fit.
    problem : why nothing can be read with it, or "".
    has_anchors : whether the recording has positions of anchors.

    Raises InputError, also for a text that is no table.
    """
    for path in files_of(paths):
        _refuse_text(path)
    types = {kind: text for name in shipped() for kind, text in load_profile(name).types.items()}
    with open_recording(paths, types, salvage) as tables:
        fitting = [name for name in shipped() if _fits(name, tables, {*RADIO})]
        lines = [
            "# A first profile. Check each line, then give it with --profile (docs/recordings.md).",
            *(f"# The shipped profile {name} fits: --profile {name}" for name in fitting),
            "about: a first profile",
            "sources:",
        ]
        found: set[str] = set()
        left, untimed = [], False
        for table in sorted(tables.types):
            suggestions = _suggestions(tables, table)
            for one in suggestions:
                streams = {
                    stream for stream, known in STREAMS.items() if known.keys() & one.columns.keys()
                }
                one.doubtful |= bool(streams & found & {*SINGLE})
                untimed |= isinstance(tables, CsvFiles) and "time" not in one.columns
                lines += _lines(tables, table, one)
                found |= set() if one.doubtful else streams
            if not suggestions:
                _refuse_lines_above(Path(table))
                left.append(_unrecognized(tables, table))
        if tables.recorded_anchors() or (fitting and _fits(fitting[0], tables, {"anchors"})):
            found.add("anchors")
        missing = [MISSING[streams] for streams in MISSING if not found & {*streams}]
        lines += [*(f"# {line}" for some in missing for line in some), *left]
        problem = NO_TIME if untimed else "" if found & {*RADIO} else NO_RADIO
    text = "".join(f"{printable(line)}\n" for line in lines)
    return text, fitting, "" if fitting else problem, "anchors" in found


def _refuse_text(path: Path) -> None:
    """Raise InputError for a text that is no table, with a line that makes a table of it."""
    start = b"" if path.is_dir() else read_head(path, 1 << 12)
    for magic, what in NO_TEXTS.items():
        if start.startswith(magic):
            raise InputError(
                f"{path}: is {what}, no text; save it as CSV, or give the arrays to uwb_tdoa.flight "
                "(docs/python.md)."
            )
    head = start.decode("utf-8", "replace")
    for command, (pattern, line) in TEXTS.items():
        if re.search(pattern, head):
            raise InputError(
                f"{path}: is the output of {command} of a DWM1001. It is no table; make one, with the "
                f"time before each record as it is: {line} {shlex.quote(str(path))} > ranges.csv; "
                f"then: {suggest_line('ranges.csv')}"
            )
    for column in (0, 1):
        _refuse_kinds(path, head.splitlines()[:-1], column)


def _refuse_kinds(path: Path, lines: Sequence[str], column: int) -> None:
    """Raise InputError if a word in a column of each line names one of several kinds of rows."""
    rows = [re.split("[,;\t]", line) for line in lines]
    words = [row[column].strip() if len(row) > column else "" for row in rows]
    sizes = {  # of the rows of each kind: most cells that are filled
        kind: max(sum(map(bool, row)) for row, word in zip(rows, words) if word == kind)
        for kind in words
        if words.count(kind) > 1
    }
    differ = len({*sizes.values()}) > 1 or re.search(SENSOR, " ".join(sizes), re.IGNORECASE)
    if len(sizes) > 1 and differ and all(re.fullmatch(WORD, word) for word in words):
        header = "" if words[0] in sizes else f"-e {words[0]} "
        split = [
            f"grep -w {header}-e {kind} {shlex.quote(str(path))} > {kind.lower()}.csv; "
            for kind in sizes
        ]
        raise InputError(
            f"{path}: has rows of several kinds, {', '.join(sizes)}; make a file of each: "
            f"{''.join(split)}then: " + suggest_line(*(f"{kind.lower()}.csv" for kind in sizes))
        )


def _refuse_lines_above(path: Path) -> None:
    """Raise InputError if a table that is not recognized has titles or units above its header."""
    text = read_head(path, 1 << 12).decode("utf-8", "replace") if path.is_file() else ""
    widths = [len(re.split("[,;\t]", line)) for line in text.splitlines()[:-1]]
    above = widths.index(max(widths)) if widths else 0
    if above and {*widths[above:]} == {max(widths)}:
        raise InputError(
            f"{path}: has {above} lines above its table; leave them out: tail -n +{above + 1} "
            f"{shlex.quote(str(path))} > table.csv; then: {suggest_line('table.csv')}"
        )


def _fits(name: str, tables: Foreign, streams: set[str]) -> bool:
    """Return whether a shipped profile finds one of some streams."""
    wanted = {column for stream in streams for column in STREAMS[stream]}
    return any(
        wanted & {*source.columns} and _has(tables, table, source)
        for source in load_profile(name).sources
        for table in tables.types
    )


def _has(tables: Foreign, table: str, source: Source) -> bool:
    is_meant = source.match(tables.topic(table), tables.types[table]) is not None
    paths = {path for path, _ in source.columns.values()}
    return is_meant and (not isinstance(tables, CsvFiles) or paths <= {*tables.fields(table)})


def _lines(tables: Foreign, table: str, one: Suggestion) -> list[str]:
    """Return the lines of a source."""
    lines = [
        f'  - topic: "{tables.topic(table)}" # {tables.types[table]}',
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


def _suggestions(tables: Foreign, table: str, by_values: bool = False) -> list[Suggestion]:
    """Return the sources that a table seems to have.

    by_values : whether only the values of its columns decide
    """
    try:
        sample = tables.sample(table, SAMPLE)
    except InputError:
        return []
    fields = [
        Field(path, each, np.array([*map(as_time, values)], float), [*map(as_text, values)])
        for (path, each), values in sample.items()
        if len(path) <= LONGEST and any(map(as_text, values))
    ]
    is_csv = isinstance(tables, CsvFiles)
    by_values = by_values or is_csv and all(one.path.isdecimal() for one in fields)
    if by_values:
        fields = _with_aliases(fields)
    inertial = _inertial(fields)
    time, why = _time(fields, bool(inertial)) if is_csv else ("", "")
    fields = _with_lists(fields) if is_csv else fields
    made = _radio(fields) or (_wide(fields) if is_csv else [])
    made += [*inertial, *_anchors(fields), *_poses(table, fields)]
    for one in made:
        one.columns = {**({"time": time} if time else {}), **one.columns}
        one.comments += [*filter(None, [why, BY_VALUES if by_values else ""])]
    if made or by_values or not is_csv:
        return made
    # an id and a number may be anything, and two ids with a signed number hardly
    return [one for one in _suggestions(tables, table, True) if "anchor_b" in one.columns]


def _with_aliases(fields: Sequence[Field]) -> list[Field]:
    """Return the fields of a table without names, with aliases by their values."""
    steps = [np.diff(one.values) for one in fields]
    few = [1 < len({*one.texts}) <= MOST_ANCHORS for one in fields]
    rising = [
        k for k, each in enumerate(steps) if (each >= 0.0).mean() > RISING and each.sum() > 0.0
    ]
    alias = dict.fromkeys(rising[:1], "t")
    for k in rising[:1]:
        part = fields[k + 1] if k + 1 < len(fields) else fields[k]
        if fields[k].is_whole and part.is_whole and not few[k + 1] and part.values.max() < 1e9:
            alias |= {k: "sec", k + 1: "nanosec"} | ECHOED.get(len(fields), {})
    ids = [
        k for k, one in enumerate(fields) if few[k] and (one.is_whole or np.isnan(one.values).all())
    ]
    others = [
        k for k, one in enumerate(fields) if not one.is_whole and np.isfinite(one.values).any()
    ]
    distance = next((k for k in others if ids and k > ids[0] and k not in alias), None)
    if distance is not None:
        signed = np.nanmin(fields[distance].values) < 0.0
        names = ("anchor_a", "anchor_b", "tdoa") if signed else ("anchor", "range")
        before = [k for k in ids if k < distance and k not in alias][1 - len(names) :]
        alias |= dict(zip((*before, distance), names))
    return [replace(one, alias=alias.get(k, "")) for k, one in enumerate(fields)]


def _with_lists(fields: Sequence[Field]) -> list[Field]:
    """Return the fields with one for all entries of a list: d[0].id, d[1].id ... is d[{k}].id."""
    lists: dict[str, list[Field]] = {}
    for one in fields:
        lists.setdefault(re.sub(r"\[\d+\](?=\.)", "[{k}]", one.path, count=1), []).append(one)
    return [
        each[0] if each[0].path == path else replace(each[0], path=path, values=_values(each))
        for path, each in lists.items()
    ]


def _values(fields: Sequence[Field]) -> np.ndarray:
    return np.concatenate([one.values for one in fields])


def _named(fields: Sequence[Field], pattern: str) -> list[Field]:
    return [one for one in fields if re.fullmatch(pattern, one.name, re.IGNORECASE)]


def _time(fields: Sequence[Field], fast: bool) -> tuple[str, str]:
    """Return the column of the time, or "", and why it is in its unit.

    fast : whether the rows are those of an IMU.
    """
    labels = [one.alias or one.path for one in fields]
    for one, label in zip(fields, labels):
        whole = re.fullmatch(SECONDS, label, re.IGNORECASE)
        for other, part in zip(fields, labels):
            match = re.fullmatch(FRACTION, part, re.IGNORECASE)
            unit = UNIT_OF_FRACTION[match[2].lower()] if match else "s"
            below_one = np.nanmax(other.values, initial=0.0) * TIME[unit] <= 1.0
            if whole and match and whole[1] == match[1] and below_one:
                return f"{one.path}:s+{other.path}:{unit}", "The time is in two columns."
    by_form = [
        [one.path for one in fields if one.texts and re.fullmatch(form, one.texts[0])]
        for form in (DAY, CLOCK)
    ]
    if all(by_form):
        return f"{by_form[0][0]}:s+{by_form[1][0]}:s", "The date and the time are in two columns."
    named = [one for one in _named(fields, TIME_NAME) if np.isfinite(one.values).any()]
    if not named:
        return "", NO_TIME
    one = min(named, key=lambda each: "header" not in each.path)
    steps = np.abs(np.diff(one.values[np.isfinite(one.values)]))
    step, level = np.median(steps[steps > 0.0]), np.nanmedian(one.values)
    usual = USUAL_STEP if fast or one.is_whole else LONG_STEP
    possible = [unit for unit, factor in TIME.items() if not step * factor > LONG_STEP] or ["s"]
    dates = [unit for unit in possible if CALENDAR[0] <= level * TIME[unit] <= CALENDAR[1]]
    likely = [unit for unit in possible if step * TIME[unit] <= usual]
    by_value = (dates or likely or possible)[0]
    by_name = re.fullmatch(FRACTION, one.name)  # as millis
    unit = one.unit if one.unit in TIME else UNIT_OF_FRACTION[by_name[2]] if by_name else by_value
    return f"{one.path}:{unit}", f"The stamps are {step:.3g} apart in the median, taken as {unit}."


def _beside(one: Field, other: Field) -> bool:
    """Return whether two fields belong to the same record."""
    return one.each == other.each and one.path.rpartition(".")[0] == other.path.rpartition(".")[0]


def _radio(fields: Sequence[Field]) -> list[Suggestion]:
    """Return TDOAs beside the ids of two anchors, or ranges beside the id of one."""
    of_pairs = [[rf"(anchor|node|id|uwb)?_?(id)?_?{end}(_?id)?" for end in ends] for ends in PAIRS]
    for what, pattern, names, ends, chosen in (
        ("TDOA", TDOA, ("anchor_a", "anchor_b"), of_pairs, 0),
        ("range", RANGE, ("anchor",), [[ID]], -1),
    ):
        for one in _named(fields, pattern):
            beside = [other for other in fields if other is not one and _beside(one, other)]
            for patterns in ends:
                ids = [_named(beside, each) for each in patterns]
                if all(ids):
                    unit, why = _length(f"median {what}", one)
                    columns = {name: found[chosen].path for name, found in zip(names, ids)}
                    columns[what.lower()] = one.path + unit
                    return [Suggestion(columns, one.each, why + [SIGN] * (what == "TDOA"))]
    return []


def _wide(fields: Sequence[Field]) -> list[Suggestion]:
    """Return TDOAs of a table with a column for each pair, or ranges with one for each anchor."""
    for shape, names in ((PAIR, ("anchor_a", "anchor_b")), (SINGLE_ANCHOR, ("anchor",))):
        groups: dict[tuple[str, ...], list[Field]] = {}
        for one in fields:
            match = re.fullmatch(shape, one.known)
            if match and len({*match.groups()[1::2]}) == len(names):
                groups.setdefault(match.groups()[::2], []).append(one)
        for (stem, *between), group in groups.items():
            named = len(names) == 2 or re.fullmatch(DISTANCE, stem, re.IGNORECASE)
            if len(group) < FEWEST_COLUMNS or not named or not np.isfinite(_values(group)).any():
                continue
            tail = group[0].path.removeprefix(group[0].known)
            pattern = stem + "".join(
                f"{{{name}}}{text}" for name, text in zip(names, [*between, ""])
            )
            what = "TDOA" if len(names) == 2 else "range"
            unit, why = _length(f"median {what}", replace(group[0], values=_values(group)))
            why.append(
                "A column for each; a value that repeats the last one of its column is left out."
            )
            columns = {**dict(zip(names, names)), what.lower(): pattern + tail + unit}
            return [Suggestion(columns, comments=why + [SIGN] * (what == "TDOA"))]
    return []


def _length(
    what: str, one: Field, statistic: Callable[[np.ndarray], float] = np.nanmedian
) -> tuple[str, list[str]]:
    """Return the unit of lengths by their name, or by a statistic of their sizes, and why."""
    known = np.abs(one.values[np.isfinite(one.values)])
    typical = float(statistic(known)) if len(known) else 0.0
    by_value = "mm" if typical > VERY_LONG else "cm" if typical > LONG else "m"
    unit = one.unit if one.unit in LENGTH else by_value
    return f":{unit}", [f"The {what} is {typical:.3g}, taken as {unit}."]


def _vector(fields: Sequence[Field], pattern: str, each: str = "") -> list[Field]:
    """Return x, y and z of a vector by the names of their paths; empty if there are not three."""
    by_axis: dict[str, Field] = {}
    for one in fields:
        match = re.fullmatch(pattern, one.known, re.IGNORECASE)
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
    by_force = [unit for unit, (low, high) in GRAVITY.items() if low < force < high]
    of_force = accel[0].unit if accel[0].unit in UNITS["accel_x"] else (by_force or ["m/s^2"])[0]
    in_degrees = rate > FAST_TURN or of_force in ("g", "mg")
    of_rate = "deg/s" if in_degrees else "rad/s"
    units = gyro[0].unit if gyro[0].unit in UNITS["gyro_x"] else of_rate, of_force
    why = [
        f"The largest rate is {rate:.3g}, taken as {units[0]}.",
        f"The median specific force is {force:.3g}, taken as {units[1]}.",
        "Axes: x forward, y left, z up. With body: frd y points to the right, z down.",
    ]
    if not by_force:
        why.append("That is not gravity: use a stream that still has it.")
    columns = {f"gyro_{axis}": f"{one.path}:{units[0]}" for axis, one in zip("xyz", gyro)}
    columns |= {f"accel_{axis}": f"{one.path}:{units[1]}" for axis, one in zip("xyz", accel)}
    return [Suggestion(columns, comments=why)]


def _anchors(fields: Sequence[Field]) -> list[Suggestion]:
    """Return positions with ids, each in an entry of an array."""
    for each in dict.fromkeys(one.each for one in fields):
        place = _vector(fields, PLACE if each else r"(anchor)([._])([xyz])", each)
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
        likely = [one for one in fields if in_table or re.search(pattern, one.known, re.IGNORECASE)]
        place = _vector(likely, PLACE)
        if place:
            break
    else:
        return []
    unit, why = _length("largest coordinate", replace(place[0], values=_values(place)), np.nanmax)
    columns = {f"pose_{axis}": f"{one.path}{unit}" for axis, one in zip("xyz", place)}
    turned = [(re.fullmatch(ATTITUDE, one.known, re.IGNORECASE), one.path) for one in likely]
    attitude = {f"pose_q{match[2].lower()}": path for match, path in turned if match}
    columns |= attitude if len(attitude) == 4 else {}
    doubtful = pattern == POSE
    why.append(
        "A position that may be an estimate. Only ground truth belongs here."
        if doubtful
        else "Ground truth by its name, in the frame of the anchors."
    )
    return [Suggestion(columns, comments=why, doubtful=doubtful)]
