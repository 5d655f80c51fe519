"""The rules over streams and over residuals: what is said of sound and of faulty recordings, and
when. They are Python, so that a variant is a changed module.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
import importlib
import math
from pathlib import Path
from typing import Any

from mistakes import MISTAKES, arriving
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
import uwb_tdoa_ekf
from uwb_tdoa_ekf.monitoring.recorded import watched
from uwb_tdoa_ekf.monitoring.stream_watch import StreamWatch
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.readers.streams import protocol

from .rows import FIRST_SEED, SCREENED, VALUES, Inputs

Said = dict[str, list[float]]  # s, first and last, by rule
HEALTHY = (*(name for name in SCREENED if "-" in name and "const" not in name), "0426-traj5")
FAULTY = ("0426-traj5",)
EVERY = 1.0  # s between two looks
UNTIL = 45.0  # s
LEAST = 1.0  # s, by which a detection must come later to count
PACKAGE = "monitoring"
KINDS = "streams", "monitoring"  # of what is watched
# Modules whose rules judge streams by themselves
OF_STREAMS = {
    "stamp_rules",
    "inertial_rules",
    "ranging_rules",
    "ranging_windows",
    "stream_rules",
    "stream_watch",
    "survey_scale",
    "explain",
}
NO_TUNING = {"inertial_rules.GRAVITY", "ranging_rules.TICK", "scale.NANOSECONDS"}
LISTS = (  # of rules, by module
    ("monitoring.stamp_rules", "OF_ONE"),
    ("monitoring.stamp_rules", "OF_BOTH"),
    ("monitoring.inertial_rules", "RULES"),
    ("monitoring.ranging_rules", "RULES"),
)
METHODS = {  # of the monitor: what takes their place
    "an anchor that changes": ("monitor.Monitor._look_for_change", None),
    "an anchor that is not as surveyed": ("monitor.Monitor._compare", None),
    "two anchors that are exchanged": ("monitor.Monitor._look_for_swap", False),
    "an anchor that falls silent": ("monitor.Monitor._is_silent", False),
    "a bias of the IMU that moves": ("monitor.Monitor._follow_biases", None),
    "a change is clear": ("monitor._is_clear", True),
    "a displacement matters": ("monitor._matters", True),
    "signs that turn": ("monitor.turned", False),
    "an anchor passed long ago": ("monitor.Monitor._was_often", True),
    "signs that are wrong": ("sign_watch.SignWatch.feed", None),
    "blocks of both streams are ours": ("stream_watch.StreamWatch._starved", False),
    "notes are not said in flight": ("stream_watch.StreamWatch._counts", True),
}


@dataclass(frozen=True)
class Watched:
    """A row: said() : Said. of : "streams" or "monitoring", whose rules it shows."""

    name: str
    of: str
    said: Callable[[], Said]


@dataclass(frozen=True)
class Patch:
    """A variant: name : as in the table; of : of a Watched; changed : {(module, attribute): value}."""

    name: str
    of: tuple[str, ...]
    changed: dict[tuple[str, str], Any]

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The modules are changed inside."""
        before = {}
        try:
            for (owner, name), value in self.changed.items():
                target = _found(owner)
                before[owner, name] = getattr(target, name)
                setattr(target, name, value)
            yield
        finally:
            for (owner, name), value in before.items():
                setattr(_found(owner), name, value)


def _found(path: str) -> Any:
    """A module, or a class in one, of the package: "monitoring.monitor", "....Monitor"."""
    package, module, *inside = path.split(".")
    found = importlib.import_module(f"{uwb_tdoa_ekf.__name__}.{package}.{module}")
    for name in inside:
        found = getattr(found, name)
    return found


def rows(inputs: Inputs) -> list[Watched]:
    """All of them."""
    made = []
    for name in dict.fromkeys((*HEALTHY, *FAULTY)):
        case = inputs.recording(name)
        made.append(Watched(f"{name} is sound", "streams", partial(_streams, inputs, name, "")))
        made.append(
            Watched(f"{name} is sound, residuals", "monitoring", partial(_residuals, inputs, name))
        )
        if name in FAULTY:
            made.append(
                Watched(
                    f"{name}, anchor moved", "monitoring", partial(_residuals, inputs, name, True)
                )
            )
            kind = protocol(case.flight.tdoa)
            for fault, mistake in MISTAKES.items():
                needs = mistake.needs
                if "other" in needs or "rooms" in needs or needs not in ("", "imu", "live", kind):
                    continue
                made.append(
                    Watched(f"{name}, {fault}", "streams", partial(_streams, inputs, name, fault))
                )
    for world in ("hall", "anchor-late", "anchor-silent"):
        for k in range(2):
            name = f"fly {world} {FIRST_SEED + k}"
            made.append(
                Watched(
                    f"{name}, residuals",
                    "monitoring",
                    partial(_flown, inputs, world, FIRST_SEED + k),
                )
            )
    for fault in ("tdoa: sign", "tdoa: two ids exchanged", "tdoa: an anchor 1 m late"):
        made.append(Watched(f"{fault}, residuals", "monitoring", partial(_faulty, inputs, fault)))
    return made


