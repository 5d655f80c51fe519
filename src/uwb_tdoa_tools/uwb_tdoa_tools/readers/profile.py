# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Profiles: which topic and which field of a foreign recording is which stream.

profile = load_profile("dwm1001")               # a shipped profile, or a YAML file
profile = Profile.of_columns(parse_columns("time=t_ms:ms,anchor=id,range=dist:mm"))
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
import re
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import (
    DEFINITION_BYTES,
    InputError,
    number_of,
    refuse_others,
    sanitize,
)
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.survey import name_of

from .streams import GRAVITY

Columns = dict[str, tuple[str, float]]  # {our column: (their column or field, factor)}

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "ft": 0.3048,
    "ticks": TICK,
    "ns": SPEED_OF_LIGHT / 1e9,
}
# As `make_flight` takes them, from a Crazyflie: deg/s and g.
RATE = {"rad/s": 180.0 / np.pi, "deg/s": 1.0}
FORCE = {"m/s^2": 1.0 / GRAVITY, "g": 1.0, "mg": 1e-3, "mm/s^2": 1e-3 / GRAVITY}
NUMBER = {"": 1.0}
HEIGHT = {unit: 1e3 * factor for unit, factor in LENGTH.items() if unit in ("m", "cm", "mm")}
# stream: {our column: (column of the stream, {unit: factor}, the first is the default)}
STREAMS = {
    "tdoa": {
        "anchor_a": ("a", NUMBER),
        "anchor_b": ("b", NUMBER),
        "tdoa": ("d", LENGTH),
        "tdoa_std": ("std", LENGTH),
    },
    "range": {"anchor": ("anchor", NUMBER), "range": ("d", LENGTH), "range_std": ("std", LENGTH)},
    "gyro": {f"gyro_{axis}": (axis, RATE) for axis in "xyz"},
    "acc": {f"accel_{axis}": (axis, FORCE) for axis in "xyz"},
    "pose": {f"pose_{axis}": (axis, LENGTH) for axis in "xyz"}
    | {f"pose_q{k}": (f"q{k}", NUMBER) for k in "xyzw"},
    "tof": {"height": ("tof", HEIGHT)},  # in mm, as a Crazyflie has it
    "baro": {"altitude": ("baro", {"m": 1.0})},
    "flow": {f"flow_{axis}": (axis, NUMBER) for axis in "xy"},
    "anchors": {"anchor_id": ("id", NUMBER)} | {f"anchor_{axis}": (axis, LENGTH) for axis in "xyz"},
}
TIMES = {  # of each stream: the first that is given, else "time"
    "tdoa": ("tdoa_time",),
    "range": ("range_time",),
    "gyro": ("gyro_time", "imu_time"),
    "acc": ("accel_time", "imu_time"),
    "pose": ("pose_time",),
    "tof": ("height_time",),
    "baro": ("altitude_time",),
    "flow": ("flow_time",),
    "anchors": (),
}
RADIO = "tdoa", "range"  # streams; a profile has one of them or both
ANCHORS = "anchor_a", "anchor_b", "anchor", "anchor_id"  # columns that name anchors
# cells of tools without a value
EMPTY = {"", "-", "--", "n/a", "na", "nan", "none", "null"}
MOST_SKIPPED = 0.25  # largest share of invalid records in a stream
ATTITUDE = {f"pose_q{k}" for k in "xyzw"}
OPTIONAL = {*ATTITUDE, "tdoa_std", "range_std"}
UNITS = {name: units for columns in STREAMS.values() for name, (_, units) in columns.items()}
UNITS |= {
    name: TIME for name in ("time", *sorted({name for names in TIMES.values() for name in names}))
}


