# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read anchor surveys of any form, whose anchors have ids or names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from .anchors import FARTHEST, GEODETIC, UNITS, Anchors, refuse_faulty
from .arrays import rotations
from .errors import SURVEY_BYTES, InputError, number_of
from .files import read_bytes
from .safe_yaml import parse_yaml

Lines = list[tuple[int, list[str]]]  # numbers of lines, and their cells

LARGEST_ID = 65535
NOT_SURVEYED = [math.nan] * 4  # orientation without a survey
IDS = (
    "id",
    "anchor",
    "anchor id",
    "anchorid",
    "name",
    "anchor name",
    "label",
    "address",
    "addr",
    "node",
    "node id",
    "beacon",
    "nr",
    "no",
    "#",
    "index",
)
LENGTHS = {  # of units, m
    "": 1.0,
    "m": 1.0,
    "metre": 1.0,
    "meter": 1.0,
    "dm": 0.1,
    "decimetre": 0.1,
    "decimeter": 0.1,
    "cm": 0.01,
    "centimetre": 0.01,
    "centimeter": 0.01,
    "mm": 0.001,
    "millimetre": 0.001,
    "millimeter": 0.001,
    "ft": 0.3048,
    "foot": 0.3048,
    "feet": 0.3048,
    "in": 0.0254,
    "inch": 0.0254,
    "inches": 0.0254,
}
LENGTHS |= {f"{unit}s": length for unit, length in LENGTHS.items() if unit.endswith(("re", "er"))}
# keys that hold a position
NESTED = ("position", "pos", "pose", "translation", "location", "coordinates", "xyz", "point")
TURNED = ("orientation", "rotation", "quaternion")
_UNIT = re.compile(rf"^(.*?)[ (\[]+({'|'.join(filter(None, LENGTHS))})[)\]]?$")
_UNIT_KEY = re.compile(r"(?:(?:length|distance|position|coordinate|coordinates)[ _-]?)?units?")
_UNIT_COMMENT = re.compile(r"^\s*#.*?\bunits?\s*[:=]\W*(\w*)", re.IGNORECASE | re.MULTILINE)
# A1 alone is a name, perhaps a hexadecimal one; a1_pos is the position of anchor 1.
_NUMBERED = re.compile(
    r"^(?:anchor|anc|beacon|node|a(?=.*[a-z]$))[ _-]?([0-9]{1,5})(?:[ _-]?(?:pos|position|xyz))?$",
    re.IGNORECASE,
)
_LETTERED = re.compile(r"^a[ _-]?([0-9]{1,5})$", re.IGNORECASE)
_COMMA = re.compile(r"^[-+]?[0-9]+,[0-9]+$")
_OPENCV = re.compile(r"^%YAML:1\.0\s*$", re.MULTILINE)


AROUND = "anchors", "anchor_positions", "ros__parameters", "/**", "beacons"  # keys around anchors
BESIDE = "n_", "num", "count", "frame", "unit", "name", "version", "type", "description"


class Entry(NamedTuple):
    """One anchor of a file.

    Attributes
    ----------
    name : its id as text, or a name
    position : (3,) m
    orientation : (4,) x y z w, NaN if not surveyed
    """

    name: str
    position: list[float]
    orientation: list[float] = NOT_SURVEYED


@dataclass(frozen=True)
class NamedAnchors:
    """Anchors, and their names in the survey.

    Attributes
    ----------
    anchors : Anchors.
    ids : {name: id}; empty if the names are the ids.
    """

    anchors: Anchors
    ids: dict[str, int] = field(default_factory=dict)

    def id_of(self, value: Any) -> int | None:
        """Return the id of an anchor from its name or id (decimal or 0x1A2B); None if unknown.

        Names come first. Where anchors have names, an id counts if the name ends with it.
        """
        text = name_of(value)
        if text in self.ids:
            return self.ids[text]
        folded = [number for name, number in self.ids.items() if name.casefold() == text.casefold()]
        if len(folded) == 1:
            return folded[0]
        decimal = _decimal(text)
        number = int(decimal) if is_id(decimal) and int(decimal) <= LARGEST_ID else None
        if self.ids and not any(
            of == number and name.endswith(str(number)) for name, of in self.ids.items()
        ):
            return None
        return number


