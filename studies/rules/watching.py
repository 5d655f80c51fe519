# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Variants of the rules over streams and over residuals. Most are Python, so that a variant is a
changed module; constants of compiled functions are read from the table of `tuned`.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np

import uwb_tdoa_ekf

from . import pace
from .tuned import Entry, Live, Tuned
from .watched import Said

# s by which a detection must come later, or end later, to count; and share of the deciding number
LEAST, NOTICED = 0.99, 0.02
PACKAGE = "monitoring"
KINDS = "streams", "scale", "sign", "monitoring", "node", "pace"  # kinds of watched rows
# Kinds of rows that the rules of a module can change
KINDS_OF = {
    "explain": ("sign",),
    "finding": KINDS,
    "health": ("node",),
    "signs": ("sign", "monitoring"),
    "status": ("node",),
    "survey_scale": ("scale",),
} | dict.fromkeys(
    (
        "stamp_rules",
        "inertial_rules",
        "ranging_rules",
        "stream_rules",
        "windows",
    ),
    ("streams",),
)
# Numbers that nobody chose: module and name, and what they are
NO_TUNING = {
    "ranging_rules.WRAPS": "ranges of a counter",
    "stamp_rules.UNITS": "units",
    "status.FAULT_YAW_STD": "more than that of a yaw that may be any",
    "survey_scale.NANOSECONDS": "a unit",
    "windows.GRIDS": "steps to which people round",
    "windows.NO_SAMPLE": "no sensor returns it",
    "windows.NO_STAMP": "no clock returns it",
    "windows.NO_TDOA": "no tag returns it",
}
# Constants of the core that a module of monitoring uses too: the module, and the kind of its rows
OF_CORE = {("yaw_check", "YAW_KNOWN"): ("status", "node")}
FACTORS = 0.5, 2.0
LISTS = (  # of rules, by module
    ("monitoring.stamp_rules", "OF_ONE"),
    ("monitoring.stamp_rules", "OF_BOTH"),
    ("monitoring.inertial_rules", "RULES"),
    ("monitoring.ranging_rules", "RULES"),
)
# What takes the place of a function of the package, or the value of a constant, where a rule is off
SWITCHES: dict[str, tuple[str, Any]] = {
    "an anchor that changes": ("monitor.Monitor._look_for_change", lambda *_: None),
    "an anchor that is not as surveyed": ("monitor.Monitor._compare", lambda *_: None),
    "two anchors that are exchanged": ("monitor.Monitor._look_for_swap", lambda *_: False),
    "an anchor that falls silent": ("monitor.Monitor._is_silent", lambda *_: False),
    "a silent anchor was heard often": ("monitor.Monitor._was_often", lambda *_: True),
    "a silent anchor is near": ("monitor.NEARER", 1e9),
    "anchors passed long ago are forgotten": ("monitor.FORGET", 10**9),
    "a bias of the IMU that moves": ("monitor.Monitor._follow_biases", lambda *_: None),
    "a change is clear": ("monitor._is_clear", lambda *_: True),
    "a change is clearly of one anchor": ("monitor.CLEARLY", 0.0),
    "a change explains most errors": ("monitor.MOST_LEFT", math.inf),
    "no change while most TDOAs are rejected": ("monitor.FEWEST_ACCEPTED", 0.0),
    "no change soon after the first motion": ("monitor.SETTLE", 0.0),
    "a small change is over": ("monitor.SMALLEST_CHANGE", 0.0),
    "a displacement matters": ("monitor._matters", lambda *_: True),
    "a displacement is found several times": ("monitor.NAMED", 1),
    "recent slices are compared with the calibration": ("monitor.YOUNG", 10**9),
    "a sure comparison settles a doubt": (
        "monitor._surest",
        lambda displaced: {one.row: one for one in displaced},
    ),
    "an exchange is heard several times": ("monitor.TOGETHER", 1),
    "an exchange holds for a while": ("monitor.HELD", 1),
    "signs that turn": ("monitor.turned", lambda *_: False),
    "signs turn only where the filter was right": ("monitor.AGREED", math.inf),
    "signs turn once in a while": ("monitor.TURN_APART", 0.0),
    "the size of a change is refined": ("change.ChangeDetector.refined", lambda *_: None),
    "the errors of a flight set the limit": ("change.LARGEST_ERROR", 0.0),
    "prior of the errors of a flight": ("change.SCALE_SLICES", 0),
    "smooth errors of each anchor": ("reference.FUNCTION_STDS", (1e-4,)),
    "errors that are constant in a cell": ("reference.ERROR_STDS", (1e-4,)),
    "enough slices for a comparison": ("reference.FEWEST_SLICES", 0),
    "large innovations are clipped": ("slices.CLIP", math.inf),
    "an exchange is looked for at large residuals only": ("swap.LARGE", 0.0),
    "an exchange is clear by far": ("swap.SHARE", 0.0),
    "an exchange is clear alone": ("swap.MOST_LEFT", 0.0),
    "large residuals of an exchange are clipped": ("swap.CLIP", math.inf),
    "signs: the present sign explains little": ("signs.PRESENT", 2.0),
    "signs: enough TDOAs": ("signs.FEWEST", 0),
    "signs that are wrong": ("signs.SignWatch.feed", lambda *_: None),
    "doubts of the filter about signs": ("signs.SignWatch.doubt", lambda *_: None),
    "a comparison of signs begins anew": ("signs.LONGEST", math.inf),
    "signs: significant": ("signs.DEVIATIONS", -math.inf),
    "blocks of few TDOAs do not count": ("explain.FEW", 0),
    "fewest blocks for signs": ("explain.LEAST", 2),
    "blocks of both streams are ours": ("stream_rules.StreamWatch._starved", lambda *_: False),
    "notes are not said in flight": ("stream_rules.StreamWatch._counts", lambda *_: True),
    "a replay at another rate": ("stream_rules.SMALLEST_UNIT", 0.0),
    "findings end with their cause": ("stream_rules.LATEST", 0),
    "a finding needs several windows": ("stream_rules.FEWEST", 1),
    "windows are checked together": ("stream_rules.IN_FLIGHT", 2),
    "unknown ids": ("stream_rules.StreamRules._unknown", lambda *_: ()),
    "order of stamps comes first": ("stamp_rules.orderly", lambda *_: True),
    "TDOAs that are late": ("stamp_rules._late", lambda *_: False),
    "a tag at rest": ("inertial_rules.resting", lambda *_: False),
    "the direction of a force without gravity": ("inertial_rules.STEADY", 0.0),
    "the motion outweighs a force without gravity": ("inertial_rules.WEIGHTLESS", math.inf),
    "most TDOAs contradict": ("status.Use.contradicted", property(lambda *_: False)),
    "most TDOAs are not used": ("status.Use.why_unused", property(lambda *_: None)),
    "a start does not contradict": ("status.SETTLED", 0.0),
    "few TDOAs have no shares": ("status.FEWEST", 0),
    "a fault states a wide velocity": ("status.FAULT_SPEED_STD", 0.0),
    "an estimator of few unknown ids runs": ("finding.FEW_UNKNOWN", 0.0),
    "a number that changes little keeps its text": ("finding.SAME", 0.0),
    "a start takes a while": ("health.START_TIMEOUT", 0.0),
    "odometry behind or ahead of the clock": ("health.BEHIND", (math.inf, math.inf)),
    "clocks that are unrelated": ("health.BEHIND", (1.0, math.inf)),
    "trouble of a sensor": ("health.Health._trouble_of_sensors", lambda *_: None),
    "a sensor that stops": ("health.STOPPED", math.inf),
    "a good sensor may contradict for a second": ("health.REPEATS", 1),
    "the text has a few sentences": ("health.MOST_SAID", 10**9),
    "the scale of a survey": ("survey_scale.SurveyScale.add", lambda *_: None),
    "one anchor in another unit": ("survey_scale.SINGLE", 0),
    "a scale: significant": ("survey_scale.DEVIATIONS", -math.inf),
    "a scale: much better": ("survey_scale.LEFT", 1.0),
    "a scale: much time or motion where it is less clear": ("survey_scale.CLEARLY", 1.0),
    "a scale: TDOAs that are not in metres": ("survey_scale.SMALL", 0.0),
}


