"""Anchor surveys: total-station text files, CSV files of positions, and our own YAML."""

from __future__ import annotations

import re
from typing import Any, TYPE_CHECKING

import numpy as np

from .anchors import FARTHEST, Anchors
from .errors import InputError
from .files import read_bytes
from .later import rotations
from .limits import SURVEY_BYTES

if TYPE_CHECKING:
    from pathlib import Path

# The tips of the three marker arms of a stand in the stand's own frame, metres. Arm 1 points up (z), arm 3 forward (x).
# Arm 2, "left" for somebody who looks at the stand from the front, points to -y: only this makes a right-handed frame
# of the three. (With +y the fit is as good, for three points are flat, but every stand tilts by some 60 degrees. With
# -y those on the floor have z up to within 1 degree, and in all of them the antenna is 11 mm forward, 26 mm to -y and
# 49 mm up of where the arms meet.)
ARM_TIPS = np.array([[0.0, 0.0, 0.110], [0.0, -0.121, 0.0], [0.080, 0.0, 0.0]])
MAX_TIP_RESIDUAL = 0.010  # metres RMS; measured: 0.5 ... 2.2 mm

_ANTENNA = re.compile(r"anchorAnt_?([0-9]{1,9})$")
_TIP = re.compile(r"anchor_?([0-9]{1,9})_([123])$")
_OURS = re.compile(r"[{\s]*[\"']?anchors[\"']?\s*:")
Lines = list[tuple[int, list[str]]]  # numbers and cells


def read_survey(path: str | Path) -> Anchors:
    """Anchors of a survey file of any of three kinds, told apart by content.

    - total station: lines `name,x,y,z` in metres; `anchorAntN` is the antenna of anchor N, `anchorN_1/_2/_3` the arm
      tips of its stand (up, left, forward), from which the orientation follows; other names are ignored;
    - `id,x,y,z` with that header line, or `,x,y,z`: positions only;
    - YAML, see `Anchors.from_yaml`.

    Orientation: antenna stand to world; x forward, z up the stand, y completes a right-handed frame. NaN without tips.
    Positions stay in the frame of the survey. Raises InputError with the line.
    """
    try:
        text = read_bytes(path, SURVEY_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not text; give a survey file (.txt, .csv or .yaml)."
        ) from error
    texts = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    if any(_OURS.match(line) for _, line in texts):
        return Anchors.from_yaml(path)
    lines = [(number, [cell.strip() for cell in line.split(",")]) for number, line in texts]
    if not lines:
        raise InputError(f"{path}: is empty; give a survey file (.txt, .csv or .yaml).")
    try:
        if lines[0][1] in (["id", "x", "y", "z"], ["", "x", "y", "z"]):  # the second as pandas writes it
            return _positions(path, lines[1:])
        return _total_station(path, lines)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(f"{path}: ") else f"{path}: {message}") from error


def orientation_from_tips(tips: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation that best turns `ARM_TIPS` into the surveyed tips, and the RMS distance that remains.

    tips : (3, 3) world positions of tips 1, 2, 3, metres. Returns (quaternion x y z w stand to world, metres).
    Source: Kabsch, Acta Cryst. A 32, 1976 (as implemented by scipy).
    """
    surveyed, nominal = tips - tips.mean(axis=0), ARM_TIPS - ARM_TIPS.mean(axis=0)
    rotation, _ = rotations.Rotation.align_vectors(surveyed, nominal)
    return rotation.as_quat(), float(np.sqrt(((rotation.apply(nominal) - surveyed) ** 2).sum(axis=1).mean()))


def _positions(path: str | Path, lines: Lines) -> Anchors:
    ids, positions = [], []
    for number, cells in lines:
        if not re.fullmatch("[0-9]{1,9}", cells[0]):
            raise InputError(f"{path}: line {number}: id is {cells[0]!r}; it must be a whole number.")
        ids.append(int(cells[0]))
        positions.append(_point(path, number, cells))
    if not ids:
        raise InputError(f"{path}: holds no anchor; add lines 'id,x,y,z' in metres.")
    return Anchors.from_positions(positions, ids)


def _total_station(path: str | Path, lines: Lines) -> Anchors:
    antennas: dict[Any, list[float]] = {}
    tips: dict[Any, list[float]] = {}
    for number, cells in lines:
        antenna, tip = _ANTENNA.match(cells[0]), _TIP.match(cells[0])
        points, key = (
            (antennas, int(antenna[1])) if antenna else (tips, (int(tip[1]), int(tip[2]))) if tip else (None, None)
        )
        point = _point(path, number, cells)
        if points is None:
            continue
        if key in points:
            raise InputError(f"{path}: line {number}: {cells[0]} is there twice; keep one.")
        points[key] = point
    if not antennas:
        raise InputError(
            f"{path}: is no survey that can be read: expected lines 'anchorAnt0,x,y,z' of a total station, a header "
            "line 'id,x,y,z', or YAML with 'anchors:'."
        )
    for anchor, _ in tips:
        if anchor not in antennas:
            raise InputError(f"{path}: anchor {anchor} has arm tips but no line 'anchorAnt{anchor},x,y,z'; add it.")
    ids = sorted(antennas)
    orientations = np.array([_orientation(path, i, tips) for i in ids])
    return Anchors(np.array(ids), np.array([antennas[i] for i in ids]), orientations)


def _orientation(path: str | Path, anchor: int, tips: dict[tuple[int, int], list[float]]) -> np.ndarray:
    found = [tips[anchor, k] for k in (1, 2, 3) if (anchor, k) in tips]
    if not found:
        return np.full(4, np.nan)
    if len(found) < 3:
        raise InputError(f"{path}: anchor {anchor} has {len(found)} of 3 arm tips; survey all three or delete them.")
    quaternion, residual = orientation_from_tips(np.array(found))
    if residual > MAX_TIP_RESIDUAL:
        raise InputError(
            f"{path}: the arm tips of anchor {anchor} miss the stand's shape by {1e3 * residual:.0f} mm (at most "
            f"{1e3 * MAX_TIP_RESIDUAL:.0f} mm expected); check lines anchor{anchor}_1, _2 and _3."
        )
    return quaternion


def _point(path: str | Path, number: int, cells: list[str]) -> list[float]:
    try:
        point = [float(cell) for cell in cells[1:]]
    except ValueError:
        point = []
    if len(point) != 3 or not (np.abs(point) <= FARTHEST).all():
        raise InputError(f"{path}: line {number}: {','.join(cells)[:60]!r} is not 'name,x,y,z' with finite metres.")
    return point
