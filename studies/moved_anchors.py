# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""moved-anchors: recordings in which an anchor was moved by 0.3 to 1 m, or two were exchanged,
before the start or in the middle.

A flight of last week calibrates the tag, without ground truth. Then the anchors change, and another
flight is recorded. Each recording is judged with the calibration of last week, and without it. The
cost of a change is the increase of the 3D RMSE from 5 s after it on. Measured flights have no
change, so every named anchor is a false alarm.
"""

from dataclasses import replace
from functools import partial
import re
from types import SimpleNamespace

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.results import concatenated, rows_of
from uwb_tdoa_tools import cli, options
from uwb_tdoa_tools.diagnosis.self_calibration import Tape, self_calibrate
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing.localize import GOOD, assess
from uwb_tdoa_tools.scoring.metrics import position_errors
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.vehicles import Trajectory

from . import table

KINDS = "moved before", "moved on the way", "exchanged before", "exchanged on the way", "nothing"
MOVED = 0.3, 1.0  # m
MIDDLE = 0.4, 0.6  # of the recording, between which it happens on the way
SECONDS = 60.0  # of a flight
MATTERS = 0.05  # m, by which a change must make the position worse
SETTLED, LANDING = 8.0, 5.0  # s after the start, and before the end, that are not judged
TAPE = 0.05  # m
NEAR = 0.08  # m, 3D, within which a moved anchor shall be found
STEP = 0.5  # s between two checks of the live alarms
_NAMED = re.compile(
    r"two anchors are exchanged, \d+ and \d+|anchor \d+(?:(?:, \d+)* or \d+)?(?=: | is not where| "
    r"is not at| does not stand| is later)|the ids of two"
)


def add_options(add):
    """add : add_argument of a parser."""
    add("flights", nargs="*", metavar="FLIGHT", help="measured flights, in which nothing was moved")
    cli.add(SimpleNamespace(add_argument=add), options.READING)
    words = "judge without a calibration, and survey nothing: in a tenth of the time"
    add("--tape", action="store_true", help=words)
    table.add_options(add, draws=10, first=1000)  # limits were set on draws below 100
    table.add_only(add)


def run(args):
    """Print two tables: the named anchors, and the estimated positions of moved anchors."""
    reading = options.reading_of(args)
    cases = [
        *((kind, seed) for kind in table.chosen(args, KINDS) for seed in _seeds(args, kind)),
        *(reading.find(args.flights) if args.flights else ()),
    ]
    found = table.results(partial(_rows_of, reading, args.tape), cases, args, unit="recording")
    rows = [row for several in found for row in several]
    numbers = "recordings", "it costs more than 5 cm"
    numbers += "named then: check", "localize", "live"
    numbers += "the right one alone: check", "localize", "live"
    cli.show(table.head("change", "survey", *numbers, "of these in a pair: check", "live", texts=2))
    for kind, calibrated in dict.fromkeys((row["kind"], row["calibrated"]) for row in rows):
        some = [row for row in rows if (row["kind"], row["calibrated"]) == (kind, calibrated)]
        cli.show(table.line([kind, "calibrated" if calibrated else "tape", *_named(some)]))
    surveyed = [one for row in rows for one in row.get("surveyed", ())]
    if not surveyed:
        return
    numbers = "moved anchors", "named", "within 8 cm", "stated within 8 cm, and so"
    numbers += "off by, median [m]", "another by more than its deviation"
    cli.show("", table.head("surveyed from", *numbers))
    for source in dict.fromkeys(one["from"] for one in surveyed):
        some = [one for one in surveyed if one["from"] == source]
        cli.show(table.line([source, *_placed(some)]))


def _seeds(args, kind):
    """The seeds of a kind: twice as many without a change."""
    return range(args.first, args.first + args.draws * (2 if kind == "nothing" else 1))


def _rows_of(reading, tape, case):
    """[{figures}] of a measured flight (path, survey), or of a case (kind, seed)."""
    if case[0] not in KINDS:
        return [measured(reading, case)]
    return without_calibration(case) if tape else judge(case)


def _named(rows):
    """Cells of the first table: how often a change was named. Without a change, these are alarms."""
    none = not rows[0]["ids"]
    asked = rows if none else [row for row in rows if row["cost"] > MATTERS]
    cells = [len(rows), "" if none else len(asked)]
    cells += [sum(bool(row[how]) for row in asked) for how in ("check", "localize", "live")]
    if none:
        return cells + 5 * [""]
    ways = ("check", None), ("localize", None), ("live", None), ("check", 2), ("live", 2)
    return cells + [sum(_right(row[how], row["ids"], size) for row in asked) for how, size in ways]


def _placed(surveyed):
    """Cells of the second table: where a survey puts anchors that were moved."""
    off = np.array([one["off"] for one in surveyed])
    near, stated = off < NEAR, np.array([one["std"] < NEAR for one in surveyed])
    return [
        len(surveyed),
        sum(one["named"] for one in surveyed),
        int(near.sum()),
        f"{int((near & stated).sum())} of {int(stated.sum())}",
        f"{np.median(off):.3f}",
        sum(one["others"] > 1.0 for one in surveyed),
    ]


def judge(case):
    """[{figures}] of a recording (kind, seed), with the calibration of last week and without."""
    kind, seed = case
    week, sound, changed, ids, shift, since = recorded(kind, seed)
    last = self_calibrate([replace(week, truth=None)], Tape(std=TAPE))
    rows = []
    for calibrated in (True, False):
        anchors = last.anchors if calibrated else week.anchors
        estimator = FlightEstimator(None, last.effects if calibrated else None)
        other = replace(sound, anchors=anchors)
        flight = other if changed is sound else replace(changed, anchors=anchors)
        row = {"kind": kind, "seed": seed, "calibrated": calibrated, "ids": ids}
        rows.append(row | _judged(flight, other, estimator, since))
        if kind == "moved before":
            base = last.effects if calibrated else EffectSet()
            source = "the last calibration" if calibrated else "a tape"
            moved = int(anchors.index(np.array(ids))[0]), shift, week.anchors
            rows[-1]["surveyed"] = [_surveyed(source, flight, moved, base)]
            if not calibrated:
                exact = recorded(kind, seed, False)[2]
                rows[-1]["surveyed"].append(
                    _surveyed("a tape, no errors of antennas", exact, moved)
                )
    return rows


def without_calibration(case):
    """[{figures}] of a recording (kind, seed), with a tape alone."""
    kind, seed = case
    _, sound, changed, ids, _, since = recorded(kind, seed)
    row = {"kind": kind, "seed": seed, "calibrated": False, "ids": ids}
    return [row | _judged(changed, sound, FlightEstimator(), since)]


def _judged(flight, sound, estimator, since):
    """Return {"cost": m} and the named anchors of a Flight, see `said`.

    cost : increase of the RMSE over the flight without a change
    """
    cost = 0.0
    if flight is not sound:
        cost = _rmse(flight, estimator, since) - _rmse(sound, estimator, since)
    return {"cost": cost, **said(flight, estimator)}


def _surveyed(source, flight, moved, base=EffectSet()):
    """Figures of a survey of a Flight without ground truth, from what `source` names.

    moved : (row of the anchor, by how much it has moved, (3,) m, Anchors without that).
    """
    row, shift, anchors = moved
    found = self_calibrate([replace(flight, truth=None)], Tape(std=TAPE), base)
    off = found.surveyed.positions[row] - anchors.positions[row] - shift
    others = np.delete(np.abs(found.shifts) / found.position_std, row, axis=0)
    named = [change.anchor for change in found.changes] == [str(anchors.ids[row])]
    return {
        "from": source,
        "off": float(np.linalg.norm(off)),
        "std": float(np.linalg.norm(found.position_std[row])),
        "others": float(others.max()),
        "named": named,
    }


def measured(reading, recording):
    """Figures of a measured flight."""
    flight = replace(reading.read(recording), truth=None)
    return {
        "kind": f"none, measured {flight.name[:4]}",
        "calibrated": False,
        "ids": [],
        "name": flight.name,
        **said(flight, FlightEstimator()),
    }


def recorded(kind, seed, bias=True):
    """(Flight of last week, today's without a change and with it, ids of the anchors that changed,
    shift (3,) m, stamp of the change, s). bias : whether antennas and delays err.
    """
    rng = np.random.default_rng([seed, 7])
    room = "corners" if seed % 2 else f"random-{seed}-8"
    week, sound = (_flown(seed, path, room, None, bias) for path in (0, 1))
    anchors, since = sound.anchors, -np.inf
    ids, shift, changed = [], np.zeros(3), sound
    if kind.startswith("moved"):
        direction, row = rng.standard_normal(3), int(rng.integers(len(anchors)))
        shift = rng.uniform(*MOVED) * direction / np.linalg.norm(direction)
        positions = anchors.positions.copy()
        positions[row] += shift
        ids, changed = (
            [int(anchors.ids[row])],
            replace(_flown(seed, 1, room, anchors.at(positions), bias), anchors=anchors),
        )
    elif kind.startswith("exchanged"):
        one, two = ids = sorted(int(i) for i in rng.choice(anchors.ids, 2, replace=False))
        a, b = (
            np.select([column == one, column == two], [two, one], column)
            for column in (sound.tdoa.a, sound.tdoa.b)
        )
        changed = replace(sound, tdoa=replace(sound.tdoa, a=a, b=b))
    if kind.endswith("on the way"):
        since = float(sound.tdoa.t[0] + rng.uniform(*MIDDLE) * np.ptp(sound.tdoa.t))
        first, last = (
            rows_of(part, rows)
            for part, rows in (
                (sound.tdoa, sound.tdoa.t < since),
                (changed.tdoa, changed.tdoa.t >= since),
            )
        )
        changed = replace(sound, tdoa=concatenated([first, last]))
    return week, sound, changed, ids, shift, since


def _flown(seed, path, room, anchors=None, bias=True):
    """A simulated Flight among the anchors of a room, or others, along the same path in either
    case.
    """
    config = SimulationConfig(
        seed=seed, constellation=room, anchors=anchors, duration=SECONDS, bias=bias
    )
    filled, of_path = SimulationConfig(seed=seed, constellation=room, duration=SECONDS).complete()
    return simulate(
        config, Trajectory.of_config(filled, of_path, np.random.default_rng([seed, path]))
    )


def said(flight, estimator):
    """{"check", "localize", "live": groups of the anchors that are named, see `_groups`, and
    "verdict" of localize}.
    """
    flight = replace(flight, truth=None)
    # its reasons are the findings of `check`
    assessment = assess(flight, estimator(flight), estimator)
    named = _groups(
        [
            sentence.removeprefix("check: ")
            for sentence in assessment.reasons
            if _NAMED.match(sentence.removeprefix("check: "))
        ]
    )
    localized = [] if assessment.level == GOOD else named
    return {
        "check": named,
        "localize": localized,
        "live": _groups(live(flight, estimator)),
        "verdict": assessment.level,
    }


def live(flight, estimator):
    """Sentences of the monitor that stand at the end, or stood for LANDING s, of a Flight fed to an
    Estimator as ekf_node feeds it.
    """
    run, tdoa, imu = estimator(flight), flight.tdoa, flight.imu
    node = Estimator(
        flight.anchors,
        FilterConfig(),
        0.0,
        0.1,
        *([estimator.effects] if estimator.effects else []),
    )
    stood = {}
    for begin in np.arange(tdoa.t[0], tdoa.t[-1], STEP):
        for stream, add in ((imu, node.add_imu), (tdoa, None)):
            rows = slice(*np.searchsorted(stream.t, [begin, begin + STEP]))
            if add is not None:
                add(stream.t[rows], stream.gyro[rows], stream.accel[rows])
            else:
                node.add_tdoa(
                    tdoa.t[rows],
                    tdoa.a[rows],
                    tdoa.b[rows],
                    tdoa.d[rows] - run.bias[rows],
                    run.bias_std[rows] ** 2,
                )
        node.advance()
        for key in {_about(sentence) for sentence in node.alarms}:
            stood[key] = stood.get(key, 0.0) + STEP
    last = {_about(sentence) for sentence in node.alarms}
    return [key for key, seconds in stood.items() if key and (seconds >= LANDING or key in last)]


def _about(sentence):
    """The beginning of a sentence on an anchor that was moved or exchanged, which names it; "" of
    others.
    """
    found = _NAMED.match(sentence)
    return found.group() if found else ""


def _groups(sentences):
    """Return the groups of anchors that sentences name, in order. In a group, one has changed."""
    groups = set()
    for sentence in sentences:
        said = sentence.partition(" (")[0]
        both = "exchanged" in said or "swapped" in said
        named = said if both else _about(said) or said  # it may be the beginning alone
        numbers = map(int, re.findall(r"\d+", named))
        groups |= {(number,) for number in numbers} if both else {tuple(sorted(numbers))}
    return [list(group) for group in sorted(groups)]


def _right(groups, ids, size=None):
    """Whether groups of at most two anchors name the changed anchors, and no group is superfluous.

    size : of the largest group; None for any.
    """
    largest = max(map(len, groups), default=0)
    hit = [[number for number in group if number in ids] for group in groups]
    right = largest <= 2 and len(groups) == len(ids) and all(hit)
    return (
        right
        and {number for some in hit for number in some} == set(ids)
        and size in (None, largest)
    )


def _rmse(flight, estimator, since):
    """m, 3D, of an estimate from a while after a stamp on."""
    t = flight.truth.t
    error = position_errors(
        estimator(flight).odometry,
        flight.truth,
        max(since + LANDING, t[0] + SETTLED),
        t[-1] - LANDING,
    )[1]
    return float(np.sqrt(np.nanmean(np.sum(error**2, axis=1))))
