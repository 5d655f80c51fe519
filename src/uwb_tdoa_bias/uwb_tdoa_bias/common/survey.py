# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read anchor surveys, and find faults that a survey alone shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from .anchors import FARTHEST, Anchors
from .errors import InputError
from .files import read_bytes
from .lazy import rotations
from .limits import SURVEY_BYTES
from .safe_yaml import parse_yaml

Lines = list[tuple[int, list[str]]]  # numbers of lines, and their cells

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
_NUMBERED = re.compile(
    r"^(?:anchor|anc|a|beacon|node)[ _-]?([0-9]{1,5})(?:[ _-]?(?:pos|position|xyz))?$",
    re.IGNORECASE,
)
_COMMA = re.compile(r"^[-+]?[0-9]+,[0-9]+$")
_OPENCV = re.compile(r"^%YAML:1\.0\s*$", re.MULTILINE)


class Entry(NamedTuple):
    """One anchor of a file.

    Attributes
    ----------
    name : its id as text, or a name
    position : (3,) m
    orientation : (4,) x y z w, NaN if not surveyed
    where : the line or key, for messages
    """

    name: str
    position: list[float]
    orientation: list[float]
    where: str


class Columns(NamedTuple):
    """Meaning of the cells of a table.

    Attributes
    ----------
    name : place of the id or name, or None
    axes : places of x, y and z
    units : names of the units of x, y and z, "" where the header names none
    turn : places of the quaternion x, y, z, w, or ()
    unit : place of the unit, or None
    """

    name: int | None
    axes: tuple[int, int, int]
    units: tuple[str, str, str] = ("", "", "")
    turn: tuple[int, ...] = ()
    unit: int | None = None


def columns_of(header: Sequence[str]) -> Columns | None:
    """Return the Columns of a header; None without x, y and z.

    Names may be in upper or lower case, with or without a unit.
    """
    roles: dict[str, int] = {}
    units: dict[str, str] = {}
    for place, cell in enumerate(header):
        role, unit = _role(cell)
        if role and role not in roles:
            roles[role], units[role] = place, unit
    if not roles.keys() >= {"x", "y", "z"}:
        return None
    turn = tuple(roles[name] for name in ("qx", "qy", "qz", "qw") if name in roles)
    x, y, z = (roles[axis] for axis in "xyz")
    return Columns(
        roles.get("name"),
        (x, y, z),
        (units["x"], units["y"], units["z"]),
        turn if len(turn) == 4 else (),
        roles.get("unit"),
    )


def _role(cell: str) -> tuple[str, str]:
    """Return ("x", "y", "z", "name", "unit", "qx" ... or "", name of the unit) of a header cell."""
    text = " ".join(re.split(r"[\s_.]+", cell.strip().lower())).strip()
    if _UNIT_KEY.fullmatch(text):
        return "unit", ""
    found = _UNIT.match(text)
    text, unit = (found[1].strip(), found[2]) if found else (text, "")
    words = [word for word in text.split() if word not in (*NESTED, "p", "anchor")]
    if len(words) == 1 and words[0] in ("x", "y", "z", "px", "py", "pz", "tx", "ty", "tz"):
        return words[0][-1], unit
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
    stated = [value for key, value in content.items() if _UNIT_KEY.fullmatch(str(key).lower())]
    return _unit(stated[0], where) if stated else unit


def name_of(value: Any) -> str:
    """Return the name of an anchor or tag: a text as it is, but 1 for 1.0.

    A text without a point is no number: 12E3 and 0012 are ids.
    """
    text = str(value).strip()
    number = _number(text) if "." in text else math.nan
    return str(int(number)) if number.is_integer() else text


