# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge which positions the anchors and the motion of the tag determine.

A rule takes a CoverageView and yields Findings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_ekf.core.workspace import FLAT
from uwb_tdoa_ekf.monitoring.finding import NOTE, WARNING, Finding
from uwb_tdoa_ekf.monitoring.monitor import NEARER
from uwb_tdoa_ekf.monitoring.windows import TdoaWindow

from .ordered import FLAT_SHARE, LEAST_MOTION, second_principal_std, size_and_thickness
from .pair_rules import MANY

CEILING = 1.5  # m; anchors whose mean height is larger hang at a ceiling


def sides_of(positions: np.ndarray) -> tuple[str, ...]:
    """Return the possible values of `tag_side` for anchors in a plane across an axis of the world.

    Parameters
    ----------
    positions : (n, 3) array
        Anchors, m, world.

    Returns
    -------
    tuple of str
        ("below",), ("above",), ("+x", "-x"), ("+y", "-y"), or () if the anchors lie in no such plane or
        in a line.
    """
    flat = np.ptp(positions, axis=0) < FLAT
    if np.count_nonzero(flat) != 1 or second_principal_std(positions) < FLAT:
        return ()
    if flat[2]:
        return ("below",) if positions[:, 2].mean() > CEILING else ("above",)
    axis = "xy"[int(np.argmax(flat))]
    return f"+{axis}", f"-{axis}"


def to_copy(sides: Sequence[str]) -> str:
    """Return the remedy for possible sides, as a phrase."""
    lines = " or ".join(f"-p tag_side:={side}" for side in sides)
    which = (
        ""
        if len(sides) == 1
        else f", whether the tag is at {'larger or smaller ' + sides[0][1:]} than they are"
    )
    return f"tell ekf_node the side, --ros-args {lines}{which} (tag_side in a file for --config)"


RARE = 0.2  # share of the median rate of the anchors; healthy 0.54 at least
SILENT = 5.0  # s for which an anchor that is heard otherwise is not
OUTSIDE, MARGIN = 0.5, 0.5  # share of the places of the tag, and m beyond the box of the anchors
SHORT = 10.0  # s
FEWEST = 3  # anchors, which always lie in a plane
NAMED = 5  # missing anchors of a hall that the finding names
PART = 0.2  # share of the seconds with an unknown side beyond which there is a finding


@dataclass(frozen=True)
class CoverageView:
    """Input of the rules.

    Attributes
    ----------
    anchors : Anchors
        The survey.
    windows : list of TdoaWindow
        Windows of a second.
    places : (k, 3) array
        Positions of the tag, m, world; empty if it was not located.
    height_known : bool
        Whether a sensor measures the height of the tag.
    track : (t (k,) s, p (k, 3) m) or None
        Trajectory of the tag.
    """

    anchors: Anchors
    windows: list[TdoaWindow]
    places: np.ndarray
    height_known: bool = False
    track: tuple[np.ndarray, np.ndarray] | None = None

    def within_reach(self, heard: np.ndarray) -> np.ndarray:
        """Return in which windows the tag is near enough to each anchor to hear it.

        The limit is the distance to the farthest anchor that it hears. Without a track, all are near.

        Parameters
        ----------
        heard : (W, N) array
            Number of TDOAs of each anchor in each window.

        Returns
        -------
        (W, N) array of bool
        """
        if self.track is None or len(self.track[0]) < 2:
            return np.ones(heard.shape, bool)
        t = np.array([0.5 * (window.stamps.begin + window.stamps.end) for window in self.windows])
        place = np.column_stack([np.interp(t, self.track[0], column) for column in self.track[1].T])
        away = np.linalg.norm(place[:, None] - self.anchors.positions, axis=2)
        return away <= NEARER * np.max(away, where=heard > 0, initial=0.0)


def unheard_anchors(view: CoverageView) -> Iterator[Finding]:
    """Yield anchors of the survey that are never, hardly ever, or for a while not heard."""
    if not view.windows:  # a recording of less than a second
        return
    heard = np.array([window.heard for window in view.windows])
    counts = heard.sum(axis=0)
    near = view.within_reach(heard)
    many = len(counts) > MANY  # the tag passes out of the reach of most
    lost = view.anchors.ids[(counts == 0) & (many | near.any(axis=0))].tolist()
    if many:
        if lost:
            yield Finding(
                "anchor_missing",
                NOTE,
                cause=(
                    f"the tag never hears {len(lost)} of {len(counts)} anchors, such as "
                    f"{', '.join(map(str, lost[:NAMED]))}"
                ),
                evidence=f"{len(lost)} of {len(counts)}",
                remedy=(
                    "look whether they are on, if the tag was near them: localize --zones says who "
                    "was heard where"
                ),
                value=float(len(lost)),
            )
        return
    if lost:
        yield Finding(
            "anchor_missing",
            WARNING,
            cause=f"anchors of the survey that the tag never hears: {', '.join(map(str, lost))}",
            evidence=f"{len(lost)} of {len(counts)}",
            remedy="switch them on, or take them out of the survey",
            value=float(len(lost)),
        )
    rates = counts / np.maximum(near.sum(axis=0), 1)
    for row in np.flatnonzero((counts > 0) & near.any(axis=0)):
        share = rates[row] / np.median(rates[counts > 0])
        number = int(view.anchors.ids[row])
        remedy = f"look at anchor {number}: power, line of sight"
        since, until = _silence(view.windows, (heard[:, row] > 0) | ~near[:, row])
        if until - since > SILENT:
            yield Finding(
                "anchor_silent",
                WARNING,
                cause=f"anchor {number} falls silent",
                evidence=f"{until - since:.0f} s from {since:.1f} s on",
                remedy=remedy,
                value=until - since,
            )
        elif share < RARE:
            yield Finding(
                "anchor_rare",
                NOTE,
                cause=f"anchor {number} is hardly heard",
                evidence=f"{100.0 * share:.0f} % of what is heard of the one in the middle",
                remedy=remedy,
                value=share,
            )


