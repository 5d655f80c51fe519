"""What a self-calibration says for `survey`: figures, sentences, a picture."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.files import write_filled

from ..checking.pair_rules import MANY

if TYPE_CHECKING:
    from pathlib import Path

    from ..diagnosis.self_calibration import SelfCalibration

# standard deviations, and times what most others are off by, that an anchor must be off by to stand
# apart
SURE = 5.0
KNOWN_WELL = 0.02  # m, standard deviation as given that leaves nothing to wish for


def apart(found: SelfCalibration) -> list[int]:
    """Rows of those of MANY anchors that the flights put plainly elsewhere than given, while they
    leave the others about where they were.
    """
    if len(found.given) <= MANY:
        return []
    off, improved = np.abs(found.shifts), found.improved
    others = np.array(
        [
            1.4826 * np.median(column[known]) if known.any() else np.inf
            for column, known in zip(off.T, improved.T)
        ]
    )
    return np.flatnonzero(
        (improved & (off > SURE * found.position_std) & (off > SURE * others)).any(axis=1)
    ).tolist()


def as_dict(found: SelfCalibration) -> dict[str, Any]:
    """For JSON."""
    return {
        "flights": list(found.flights),
        "frame": found.surveyed.frame,
        "anchors": {
            str(i): {
                "given": found.given.positions[row].tolist(),
                "given_std": found.given_std[row].tolist(),
                "position": found.surveyed.positions[row].tolist(),
                "std": found.position_std[row].tolist(),
                "improved": found.improved[row].tolist(),
                "delay": float(found.delays[row]),
            }
            for row, i in enumerate(found.given.ids)
        },
        "changes": [
            {
                "effect": one.effect,
                "anchor": one.anchor,
                "values": one.values.tolist(),
                "std": one.std.tolist(),
                "or": list(one.rivals),
            }
            for one in found.changes
        ],
        "apart": [str(found.given.ids[row]) for row in apart(found)],
        "applied": found.why_not is None,
        "blocked": list(found.blocked),
        "marks_left_out": found.marks,
        "marks_on_the_floor": found.grounded,
        "slow_before": found.before,
        "slow_left": found.left,
        "covariance": found.solution.covariance.tolist(),
        "tdoa_std": found.tdoa_std,
        "delay_std": found.solution.delay_std,
        "tag_delay": found.tag_delay,
        "function_std": found.solution.function_std,
    }


def as_text(found: SelfCalibration) -> str:
    """A table of all coordinates, and what it means."""
    lines = (
        ["values that make these data fit; measure again before you move an anchor:"]
        if found.why_not
        else []
    )
    lines += [f"{'anchor':>6}  {'given [m]':>24}  {'shift [cm]':>20}  {'std [cm]':>17}  improved"]
    for row, i in enumerate(found.given.ids):
        given = "".join(f"{v:8.2f}" for v in found.given.positions[row])
        shift = "".join(f"{100 * v:7.1f}" for v in found.shifts[row])
        std = "".join(f"{100 * v:6.1f}" for v in found.position_std[row])
        better = "".join(axis if good else "-" for axis, good in zip("xyz", found.improved[row]))
        lines.append(f"{i:>6}  {given:>24}  {shift:>20}  {std:>17}  {better}")
    count = int(found.improved.sum())
    if not found.why_not:
        lines.append(f"{count} of {found.improved.size} coordinates are known better than before")
    rough = found.given_std.max(axis=1) > KNOWN_WELL
    moved = {change.anchor for change in found.changes}
    unseen = [
        str(i)
        for row, i in enumerate(found.given.ids)
        if rough[row] and not found.improved[row].any() and str(i) not in moved
    ]
    if unseen:
        lines.append(
            f"nothing new is told of anchors {', '.join(unseen)}: fly closer to them, on all "
            "sides, high and low"
        )
    since = (
        "since the last calibration"
        if found.base.covariance is not None
        else "beyond what the tape may be off by"
    )
    lines += [f"{since}: {change.as_text()}" for change in found.changes]
    if found.base.covariance is not None:
        lines += (
            [] if found.changes else ["no anchor has changed clearly since the last calibration"]
        )
    for row in apart(found):
        by = ", ".join(
            f"{100 * value:+.1f} +- {100 * std:.1f}"
            for value, std in zip(found.shifts[row], found.position_std[row])
        )
        lines.append(
            f"anchor {found.given.ids[row]} does not stand where it was given, as the others "
            f"do: off by {by} cm (x, y, z)"
        )
    if found.tag_delay is not None:
        delay, its_std = found.tag_delay
        lines.append(
            f"all ranges are {100 * abs(delay):.1f} +- {100 * its_std:.1f} cm too "
            f"{'long' if delay > 0.0 else 'short'}, beside what was known: the antenna "
            "delay of the tag; another tag has its own: the filter finds what differs, by "
            "range_offset_std"
        )
    lines += found.blocked
    if found.marks:
        before, after, nearer = found.marks
        off = f"off by {100 * before:.1f} cm as given, {100 * after:.1f} cm with the others' survey"
        lines.append(
            f"marks, each left out once: the estimate there is {off}, and nearer at "
            f"{nearer:.0%} of them"
        )
    if found.grounded:
        lines.append(
            f"left out: {found.grounded} marks on the floor, where estimates are metres off "
            "and do not know it; mark places in the air"
        )
    if found.why_not:
        lines.append(f"nothing is applied, anchors stay as given: {found.why_not}")
    return "\n".join(lines)


def picture(found: SelfCalibration, path: str | Path) -> None:
    """Plan and elevation, before and after, with 95 % intervals."""
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    surveyed = found.surveyed.positions
    for ax, (u, v) in zip(figure.subplots(1, 2), ((0, 1), (0, 2))):
        ax.errorbar(
            surveyed[:, u],
            surveyed[:, v],
            1.96 * found.position_std[:, v],
            1.96 * found.position_std[:, u],
            fmt="o",
            ms=5,
            color="tab:blue",
            lw=1.2,
            label="surveyed, 95 %",
        )
        ax.plot(
            found.given.positions[:, u],
            found.given.positions[:, v],
            "x",
            ms=8,
            color="tab:red",
            label="given",
        )
        for row, i in enumerate(found.given.ids):
            ax.annotate(str(i), surveyed[row, [u, v]], textcoords="offset points", xytext=(7, 7))
        ax.set(
            xlabel=f"{'xyz'[u]} [m]",
            ylabel=f"{'xyz'[v]} [m]",
            title="from above" if v == 1 else "from the side",
        )
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.25)
    figure.axes[0].legend()
    write_filled(path, partial(figure.savefig, dpi=110))