# of a table id,latitude,longitude,height; the length of a degree is that of the WGS 84 ellipsoid
GEODETIC = (
    "latitude and longitude in degrees; give metres, x to the east and y to the north. For a file with "
    """id,latitude,longitude,height: awk -F, 'NR==1 {print "id,x,y,z"; next} NR==2 {a=$2; o=$3; """
    """r=a*0.01745329} {printf "%s,%.3f,%.3f,%s\\n", $1, ($3-o)*(111413*cos(r)-93.5*cos(3*r)), """
    """($2-a)*(111133-559.8*cos(2*r)), $4}' FILE > metres.csv"""
)
SMALL, MANY_TIMES = 0.01, 1000.0  # degrees, of a room; and how often it goes into the coordinates
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
    header = [(number, cells) for number, cells in comments_above[-1:] if columns_of(cells)]
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
    try:
        number = float(text)
    except (ValueError, OverflowError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def read_table(lines: Lines, unit: str = "") -> list[Entry] | None:
    """Return the entries of a table; None for an unknown header or form.

    A table without a header needs an id and three numbers in each line. Raises InputError.

    lines : line numbers and cells; unit : of cells whose unit the header does not name
    """
    (number, header), rest = lines[0], lines[1:]
    columns = columns_of(header)
    if columns is None:
        if any(re.match("lat(itude)?\\b", cell.strip(), re.IGNORECASE) for cell in header):
            raise InputError(f"line {number}: {', '.join(header)} are {GEODETIC}")
        if all(map(_is_number, lines[0][1])):
            return _without_header(lines, unit)
        return None
    if columns.name is None:
        raise InputError(
            f"line {number}: columns x, y and z are recognized, and no column with the ids of "
            "the anchors; add one named 'id'."
        )
    if not rest:
        raise InputError("holds no anchor; add lines 'id,x,y,z' in metres.")
    return [_row(number, cells, columns, len(header), unit) for number, cells in rest]


def _without_header(lines: Lines, unit: str) -> list[Entry]:
    number, cells = lines[0]
    if len(cells) == 3:
        raise InputError(
            f"line {number}: three numbers are recognized as a position, and no id; put the "
            "id of each anchor before its position, "
            "and 'id,x,y,z' in the first line."
        )
    if len(cells) != 4:
        raise InputError(
            f"line {number}: {len(cells)} numbers and no header: what they mean is not known; "
            "put 'id,x,y,z' in the first line, "
            "and other names for what is more."
        )
    return [_row(number, cells, Columns(0, (1, 2, 3)), 4, unit) for number, cells in lines]


def _row(number: int, cells: list[str], columns: Columns, count: int, unit: str) -> Entry:
    """Return the Entry of line `number`; count : cells of the header, at least 4.

    Anchors checks the quaternion.
    """
    assert columns.name is not None
    fewest = max(*columns.axes, columns.name, *columns.turn, columns.unit or 0) + 1
    if not fewest <= len(cells) <= max(count, 4):
        hint = "; decimal commas need ';' between the cells" if len(cells) == 2 * count - 1 else ""
        raise InputError(
            f"line {number}: {','.join(cells)[:60]!r} has {len(cells)} cells, the header "
            f"{count}{hint}."
        )
    if columns.unit is not None:
        unit = _unit(cells[columns.unit], f"line {number}")
    values = [_number(cells[place]) for place in columns.axes]
    if not all(map(math.isfinite, values)):
        raise InputError(
            f"line {number}: {','.join(cells)[:60]!r} is not 'id,x,y,z' with finite metres."
        )
    turn = [_number(cells[place]) for place in columns.turn] or NOT_SURVEYED
    position = _in_metres(values, unit, columns.units)
    return Entry(name_of(cells[columns.name]), position, turn, f"line {number}")


def read_tree(text: str, path: str | Path) -> tuple[list[Entry], str]:
    """Return the entries of YAML or JSON, and the name of the world frame.

    Raises InputError that names key and remedy.
    """
    opencv = bool(_OPENCV.search(text)) or "!!opencv-matrix" in text
    content = parse_yaml(
        _OPENCV.sub("", text).replace("!!opencv-matrix", "") if opencv else text,
        path,
        float_texts=True,
    )
    frame, unit = "map", ""
    for _ in range(8):  # levels around the anchors: parameter file, and "anchors"
        if not isinstance(content, dict):
            break
        given = content.get("frame", content.get("frame_id", frame))
        if not isinstance(given, str):
            raise InputError(
                f"{path}: frame: {given!r} is no name; write the name of the world frame, e.g. map."
            )
        frame, unit = given, _unit_of(content, unit, str(path))
        inner = next(
            (
                key
                for key in content
                if str(key).lower()
                in ("anchors", "anchor_positions", "ros__parameters", "/**", "beacons")
            ),
            None,
        )
        if inner is None or not isinstance(content[inner], (dict, list)):
            break
        content = content[inner]
    try:
        entries = list(_entries(content, unit))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if not entries:
        raise InputError(f"{path}: no anchor is recognized; {WRITE}.")
    return entries, frame


WRITE = "write 'anchors: {0: {position: [x, y, z]}, 1: ...}', in metres"


def _entries(content: Any, unit: str) -> Iterator[Entry]:
    """Yield the entries of a list or mapping; raise ValueError with key, value and remedy."""
    if isinstance(content, list):
        for place, item in enumerate(content):
            yield _of_list(item, f"anchors[{place}]", unit)
        return
    if not isinstance(content, dict):
        return
    matrices = [
        (key, value)
        for key, value in content.items()
        if isinstance(value, dict) and value.keys() >= {"rows", "cols", "data"}
    ]
    if matrices:
        yield from _of_matrix(*matrices[0], unit)
        return
    numbered = {key: _NUMBERED.match(str(key)) for key in content}
    if any(numbered.values()) and all(
        isinstance(content[key], (list, dict)) for key, found in numbered.items() if found
    ):
        yield from (
            _of_value(found[1], content[key], str(key), unit)
            for key, found in numbered.items()
            if found
        )
        return
    for key, value in content.items():
        if isinstance(value, (dict, list)):
            yield _of_value(name_of(key), value, str(key), unit)
        elif (
            not str(key)
            .lower()
            .startswith(
                ("n_", "num", "count", "frame", "unit", "name", "version", "type", "description")
            )
        ):
            raise ValueError(f"{key}: {value!r} is no position; {WRITE}.")


def _of_matrix(key: Any, value: dict[str, Any], unit: str) -> Iterator[Entry]:
    """Yield the rows of an OpenCV matrix as anchors 0, 1, 2, ...; it has no place for ids."""
    rows, columns, data = value["rows"], value["cols"], value["data"]
    if (
        columns != 3
        or not isinstance(data, list)
        or not isinstance(rows, int)
        or len(data) != 3 * rows
    ):
        raise ValueError(
            f"{key}: a matrix of {rows} x {columns} is recognized; it must have a row x, y, z "
            "for each anchor, so 3 columns."
        )
    for row in range(rows):
        yield Entry(
            str(row),
            _three(data[3 * row : 3 * row + 3], f"{key}, row {row}", unit),
            NOT_SURVEYED,
            f"{key}, row {row}",
        )


def _of_list(item: Any, where: str, unit: str) -> Entry:
    if isinstance(item, list):
        if len(item) == 4:
            return Entry(name_of(item[0]), _three(item[1:], where, unit), NOT_SURVEYED, where)
        three = len(item) == 3
        what = (
            "a position is recognized, and no id" if three else f"{len(item)} values are no anchor"
        )
        raise ValueError(f"{where}: {what}; write '- {{id: 0, position: [x, y, z]}}'.")
    if not isinstance(item, dict):
        raise ValueError(
            f"{where}: {item!r} is no anchor; write '- {{id: 0, position: [x, y, z]}}'."
        )
    named = [
        key
        for key in item
        if " ".join(str(key).lower().split("_")) in IDS and not isinstance(item[key], (dict, list))
    ]
    if not named:
        raise ValueError(
            f"{where}: no id is recognized among {', '.join(map(str, item))}; write 'id: 0'."
        )
    rest = {key: value for key, value in item.items() if key != named[0]}
    return _of_value(name_of(item[named[0]]), rest, where, unit)


def _of_value(name: str, value: Any, where: str, unit: str) -> Entry:
    """Return the anchor `name` of its value.

    value : list of three numbers, or mapping with a position, or with x, y and z; unit : of numbers
    whose unit is not given beside them
    """
    if isinstance(value, list):
        return Entry(name, _three(value, where, unit), NOT_SURVEYED, where)
    unit = _unit_of(value, unit, where)
    keys = {str(key).lower(): key for key in value}
    turn = next((value[keys[key]] for key in TURNED if key in keys), None)
    nested = next((key for key in NESTED if key in keys), None)
    if nested is not None:
        inner = value[keys[nested]]
        if isinstance(inner, dict):
            within = _of_value(name, inner, f"{where}: {keys[nested]}", unit)
            return within._replace(orientation=_turn(turn, where)) if turn is not None else within
        return Entry(
            name, _three(inner, f"{where}: {keys[nested]}", unit), _turn(turn, where), where
        )
    columns = columns_of([str(key) for key in value])
    if columns is None:
        raise ValueError(
            f"{where}: no position is recognized among {', '.join(map(str, value))[:80]}; {WRITE}."
        )
    values = list(value.values())
    position = _three([values[place] for place in columns.axes], where, unit, columns.units)
    return Entry(name, position, _turn(turn, where), where)


def _in_metres(
    numbers: Sequence[float], unit: str, own: Sequence[str] = ("", "", "")
) -> list[float]:
    """Return three numbers in m; unit : of those without a unit of their own."""
    return [number * LENGTHS[each or unit] for number, each in zip(numbers, own)]


def _three(value: Any, where: str, unit: str, own: Sequence[str] = ("", "", "")) -> list[float]:
    numbers = [_number(each) for each in value] if isinstance(value, list) else []
    if len(numbers) == 6:
        raise ValueError(
            f"{where}: 6 numbers stand where 3 belong, as decimal commas make it; write "
            "decimal points, [-3.1, 4.0, 0.2]."
        )
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{where}: {str(value)[:60]} is not 3 numbers x, y, z in metres.")
    return _in_metres(numbers, unit, own)


def _turn(value: Any, where: str) -> list[float]:
    if value is None:
        return NOT_SURVEYED
    if isinstance(value, dict):
        value = [value.get(key, value.get(f"q{key}")) for key in "xyzw"]
    numbers = [_number(each) for each in value] if isinstance(value, list) else []
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise ValueError(f"{where}: orientation is {str(value)[:60]}, not 4 numbers x, y, z, w.")
    return numbers


SAME_PLACE = 0.001  # m; two antennas are at least some cm apart
# m. A UWB radio reaches at most 300 m, and a tag must receive several anchors at once. An anchor with
# fewer than NEIGHBOURS others within this distance is out of place.
LONELY = 500.0
NEIGHBOURS = 2  # required within LONELY; fewer if there are fewer anchors
USUAL = 6.0  # m between neighbours, typical; the unit that gives the nearest value is named
UNITS = {
    "millimetres": 1000.0,
    "centimetres": 100.0,
    "inches": 1.0 / 0.0254,
    "decimetres": 10.0,
    "feet": 1.0 / 0.3048,
}  # units per metre
FARTHEST_OFF = 200  # anchors farthest from the median whose neighbours are searched
MOST_NAMED = 10  # anchors in a sentence


def survey_fault(anchors: Anchors) -> str:
    """Return what is certainly wrong with Anchors: cause, evidence and remedy; "" for a usable survey."""
    if len(anchors) < 2:
        return ""
    level = anchors.positions[:, :2]
    spread = np.ptp(level, axis=0)
    if (
        (spread > 0.0).all()
        and (MANY_TIMES * spread < np.abs(level)).all()
        and spread.max() < SMALL
    ):
        return f"x and y are the same within {spread.max():.1g}, as are {GEODETIC}"
    cells = np.round(anchors.positions / SAME_PLACE)
    _, group, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    together = np.flatnonzero(counts > 1)
    if not len(together):
        return _far(anchors)
    rows = np.flatnonzero(group.reshape(-1) == together[0])
    x, y, z = anchors.positions[rows[0]]
    place = f"at ({x:g}, {y:g}, {z:g})"
    if len(rows) == len(anchors):
        return (
            f"all anchors are at one place (all {len(anchors)} are {place}); write the measured "
            "position of each anchor."
        )
    more = f", and {len(together) - 1} more groups are" if len(together) > 1 else ""
    names = _listed(anchors.ids[rows])
    return f"anchors {names} are at one place ({place}{more}); measure each of them again."


def refuse_faulty(anchors: Anchors, source: str = "anchors") -> Anchors:
    """Return the Anchors unchanged; raise InputError for a survey that is certainly wrong.

    source : origin of the anchors, for the message
    """
    fault = survey_fault(anchors)
    if fault:
        raise InputError(f"{source}: {fault}")
    return anchors


def _far(anchors: Anchors) -> str:
    """Return the fault of anchors without neighbours within radio reach, all or single ones, or ""."""
    positions = anchors.positions
    off = np.abs(positions - np.median(positions, axis=0)).max(axis=1)
    rows = np.argsort(off)[-FARTHEST_OFF:]
    distances = np.linalg.norm(positions[rows, None] - positions, axis=2)
    # to the second nearest other anchor, as place 0 is the anchor itself: the nearest may be misplaced
    # with it
    place = min(NEIGHBOURS, len(anchors) - 1)
    nearest = np.partition(distances, place, axis=1)[:, place]
    lonely = rows[nearest > LONELY]
    if not len(lonely):
        return ""
    spacing = float(np.median(nearest[nearest > LONELY]))
    who, looks, them = "the survey", "looks", "it"
    if len(lonely) > 0.5 * len(rows):
        evidence = f"neighbouring anchors are {spacing:.0f} m apart"
        unit = min(UNITS, key=lambda name: abs(np.log(spacing / UNITS[name] / USUAL)))
    else:
        names = _listed(np.sort(anchors.ids[lonely]))
        who = f"the position of anchor {names}"
        if len(lonely) > 1:
            who, looks, them = f"the positions of anchors {names}", "look", "them"
        evidence = f"{spacing:.0f} m from the second nearest anchor"
        rest = positions[np.setdiff1d(np.arange(len(anchors)), lonely)]
        inside = {
            name: np.linalg.norm(positions[lonely[-1]] / count - np.median(rest, axis=0))
            for name, count in UNITS.items()
        }
        # the smallest divisor that puts the farthest one within two room sizes of the rest
        room = 2.0 * np.ptp(rest, axis=0).max()
        unit = next((name for name in reversed(UNITS) if inside[name] < room), "")
    evidence += ", and a radio reaches 300 m"
    # after the division the spacing must be one of anchors
    if not unit or not 0.05 < spacing / UNITS[unit] < 0.5 * LONELY:
        return f"{who} cannot be in metres ({evidence}); give metres, in one frame for all anchors."
    return (
        f"{who} {looks} like {unit} ({evidence}); give metres: divide {them} by {UNITS[unit]:.6g}."
    )


def _listed(ids: np.ndarray) -> str:
    named = [str(number) for number in ids[:MOST_NAMED].tolist()] + ["..."] * (
        len(ids) > MOST_NAMED
    )
    return named[0] if len(named) == 1 else f"{', '.join(named[:-1])} and {named[-1]}"


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


def read_survey(path: str | Path) -> Anchors:
    """Return the Anchors of a survey file, in the frame of the survey.

    The file is of a total station, or of any form of `read_entries` whose anchors have numbers as
    names. Raises InputError with line or key, value and remedy.
    """
    entries, frame = read_entries(path)
    for entry in entries:
        if not is_id(entry.name):
            raise InputError(
                f"{path}: {entry.where}: id is {entry.name[:40]!r}; it must be a whole number."
            )
    return anchors_of(path, entries, [int(entry.name) for entry in entries], frame)


def anchors_of(
    path: str | Path, entries: Sequence[Entry], ids: Sequence[int], frame: str
) -> Anchors:
    """Return the Anchors of entries of a file, with these ids; raise InputError."""
    positions = np.array([entry.position for entry in entries])
    orientations = np.array([entry.orientation for entry in entries])
    try:
        return Anchors(np.array(ids), positions, orientations, frame)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


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
            f"{path}: byte {error.start} is not text; give a survey file (.txt, .csv, .yaml "
            "or .json)."
        ) from error
    if not text.strip():
        raise InputError(f"{path}: is empty; give a survey file (.txt, .csv, .yaml or .json).")
    if not is_table(text):
        return read_tree(text, path)
    lines = lines_of(text)
    try:
        comment = _UNIT_COMMENT.search(text)
        unit = _unit(comment[1], f"comment {comment[0].strip()[:60]!r}") if comment else ""
        entries = read_table(lines, unit)
        return (_total_station(path, lines, unit) if entries is None else entries), "map"
    except InputError as error:
        message = str(error)
        raise InputError(
            message if message.startswith(f"{path}: ") else f"{path}: {message}"
        ) from error


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


