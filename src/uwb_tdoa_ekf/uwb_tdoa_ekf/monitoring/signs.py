"""Are the signs of all TDOAs the wrong way round? No counter shows that: a second filter, without
the IMU, is fed with both signs, and what each leaves unexplained is compared, as `check` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..core.memory import TDOA, new_state, structured
from .explain import Unexplained, compare, innovations
from .finding import ERROR, Finding

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors


LARGE = 0.75  # m, by which a TDOA changes with its sign, below which it shows nothing
GAIN = 0.35  # share of that change that may be left with the other sign
# Shares of the TDOAs that show something: those that the other sign must explain, and those that
# the present one may explain. After a
# turn these were 0.66 to 1.0 and 0.0 in simulated flights; near a floor, where anchors are metres
# late, 0.67 and 0.3
SHARE, PRESENT = 0.6, 0.1
FEWEST = 10  # TDOAs that show something


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations (n,), m; predicted : (n,) m, at the
    place of the filter.

    All TDOAs that are far from zero are asked, those that the filter explains, too. Where a few
    anchors are late, as near a floor, most TDOAs contradict a turn.
    """
    change = np.abs(2.0 * predicted)
    asked = change > LARGE
    if np.count_nonzero(asked) < FEWEST:
        return False
    small = GAIN * change[asked]
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -d - predicted, of a measured d
    return bool(
        np.mean(left < small) > SHARE and np.mean(np.abs(innovation[asked]) < small) < PRESENT
    )


# What must stay unexplained less, and by how many standard errors. On 37 measured flights, of any
# 10 to 40 s from the start or
# in the air: healthy ones 0.98 and 0.2, those with the other sign 0.81 and 2.5 after 30 s in the
# air, most after 12.
RATIO, DEVIATIONS = 0.85, 3.0
TURNED = -1.0  # value of a Finding on signs that have turned in flight
LONGEST = 40.0  # s of stamps, after which it begins anew


class SignWatch:
    """Compares until it is certain that the signs are right, and again once they are doubted; of
    wrong ones it goes on to see when they are right again.

    finding : Finding, or None.
    """

    def __init__(self, anchors: Anchors) -> None:
        """anchors : Anchors."""
        self._anchors = anchors
        self.finding: Finding | None = None
        self._certain = False
        self._begin()

    def doubt(self) -> None:
        """Compare again, from the next TDOA on, where it was certain."""
        if self._certain:
            self._certain = False
            self._begin()

    def turn(self) -> None:
        """The signs of all TDOAs have turned in flight: name that at once, or its end.

        The comparison begins again, and decides.
        """
        line = (
            "message.distance_difference = distance_to_b - distance_to_a  # always, not only in "
            "the beginning"
        )
        evidence = (
            "from one moment on, each TDOA is the negative of what the place of the tag makes it"
        )
        turned = Finding(
            "tdoa_sign",
            ERROR,
            "the sign of all TDOAs has changed in flight",
            evidence,
            line,
            TURNED,
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
        """Take raw TDOAs (n,) of about a second: stamps, s; ids; m.

        Those that came too late for this are left out.
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
        t = np.concatenate(self._stamps)
        right, wrong = (Unexplained.of(t, np.concatenate(kept)) for kept in self._innovations)
        if _better(right, wrong):
            self.finding, self._certain = None, True
            self._states, self._stamps, self._innovations = [], [], ([], [])
        elif _better(wrong, right):
            ratio, z = compare(right, wrong)
            evidence = (
                f"the other way round {100.0 * (1.0 - ratio):.0f} % less stays unexplained, "
                f"{z:.0f} standard errors"
            )
            line = "message.distance_difference = distance_to_b - distance_to_a  # not a - b"
            self.finding = Finding(
                "tdoa_sign", ERROR, "the sign of all TDOAs is wrong", evidence, line, ratio
            )
            self._begin()
        elif t[-1] - t[0] > LONGEST:
            self._begin()


def _better(one: Unexplained, other: Unexplained) -> bool:
    """Whether one Unexplained certainly leaves less than the other."""
    ratio, z = compare(other, one)
    return ratio < RATIO and z > DEVIATIONS