def read_survey(path: str | Path) -> Anchors:
    """Return the Anchors of a survey whose names are ids, see `read_named_anchors`. Raise InputError.

    The name A1 counts as the id 1.
    """
    named = read_named_anchors(path)
    for name, number in named.ids.items():
        lettered = _LETTERED.match(name)
        if lettered is None or int(lettered[1]) != number:
            raise InputError(f"{path}: id is {name[:40]!r}; it must be a whole number.")
    return named.anchors


def read_named_anchors(path: str | Path) -> NamedAnchors:
    """Read a survey file of any form of `read_entries`, with ids or any names.

    Names that all end with different numbers get these as ids. Other names get their line number in
    the survey, from 0. Raises InputError, also for a survey that is certainly wrong.
    """
    return named_anchors(path, *read_entries(path))


def named_anchors(path: str | Path, entries: Sequence[Entry], frame: str = "map") -> NamedAnchors:
    """Return the NamedAnchors of entries, see `read_named_anchors`; `path` is for messages."""
    names = [_decimal(entry.name) for entry in entries]
    named: dict[str, int] = {}
    if all(map(is_id, names)):
        ids = [int(name) for name in names]
    else:
        if len(set(names)) < len(names):
            raise InputError(
                f"{path}: anchor {next(name for name in names if names.count(name) > 1)!r} is "
                "there twice; every anchor needs its own name."
            )
        ends = [re.search(r"(\d{1,5})$", name) for name in names]
        ids = [int(end[1]) for end in ends if end]
        if len(set(ids)) < len(names) or max(ids) > LARGEST_ID:
            ids = list(range(len(names)))
        named = dict(zip(names, ids))
    positions, orientations = (
        np.array([getattr(entry, part) for entry in entries])
        for part in ("position", "orientation")
    )
    try:
        anchors = Anchors(np.array(ids), positions, orientations, frame)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return NamedAnchors(refuse_faulty(anchors, str(path)), named)


def as_named(survey: str | Path | Anchors | None) -> NamedAnchors | None:
    """Return the NamedAnchors of Anchors, or of a survey file; None for None. Raises InputError."""
    if isinstance(survey, Anchors):
        return NamedAnchors(survey)
    return None if survey is None else read_named_anchors(survey)


def _decimal(name: str) -> str:
    """Return the decimal id of a name like 0x1A2B; other names as they are."""
    return str(int(name, 16)) if re.fullmatch("0[xX][0-9A-Fa-f]{1,4}", name) else name


def is_id(name: str) -> bool:
    """Return whether a name is a whole number, as ids in messages are."""
    return re.fullmatch("[0-9]{1,9}", name) is not None


def read_entries(path: str | Path) -> tuple[list[Entry], str]:
    """Return the entries of a survey file in its own order, and the name of the world frame.

    The content determines the form:

    - total station: lines `name,x,y,z` in metres; `anchorAntN` is the antenna of anchor N,
      `anchorN_1/_2/_3` are the arm tips of its stand (up, left, forward), which give the
      orientation; other names are ignored;
    - a table: commas, semicolons, tabs or blanks between its cells; a header names id, x, y and z in
      any usual way, with or without units; a column `unit`, or a comment `# unit: ft`, gives it too;
      without a header each line is an id and three numbers;
    - YAML or JSON: `anchors: {0: {position: [x, y, z], orientation: [x, y, z, w]}}`, the same as a
      list, `0: {x:, y:, z:}` of the Crazyflie client, `anchor0_pos: [x, y, z]` of lps-ros, parameter
      files of ROS, an OpenCV matrix with a row for each anchor. `unit: ft` holds where it stands and
      below.

    Orientation: antenna stand to world; x forward, z up the stand, y completes a right-handed
    frame. NaN if not surveyed. Raises InputError.
    """
    try:
        text = read_bytes(path, SURVEY_BYTES, "survey file").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not text in UTF-8; write the survey in UTF-8 (.txt, "
            ".csv, .yaml or .json)."
        ) from error
    if not text.strip():
        raise InputError(f"{path}: is empty; give a survey file (.txt, .csv, .yaml or .json).")
    try:
        return (list(_of_table(text)), "map") if is_table(text) else _of_tree(text, path)
    except InputError as error:
        message = str(error)
        raise InputError(
            message if message.startswith(f"{path}: ") else f"{path}: {message}"
        ) from error


