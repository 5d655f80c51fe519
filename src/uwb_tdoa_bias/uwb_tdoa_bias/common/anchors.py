# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors of an installation: ids, positions and orientations of the fixed radios.

`FlyableVolume` is where they locate a tag reliably; `plan` saves it and `ekf_node` reads it.
`refuse_faulty` finds faults that a survey alone shows: units, places, coordinates in degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import yaml

from .errors import InputError, written_by
from .files import read_arrays, write_filled, write_text

SAME_PLACE = 0.01  # m; a smaller change of a repeated anchor is no change
# m. Data made for other anchors, e.g. a flyable volume, hold only if every anchor moved less.
CONSTELLATION = 0.1
MOST = 10_000  # anchors, limit of a message
# m along each axis. Grid coordinates of a country fit, and their squares do not overflow.
FARTHEST = 1e8


@dataclass(frozen=True)
class Anchors:
    """The fixed radios of one installation, in one world frame.

    Attributes
    ----------
    ids : (N,) int array, each id once, 0 ... 65535
    positions : (N, 3) float array, antenna centres, m, world
    orientations : (N, 4) float array, quaternions x y z w, antenna to world, normalised;
        a row of NaN if the orientation was not surveyed
    frame : name of the world frame
    """

    ids: np.ndarray
    positions: np.ndarray
    orientations: np.ndarray
    frame: str = "map"

    def __post_init__(self) -> None:
        ids = _whole(self.ids)
        positions = np.array(self.positions, dtype=float, order="C")
        orientations = np.array(self.orientations, dtype=float)
        n = len(ids)
        if n == 0:
            raise InputError("anchors: the list is empty; give at least two anchors.")
        if n > MOST:
            raise InputError(
                f"anchors: there are {n}; give at most {MOST}, e.g. those of one hall."
            )
        if positions.shape != (n, 3) or orientations.shape != (n, 4):
            raise InputError(
                f"anchors: {n} ids need positions of shape ({n}, 3) and orientations of shape "
                f"({n}, 4), "
                f"got {positions.shape} and {orientations.shape}."
            )
        values, counts = np.unique(ids, return_counts=True)
        if (counts > 1).any():
            raise InputError(
                f"anchors: id {values[counts > 1][0]} is given twice; every anchor needs its "
                "own id."
            )
        bad = ~(np.abs(positions) <= FARTHEST).all(axis=1)
        if bad.any():
            raise InputError(
                f"anchors: position of anchor {ids[bad][0]} is {positions[bad][0]}; it must "
                "be finite metres, at most "
                f"{FARTHEST:g} from the origin."
            )
        bad = ~np.isfinite(orientations).all(axis=1) & ~np.isnan(orientations).all(axis=1)
        bad |= np.abs(np.nan_to_num(orientations)).max(axis=1) > 1e6
        if bad.any():
            raise InputError(
                f"anchors: orientation of anchor {ids[bad][0]} is {orientations[bad][0]}; "
                "give a quaternion x, y, z, w."
            )
        norm = np.linalg.norm(orientations, axis=1, keepdims=True)
        orientations = np.where(
            norm > 1e-9, orientations / np.where(norm > 1e-9, norm, 1.0), np.nan
        )
        for name, value in (("ids", ids), ("positions", positions), ("orientations", orientations)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        rows = np.full(ids.max() + 3, -1)  # one entry per id from -1 to one beyond the largest
        rows[ids + 1] = np.arange(n)
        object.__setattr__(self, "_rows", rows)

    def __len__(self) -> int:
        return len(self.ids)

    def row(self, anchor: int) -> int:
        """Return the row of one id, -1 for an unknown id."""
        return int(self.index(anchor))

    def index(self, ids: ArrayLike) -> np.ndarray:
        """Return the rows of some ids: int array of the shape of `ids`, -1 for an unknown id."""
        rows = self._rows  # type: ignore[attr-defined]  # set by __post_init__, no field
        return rows.take(np.asarray(ids, dtype=np.int64) + 1, mode="clip")

    def stand_at(self, ids: np.ndarray, positions: np.ndarray, frame: str) -> bool:
        """Return whether these anchors stand at some positions, each within CONSTELLATION.

        Parameters
        ----------
        ids : (n,) anchor ids; all ids of this object and no other
        positions : (n, 3) m, world
        frame : name of the world frame; it must be the same
        """
        rows = self.index(ids)
        if frame != self.frame or len(ids) != len(self) or (rows < 0).any():
            return False
        return bool(
            (np.linalg.norm(self.positions[rows] - positions, axis=1) <= CONSTELLATION).all()
        )

    def at(self, positions: np.ndarray) -> Anchors:
        """Return these Anchors at other positions, (N, 3) m, world."""
        return Anchors(self.ids, positions, self.orientations, self.frame)

    def only(self, rows: np.ndarray) -> Anchors:
        """Return the Anchors of some rows."""
        return Anchors(self.ids[rows], self.positions[rows], self.orientations[rows], self.frame)

    @classmethod
    def from_positions(
        cls, positions: ArrayLike, ids: ArrayLike | None = None, frame: str = "map"
    ) -> Anchors:
        """Return Anchors without orientations at (N, 3) positions, m, world.

        Default ids: 0 ... N-1.
        """
        positions = np.asarray(positions, dtype=float)
        ids = np.arange(len(positions)) if ids is None else np.asarray(ids)
        return cls(ids, positions, np.full((len(positions), 4), np.nan), frame)

    @classmethod
    def from_message(cls, message: Any) -> Anchors:
        """Return the Anchors of a uwb_tdoa_msgs/AnchorArray, from rclpy or from a bag.

        The orientation (0, 0, 0, 0) means unknown. An empty frame_id means "map". Raises InputError.
        """
        positions = [anchor.pose.position for anchor in message.anchors]
        orientations = [anchor.pose.orientation for anchor in message.anchors]
        return cls(
            np.array([anchor.id for anchor in message.anchors]),
            np.array([[p.x, p.y, p.z] for p in positions]).reshape(-1, 3),
            np.array([[q.x, q.y, q.z, q.w] for q in orientations]).reshape(-1, 4),
            message.header.frame_id or "map",
        )

    def to_yaml(self, path: str | Path) -> None:
        """Write a YAML file that `read_survey` reads."""
        columns = self.ids.tolist(), self.positions.tolist(), self.orientations.tolist()
        entries = {
            i: {"position": p, **({"orientation": q} if np.isfinite(q).all() else {})}
            for i, p, q in zip(*columns)
        }
        text = yaml.safe_dump(
            {"frame": self.frame, "anchors": entries}, sort_keys=False, default_flow_style=None
        )
        write_text(path, f"# {written_by()}\n{text}")

    def to_csv(self, path: str | Path) -> None:
        """Write ids and positions as a CSV file, to 0.1 mm, that `read_survey` reads."""
        rows = (f"{i},{x:.4f},{y:.4f},{z:.4f}" for i, (x, y, z) in zip(self.ids, self.positions))
        write_text(path, "\n".join(["id,x,y,z", *rows, ""]))


def _whole(ids: ArrayLike) -> np.ndarray:
    """Return ids as (N,) int64; raise InputError unless all are whole numbers 0 ... 65535."""
    values = np.asarray(ids).reshape(-1)
    bad = [
        value
        for value in values.tolist()
        if isinstance(value, bool) or not (0 <= value <= 65535) or value % 1
    ]
    if bad:
        raise InputError(f"anchors: id {bad[0]!r} is not a whole number 0 ... 65535.")
    return values.astype(np.int64)


# of a table id,latitude,longitude,height; the length of a degree is that of the WGS 84 ellipsoid
GEODETIC = (
    "latitude and longitude in degrees; give metres, x to the east and y to the north. For a file with "
    """id,latitude,longitude,height: awk -F, 'NR==1 {print "id,x,y,z"; next} NR==2 {a=$2; o=$3; """
    """r=a*0.01745329} {printf "%s,%.3f,%.3f,%s\\n", $1, ($3-o)*(111413*cos(r)-93.5*cos(3*r)), """
    """($2-a)*(111133-559.8*cos(2*r)), $4}' FILE > metres.csv"""
)
SMALL, MANY_TIMES = 0.01, 1000.0  # degrees, of a room; and how often it goes into the coordinates

ONE_PLACE = 0.001  # m; two antennas are at least some cm apart
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
        (spread > 0.0).any()
        and (MANY_TIMES * spread < np.abs(level)).all()
        and spread.max() < SMALL
    ):
        return f"x and y are the same within {spread.max():.1g}, as are {GEODETIC}"
    cells = np.round(anchors.positions / ONE_PLACE)
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


