"""Faults that a survey shows by itself, before any measurement: anchors at one place, another unit,
an anchor far away.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    from .anchors import Anchors

SAME_PLACE = 0.001  # m; two antennas are some centimetres apart at least
# m. A UWB radio reaches some 300 m at most, and a tag must hear several anchors at once: beyond
# this an anchor has no neighbours.
LONELY = 500.0
NEIGHBOURS = 2  # that an anchor must have within that; fewer where there are fewer
USUAL = 6.0  # m between neighbours of usual installations: the unit that comes nearest is named
UNITS = {
    "millimetres": 1000.0,
    "centimetres": 100.0,
    "inches": 1.0 / 0.0254,
    "decimetres": 10.0,
    "feet": 1.0 / 0.3048,
}  # in 1 m
FARTHEST_OFF = 200  # anchors, those farthest off the middle, of which neighbours are looked for
MOST_NAMED = 10  # anchors in a sentence


class SurveyFault(NamedTuple):
    """rule : its name; cause : what is wrong, a clause; evidence : numbers; remedy : what to do;
    value : the number that decided.
    """

    rule: str
    cause: str
    evidence: str
    remedy: str
    value: float

    @property
    def sentence(self) -> str:
        """All of it in one line."""
        return f"{self.cause} ({self.evidence}); {self.remedy}."


def survey_faults(anchors: Anchors) -> list[SurveyFault]:
    """Return what is certainly wrong with Anchors: list of SurveyFault, empty for a usable survey."""
    if len(anchors) < 2:
        return []
    together = _together(anchors)
    if together and len(together[0]) == len(anchors):
        x, y, z = anchors.positions[0]
        cause, remedy = "all anchors are at one place", "write the measured position of each anchor"
        evidence = f"all {len(anchors)} are at ({x:g}, {y:g}, {z:g})"
        return [SurveyFault("survey_one_place", cause, evidence, remedy, float(len(anchors)))]
    return [*_same_place(anchors, together), *_far(anchors)]


def refuse_faulty(anchors: Anchors, source: str = "anchors") -> Anchors:
    """Return the Anchors unchanged. source : where they are from, for the message.

    Raises InputError for a survey that is certainly wrong.
    """
    faults = survey_faults(anchors)
    if faults:
        raise InputError(f"{source}: {faults[0].sentence}")
    return anchors


def _together(anchors: Anchors) -> list[np.ndarray]:
    """Groups of rows (k,) that are at one place."""
    cells = np.round(anchors.positions / SAME_PLACE)
    _, group, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return [np.flatnonzero(group.reshape(-1) == number) for number in np.flatnonzero(counts > 1)]


def _same_place(anchors: Anchors, together: list[np.ndarray]) -> list[SurveyFault]:
    if not together:
        return []
    rows = together[0]
    x, y, z = anchors.positions[rows[0]]
    cause = f"anchors {_listed(anchors.ids[rows])} are at one place"
    evidence = f"at ({x:g}, {y:g}, {z:g})" + (
        f", and {len(together) - 1} more groups are" if len(together) > 1 else ""
    )
    return [
        SurveyFault(
            "survey_same_place", cause, evidence, "measure each of them again", float(len(rows))
        )
    ]


def _far(anchors: Anchors) -> list[SurveyFault]:
    """Anchors without neighbours within the reach of a radio: all of them, or single ones."""
    positions = anchors.positions
    off = np.abs(positions - np.median(positions, axis=0)).max(axis=1)
    rows = np.argsort(off)[-FARTHEST_OFF:]
    distances = np.linalg.norm(positions[rows, None] - positions, axis=2)
    nearest = np.partition(distances, min(NEIGHBOURS, len(anchors) - 1), axis=1)[
        :, min(NEIGHBOURS, len(anchors) - 1)
    ]
    lonely = rows[nearest > LONELY]
    if not len(lonely):
        return []
    spacing, one = float(np.median(nearest[nearest > LONELY])), len(lonely) == 1
    if len(lonely) > 0.5 * len(rows):
        who, looks, evidence = (
            "the survey",
            "looks",
            f"neighbouring anchors are {spacing:.0f} m apart",
        )
        unit = min(UNITS, key=lambda name: abs(np.log(spacing / UNITS[name] / USUAL)))
    else:
        names, looks = _listed(np.sort(anchors.ids[lonely])), "looks" if one else "look"
        who = f"the position of anchor {names}" if one else f"the positions of anchors {names}"
        evidence = f"{spacing:.0f} m from the other anchors"
        rest = positions[np.setdiff1d(np.arange(len(anchors)), lonely)]
        inside = {
            name: np.linalg.norm(positions[lonely[-1]] / count - np.median(rest, axis=0))
            for name, count in UNITS.items()
        }
        unit = next(
            (name for name in reversed(UNITS) if inside[name] < 2.0 * np.ptp(rest, axis=0).max()),
            "",
        )
    evidence += ", and a radio reaches 300 m"
    if not unit or not 0.05 < spacing / UNITS[unit] < 0.5 * LONELY:
        return [
            SurveyFault(
                "survey_unit",
                f"{who} cannot be in metres",
                evidence,
                "give metres, in one frame for all anchors",
                spacing,
            )
        ]
    remedy = (
        f"give metres: divide {'it' if one or looks == 'looks' else 'them'} by {UNITS[unit]:.6g}"
    )
    return [SurveyFault("survey_unit", f"{who} {looks} like {unit}", evidence, remedy, UNITS[unit])]


def _listed(ids: np.ndarray) -> str:
    named = [str(number) for number in ids[:MOST_NAMED].tolist()] + ["..."] * (
        len(ids) > MOST_NAMED
    )
    return named[0] if len(named) == 1 else f"{', '.join(named[:-1])} and {named[-1]}"