# {word of a header: axis}, in the world frame x east, y north, z up (REP 103)
AXES = {f"{prefix}{axis}": axis for axis in "xyz" for prefix in ("", "p", "t")} | {
    "east": "x",
    "north": "y",
    "up": "z",
}


def _roles(names: Sequence[Any]) -> dict[str, tuple[Any, str]]:
    """Return {role: (name, its unit)} of the columns of a table, or the keys of a mapping.

    Roles are "x", "y", "z", "name", "unit" and "qx" ... "qw". The first name of a role counts.
    """
    roles: dict[str, tuple[Any, str]] = {}
    for name in names:
        role, unit = _role(str(name))
        roles.setdefault(role, (name, unit))
    return roles


def _has_axes(roles: Mapping[str, Any]) -> bool:
    return roles.keys() >= {"x", "y", "z"}


def _role(cell: str) -> tuple[str, str]:
    """Return ("x", "y", "z", "name", "unit", "qx" ... or "", name of the unit) of a header cell."""
    text = " ".join(re.split(r"[\s_.]+", cell.strip().lower())).strip()
    if _UNIT_KEY.fullmatch(text):
        return "unit", ""
    found = _UNIT.match(text)
    text, unit = (found[1].strip(), found[2]) if found else (text, "")
    words = [word for word in text.split() if word not in (*NESTED, "p", "anchor")]
    if len(words) == 1 and words[0] in AXES:
        return AXES[words[0]], unit
    words = [word for word in text.split() if word not in TURNED]
    if len(words) == 1 and words[0] in ("qx", "qy", "qz", "qw"):
        return words[0], ""
    if len(words) == 1 and len(words[0]) == 1 and words[0] in "xyzw" and text.split()[0] in TURNED:
        return f"q{words[0]}", ""
    return ("name", "") if text in ("", *IDS) else ("", "")


def _unit(value: Any, where: str) -> str:
    """Return the name of a unit of length; raise InputError for another unit."""
    name = str(value).strip().lower()
    if name not in LENGTHS:
        raise InputError(
            f"{where}: unit {str(value)[:40]!r} is not known; give m, cm, mm, ft or in."
        )
    return name


def _unit_of(content: dict[Any, Any], unit: str, where: str) -> str:
    """Return the name of the unit that a mapping states; default : unit."""
    key, _ = _roles([*content]).get("unit", (None, ""))
    return unit if key is None else _unit(content[key], where)


def name_of(value: Any) -> str:
    """Return the name of an anchor or tag: a text as it is, but 1 for 1.0.

    A text without a point is no number: 12E3 and 0012 are ids.
    """
    text = str(value).strip()
    number = _number(text) if "." in text else math.nan
    return str(int(number)) if number.is_integer() else text


_YAML_KEY = re.compile(r"^\s*(?:- *)?[{\s]*[\"']?[\w /*.-]+[\"']?\s*:(?:\s|$)")