_FIELDS = {  # fields of the file, and their dtype kinds
    "frame": "U",
    "lower": "f",
    "step": "f",
    "flyable": "b",
    "bound": "f",
    "ids": "i",
    "positions": "f",
    "planar": "b",
}
_REMEDY = "make one with `plan ... --volume`"


@dataclass(frozen=True)
class FlyableVolume:
    """A box of cells, each flyable or not, in the world frame of its anchors.

    Attributes
    ----------
    lower : (3,) corner of the first cell, m, world
    step : (3,) size of a cell, m
    flyable : (nx, ny, nz) bool
    bound : (nx, ny, nz) m, the smallest position error that one round of TDOAs allows: root of the
        summed variances along x, y and, unless planar, z; inf where the position is undetermined
    ids, positions : (N,) and (N, 3) m, the anchors
    frame : name of the world frame
    planar : True if the height of the tag is known and does not matter here; then nz is 1
    """

    lower: np.ndarray
    step: np.ndarray
    flyable: np.ndarray
    bound: np.ndarray
    ids: np.ndarray
    positions: np.ndarray
    frame: str = "map"
    planar: bool = False

    def __post_init__(self) -> None:
        kinds = {
            "lower": float,
            "step": float,
            "flyable": bool,
            "bound": np.float32,
            "ids": int,
            "positions": float,
        }
        for name, kind in kinds.items():
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        shapes = (
            self.lower.shape,
            self.step.shape,
            self.flyable.ndim,
            self.ids.ndim,
            self.positions.shape,
        )
        fits = (
            shapes == ((3,), (3,), 3, 1, (self.ids.size, 3))
            and self.bound.shape == self.flyable.shape
        )
        if not (fits and self.flyable.size):
            raise InputError(
                "flyable volume: lower, step, flyable, bound, ids and positions do not fit "
                "together."
            )
        finite = all(np.isfinite(array).all() for array in (self.lower, self.step, self.positions))
        if not (finite and (self.step > 0.0).all() and (self.bound >= 0.0).all()):
            raise InputError(
                "flyable volume: it holds a number that is not finite, a step that is not "
                "above 0 or a bound below 0."
            )

    def contains(self, p: ArrayLike) -> np.ndarray:
        """Return whether positions p (..., 3), m, world, are flyable: (...) bool.

        Positions outside of the box and positions that are not finite are not flyable.
        """
        inside, cell = self._cells(p)
        return inside & self.flyable[cell]

    def bound_at(self, p: ArrayLike) -> np.ndarray:
        """Return the bound at positions p (..., 3), m, world: (...) m, NaN outside of the box."""
        inside, cell = self._cells(p)
        return np.where(inside, self.bound[cell], np.nan)

    def _cells(self, p: ArrayLike) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Return whether positions are inside of the box, and the indexes of their cells."""
        p = np.asarray(p, dtype=float)
        at = np.where(np.isfinite(p), (p - self.lower) / self.step, -1.0)
        if self.planar:
            at[..., 2] = 0.0
        cell = np.floor(np.clip(at, -1.0, self.flyable.shape)).astype(int)
        inside = ((cell >= 0) & (cell < self.flyable.shape)).all(axis=-1)
        return inside, tuple(np.moveaxis(np.where(inside[..., None], cell, 0), -1, 0))

    def belongs_to(self, anchors: Anchors) -> bool:
        """Return whether the volume was computed for these Anchors."""
        return anchors.stand_at(self.ids, self.positions, self.frame)

    def save(self, path: str | Path) -> None:
        """Write a numpy .npz file that `load` reads."""
        fields = {name: getattr(self, name) for name in _FIELDS}
        write_filled(path, lambda file: np.savez_compressed(file, **fields))

    @classmethod
    def load(cls, path: str | Path) -> FlyableVolume:
        """Read a file that `save` wrote; raises InputError."""
        fields = read_arrays(path, _FIELDS, "flyable volume", _REMEDY)
        try:
            given: dict[str, Any] = {
                **fields,
                "frame": str(fields["frame"]),
                "planar": bool(fields["planar"]),
            }
            return cls(**given)
        except (TypeError, ValueError, OverflowError) as error:  # InputError is a ValueError
            raise InputError(f"{path}: is no flyable volume ({error}); {_REMEDY}.") from error
