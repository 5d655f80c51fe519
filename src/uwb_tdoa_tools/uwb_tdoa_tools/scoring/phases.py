# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The phases of a recording, from the motion in its ground truth.

Together the phases are the whole recording. Some overlap.

    at_rest_earlier   rest more than 2 s before the departure
    at_rest_before    the last 2 s before the departure
    first_3_s         the first 3 s after the departure: lift-off
    to_0.3_m          from the departure to the first instant with z > 0.3 m
    in_the_air        from the first to the last instant with z > 0.3 m
    moving            from the departure to the arrival; only if first_3_s, in_the_air and
                      last_3_s do not cover it, or nothing is in the air
    last_3_s          the last 3 s before the arrival: landing
    at_rest_after     from the arrival to the end
    whole             the whole ground truth

Departure and arrival are the first and the last instant at which the tag is away from its place of
rest. That place is the median of its positions in the first, and in the last, half second.

Floors are not at z = 0 everywhere, and the tag sits on top of its vehicle. A tag that rests below
0.3 m, in a recording that exceeds 0.3 m, departs 0.07 m above its own height at rest. In the raw
logs of the UTIL data, with 0.03 m at rest, this is z = 0.1 m. In their constellations, with 0.08 m,
it is 0.15 m, up to a second after z = 0.1 m.

Any other tag departs 0.1 m from its place: a rover, a tag in the hand, a start on a table. If it
departs within a second, the recording starts (or ends) in motion and has no phase of rest there. A
phase that a recording does not have is not reported. A recording without motion is `at_rest_before`
all the time.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.flight import Truth

from ..checking.pair_rules import AIRBORNE

Span = tuple[float, float]  # from when to when, s

RISE = 0.07  # m above its height at rest: away, for a tag on the floor
MOVED = 0.1  # m from its place at rest: away, for a tag without a floor
REST_TIME = 0.5  # s at either end, whose median is the place at rest
SHORTEST = 1.0  # s; a shorter stay within MOVED of the place of rest is no phase of rest
BEFORE_DEPARTURE, IN_MOTION = 2.0, 3.0  # s, the latter after the departure and before the arrival

TITLES = {
    "at_rest_earlier": "at rest, earlier",
    "at_rest_before": "at rest before, 2 s",
    "first_3_s": "first 3 s",
    "to_0.3_m": "until z > 0.3 m",
    "in_the_air": "in the air",
    "moving": "moving",
    "last_3_s": "last 3 s",
    "at_rest_after": "at rest after",
    "whole": "whole recording",
}
# reported for each run of several
NEAR_THE_FLOOR = ("at_rest_before", "first_3_s", "last_3_s", "at_rest_after")


def in_the_air(truth: Truth) -> Span | None:
    """Return the (first, last) stamp with z above 0.3 m, s; None without any."""
    above = np.flatnonzero(truth.p[:, 2] > AIRBORNE)
    return (float(truth.t[above[0]]), float(truth.t[above[-1]])) if len(above) else None


def motion(truth: Truth) -> Span | None:
    """Return (departure, arrival), s; None without motion.

    If the recording starts or ends in motion, the first or last stamp takes their place.
    """
    t, p = truth.t, truth.p
    flies = in_the_air(truth) is not None

    def away(place: np.ndarray) -> tuple[np.ndarray, float]:
        """Return (rows of the poses away from the place, seconds that a rest must last there)."""
        if flies and place[2] <= AIRBORNE:
            return np.flatnonzero(p[:, 2] - place[2] > RISE), 0.0
        return np.flatnonzero(np.linalg.norm(p - place, axis=1) > MOVED), SHORTEST

    left, shortest = away(np.median(p[t <= t[0] + REST_TIME], axis=0))
    back, least = away(np.median(p[t >= t[-1] - REST_TIME], axis=0))
    if not len(left) and not len(back):
        return None
    departure = t[left[0]] if len(left) and t[left[0]] - t[0] >= shortest else t[0]
    arrival = t[back[-1]] if len(back) and t[-1] - t[back[-1]] >= least else t[-1]
    return float(departure), float(max(departure, arrival))


def phases(truth: Truth) -> dict[str, Span]:
    """Return {name: (begin, end) s} of the phases that a Truth has, in the order of TITLES."""
    begin, end = float(truth.t[0]), float(truth.t[-1])
    moving, flown = motion(truth), in_the_air(truth)  # (begin, end) s, or None
    if moving is None:
        found: dict[str, Span | None] = {"at_rest_before": (begin, end), "in_the_air": flown}
    else:
        departure, arrival = moving
        found = {
            "at_rest_earlier": (begin, departure - BEFORE_DEPARTURE),
            "at_rest_before": (max(begin, departure - BEFORE_DEPARTURE), departure),
            "first_3_s": (departure, min(departure + IN_MOTION, arrival)),
            "to_0.3_m": flown and (departure, flown[0]),
            "in_the_air": flown,
            "last_3_s": (max(arrival - IN_MOTION, departure), arrival),
            "at_rest_after": (arrival, end),
        }
        # a slow take-off or landing, or a tag that never leaves the floor
        if flown is None or departure + IN_MOTION < flown[0] or flown[1] < arrival - IN_MOTION:
            found["moving"] = moving
    found["whole"] = begin, end
    return {name: span for name in TITLES if (span := found.get(name)) and span[1] > span[0]}
