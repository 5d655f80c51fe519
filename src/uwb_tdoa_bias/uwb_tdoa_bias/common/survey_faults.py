# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find faults that a survey alone shows: units, places, coordinates in degrees."""

from __future__ import annotations

import numpy as np

from .anchors import Anchors
from .errors import InputError

# of a table id,latitude,longitude,height; the length of a degree is that of the WGS 84 ellipsoid
GEODETIC = (
    "latitude and longitude in degrees; give metres, x to the east and y to the north. For a file with "
    """id,latitude,longitude,height: awk -F, 'NR==1 {print "id,x,y,z"; next} NR==2 {a=$2; o=$3; """
    """r=a*0.01745329} {printf "%s,%.3f,%.3f,%s\\n", $1, ($3-o)*(111413*cos(r)-93.5*cos(3*r)), """
    """($2-a)*(111133-559.8*cos(2*r)), $4}' FILE > metres.csv"""
)
SMALL, MANY_TIMES = 0.01, 1000.0  # degrees, of a room; and how often it goes into the coordinates

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
