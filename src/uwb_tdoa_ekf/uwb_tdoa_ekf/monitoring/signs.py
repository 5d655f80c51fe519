# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detect whether the signs of all TDOAs are wrong.

No counter shows this. Two filters without IMU process the TDOAs with both signs. Their unexplained
losses are compared, as in `check`.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors

from ..core.memory import TDOA, new_state, structured
from .explain import Unexplained, compare, innovations
from .finding import ERROR, Finding
from .slices import FEWEST

LARGE = 0.75  # m, change of a TDOA with its sign below which it shows nothing
GAIN = 0.35  # largest share of that change that the other sign may leave
# Shares of the significant TDOAs: smallest share that the other sign must explain, and largest
# share that the present sign may explain. After a flip these were 0.66 to 1.0 and 0.0 in simulated
# flights. Near a floor, where anchors are metres late, they were 0.67 and 0.3.
SHARE, PRESENT = 0.6, 0.1
# Smallest number of standard errors. On 37 measured flights, over any 10 to 40 s from the start or
# in the air: healthy flights have 0.2. Flights with the other sign have 2.5 after 30 s in the air,
# most of them after 12 s.
DEVIATIONS = 3.0
WRONG_SIGN = "the sign of all TDOAs is wrong"
RIGHT_SIGN = "message.distance_difference = distance_to_b - distance_to_a  # not a - b"
TURNED = -1.0  # value of a Finding on signs that flipped in flight
LONGEST = 40.0  # s of stamps after which an undecided comparison restarts


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations of a slice.

    All TDOAs far from zero count, including those that the filter explains. If a few anchors are
    late, as near a floor, most TDOAs therefore contradict a flip.

    Parameters
    ----------
    innovation : (n,) array
        Innovations, in m.
    predicted : (n,) array
        TDOAs predicted at the position of the filter, in m.
    """
    change = np.abs(2.0 * predicted)
    asked = change > LARGE
    if np.count_nonzero(asked) < FEWEST:
        return False
    small = GAIN * change[asked]
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -(-d - predicted) for a measured d
    return bool(
        np.mean(left < small) > SHARE and np.mean(np.abs(innovation[asked]) < small) < PRESENT
    )


class SignWatch:
    """Compare both signs until the right sign is certain, and again after a doubt.

    After it finds wrong signs, the comparison continues and detects when they are right again.

    Attributes
    ----------
    finding : Finding or None
        Present result.
    """

    def __init__(self, anchors: Anchors) -> None:
        """Start a comparison for some Anchors."""
        self._anchors = anchors
        self.finding: Finding | None = None
        self._certain = False
        self._begin()

    def doubt(self) -> None:
        """Restart the comparison with the next TDOA if the signs were certain."""
        if self._certain:
            self._certain = False
            self._begin()

    def turn(self) -> None:
        """Report at once that all signs have flipped in flight, or that an earlier flip is over.

        The comparison restarts and decides.
        """
        turned = Finding(
            "tdoa_sign",
            ERROR,
            cause="the sign of all TDOAs has changed in flight",
            evidence=(
                "from one moment on, each TDOA is the negative of what the place of the tag makes "
                "it"
            ),
            remedy=(
                "message.distance_difference = distance_to_b - distance_to_a  # always, not only "
                "in "
                "the beginning"
            ),
            value=TURNED,
        )
        if self.finding is None:
            self.finding = turned
        elif self.finding.value == turned.value:
            self.finding = None
        self._certain = False
        self._begin()

    def _begin(self) -> None:
        self._states = [new_state(self._anchors.positions) for _ in range(2)]
        self._stamps: list[np.ndarray] = []
        self._innovations: tuple[list[np.ndarray], list[np.ndarray]] = [], []

    def feed(self, t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray) -> None:
        """Add raw TDOAs of about one second.

        TDOAs older than the newest ones of earlier calls are ignored.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) array
            Anchor ids.
        d : (n,) array
            TDOAs, in m.
        """
        if self._certain:
            return
        last = self._stamps[-1][-1] if self._stamps else -np.inf
        rows = np.flatnonzero(np.isfinite(t) & (t >= last))
        rows = rows[np.argsort(t[rows], kind="stable")]
        if not len(rows):
            return
        t, a, b, d = t[rows], self._anchors.index(a[rows]), self._anchors.index(b[rows]), d[rows]
        self._stamps.append(t)
        for state, kept, sign in zip(self._states, self._innovations, (1.0, -1.0)):
            kept.append(
                innovations(state, structured(TDOA, t, a, b, sign * d), self._anchors.positions)
            )
        self._test()

    def _test(self) -> None:
        # Decide between both signs, or restart the comparison after LONGEST.
        t = np.concatenate(self._stamps)
        right, wrong = (Unexplained.of(t, np.concatenate(kept)) for kept in self._innovations)
        if _better(right, wrong):
            self.finding, self._certain = None, True
            self._states, self._stamps, self._innovations = [], [], ([], [])
        elif _better(wrong, right):
            ratio, z = compare(right, wrong)
            self.finding = Finding(
                "tdoa_sign",
                ERROR,
                cause=WRONG_SIGN,
                evidence=(
                    f"the other way round {100.0 * (1.0 - ratio):.0f} % less stays unexplained, "
                    f"{z:.0f} standard errors"
                ),
                remedy=RIGHT_SIGN,
                value=ratio,
            )
            self._begin()
        elif t[-1] - t[0] > LONGEST:
            self._begin()


def _better(one: Unexplained, other: Unexplained) -> bool:
    """Return whether one Unexplained is significantly smaller than the other."""
    return compare(other, one)[1] > DEVIATIONS