def is_table(text: str) -> bool:
    """Return whether a text is a table, not YAML or JSON; an empty one is a table.

    YAML and JSON begin with one of {, [, %, - or have a line with a key.
    """
    lines = [
        line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        return True
    # A table may begin with a negative number, e.g. -3.1.
    begins_as_yaml = lines[0].lstrip()[0] in "{[%-" and not _is_number(cells_of(lines[0])[0])
    return not begins_as_yaml and not any(map(_YAML_KEY.match, lines))


def cells_of(line: str, delimiter: str | None = None) -> list[str]:
    """Return the stripped cells of a line; delimiter : default by `delimiter_of`."""
    delimiter = delimiter or delimiter_of(line)
    return (
        line.split()
        if delimiter == " "
        else [cell.strip().strip("\"'") for cell in line.split(delimiter)]
    )


def lines_of(text: str) -> Lines:
    """Return the lines of a table without comments and empty lines.

    The last comment before the first row is kept if it is a header. A text of comments alone is
    returned whole.
    """
    filled_lines = [
        (number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()
    ]
    rows = [(number, line) for number, line in filled_lines if not line.lstrip().startswith("#")]
    rows = rows or filled_lines
    first_row, first_line = rows[0]
    delimiter = delimiter_of(first_line)
    comments_above = [
        (number, cells_of(line.lstrip("# \t"), delimiter))
        for number, line in filled_lines
        if number < first_row
    ]
    header = [(number, cells) for number, cells in comments_above[-1:] if _has_axes(_roles(cells))]
    return [*header, *((number, cells_of(line, delimiter)) for number, line in rows)]


def delimiter_of(line: str) -> str:
    """Return the delimiter of a line: ";", tab, "," or " "."""
    return next(
        (
            each
            for each in ";\t,"
            if each in line and not (each == "," and _all_commas_decimal(line))
        ),
        " ",
    )


def _all_commas_decimal(line: str) -> bool:
    """Return whether all commas of a line are decimal commas of cells separated by blanks."""
    cells = line.split()
    return (
        len(cells) >= 3
        and all(_COMMA.match(cell) for cell in cells if "," in cell)
        and sum("," in cell for cell in cells) >= 2
    )


def _is_number(cell: str) -> bool:
    return math.isfinite(_number(cell))


def _number(value: Any) -> float:
    """Return the finite number of a cell or value, else NaN; a decimal comma is permitted."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return math.nan
    text = (
        value.strip().replace(",", ".")
        if isinstance(value, str) and _COMMA.match(value.strip())
        else value
    )
    number = number_of(text)
    return number if math.isfinite(number) else math.nan


def _of_table(text: str) -> Iterator[Entry]:
    """Yield the entries of a table.

    A table without a header needs an id and three numbers in each line. Raises InputError.
    """
    lines = lines_of(text)
    (number, header), rest = lines[0], lines[1:]
    comment, roles = _UNIT_COMMENT.search(text), _roles(header)
    unit = _unit(comment[1], f"comment {comment[0].strip()[:60]!r}") if comment else ""
    if not _has_axes(roles):
        if any(re.match("lat(itude)?\\b", cell.strip(), re.IGNORECASE) for cell in header):
            raise InputError(f"line {number}: {', '.join(header)} are {GEODETIC}")
        if not all(map(_is_number, header)):
            yield from _total_station(lines, unit)
            return
        if len(header) == 3:
            raise InputError(
                f"line {number}: three numbers are recognized as a position, and no id; put the "
                "id of each anchor before its position, and 'id,x,y,z' in the first line."
            )
        if len(header) != 4:
            raise InputError(
                f"line {number}: {len(header)} numbers and no header: what they mean is not known; "
                "put 'id,x,y,z' in the first line, and other names for what is more."
            )
        header, rest = ["id", "x", "y", "z"], lines
        roles = _roles(header)
    if "name" not in roles:
        raise InputError(
            f"line {number}: columns x, y and z are recognized, and no column with the ids of "
            "the anchors; add one named 'id'."
        )
    if not rest:
        raise InputError("holds no anchor; add lines 'id,x,y,z' in metres.")
    fewest = 1 + max(header.index(name) for role, (name, _) in roles.items() if role)
    for number, cells in rest:
        if not fewest <= len(cells) <= max(len(header), 4):
            hint = "; decimal commas need ';' between the cells"
            raise InputError(
                f"line {number}: {','.join(cells)[:60]!r} has {len(cells)} cells, the header "
                f"{len(header)}{hint if len(cells) == 2 * len(header) - 1 else ''}."
            )
        yield _of_item(dict(zip(header, cells)), f"line {number}", unit)


WRITE = "write 'anchors: {0: {position: [x, y, z]}, 1: ...}', in metres"


def _of_tree(text: str, path: str | Path) -> tuple[list[Entry], str]:
    """Return the entries of YAML or JSON, and the name of the world frame.

    Raises InputError that names key and remedy.
    """
    opencv = bool(_OPENCV.search(text)) or "!!opencv-matrix" in text
    content = parse_yaml(
        _OPENCV.sub("", text).replace("!!opencv-matrix", "") if opencv else text,
        path,
        texts=True,
    )
    frame, unit = "map", ""
    for _ in range(8):  # levels around the anchors: parameter file, and "anchors"
        if not isinstance(content, dict):
            break
        given = content.get("frame", content.get("frame_id", frame))
        if not isinstance(given, str):
            raise InputError(
                f"frame: {given!r} is no name; write the name of the world frame, e.g. map."
            )
        frame, unit = given, _unit_of(content, unit, "unit")
        inner = next((key for key in content if str(key).lower() in AROUND), None)
        if inner is None or not isinstance(content[inner], (dict, list)):
            break
        content = content[inner]
    entries = list(_entries(content, unit))
    if not entries:
        raise InputError(f"no anchor is recognized; {WRITE}.")
    return entries, frame


def _entries(content: Any, unit: str) -> Iterator[Entry]:
    """Yield the entries of a list or mapping. Raises InputError with key, value and remedy."""
    if isinstance(content, list):
        for place, item in enumerate(content):
            yield _of_item(item, f"anchors[{place}]", unit)
    if not isinstance(content, dict):
        return
    for key, value in content.items():
        if isinstance(value, dict) and value.keys() >= {"rows", "cols", "data"}:
            yield from _of_matrix(key, value, unit)
            return
    numbered = {key: found for key in content if (found := _NUMBERED.match(str(key)))}
    if numbered and all(isinstance(content[key], (list, dict)) for key in numbered):
        for key, found in numbered.items():
            yield _of_value(found[1], content[key], str(key), unit)
        return
    for key, value in content.items():
        if isinstance(value, (dict, list)):
            yield _of_value(name_of(key), value, str(key), unit)
        elif not str(key).lower().startswith(BESIDE):
            raise InputError(f"{key}: {value!r} is no position; {WRITE}.")


def _of_matrix(key: Any, value: dict[str, Any], unit: str) -> Iterator[Entry]:
    """Yield the rows of an OpenCV matrix as anchors 0, 1, 2, ...; it has no place for ids."""
    rows, columns, data = value["rows"], value["cols"], value["data"]
    if (
        columns != 3
        or not isinstance(data, list)
        or not isinstance(rows, int)
        or len(data) != 3 * rows
    ):
        raise InputError(
            f"{key}: a matrix of {rows} x {columns} is recognized; it must have a row x, y, z "
            "for each anchor, so 3 columns."
        )
    for row in range(rows):
        yield Entry(str(row), _three(data[3 * row : 3 * row + 3], f"{key}, row {row}", unit))


def _of_item(item: Any, where: str, unit: str) -> Entry:
    """Return the anchor of an item of a list, or of a row of a table: {column: cell}."""
    if isinstance(item, list):
        if len(item) == 4:
            return Entry(name_of(item[0]), _three(item[1:], where, unit))
        three = len(item) == 3
        what = (
            "a position is recognized, and no id" if three else f"{len(item)} values are no anchor"
        )
        raise InputError(f"{where}: {what}; write '- {{id: 0, position: [x, y, z]}}'.")
    if not isinstance(item, dict):
        raise InputError(
            f"{where}: {item!r} is no anchor; write '- {{id: 0, position: [x, y, z]}}'."
        )
    key, _ = _roles([key for key in item if not isinstance(item[key], (dict, list))]).get(
        "name", (None, "")
    )
    if key is None:
        raise InputError(
            f"{where}: no id is recognized among {', '.join(map(str, item))}; write 'id: 0'."
        )
    rest = {other: value for other, value in item.items() if other != key}
    return _of_value(name_of(item[key]), rest, where, unit)


def _of_value(name: str, value: Any, where: str, unit: str) -> Entry:
    """Return the anchor `name` of its value.

    value : list of three numbers, or mapping with a position, or with x, y and z; unit : of numbers
    whose unit is not given beside them
    """
    if isinstance(value, list):
        return Entry(name, _three(value, where, unit))
    unit, roles = _unit_of(value, unit, where), _roles([*value])
    keys = {str(key).lower(): key for key in value}
    turn = next((_turn(value[keys[key]], where) for key in TURNED if key in keys), NOT_SURVEYED)
    if _has_axes(roles):
        axes, own = zip(*(roles[axis] for axis in "xyz"))
        if roles.keys() >= {"qx", "qy", "qz", "qw"}:
            turn = [_number(value[roles[f"q{k}"][0]]) for k in "xyzw"]
        return Entry(name, _three([value[axis] for axis in axes], where, unit, own), turn)
    nested = next((keys[key] for key in NESTED if key in keys), None)
    if nested is None:
        raise InputError(
            f"{where}: no position is recognized among {', '.join(map(str, value))[:80]}; {WRITE}."
        )
    if isinstance(value[nested], dict):
        within = _of_value(name, value[nested], f"{where}: {nested}", unit)
        return within if turn is NOT_SURVEYED else within._replace(orientation=turn)
    return Entry(name, _three(value[nested], f"{where}: {nested}", unit), turn)


def _in_metres(
    numbers: Sequence[float], unit: str, own: Sequence[str] = ("", "", "")
) -> list[float]:
    """Return three numbers in m; unit : of those without a unit of their own."""
    return [number * LENGTHS[each or unit] for number, each in zip(numbers, own)]


def _three(value: Any, where: str, unit: str, own: Sequence[str] = ("", "", "")) -> list[float]:
    numbers = [_number(each) for each in value] if isinstance(value, list) else []
    if len(numbers) == 6:
        raise InputError(
            f"{where}: 6 numbers stand where 3 belong, as decimal commas make it; write "
            "decimal points, [-3.1, 4.0, 0.2]."
        )
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise InputError(f"{where}: {str(value)[:60]} is not 3 numbers x, y, z in metres.")
    return _in_metres(numbers, unit, own)


def _turn(value: Any, where: str) -> list[float]:
    if isinstance(value, dict):
        value = [value.get(key, value.get(f"q{key}")) for key in "xyzw"]
    numbers = [_number(each) for each in value] if isinstance(value, list) else []
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise InputError(f"{where}: orientation is {str(value)[:60]}, not 4 numbers x, y, z, w.")
    return numbers


# The tips of the three marker arms of a stand, m, in the frame of the stand. Arm 1 points up (z),
# arm 3 forward (x). Arm 2 points to -y: "left" for a person who looks at the stand from the front.
# Only this sign makes the frame right-handed. The fit cannot determine it, since three points are
# flat. With +y, every stand tilts by some 60 degrees. With -y, stands on the floor have z up to
# within 1 degree. In all stands the antenna is then 11 mm forward, 26 mm to -y and 49 mm up. These
# distances count from the point where the arms meet.
ARM_TIPS = np.array([[0.0, 0.0, 0.110], [0.0, -0.121, 0.0], [0.080, 0.0, 0.0]])
LARGEST_STAND = 0.5  # m, largest distance of an antenna from the middle of the arm tips
MAX_TIP_RESIDUAL = 0.010  # m RMS; measured: 0.5 ... 2.2 mm

_ANTENNA = re.compile(r"anchorAnt_?([0-9]{1,9})$")
_TIP = re.compile(r"anchor_?([0-9]{1,9})_([123])$")


def orientation_from_tips(tips: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation that best turns `ARM_TIPS` into the surveyed tips, and its RMS residual.

    Source: Kabsch, Acta Cryst. A 32, 1976 (as implemented by scipy).

    Parameters
    ----------
    tips : (3, 3) m, positions of tips 1, 2, 3, world

    Returns
    -------
    orientation : quaternion x y z w, stand to world
    residual : m
    """
    surveyed, nominal = tips - tips.mean(axis=0), ARM_TIPS - ARM_TIPS.mean(axis=0)
    rotation, _ = rotations.Rotation.align_vectors(surveyed, nominal)
    return rotation.as_quat(), float(
        np.sqrt(((rotation.apply(nominal) - surveyed) ** 2).sum(axis=1).mean())
    )


def _total_station(lines: Lines, unit: str) -> list[Entry]:
    antennas: dict[Any, list[float]] = {}
    tips: dict[Any, list[float]] = {}
    key: Any
    for number, cells in lines:
        antenna, tip = _ANTENNA.match(cells[0]), _TIP.match(cells[0])
        point = _in_metres(_point(number, cells), unit)
        if antenna:
            points, key = antennas, int(antenna[1])
        elif tip:
            points, key = tips, (int(tip[1]), int(tip[2]))
        else:
            continue
        if key in points:
            raise InputError(f"line {number}: {cells[0]} is there twice; keep one.")
        points[key] = point
    if not antennas:
        raise InputError(
            f"is no survey that can be read: line {lines[0][0]}, "
            f"{','.join(lines[0][1])[:60]!r}, is neither a header with id, x, y "
            "and z, nor a line 'anchorAnt0,x,y,z' of a total station; put 'id,x,y,z' in the "
            "first line, or write YAML with 'anchors:'."
        )
    for anchor, _ in tips:
        if anchor not in antennas:
            raise InputError(
                f"anchor {anchor} has arm tips but no line 'anchorAnt{anchor},x,y,z'; add it."
            )
    return [
        Entry(str(i), antennas[i], _orientation(i, antennas[i], tips)) for i in sorted(antennas)
    ]


def _orientation(
    anchor: int, antenna: list[float], tips: dict[tuple[int, int], list[float]]
) -> list[float]:
    """Return the quaternion x y z w, stand to world, of the arm tips of an anchor; NaN without any.

    antenna : [x, y, z] m; tips : {(anchor, arm 1 to 3): [x, y, z] m}. Raises InputError for one or two
    tips, for a poor fit, and for arms that have their true lengths in another unit than metres.
    """
    found = [tips[anchor, k] for k in (1, 2, 3) if (anchor, k) in tips]
    if not found:
        return NOT_SURVEYED
    if len(found) < 3:
        raise InputError(
            f"anchor {anchor} has {len(found)} of 3 arm tips; survey all three or delete them."
        )
    quaternion, residual = orientation_from_tips(np.array(found))
    if residual <= MAX_TIP_RESIDUAL:
        return quaternion.tolist()
    for unit, count in UNITS.items():
        stand = np.array([antenna, *found]) / count
        if orientation_from_tips(stand[1:])[1] > MAX_TIP_RESIDUAL:
            continue
        who, lines = "the survey looks", "all coordinates"
        if np.linalg.norm(stand[0] - stand[1:].mean(axis=0)) > LARGEST_STAND:
            who = f"the arm tips of anchor {anchor} look"
            lines = f"the lines anchor{anchor}_1, _2 and _3"
        raise InputError(
            f"{who} like {unit} (the arms of the stand of anchor {anchor} have their "
            f"lengths in {unit}); give metres: divide {lines} by {count:.6g}."
        )
    raise InputError(
        f"the arm tips of anchor {anchor} miss the stand's shape by {1e3 * residual:.0f} mm (at most "
        f"{1e3 * MAX_TIP_RESIDUAL:.0f} mm expected); check lines anchor{anchor}_1, _2 and _3."
    )


def _point(number: int, cells: list[str]) -> list[float]:
    point = [_number(cell) for cell in cells[1:]]
    if len(point) != 3 or not (np.abs(point) <= FARTHEST).all():
        raise InputError(
            f"line {number}: {','.join(cells)[:60]!r} is not 'name,x,y,z' with finite metres; "
            "write 'name,x,y,z' in the first line, and nothing above it."
        )
    return point