def _total_station(path: str | Path, lines: Lines, unit: str) -> list[Entry]:
    antennas: dict[Any, list[float]] = {}
    tips: dict[Any, list[float]] = {}
    key: Any
    for number, cells in lines:
        antenna, tip = _ANTENNA.match(cells[0]), _TIP.match(cells[0])
        point = _in_metres(_point(path, number, cells), unit)
        if antenna:
            points, key = antennas, int(antenna[1])
        elif tip:
            points, key = tips, (int(tip[1]), int(tip[2]))
        else:
            continue
        if key in points:
            raise InputError(f"{path}: line {number}: {cells[0]} is there twice; keep one.")
        points[key] = point
    if not antennas:
        raise InputError(
            f"{path}: is no survey that can be read: line {lines[0][0]}, "
            f"{','.join(lines[0][1])[:60]!r}, is neither a header with id, x, y "
            "and z, nor a line 'anchorAnt0,x,y,z' of a total station; put 'id,x,y,z' in the "
            "first line, or write YAML with 'anchors:'."
        )
    for anchor, _ in tips:
        if anchor not in antennas:
            raise InputError(
                f"{path}: anchor {anchor} has arm tips but no line 'anchorAnt{anchor},x,y,z'; "
                "add it."
            )
    _refuse_unit(path, antennas, tips)
    return [
        Entry(str(i), antennas[i], _orientation(path, i, tips), f"anchorAnt{i}")
        for i in sorted(antennas)
    ]


