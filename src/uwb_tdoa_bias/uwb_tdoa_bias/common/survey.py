# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read anchor surveys, and find faults that a survey alone shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import re
from typing import Any

import numpy as np

from . import survey_forms
from .anchors import FARTHEST, Anchors
from .errors import InputError
from .files import read_bytes
from .lazy import rotations
from .limits import SURVEY_BYTES
from .survey_forms import Entry, Lines

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
      any usual way, with or without units; without a header each line is an id and three numbers;
    - YAML or JSON: `anchors: {0: {position: [x, y, z], orientation: [x, y, z, w]}}`, the same as a
      list, `0: {x:, y:, z:}` of the Crazyflie client, `anchor0_pos: [x, y, z]` of lps-ros, parameter
      files of ROS, an OpenCV matrix with a row for each anchor.

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
    if not survey_forms.is_table(text):
        return survey_forms.read_tree(text, path)
    lines = survey_forms.lines_of(text)
    try:
        entries = survey_forms.read_table(lines)
        return (_total_station(path, lines) if entries is None else entries), "map"
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


def _total_station(path: str | Path, lines: Lines) -> list[Entry]:
    antennas: dict[Any, list[float]] = {}
    tips: dict[Any, list[float]] = {}
    key: Any
    for number, cells in lines:
        antenna, tip = _ANTENNA.match(cells[0]), _TIP.match(cells[0])
        point = _point(path, number, cells)
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
        return survey_forms.NOT_SURVEYED
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
    try:
        point = [float(cell) for cell in cells[1:]]
    except ValueError:
        point = []
    if len(point) != 3 or not (np.abs(point) <= FARTHEST).all():
        raise InputError(
            f"{path}: line {number}: {','.join(cells)[:60]!r} is not 'name,x,y,z' with finite "
            "metres."
        )
    return point
