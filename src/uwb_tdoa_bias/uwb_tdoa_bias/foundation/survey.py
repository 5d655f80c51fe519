"""Anchor surveys: text files of a total station, tables, YAML and JSON."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from . import survey_forms
from .anchors import FARTHEST, Anchors
from .errors import InputError
from .files import read_bytes
from .later import rotations
from .limits import SURVEY_BYTES
from .survey_forms import Entry, Lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

# The tips of the three marker arms of a stand in the stand's own frame, metres. Arm 1 points up
# (z), arm 3 forward (x).
# Arm 2, "left" for somebody who looks at the stand from the front, points to -y: only this makes a
# right-handed frame
# of the three. (With +y the fit is as good, for three points are flat, but every stand tilts by
# some 60 degrees. With
# -y those on the floor have z up to within 1 degree, and in all of them the antenna is 11 mm
# forward, 26 mm to -y and
# 49 mm up of where the arms meet.)
ARM_TIPS = np.array([[0.0, 0.0, 0.110], [0.0, -0.121, 0.0], [0.080, 0.0, 0.0]])
MAX_TIP_RESIDUAL = 0.010  # metres RMS; measured: 0.5 ... 2.2 mm

_ANTENNA = re.compile(r"anchorAnt_?([0-9]{1,9})$")
_TIP = re.compile(r"anchor_?([0-9]{1,9})_([123])$")


def read_survey(path: str | Path) -> Anchors:
    """Anchors of a survey file: of a total station, or of any form of `read_entries` whose anchors
    are called by numbers.

    Positions stay in the frame of the survey. Raises InputError with line or key, value and remedy.
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
    """Return Anchors of entries of a file, under these ids. Raises InputError."""
    positions, orientations = (
        np.array([entry.position for entry in entries]),
        np.array([entry.orientation for entry in entries]),
    )
    try:
        return Anchors(np.array(ids), positions, orientations, frame)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def is_id(name: str) -> bool:
    """Return whether a name is a whole number, as messages have it."""
    return re.fullmatch("[0-9]{1,9}", name) is not None


def read_entries(path: str | Path) -> tuple[list[Entry], str]:
    """Anchors of a survey file as they stand there, and the name of the world frame. The form is
    told by content:

    - total station: lines `name,x,y,z` in metres; `anchorAntN` is the antenna of anchor N,
      `anchorN_1/_2/_3` the arm
      tips of its stand (up, left, forward), from which the orientation follows; other names are
      ignored;
    - a table: commas, semicolons, tabs or blanks between its cells; a header names id, x, y and z
      in any usual way, with or without
      units; without a header each line is an id and three numbers;
    - YAML or JSON: `anchors: {0: {position: [x, y, z], orientation: [x, y, z, w]}}`, that as a
      list, `0: {x:, y:, z:}` of the Crazyflie
      client, `anchor0_pos: [x, y, z]` of lps-ros, parameter files of ROS, an OpenCV matrix of a row
      for each anchor.

    Orientation: antenna stand to world; x forward, z up the stand, y completes a right-handed
    frame. NaN if not surveyed. Raises InputError.
    """
    try:
        text = read_bytes(path, SURVEY_BYTES).decode("utf-8-sig")
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
    """Rotation that best turns `ARM_TIPS` into the surveyed tips, and the RMS distance that
    remains.

    tips : (3, 3) world positions of tips 1, 2, 3, metres. Returns (quaternion x y z w stand to
        world, metres).
    Source: Kabsch, Acta Cryst. A 32, 1976 (as implemented by scipy).
    """
    surveyed, nominal = tips - tips.mean(axis=0), ARM_TIPS - ARM_TIPS.mean(axis=0)
    rotation, _ = rotations.Rotation.align_vectors(surveyed, nominal)
    return rotation.as_quat(), float(
        np.sqrt(((rotation.apply(nominal) - surveyed) ** 2).sum(axis=1).mean())
    )


def _total_station(path: str | Path, lines: Lines) -> list[Entry]:
    antennas: dict[Any, list[float]] = {}
    tips: dict[Any, list[float]] = {}
    for number, cells in lines:
        antenna, tip = _ANTENNA.match(cells[0]), _TIP.match(cells[0])
        points, key = (
            (antennas, int(antenna[1]))
            if antenna
            else (tips, (int(tip[1]), int(tip[2])))
            if tip
            else (None, None)
        )
        point = _point(path, number, cells)
        if points is None:
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
    return [
        Entry(str(i), antennas[i], _orientation(path, i, tips), f"anchorAnt{i}")
        for i in sorted(antennas)
    ]


def _orientation(
    path: str | Path, anchor: int, tips: dict[tuple[int, int], list[float]]
) -> list[float]:
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
