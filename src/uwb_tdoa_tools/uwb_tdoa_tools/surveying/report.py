# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a user measured besides flights, and what a self-calibration found: figures, sentences, a picture, blocked anchors."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import TABLE_CELLS, InputError
from uwb_tdoa_bias.common.files import write_picture
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.effects import Effect, EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig

from ..bags.bag import read_odometry
from ..checking.pair_rules import MANY
from ..choices import DRIFT
from ..diagnosis.attribution import attribute
from ..diagnosis.constraints import Distance, Mark, OdometryPath
from ..diagnosis.references import Nothing
from ..diagnosis.self_calibration import SelfCalibration
from ..readers.tables import number, read_rows

MARK_KEYS = ("flight", "from", "to", "position", "std")
MARK_EXAMPLE = "{flight: monday, from: 12.0, to: 14.0, position: [1.0, -2.0, 0.5], std: 0.05}"
DISTANCE_COLUMNS = "a", "b", "distance", "std"
COORDINATE_COLUMNS = "anchor", "axis", "value", "std"
AXES = ("x", "y", "z")
PATH_COLUMNS = "t", "x", "y", "z"


def read_marks(path: str | Path, flights: Sequence[Flight]) -> list[Mark]:
    """Read [Mark] of Flights from a YAML file as in MARK_EXAMPLE.

    `from` and `to` are s since the first TDOA of the flight, or its first range without TDOAs.
    `position` is the mean position of the tag between them, m. Raises InputError.
    """
    content = read_yaml(path)
    entries = content.get("marks") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected a list 'marks', each as {MARK_EXAMPLE}.")
    lengths = {flight.name: flight.duration for flight in flights}
    return [
        _mark(f"{path}: mark {number}", entry, lengths)
        for number, entry in enumerate(entries, start=1)
    ]


def _mark(where: str, entry: Any, lengths: Mapping[str, float]) -> Mark:
    if not isinstance(entry, dict) or set(entry) != set(MARK_KEYS):
        raise InputError(f"{where}: must be as {MARK_EXAMPLE}.")
    flight, first, last, position, std = (entry[key] for key in MARK_KEYS)
    if not isinstance(flight, str) or flight not in lengths:
        raise InputError(f"{where}: there is no flight {flight!r}; given are {', '.join(lengths)}.")
    try:
        first, last, std = float(first), float(last), float(std)
        position = tuple(map(float, position))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}; write it as {MARK_EXAMPLE}.") from error
    if not 0.0 <= first < last <= lengths[flight]:
        raise InputError(
            f"{where}: from {first:g} to {last:g} s must lie, one after the other, in the "
            f"{lengths[flight]:.1f} s of {flight}."
        )
    if (
        len(position) != 3
        or not all(abs(value) < 1e6 for value in position)
        or not 0.0 < std < 10.0
    ):
        raise InputError(
            f"{where}: position {list(position)} +- {std:g} must be three coordinates and a "
            "std above 0, in m."
        )
    return Mark(flight, first, last, position, std)


def read_distances(path: str | Path, anchors: Anchors | None = None) -> list[Distance]:
    """Read [Distance] between Anchors from a CSV file with the columns DISTANCE_COLUMNS: ids, m, m.

    anchors : None allows any ids. Raises InputError.
    """
    out, known = [], "" if anchors is None else ", ".join(str(i) for i in anchors.ids)
    for line, row in read_rows(path, DISTANCE_COLUMNS):
        a, b, distance, std = (number(path, line, row, name) for name in DISTANCE_COLUMNS)
        if anchors is None:
            _check_id(path, line, a)
            _check_id(path, line, b)
        if a == b or (anchors is not None and (anchors.index(np.array([a, b])) < 0).any()):
            raise InputError(
                f"{path}: line {line}: {a:g} and {b:g} must be two of the anchors {known}."
                if known
                else f"{path}: line {line}: {a:g} and {b:g} must be two anchors."
            )
        if not (0.0 < distance < 1e4 and 0.0 < std < 10.0):
            raise InputError(
                f"{path}: line {line}: {distance:g} +- {std:g} m is no distance; both must be "
                "above 0, in m."
            )
        out.append(Distance(int(a), int(b), distance, std))
    if not out:
        raise InputError(
            f"{path}: holds no distance; write one in each line below {','.join(DISTANCE_COLUMNS)}."
        )
    return out