def _silence(windows: Sequence[TdoaWindow], heard: np.ndarray) -> tuple[float, float]:
    """Return (first, last stamp or arrival) of the longest run of windows that are not `heard` (W,).

    (0, 0) if there is none.
    """
    longest, begin = (0.0, 0.0), None
    for window, there in zip(windows, heard):
        if there:
            begin = None
            continue
        begin = window.stamps.begin if begin is None else begin
        longest = max(longest, (begin, window.stamps.end), key=lambda run: run[1] - run[0])
    return longest


def flat_anchors(view: CoverageView) -> Iterator[Finding]:
    """Yield a finding if the anchors lie in one plane: in a hall, those that are heard together.

    The distance from the plane is then poorly determined, and its sign not at all.
    """
    p = view.anchors.positions
    together = [p[window.heard > 0] for window in view.windows] if len(p) > MANY else [p]
    sizes = [size_and_thickness(some) for some in together if len(some) > FEWEST]
    found = [(size, thickness) for size, thickness in sizes if thickness < FLAT_SHARE * size]
    if len(found) > PART * len(sizes):
        size, thickness = np.median(found, axis=0)
        yield Finding(
            "anchors_flat",
            WARNING,
            cause="the anchors lie in a plane: the direction across it is hardly told",
            evidence=f"they are within {thickness:.2f} m (rms) of a plane and {size:.1f} m across",
            remedy=(
                "put half of the anchors low, and half of them high; plan --improve move says "
                "which "
                "where"
            ),
            value=float(thickness),
        )


def unknown_side(view: CoverageView) -> Iterator[Finding]:
    """Yield a finding if the anchors lie in a plane across an axis: the user must give the tag's side."""
    heard = [view.anchors.positions[window.heard > 0] for window in view.windows]
    sides = [
        sides_of(positions)
        for positions in heard or [view.anchors.positions]
        if len(positions) > FEWEST
    ]
    needed = [one for one in sides if one]
    if len(needed) <= PART * len(sides):
        return
    most = max(sorted(set(needed)), key=needed.count)
    if view.height_known and most[0] in ("below", "above"):
        return
    remedy = to_copy(most)
    yield Finding(
        "side_unknown",
        WARNING,
        cause="TDOAs do not tell on which side of its anchors the tag is",
        evidence=(
            f"in {100.0 * len(needed) / len(sides):.0f} % of the seconds those that are heard have "
            f"one {'height' if len(most) == 1 else most[0][1:]}"
        ),
        remedy=remedy,
        value=len(needed) / len(sides),
    )


def survey_below_zero(view: CoverageView) -> Iterator[Finding]:
    """Yield a finding if all anchors are below zero: z points down."""
    z = view.anchors.positions[:, 2]
    if z.max() <= 0.05 and np.ptp(z) > 0.5:
        yield Finding(
            "survey_z_down",
            WARNING,
            cause="all anchors are below zero: z seems to point down in the survey",
            evidence=f"heights from {z.min():.2f} to {z.max():.2f} m",
            remedy="x, y, z = y, x, -z  # of every anchor; x, y, -z if y is left of x",
            value=float(z.max()),
        )


def tag_outside(view: CoverageView) -> Iterator[Finding]:
    """Yield a finding if the tag is outside of its anchors."""
    p = view.anchors.positions
    if not len(view.places):
        return
    low, high = p.min(axis=0) - MARGIN, p.max(axis=0) + MARGIN
    share = float(np.mean(((view.places < low) | (view.places > high)).any(axis=1)))
    if share > OUTSIDE:
        yield Finding(
            "outside",
            WARNING,
            cause="the tag is outside of its anchors, where it is hardly located",
            evidence=(
                f"{100.0 * share:.0f} % of the places are more than {MARGIN} m beyond the anchors"
            ),
            remedy="look where a tag can be located: plan --volume draws it",
            value=share,
        )


def little_motion(view: CoverageView) -> Iterator[Finding]:
    """Yield a finding if the tag hardly moves."""
    if not len(view.places):
        return
    moved = second_principal_std(view.places)
    duration = view.windows[-1].stamps.end - view.windows[0].stamps.begin
    if duration < SHORT or moved < LEAST_MOTION:
        yield Finding(
            "little_motion",
            NOTE,
            cause="sign, ids, survey and axes can hardly be told from this recording",
            evidence=(
                f"{duration:.0f} s; the positions vary by {moved:.2f} m (standard deviation) across "
                "their main direction"
            ),
            remedy=(
                "record a minute in which the tag is carried through the whole room, turned, "
                "lifted "
                "and lowered"
            ),
            value=moved,
        )


RULES = (unheard_anchors, flat_anchors, unknown_side, survey_below_zero, tag_outside, little_motion)