def _streams(inputs: Inputs, name: str, fault: str) -> Said:
    recording = inputs.kept(f"streams {name} {fault}", lambda: _recording(inputs, name, fault))
    watch = StreamWatch(recording.anchors, 0.25)
    imu, tdoa = recording.imu, recording.tdoa
    begin = min(recording.tdoa_arrival[0], recording.imu_arrival[0])
    said: Said = {}
    for at in np.arange(begin + EVERY, begin + UNTIL, EVERY):
        k = (recording.imu_arrival > at - EVERY) & (recording.imu_arrival <= at)
        watch.add_imu(imu.t[k], recording.imu_arrival[k], imu.gyro[k], imu.accel[k])
        k = (recording.tdoa_arrival > at - EVERY) & (recording.tdoa_arrival <= at)
        watch.add_tdoa(tdoa.t[k], recording.tdoa_arrival[k], tdoa.a[k], tdoa.b[k], tdoa.d[k])
        for finding in watch.findings():
            said.setdefault(finding.rule, [at - begin, 0.0])[1] = at - begin
    return said


def _recording(inputs: Inputs, name: str, fault: str) -> Any:
    recording = arriving(of_flight(inputs.recording(name).flight), 0)
    if not fault:
        return recording
    return MISTAKES[fault].make(recording, np.random.default_rng([0, *fault.encode()]), None)


def _events(anchors: Anchors, run: Any) -> Said:
    said: Said = {}
    for event in watched(anchors, run.odometry, run.residuals):
        key = f"{event.finding.rule} {event.finding.cause.split(':')[0]}"
        said.setdefault(key, [event.since, event.until])[1] = event.until
    return said


def _run(inputs: Inputs, key: str, flight: Any) -> Any:
    return inputs.kept(f"run {key}", lambda: run_offline(flight))


def _residuals(inputs: Inputs, name: str, moved: bool = False) -> Said:
    flight = inputs.recording(name).flight.without(*SENSOR_NAMES)
    anchors = flight.anchors
    if moved:
        positions = anchors.positions.copy()
        positions[3] += [0.5, -0.3, 0.0]
        anchors = Anchors(anchors.ids, positions, anchors.orientations)
        flight = replace(flight, anchors=anchors)
    return _events(anchors, _run(inputs, f"{name} {moved}", flight))


def _flown(inputs: Inputs, world: str, seed: int) -> Said:
    flight = inputs.flight_of(world, seed)
    return _events(flight.anchors, _run(inputs, f"{world} {seed}", flight))


def _faulty(inputs: Inputs, fault: str) -> Said:
    flight = inputs.faulty(VALUES[fault], fault.split(":")[0]).flight
    return _events(flight.anchors, _run(inputs, fault, flight))


def patches() -> list[Patch]:
    """Every rule off, every constant of Python code halved and doubled."""
    made = []
    for module, name in LISTS:
        for rule in getattr(_found(module), name):
            left = tuple(one for one in getattr(_found(module), name) if one is not rule)
            label = f"without: {module.split('.')[1]}.{rule.__name__}"
            made.append(Patch(label, ("streams",), {(module, name): left}))
    for label, (path, value) in METHODS.items():
        owner, _, name = f"monitoring.{path}".rpartition(".")
        of = "streams" if "watch." in path else "monitoring"
        instead = partial(_constant, value)
        made.append(Patch(f"without: {label}", (of,), {(owner, name): _method(instead)}))
    return made + list(_constants(PACKAGE))


def _constant(value: Any, *_: object, **__: object) -> Any:
    return value


def _method(function: Callable) -> Callable:
    """A function, so that it is bound to its object where it is one of a class."""
    return lambda *args, **named: function(*args, **named)


def _constants(package: str) -> Iterator[Patch]:
    folder = Path(uwb_tdoa_ekf.__file__).parent / package
    trees = {path.stem: ast.parse(path.read_text()) for path in sorted(folder.glob("*.py"))}
    for module, tree in trees.items():
        frozen = {
            node.id
            for function in tree.body
            if isinstance(function, ast.FunctionDef) and function.decorator_list
            for node in ast.walk(function)
            if isinstance(node, ast.Name)
        }
        for name in _tuned_names(tree):
            found = getattr(_found(f"{package}.{module}"), name)
            key = f"{module}.{name}"
            if name in frozen or key in NO_TUNING or not _is_number(found):
                continue
            where = [f"{package}.{module}"] + [
                f"{package}.{other}" for other, its in trees.items() if _imports(its, module, name)
            ]
            of = ("streams",) if module in OF_STREAMS else ("monitoring",)
            for factor in (0.5, 2.0):
                scaled = _scaled(found, factor)
                if scaled != found:
                    label = f"{package}.{key} x {factor:g}"
                    yield Patch(label, of, {(one, name): scaled for one in where})


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
    """{rule: "lost", "new" or "late"} of what is said of a row."""
    out = {rule: "lost" for rule in before if rule not in after}
    out |= {rule: "new" for rule in after if rule not in before}
    for rule in before.keys() & after.keys():
        if abs(after[rule][0] - before[rule][0]) > max(LEAST, 0.02 * abs(before[rule][0])):
            out[rule] = "late" if after[rule][0] > before[rule][0] else "early"
    return out