def read_coordinates(path: str | Path) -> list[tuple[int, int, float, float]]:
    """Read coordinates of anchors from a CSV file with the columns COORDINATE_COLUMNS.

    Returns (id, axis 0 to 2, value m, std m) of each line; in the file axes are x, y, z. Raises InputError.
    """
    out = []
    for line, row in read_rows(path, COORDINATE_COLUMNS):
        anchor, value, std = (number(path, line, row, n) for n in ("anchor", "value", "std"))
        _check_id(path, line, anchor)
        axis = row["axis"].strip().lower()
        if axis not in AXES or not abs(value) < 1e6 or not 0.0 < std <= 10.0:
            raise InputError(
                f"{path}: line {line}: {axis} = {value:g} +- {std:g} m is no coordinate; write x, y or "
                "z, and a std above 0, at most 10 m."
            )
        out.append((int(anchor), AXES.index(axis), value, std))
    return out


def _check_id(path: str | Path, line: int, value: float) -> None:
    if not (0.0 <= value <= 65535.0 and value == int(value)):
        raise InputError(f"{path}: line {line}: {value:g} is no id; ids are whole, 0 ... 65535.")


def read_paths(
    source: str, flights: Sequence[Flight], drift: float = DRIFT, namespace: str = ""
) -> list[OdometryPath]:
    """Read the OdometryPath of each Flight that the source contains.

    Parameters
    ----------
    source : CSV file, or the name of a nav_msgs/Odometry topic in the bags. The columns of the file
        are flight, t (s, clock of the recording), x, y, z (m).
    drift : m per square root of a second.

    Raises InputError.
    """
    if not 0.0 <= drift <= 10.0:
        raise InputError(f"--drift: {drift:g} must be from 0 to 10 m per square root of a second.")
    if Path(source).is_file():
        return _of_table(source, flights, drift)
    out = []
    for flight in flights:
        if "bag" not in flight.meta:
            raise InputError(
                f"--odometry {source}: is no CSV file, and {flight.name} is no bag that could "
                "have such a topic."
            )
        found = read_odometry(flight.meta["bag"], namespace, topics={"odometry": source})
        valid = np.isfinite(found.p).all(axis=1)
        out.append(OdometryPath(flight.name, found.t[valid], found.p[valid], drift))
    return out


def _of_table(path: str, flights: Sequence[Flight], drift: float) -> list[OdometryPath]:
    rows = {flight.name: array("d") for flight in flights}
    for line, row in read_rows(path, ("flight", *PATH_COLUMNS), TABLE_CELLS):
        if row["flight"] in rows:
            rows[row["flight"]].extend(number(path, line, row, name) for name in PATH_COLUMNS)
    out = []
    for name, some in rows.items():
        if not some:
            raise InputError(
                f"{path}: holds no row of flight {name}; its first column names the flight."
            )
        table = np.array(some).reshape(-1, len(PATH_COLUMNS))
        if (np.diff(table[:, 0]) <= 0.0).any():
            raise InputError(
                f"{path}: the stamps of flight {name} do not rise; sort its rows by t."
            )
        out.append(OdometryPath(name, table[:, 0], table[:, 1:], drift))
    return out


# smallest shift of a misplaced anchor: standard deviations, and multiples of the usual shift
CLEAR_SHIFT = 5.0
KNOWN_WELL = 0.02  # m, standard deviation of a position that needs no survey
BLOCKED_DELAY = 0.2  # m, smallest delay of a blocked anchor; antennas cause up to that