def parse_columns(text: str) -> Columns:
    """Return {our column: (their column, factor)} of "OURS=THEIRS[:UNIT],...".

    A value times its factor is in m, s, degrees/s or g, as `make_flight` takes them. Raises
    InputError.
    """
    columns: Columns = {}
    for entry in text.split(","):
        ours, equals, theirs = (part.strip() for part in entry.partition("="))
        if not equals or ours not in UNITS or not theirs or ours in columns:
            raise _unknown("--columns", entry)
        columns[ours] = parse_column("--columns", ours, theirs)
    check_columns("--columns", columns)
    return columns


def parse_column(where: str, ours: str, theirs: str) -> tuple[str, float]:
    """Return (their column, factor) of one of our columns and "[-]THEIRS[:UNIT]".

    Without UNIT it is in the first of UNITS. A name that holds a colon needs its unit. A minus
    changes the sign. `where` begins error messages. Raises InputError.
    """
    entry = f"{ours}={theirs}"
    if ours not in UNITS:
        raise _unknown(where, entry)
    name, colon, unit = (part.strip() for part in theirs.rpartition(":"))
    units = UNITS[ours]
    if not colon or (units is TIME and len(parts_of(theirs)) > 1):
        name, unit = theirs.strip(), next(iter(units))
    sign = -1.0 if name.startswith("-") else 1.0
    name = name.removeprefix("-").strip()
    if not name:
        raise _unknown(where, entry)
    if unit not in units:
        usual = " or ".join(filter(None, units)) or "none"
        raise InputError(f"{where}: {entry!r}: {unit!r} is no unit of {ours}; use {usual}.")
    return name, sign * units[unit]


def parts_of(path: str) -> list[tuple[str, float]]:
    """Return [(column, factor)] whose sum is a time in s: "sec:s+nanosec:ns" has two."""
    units = "|".join(TIME)
    found = re.fullmatch(rf"(.+):({units})\+(.+):({units})", path.strip())
    return [(found[1], TIME[found[2]]), (found[3], TIME[found[4]])] if found else [(path, 1.0)]


def _unknown(where: str, entry: str) -> InputError:
    return InputError(
        f"{where}: {entry!r} is not OURS=THEIRS, where OURS, once, is one of {', '.join(UNITS)}."
    )


def check_columns(where: str, columns: Columns, time: bool = True) -> None:
    """Raise InputError for columns that are incomplete.

    time : whether each stream needs a column with the time. Otherwise messages have it.
    """
    used = [stream for stream, names in STREAMS.items() if names.keys() & columns.keys()]
    # without a column of a radio, the error names those of TDOAs
    for stream in used if {*RADIO} & {*used} or not time else ["tdoa", *used]:
        needed = [*(name for name in STREAMS[stream] if name not in OPTIONAL)]
        if missing := [name for name in needed if name not in columns]:
            per_file = "; where each anchor has a file, write a profile with topic: 'A{anchor}.csv'"
            raise InputError(
                f"{where}: {missing[0]} is missing; {', '.join(needed)} belong together"
                f"{per_file if missing == ['anchor'] else ''}."
            )
        if time and stream != "anchors" and not {*TIMES[stream], "time"} & columns.keys():
            raise InputError(
                f"{where}: {TIMES[stream][-1]}, or time, is missing; name the column with the time."
            )
    if len(ATTITUDE & columns.keys()) not in (0, 4):
        raise InputError(f"{where}: {', '.join(sorted(ATTITUDE))} belong together.")


SHIPPED = Path(__file__).resolve().parent / "profiles"
_AXES = {"body": ("flu", "frd"), "world": ("enu", "ned")}  # the first is ours
_TEXTS = "topic", "type", "each", "tag"
MOST_STARS = 4  # of a pattern; the time to compare it grows with each
_KEYS = "about", "sources", "types", "antenna"
_SOURCE = *_TEXTS, *_AXES, "where", "columns"
_NAME = re.compile(r"\{(\w+)\}")
_COMPARISON = re.compile(r"(<=|>=|<|>)\s*(\S+)")
_COMPARE = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
}