def _refuse_unit(
    path: str | Path,
    antennas: dict[int, list[float]],
    tips: dict[tuple[int, int], list[float]],
) -> None:
    """Raise InputError if the arms of a stand have their true lengths in another unit than metres.

    antennas : {anchor: [x, y, z]}; tips : {(anchor, arm 1 to 3): [x, y, z]}
    """
    for anchor, antenna in antennas.items():
        found = [tips[anchor, k] for k in (1, 2, 3) if (anchor, k) in tips]
        if len(found) < 3 or orientation_from_tips(np.array(found))[1] <= MAX_TIP_RESIDUAL:
            continue
        for unit, count in UNITS.items():
            stand = np.array([antenna, *found]) / count
            if orientation_from_tips(stand[1:])[1] > MAX_TIP_RESIDUAL:
                continue
            who, lines = "the survey looks", "all coordinates"
            if np.linalg.norm(stand[0] - stand[1:].mean(axis=0)) > LARGEST_STAND:
                who = f"the arm tips of anchor {anchor} look"
                lines = f"the lines anchor{anchor}_1, _2 and _3"
            raise InputError(
                f"{path}: {who} like {unit} (the arms of the stand of anchor {anchor} have their "
                f"lengths in {unit}); give metres: divide {lines} by {count:.6g}."
            )