def _wider(units: dict[str, tuple[float, float, float]], factor: float) -> dict:
    """Ranges of the units of a force: {unit: (size, low, high)}. The sizes stay."""
    out = {}
    for unit, (size, low, high) in units.items():
        middle, half = math.sqrt(low * high), math.sqrt(high / low) ** factor
        out[unit] = size, middle / half, middle * half
    return out


# How a constant of several parts is scaled
PARTS: dict[str, Callable[[Any, float], Any]] = {"inertial_rules.FORCE_UNITS": _wider}


@dataclass(frozen=True)
class Patch:
    """A variant.

    name : as in the table
    of : kinds of Watched rows that it concerns
    changed : {(module, attribute): value}
    entry, factor : constant to scale in compiled functions, and its factor
    """

    name: str
    of: tuple[str, ...]
    changed: dict[tuple[str, str], Any]
    entry: Entry | None = None
    factor: float = 1.0

    @contextmanager
    def applied(self, live: Live | None = None) -> Iterator[None]:
        """The modules, and the table of compiled functions, are changed inside."""
        before = {}
        try:
            if self.entry is not None and live is not None:
                live.scale(self.entry, self.factor)
            for (owner, name), value in self.changed.items():
                target = _found(owner)
                before[owner, name] = getattr(target, name)
                setattr(target, name, value)
            yield
        finally:
            if live is not None:
                live.restore()
            for (owner, name), value in before.items():
                setattr(_found(owner), name, value)