@dataclass(frozen=True)
class Condition:
    """A condition on a field: only records that meet it count.

    Attributes
    ----------
    path : field.
    comparison, limit : "<", "<=", ">" or ">=", and the number behind it; "" for `values`.
    values : texts of the allowed values.
    """

    path: str
    comparison: str = ""
    limit: float = math.nan
    values: tuple[str, ...] = ()

    def met(self, value: Any) -> bool:
        """Return whether a value meets the condition."""
        if not self.comparison:
            return as_text(value) in self.values
        return bool(_COMPARE[self.comparison](number_of(value), self.limit))


@dataclass(frozen=True)
class Source:
    """Where a recording holds the columns of some streams.

    Attributes
    ----------
    columns : {our column: (path of the field, factor to our unit)}. `{name}` in a path stands for
        a part of it and is a field, as in `topic`: each field that fits is a source.
    topic : pattern of a topic, or of the name of a CSV file; "" for any file that has the columns.
        `{name}` stands for a part of the topic and is a field, `*` for anything.
    type : pattern of the type of the messages; "" for any.
    each : path of an array; each of its entries is a record.
    where : Conditions.
    tag : path of the id of the tag; "" if the source holds one tag.
    body, world : axes: flu or frd, enu or ned.
    """

    columns: Columns
    topic: str = ""
    type: str = ""
    each: str = ""
    where: tuple[Condition, ...] = ()
    tag: str = ""
    body: str = "flu"
    world: str = "enu"

    def over(self, fields: Iterable[str]) -> list[tuple[Source, dict[str, str]]]:
        """Return [(Source, {name: text})] for each field of a pattern such as "d{a}-{b}".

        Without a pattern among its columns it is the source itself, without names.
        """
        pattern = next((path for path, _ in self.columns.values() if _NAME.search(path)), "")
        if not pattern:
            return [(self, {})]
        fitting = (re.fullmatch(_expression(pattern), each) for each in fields)
        found = [fit.groupdict() for fit in fitting if fit]
        return [
            (
                replace(
                    self,
                    columns={
                        ours: (_NAME.sub(lambda name: names.get(name[1], name[0]), path), factor)
                        for ours, (path, factor) in self.columns.items()
                    },
                ),
                names,
            )
            for names in found
        ]

    def match(self, table: str, kind: str) -> dict[str, str] | None:
        """Return {name: text} of the names in `topic`; None if another table is meant.

        table, kind : topic and type of its messages, or name of a CSV file and "CSV".
        """
        fits = re.fullmatch(_expression(self.type or "*"), kind)
        found = re.fullmatch(_expression(self.topic or "*"), table)
        return found.groupdict() if fits and found else None


def _expression(pattern: str) -> str:
    """Return the regular expression of a pattern of a topic or type."""
    named = re.sub(r"\\\{(\w+)\\\}", r"(?P<\1>[^/]+)", re.escape(pattern))
    return named.replace(r"\*", ".*")


@dataclass(frozen=True)
class Profile:
    """How to read recordings of one kind.

    Attributes
    ----------
    name : of the shipped profile, or of the file.
    sources : Sources.
    about : one sentence.
    types : {type of a message: text of its .msg file}, for bags without definitions.
    antenna : {tag: (x, y, z) of its antenna in the body frame, m}; "" for every tag.
    """

    name: str
    sources: tuple[Source, ...]
    about: str = ""
    types: dict[str, str] = field(default_factory=dict)
    antenna: dict[str, tuple[float, ...]] = field(default_factory=dict)

    @classmethod
    def of_columns(cls, columns: Columns) -> Profile:
        """Return the Profile of --columns: each stream from the file that has its columns."""
        times = {name: column for name, column in columns.items() if name.endswith("time")}
        given = [
            {name: columns[name] for name in names if name in columns} for names in STREAMS.values()
        ]
        return cls("columns as given", tuple(Source(mine | times) for mine in given if mine))


