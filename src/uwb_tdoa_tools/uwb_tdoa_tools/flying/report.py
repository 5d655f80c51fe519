"""What many flights came to, in words and for JSON."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .verdict import DRIVE_PHASES, PHASES

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

DISHONEST = 3.0  # standard deviations of a coordinate


@dataclass(frozen=True)
class Wording:
    """How verdicts of a vehicle are told. goal : what it was to do, as its verdict has it; begun :
    the same of its start; phases; figures : {name: what it is}, silent ones "".
    """

    goal: str
    begun: str
    phases: tuple[str, ...]
    figures: dict[str, str]


QUADROTOR = Wording(
    "landed",
    "armed",
    PHASES,
    {
        "armed_off": "estimate off when armed, m",
        "tracking": "off the path in the air, m",
        "estimation": "",
        "place": "landed from the wanted place, m",
        "touchdown": "touchdown, m/s",
    },
)
ROVER = Wording(
    "arrived",
    "started",
    DRIVE_PHASES,
    {
        "armed_off": "estimate off when started, m",
        "tracking": "off the path, m",
        "farthest": "largest distance to the path, m",
        "estimation": "",
        "place": "stopped from the wanted place, m",
        "yaw": "yaw off, degrees",
        "yaw_nees": "NEES of the yaw",
    },
)


def wording_of(verdict: dict[str, Any]) -> Wording:
    """The Wording of a verdict, or of a summary."""
    return ROVER if ROVER.goal in verdict else QUADROTOR


def reached(verdict: dict[str, Any]) -> bool:
    """Whether a vehicle did what it was to do, by its verdict."""
    return bool(verdict[wording_of(verdict).goal])


def summary(verdicts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """dict for JSON, of verdicts as of `verdict_of`: counts, medians and largest of the figures,
    per phase too.
    """
    wording = wording_of(verdicts[0])
    out = {"flights": len(verdicts), wording.goal: sum(one[wording.goal] for one in verdicts)}
    out["why"] = dict(Counter(one["why"] for one in verdicts if one["why"]).most_common())
    out["safe"] = sum(one["safe"] for one in verdicts)
    out["armed"] = sum(one["started"] is not None for one in verdicts)
    known = [one["armed_deviations"] for one in verdicts if one["armed_deviations"] is not None]
    out["armed_beyond_three_deviations"] = (
        sum(value > DISHONEST for value in known) if known else None
    )  # a peer tells none
    out["said_lost"] = sum(one["said_lost"] is not None for one in verdicts)
    for name in wording.figures:
        out[name] = _spread([one[name] for one in verdicts])
    for phase in wording.phases:
        mine = [one["phases"][phase] for one in verdicts if phase in one["phases"]]
        out[phase] = {
            name: _spread([one[name] for one in mine]) for name in ("rmse", "largest", "nees")
        }
    return out


def _spread(values: Iterable[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {
        "median": float(np.median(known)),
        "least": float(min(known)),
        "most": float(max(known)),
    }


def text(summed: dict[str, Any]) -> str:
    """Lines of a summary."""
    wording = wording_of(summed)
    goal = wording.goal
    lines = [f"{summed[goal]} of {summed['flights']} {goal}; {summed['safe']} without a crash"]
    lines += [f"  {count} {why}" for why, count in summed["why"].items()]
    beyond = summed["armed_beyond_three_deviations"]
    lines.append(
        f"{wording.begun} {summed['armed']}, of these {'?' if beyond is None else beyond} while the "
        "estimate was more than three of its "
        f"deviations off; {summed['said_lost']} said that they were lost"
    )
    for name, what in wording.figures.items():
        if what:
            lines.append(f"{what:34s}{_range(summed[name])}")
    lines.append(f"{'estimate':10s}{'rmse, m':>24s}{'largest, m':>24s}{'NEES':>24s}")
    for phase in wording.phases:
        lines.append(
            f"{phase:10s}"
            + "".join(f"{_range(summed[phase][name]):>24s}" for name in ("rmse", "largest", "nees"))
        )
    return "\n".join(lines)


def sentence(verdict: dict[str, Any]) -> str:
    """One of them in words."""
    goal = wording_of(verdict).goal
    if not verdict[goal]:
        return f"not {goal}: {verdict['why']}"
    if goal == ROVER.goal:
        return (
            f"arrived {verdict['place']:.2f} m from the wanted place, "
            f"{verdict['tracking']:.2f} m off the path"
        )
    figures = f"{verdict['place']:.2f} m from the wanted place at {verdict['touchdown']:.2f} m/s"
    return f"landed {figures}, in the air {verdict['tracking']:.2f} m off the path"


def _range(spread: dict[str, float] | None) -> str:
    return (
        "-"
        if spread is None
        else f"{spread['median']:.2f} ({spread['least']:.2f} - {spread['most']:.2f})"
    )