def _orientation(
    path: str | Path, anchor: int, tips: dict[tuple[int, int], list[float]]
) -> list[float]:
    """Return the quaternion x y z w, stand to world, of the arm tips of an anchor; NaN without any.

    tips : {(anchor, arm 1 to 3): [x, y, z] m}; raises InputError for one or two tips, or a poor fit
    """
    found = [tips[anchor, k] for k in (1, 2, 3) if (anchor, k) in tips]
    if not found:
        return NOT_SURVEYED
    if len(found) < 3:
        raise InputError(
            f"{path}: anchor {anchor} has {len(found)} of 3 arm tips; survey all three or "
            "delete them."
        )
    quaternion, residual = orientation_from_tips(np.array(found))
    if residual > MAX_TIP_RESIDUAL:
        raise InputError(
            f"{path}: the arm tips of anchor {anchor} miss the stand's shape by "
            f"{1e3 * residual:.0f} mm (at most "
            f"{1e3 * MAX_TIP_RESIDUAL:.0f} mm expected); check lines anchor{anchor}_1, _2 and _3."
        )
    return quaternion.tolist()


def _point(path: str | Path, number: int, cells: list[str]) -> list[float]:
    point = [_number(cell) for cell in cells[1:]]
    if len(point) != 3 or not (np.abs(point) <= FARTHEST).all():
        raise InputError(
            f"{path}: line {number}: {','.join(cells)[:60]!r} is not 'name,x,y,z' with finite "
            "metres."
        )
    return point