def _found(path: str) -> Any:
    """A module, or a class in one, of the package: "monitoring.monitor", "....Monitor"."""
    if path == pace.MODULE:
        return importlib.import_module(path)
    package, module, *inside = path.split(".")
    found = importlib.import_module(f"{uwb_tdoa_ekf.__name__}.{package}.{module}")
    for name in inside:
        found = getattr(found, name)
    return found


def patches(tuned: Tuned) -> list[Patch]:
    """Every rule off, every constant halved and doubled. Of the core, those in OF_CORE."""
    made = []
    for module, name in LISTS:
        for rule in getattr(_found(module), name):
            left = tuple(one for one in getattr(_found(module), name) if one is not rule)
            label = f"without: {module.split('.')[1]}.{rule.__name__}"
            made.append(Patch(label, ("streams",), {(module, name): left}))
    trees = _trees()
    for label, (path, value) in SWITCHES.items():
        module, *_ = path.split(".")
        owner, _, name = f"{PACKAGE}.{path}".rpartition(".")
        where = [owner] if "." in path.partition(".")[2] else _holders(trees, module, name)
        instead = _method(value) if callable(value) and not isinstance(value, property) else value
        changed = {(one, name): instead for one in where}
        made.append(Patch(f"without: {label}", _kinds(module), changed))
    made += _constants(trees, {entry.name: entry for entry in tuned.constants})
    for (module, name), (holder, kind) in OF_CORE.items():
        for factor in FACTORS:
            changed = {
                (f"{PACKAGE}.{holder}", name): factor * getattr(_found(f"core.{module}"), name)
            }
            made.append(Patch(f"{module}.{name} x {factor:g}", (kind,), changed))
    return made + list(_of_pace())


def _of_pace() -> Iterator[Patch]:
    for label, (name, value) in pace.SWITCHES.items():
        yield Patch(f"without: {label}", ("pace",), {(pace.MODULE, name): value})
    for name in pace.CONSTANTS:
        for factor in FACTORS:
            value = _scaled(getattr(_found(pace.MODULE), name), factor)
            key = f"flying.over_topics.{name} x {factor:g}"
            yield Patch(key, ("pace",), {(pace.MODULE, name): value})


def _kinds(module: str) -> tuple[str, ...]:
    return KINDS_OF.get(module, ("monitoring",))


def _trees() -> dict[str, ast.Module]:
    folder = Path(uwb_tdoa_ekf.__file__).parent / PACKAGE
    return {path.stem: ast.parse(path.read_text()) for path in sorted(folder.glob("*.py"))}