def shipped() -> list[str]:
    """Return the names of the shipped profiles."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def load_profile(name: str | Path) -> Profile:
    """Return a Profile by the name of a shipped one, or from a YAML file. Raises InputError."""
    path = Path(name)
    if str(name) in shipped():
        path = SHIPPED / f"{name}.yaml"
    elif not path.is_file():
        raise InputError(
            f"--profile: {name} is neither a file nor a shipped profile; these are "
            f"{', '.join(shipped())}."
        )
    content = read_yaml(path)
    if not isinstance(content, dict) or not isinstance(content.get("sources"), list):
        raise InputError(f"{path}: is no profile; write a list under sources (docs/recordings.md).")
    refuse_others(path, content, _KEYS)
    sources = tuple(
        _source(f"{path}: source {number}", each)
        for number, each in enumerate(content["sources"], start=1)
    )
    if not any({*RADIO} & {*source.columns} for source in sources):
        raise InputError(f"{path}: no source gives tdoa or range; one of them is needed.")
    return Profile(
        sanitize(path.stem),
        sources,
        str(content.get("about", "")),
        _types(path, content.get("types")),
        _antenna(path, content.get("antenna")),
    )


def _source(where: str, content: Any) -> Source:
    if not isinstance(content, dict) or not isinstance(content.get("columns"), dict):
        raise InputError(f"{where}: needs columns: {{OURS: THEIRS}}; see docs/recordings.md.")
    refuse_others(where, content, _SOURCE)
    columns = {
        str(ours): parse_column(where, str(ours), str(theirs))
        for ours, theirs in content["columns"].items()
    }
    check_columns(where, columns, time=False)
    texts = {name: content.get(name, "") for name in _TEXTS}
    for name, value in texts.items():
        if not isinstance(value, str):
            raise InputError(f"{where}: {name} is {value!r}; it must be a text.")
        if value.count("*") > MOST_STARS:
            raise InputError(f"{where}: {name} has more than {MOST_STARS} stars; write names out.")
    for name, known in _AXES.items():
        refuse_others(f"{where}: {name}", [content.get(name, known[0])], known)
    conditions = content.get("where", {})
    if not isinstance(conditions, dict):
        raise InputError(f"{where}: where is no {{FIELD: VALUE}}; see docs/recordings.md.")
    return Source(
        columns,
        where=tuple(_condition(str(path), value) for path, value in conditions.items()),
        **texts,
        **{name: content.get(name, known[0]) for name, known in _AXES.items()},
    )


def _condition(path: str, value: Any) -> Condition:
    match = _COMPARISON.fullmatch(value.strip()) if isinstance(value, str) else None
    if match:
        try:
            return Condition(path, match[1], float(match[2]))
        except ValueError as error:
            raise InputError(f"where: {path}: {value!r} compares with no number.") from error
    values = value if isinstance(value, list) else [value]
    return Condition(path, values=tuple(as_text(each) for each in values))


def as_text(value: Any) -> str:
    """Return a value of a field as text: 1 for 1.0 and for true."""
    number = number_of(value)
    if math.isnan(number):
        return str(value).strip()
    return str(int(number)) if number.is_integer() else repr(number)


def _types(path: Path, content: Any) -> dict[str, str]:
    types = content or {}
    if not isinstance(types, dict) or not all(
        isinstance(text, str) and len(text) < DEFINITION_BYTES for text in types.values()
    ):
        raise InputError(f"{path}: types must be {{pkg/msg/Name: text of the .msg file}}.")
    return {str(name): text for name, text in types.items()}


def _antenna(path: Path, content: Any) -> dict[str, tuple[float, ...]]:
    antenna = {"": content} if isinstance(content, list) else content or {}
    good = isinstance(antenna, dict) and all(
        isinstance(place, list)
        and len(place) == 3
        and all(isinstance(each, (int, float)) and abs(each) < 100.0 for each in place)
        for place in antenna.values()
    )
    if not good:
        raise InputError(f"{path}: antenna must be [x, y, z], or {{TAG: [x, y, z]}}, in m.")
    return {name_of(tag): tuple(map(float, place)) for tag, place in antenna.items()}