def misplaced_anchors(found: SelfCalibration) -> list[int]:
    """Return the rows of anchors that clearly stand elsewhere than given, while the others do not.

    Empty for MANY anchors or fewer.
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
        (improved & (off > CLEAR_SHIFT * found.position_std) & (off > CLEAR_SHIFT * others)).any(
            axis=1
        )
    ).tolist()


def as_dict(found: SelfCalibration) -> dict[str, Any]:
    """Return the figures for JSON."""
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
                "or_anchors": list(one.others),
            }
            for one in found.changes
        ],
        "apart": [str(found.given.ids[row]) for row in misplaced_anchors(found)],
        "applied": found.why_not is None,
        "blocked": list(found.blocked),
        "marks_left_out": found.marks,
        "marks_on_the_floor": found.marks_on_floor,
        "slow_before": found.before,
        "slow_left": found.left,
        "covariance": found.solution.covariance.tolist(),
        "tdoa_std": found.tdoa_std,
        "delay_std": found.solution.delay_std,
        "tag_delay": found.tag_delay,
        "function_std": found.solution.function_std,
    }


def as_text(found: SelfCalibration) -> str:
    """Return a table of all coordinates, and its interpretation."""
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
            f"the flights do not improve anchors {', '.join(unseen)}: move closer to them, on all "
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
    for row in misplaced_anchors(found):
        by = ", ".join(
            f"{100 * value:+.1f} +- {100 * std:.1f}"
            for value, std in zip(found.shifts[row], found.position_std[row])
        )
        lines.append(
            f"anchor {found.given.ids[row]} is not at its given position, unlike the others: "
            f"off by {by} cm (x, y, z)"
        )
    if found.tag_delay is not None:
        delay, its_std = found.tag_delay
        lines.append(
            f"all ranges are {100 * abs(delay):.1f} +- {100 * its_std:.1f} cm too "
            f"{'long' if delay > 0.0 else 'short'}, in addition to known effects: the antenna "
            "delay of the tag. For another tag the filter estimates the difference "
            "(range_offset_std)"
        )
    lines += found.blocked
    if found.marks:
        before, after, nearer = found.marks
        off = f"off by {100 * before:.1f} cm as given, {100 * after:.1f} cm with the others' survey"
        lines.append(
            f"marks, each left out once: the estimate there is {off}, and nearer at "
            f"{nearer:.0%} of them"
        )
    if found.marks_on_floor:
        lines.append(
            f"left out: {found.marks_on_floor} marks on the floor, where estimates are metres off "
            "and do not know it; mark places in the air"
        )
    if found.why_not:
        lines.append(f"nothing is applied, anchors stay as given: {found.why_not}")
    return "\n".join(lines)


def picture(found: SelfCalibration, path: str | Path) -> None:
    """Draw given and surveyed anchors, from above and from the side, with 95 % intervals."""
    from ..scoring.plots import two_views  # takes a second to import

    figure, views = two_views()
    surveyed = found.surveyed.positions
    for ax, (u, v) in views:
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
            ax.annotate(
                str(i),
                (surveyed[row, u], surveyed[row, v]),
                textcoords="offset points",
                xytext=(7, 7),
            )
    figure.axes[0].legend()
    write_picture(path, figure)


def with_blocked(
    result: SelfCalibration,
    flights: Sequence[Flight],
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> SelfCalibration:
    """Add blocked anchors to the SelfCalibration of Flights.

    Obstacles delay the signals of an anchor in a region. Positions and delays of anchors do not
    explain these residuals.
    """
    flights = [flight for flight in flights if len(flight.tdoa)]
    if not flights:
        return result
    reference = Nothing(config)
    moved = [reference.prepare(replace(flight, anchors=result.surveyed)) for flight in flights]
    base = EffectSet((*result.base.effects, result.found(result.shifts)[1]))
    effects = attribute(
        moved, reference, base, ("nlos",), undeclared=False, progress=progress
    ).effects
    return replace(
        result,
        blocked=tuple(
            sentence for effect in effects for sentence in with_large_delays(effect).advice()
        ),
    )


def with_large_delays(effect: Effect) -> Effect:
    """Return the effect nlos with only the anchors whose delay reaches BLOCKED_DELAY."""
    late = {
        key.partition(".")[0]
        for key, value in effect.values.items()
        if key.endswith(".delay") and value >= BLOCKED_DELAY
    }
    values, std = (
        {key: some[key] for key in some if key.partition(".")[0] in late}
        for some in (effect.values, effect.std)
    )
    return replace(effect, values=values, std=std)