def _holders(trees: dict[str, ast.Module], module: str, name: str) -> list[str]:
    """Modules that hold a name of a module: itself, and those that import it."""
    others = [other for other, tree in trees.items() if _imports(tree, module, name)]
    return [f"{PACKAGE}.{one}" for one in (module, *others)]


def _method(function: Callable) -> Callable:
    """Wrap a callable in a function, which binds to its object if it is a method of a class."""
    return lambda *args, **named: function(*args, **named)


def _constants(trees: dict[str, ast.Module], entries: dict[str, Entry]) -> Iterator[Patch]:
    for module, tree in trees.items():
        frozen = {
            node.id
            for function in tree.body
            if isinstance(function, ast.FunctionDef) and function.decorator_list
            for node in ast.walk(function)
            if isinstance(node, ast.Name)
        }
        for name in tuned_names(tree):
            found = getattr(_found(f"{PACKAGE}.{module}"), name)
            key, kinds = f"{PACKAGE}.{module}.{name}", _kinds(module)
            entry = entries.get(key)
            is_size = name in frozen and entry is None
            if is_size or f"{module}.{name}" in NO_TUNING or not kinds or not is_number(found):
                continue
            where = _holders(trees, module, name)
            scale = PARTS.get(f"{module}.{name}", _scaled)
            for factor in FACTORS:
                scaled = scale(found, factor)
                if repr(scaled) != repr(found):
                    changed = {(one, name): scaled for one in where}
                    yield Patch(f"{key} x {factor:g}", kinds, changed, entry, factor)


def tuned_names(tree: ast.Module) -> list[str]:
    names = []
    for node in tree.body:
        if isinstance(node, ast.Assign):
            is_range = isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "range"
            for one in ast.walk(node):
                stored = isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)
                if stored and one.id.isupper() and not is_range:
                    names.append(one.id)
    return names


def is_number(value: object) -> bool:
    """Whether a value is a number, or holds some, and all of them can be scaled."""
    parts = list(_numbers(value))
    return bool(parts) and all(math.isfinite(one) and one for one in parts)


def _numbers(value: object) -> Iterator[float]:
    """Numbers in a value, in tuples, and in the values of a dict; names of units count as none."""
    if isinstance(value, np.ndarray) and value.dtype == float:
        yield from value[value != 0.0].tolist()
    elif isinstance(value, dict):
        for one in value.values():
            yield from _numbers(one)
    elif isinstance(value, tuple):
        for one in value:
            yield from _numbers(one)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _scaled(value: Any, factor: float) -> Any:
    """What `is_number` accepts, with its numbers times a factor; a count is at least 1."""
    if isinstance(value, tuple):
        return tuple(_scaled(one, factor) for one in value)
    if isinstance(value, dict):
        return {key: _scaled(one, factor) for key, one in value.items()}
    if type(value) is int:
        return max(1, round(factor * value))
    return factor * value if isinstance(value, (float, np.ndarray)) else value


def _imports(tree: ast.Module, module: str, name: str) -> bool:
    return any(
        isinstance(node, ast.ImportFrom)
        and node.module == module
        and any(alias.name == name for alias in node.names)
        for node in ast.walk(tree)
    )


def differs(before: Said, after: Said) -> dict[str, str]:
    """Changes of the findings of a row: {rule: kind}.

    The kind is "lost", "new", "late", "early", "longer", "shorter" or "size".
    """
    out = {rule: "lost" for rule in before if rule not in after}
    out |= {rule: "new" for rule in after if rule not in before}
    for rule in before.keys() & after.keys():
        (first, last, size), (its_first, its_last, its_size) = before[rule], after[rule]
        if abs(its_first - first) > LEAST:
            out[rule] = "late" if its_first > first else "early"
        elif abs(its_last - last) > LEAST:
            out[rule] = "longer" if its_last > last else "shorter"
        elif abs(its_size - size) > NOTICED * max(abs(size), abs(its_size)):
            out[rule] = "size"
    return out
