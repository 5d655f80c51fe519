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

import uwb_tdoa_ekf

from .tuned import Entry, Live, Tuned
from .watched import Said

# s by which a detection must come later, or end later, to count; and share of the deciding number
LEAST, NOTICED = 0.99, 0.02
PACKAGE = "monitoring"
KINDS = "streams", "scale", "sign", "monitoring"  # of what is watched
# Kinds of rows that the rules of a module can change
KINDS_OF = {
    "explain": ("sign",),
    "finding": KINDS,
    "health": (),
    "signs": ("sign", "monitoring"),
    "status": (),
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
NO_TUNING = {  # what nature gives, and what nothing returns
    "survey_scale.NANOSECONDS",
    "windows.NO_SAMPLE",
    "windows.NO_STAMP",
    "windows.NO_TDOA",
}
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
    "a clock that drifts": ("change.FASTEST_DRIFT", 0.0),
    "a drift is clearer than a step": ("change.CLEARLY", 1.0),
    "the size of a change is refined": ("change.ChangeDetector.refined", lambda *_: None),
    "the errors of a flight set the limit": ("change.LARGEST_ERROR", 0.0),
    "prior of the errors of a flight": ("change.SCALE_SLICES", 0),
    "smooth errors of each anchor": ("reference.FUNCTION_STDS", (1e-4,)),
    "errors that are constant in a cell": ("reference.ERROR_STDS", (1e-4,)),
    "enough cells for a comparison": ("reference.FEWEST_CELLS", 0),
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
    "signs: much better": ("signs.RATIO", 1.0),
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
    "the scale of a survey": ("survey_scale.SurveyScale.add", lambda *_: None),
    "one anchor in another unit": ("survey_scale.SINGLE", 0),
    "a scale: significant": ("survey_scale.DEVIATIONS", -math.inf),
    "a scale: much better": ("survey_scale.LEFT", 1.0),
    "a scale: fits well": ("survey_scale.GOOD", math.inf),
    "a scale: much time or motion where it is less clear": ("survey_scale.CLEARLY", 1.0),
    "a scale: TDOAs that are not in metres": ("survey_scale.SMALL", 0.0),
}


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
    package, module, *inside = path.split(".")
    found = importlib.import_module(f"{uwb_tdoa_ekf.__name__}.{package}.{module}")
    for name in inside:
        found = getattr(found, name)
    return found


def patches(tuned: Tuned) -> list[Patch]:
    """Every rule off, every constant halved and doubled."""
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
        instead = _method(value) if callable(value) else value
        changed = {(one, name): instead for one in where}
        made.append(Patch(f"without: {label}", _kinds(module), changed))
    return made + list(_constants(trees, {entry.name: entry for entry in tuned.constants}))


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
        for name in _tuned_names(tree):
            found = getattr(_found(f"{PACKAGE}.{module}"), name)
            key, kinds = f"{PACKAGE}.{module}.{name}", _kinds(module)
            entry = entries.get(key)
            is_size = name in frozen and entry is None
            if is_size or f"{module}.{name}" in NO_TUNING or not kinds or not _is_number(found):
                continue
            where = _holders(trees, module, name)
            for factor in (0.5, 2.0):
                scaled = _scaled(found, factor)
                if scaled != found:
                    changed = {(one, name): scaled for one in where}
                    yield Patch(f"{key} x {factor:g}", kinds, changed, entry, factor)


def _tuned_names(tree: ast.Module) -> list[str]:
    names = []
    for node in tree.body:
        if isinstance(node, ast.Assign):
            is_range = isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "range"
            for one in ast.walk(node):
                stored = isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)
                if stored and one.id.isupper() and not is_range:
                    names.append(one.id)
    return names


def _is_number(value: object) -> bool:
    parts = value if isinstance(value, tuple) else (value,)
    return bool(parts) and all(
        type(one) in (int, float) and math.isfinite(one) and one for one in parts
    )


def _scaled(value: Any, factor: float) -> Any:
    """A number, or some, times a factor; a count is at least 1."""
    if isinstance(value, tuple):
        return tuple(_scaled(one, factor) for one in value)
    return max(1, round(factor * value)) if isinstance(value, int) else factor * value


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
