"""What a survey from flights says: figures, sentences, a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.elsewhere import elsewhere

from ..checking.known_path import MANY
from ..diagnosis.calibration import LEFT, why_marks_speak_against
from ..diagnosis.self_survey import Surveyed, calibrated

if TYPE_CHECKING:
    from pathlib import Path
    from uwb_tdoa_bias.foundation.anchors import Anchors

IMPROVED = 0.7  # of the standard deviation as given; less is an improvement
CLEARLY = 2.6  # slow innovations as given over those that are left, beyond which the tape was worse than what else is wrong
SURE = 5.0  # standard deviations, and times what most others are off by, that an anchor must be off by to stand apart
KNOWN_WELL = 0.02  # m, standard deviation as given that leaves nothing to wish for


@dataclass(frozen=True, eq=False)
class Result:
    """given : Anchors; given_std (N, 3) m; surveyed : Surveyed; flights : names; base : EffectSet that was in the model;
    blocked : sentences on what makes anchors late somewhere, once somebody has looked (`blocked.py`)."""

    given: Anchors
    given_std: np.ndarray
    surveyed: Surveyed
    flights: tuple[str, ...]
    base: EffectSet = EffectSet()
    blocked: tuple[str, ...] = ()

    @property
    def why_not(self) -> str | None:
        """Why it must not be used instead of what was given; None if it may."""
        before, left, marks = self.surveyed.before, self.surveyed.left, self.surveyed.marks
        if marks:
            return why_marks_speak_against(marks)
        if left <= LEFT or before > CLEARLY * left:
            return None
        return (
            f"{100 * before:.1f} cm of the innovations are slow with the anchors as given, and {100 * left:.1f} cm with others: more than "
            f"{100 * LEFT:.1f} cm: something else is wrong too, and the position might suffer; give --marks, or fly where it is known"
        )

    @property
    def anchors(self) -> Anchors:
        """The Anchors to use."""
        return self.surveyed.anchors if self.why_not is None else self.given

    @property
    def effects(self) -> EffectSet:
        """The EffectSet to use with them, with what was in the model; its covariance is the prior of the next survey."""
        if self.why_not is not None:
            return self.base
        found = self.surveyed
        return calibrated(self.base, found.anchors, np.zeros_like(self.shifts), found.delays, found.covariance)

    @property
    def shifts(self) -> np.ndarray:
        """(N, 3) m, from what was given."""
        return self.surveyed.anchors.positions - self.given.positions

    @property
    def improved(self) -> np.ndarray:
        """(N, 3) bool."""
        return self.surveyed.position_std < IMPROVED * self.given_std

    @property
    def apart(self) -> list[int]:
        """Rows of those of MANY anchors that the flights put plainly elsewhere than given, while they leave the others about where they
        were."""
        if len(self.given) <= MANY:
            return []
        off, told = np.abs(self.shifts), self.improved
        others = np.array([1.4826 * np.median(column[known]) if known.any() else np.inf for column, known in zip(off.T, told.T)])
        return np.flatnonzero((told & (off > SURE * self.surveyed.position_std) & (off > SURE * others)).any(axis=1)).tolist()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        found = self.surveyed
        return {
            "flights": list(self.flights),
            "frame": found.anchors.frame,
            "anchors": {
                str(i): {
                    "given": self.given.positions[row].tolist(),
                    "given_std": self.given_std[row].tolist(),
                    "position": found.anchors.positions[row].tolist(),
                    "std": found.position_std[row].tolist(),
                    "improved": self.improved[row].tolist(),
                    "delay": float(found.delays[row]),
                }
                for row, i in enumerate(found.anchors.ids)
            },
            "changes": [
                {"effect": one.effect, "anchor": one.anchor, "values": one.values.tolist(), "std": one.std.tolist(), "or": list(one.rivals)}
                for one in found.changes
            ],
            "apart": [str(self.given.ids[row]) for row in self.apart],
            "applied": self.why_not is None,
            "blocked": list(self.blocked),
            "marks_left_out": found.marks,
            "marks_on_the_floor": found.grounded,
            "slow_before": found.before,
            "slow_left": found.left,
            "covariance": found.covariance.tolist(),
            "tdoa_std": found.tdoa_std,
            "delay_std": found.delay_std,
            "function_std": found.function_std,
        }

    def as_text(self) -> str:
        """A table of all coordinates, and what it means."""
        lines = ["values that make these data fit; measure again before you move an anchor:"] if self.why_not else []
        lines += [f"{'anchor':>6}  {'given [m]':>24}  {'shift [cm]':>20}  {'std [cm]':>17}  improved"]
        found = self.surveyed
        for row, i in enumerate(found.anchors.ids):
            given = "".join(f"{v:8.2f}" for v in self.given.positions[row])
            shift = "".join(f"{100 * v:7.1f}" for v in self.shifts[row])
            std = "".join(f"{100 * v:6.1f}" for v in found.position_std[row])
            better = "".join(axis if good else "-" for axis, good in zip("xyz", self.improved[row]))
            lines.append(f"{i:>6}  {given:>24}  {shift:>20}  {std:>17}  {better}")
        count = int(self.improved.sum())
        if not self.why_not:
            lines.append(f"{count} of {self.improved.size} coordinates are known better than before")
        rough = self.given_std.max(axis=1) > KNOWN_WELL
        unseen = [str(i) for row, i in enumerate(found.anchors.ids) if rough[row] and not self.improved[row].any()]
        if unseen:
            lines.append(f"nothing new is told of anchors {', '.join(unseen)}: fly closer to them, on all sides, high and low")
        since = "since the last calibration" if self.base.covariance is not None else "beyond what the tape may be off by"
        lines += [f"{since}: {change.as_text()}" for change in found.changes]
        if self.base.covariance is not None:
            lines += [] if found.changes else ["no anchor has changed clearly since the last calibration"]
        for row in self.apart:
            by = ", ".join(f"{100 * value:+.1f} +- {100 * std:.1f}" for value, std in zip(self.shifts[row], found.position_std[row]))
            lines.append(f"anchor {self.given.ids[row]} does not stand where it was given, as the others do: off by {by} cm (x, y, z)")
        lines += self.blocked
        if found.marks:
            before, after, nearer = found.marks
            off = f"off by {100 * before:.1f} cm as given, {100 * after:.1f} cm with the others' survey"
            lines.append(f"marks, each left out once: the estimate there is {off}, and nearer at {nearer:.0%} of them")
        if found.grounded:
            lines.append(
                f"left out: {found.grounded} marks on the floor, where estimates are metres off and do not know it; mark places in the air"
            )
        if self.why_not:
            lines.append(f"nothing is applied, anchors stay as given: {self.why_not}")
        return "\n".join(lines)

    def picture(self, path: str | Path) -> None:
        """Plan and elevation, before and after, with 95 % intervals."""
        with elsewhere():  # where no settings of others are
            from matplotlib.figure import Figure  # takes a second to import

        figure = Figure(figsize=(11.0, 5.0), layout="constrained")
        found = self.surveyed.anchors.positions
        for ax, (u, v) in zip(figure.subplots(1, 2), ((0, 1), (0, 2))):
            ax.errorbar(
                found[:, u], found[:, v], 1.96 * self.surveyed.position_std[:, v], 1.96 * self.surveyed.position_std[:, u],
                fmt="o", ms=5, color="tab:blue", lw=1.2, label="surveyed, 95 %",
            )  # fmt: skip
            ax.plot(self.given.positions[:, u], self.given.positions[:, v], "x", ms=8, color="tab:red", label="given")
            for row, i in enumerate(self.given.ids):
                ax.annotate(str(i), found[row, [u, v]], textcoords="offset points", xytext=(7, 7))
            ax.set(xlabel=f"{'xyz'[u]} [m]", ylabel=f"{'xyz'[v]} [m]", title="from above" if v == 1 else "from the side")
            ax.set_aspect("equal", adjustable="datalim")
            ax.grid(alpha=0.25)
        figure.axes[0].legend()
        figure.savefig(path, dpi=110)
