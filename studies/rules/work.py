# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run variants of the filter, in a process that imports its tuned copy: started by `figures`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import json
from pathlib import Path
import pickle
import sys
from typing import Any

from tqdm import tqdm

from uwb_tdoa_bias.common import sensors
from uwb_tdoa_bias.common.files import write_text

from . import watched, watching
from .catalogue import OF_SENSORS, RULES
from .rows import Inputs, Row, judged
from .tuned import Entry, Live, Tuned
from .worth import Worth, noise_of, worth

BASE, NUDGED = "as it is", "all constants x "
FACTORS = 0.5, 2.0
CHANGED_ROWS = 2  # so many rows that change show that a rule over streams is needed
NUDGES = 0.999, 0.9995, 0.9998, 1.0002, 1.0005, 1.001  # of all constants at once
# {module of the core: sensor}, and the rules of a plane
MODULES = dict(zip(sensors.MODULES, sensors.SENSORS)) | {"plane": "plane"}


@dataclass(frozen=True)
class Variant:
    """entry : None for the filter as it is, or for all constants; factor : of a constant, 0.0 for a
    rule that is off.
    """

    name: str
    entry: Entry | None
    factor: float = 1.0

    @property
    def sensor(self) -> str:
        """The sensor, or "plane", whose rows alone it can change; "" for all others."""
        if self.entry is None:
            return ""
        name = self.entry.name
        module = next((rule.module for rule in RULES if rule.name == name), name.split(".")[0])
        return OF_SENSORS.get(name, MODULES.get(module, ""))

    def concerns(self, row: Row, screen: bool) -> bool:
        """Whether it can change a Row; in the screen, in a way that rows without sensors do not show.

        Other sensors share constants with the range finder.
        """
        if self.entry is None:
            return True
        if self.sensor == "height" and self.factor:
            return bool(row.needs)
        return self.sensor in row.needs if self.sensor else not (screen and row.needs)

    def is_decided(self, so_far: Worth) -> bool:
        """Whether more rows need not be run: a rule is clearly worth it, or a constant matters."""
        if self.entry is None:
            return False
        return so_far.changed > 0 if self.factor else so_far.clear

    def apply(self, live: Live) -> bool:
        """Make the filter this one. Returns False if it stays what it is."""
        live.restore()
        if self.entry is None:
            live.nudge(self.factor)
            return True
        if self.factor == 0.0:
            live.switch_off(self.entry)
            return True
        return live.scale(self.entry, self.factor)


def variants_of(tuned: Tuned) -> list[Variant]:
    """All of them: as it is, without each rule, with each constant scaled."""
    made = [Variant(BASE, None)]
    made += [Variant(f"{NUDGED}{factor:g}", None, factor) for factor in NUDGES]
    made += [Variant(f"without: {rule.name}", rule, 0.0) for rule in tuned.rules]
    for factor in FACTORS:
        for constant in tuned.core:
            made.append(Variant(f"{constant.name} x {factor:g}", constant, factor))
    return made


def main(job: dict[str, Any]) -> None:
    """job : as of `figures.run`."""
    tuned: Tuned = job["tuned"]
    live = Live(tuned)
    inputs = Inputs(job["data"], job["cache"])
    rows = [row for row in inputs.rows() if row.screen or not job["screen"]]
    rows = [row for row in rows if not job["rows"] or any(word in row.name for word in job["rows"])]
    if job["watch"]:
        _watch(job, inputs, live)
        return
    chosen = [
        variant
        for variant in variants_of(tuned)
        if variant.entry is None or any(word in variant.name for word in job["only"])
    ]
    if job["stop"]:  # the shortest first
        rows.sort(key=lambda row: len(inputs.case(row).flight.truth.t))
    base: dict[str, dict[str, list]] = {}
    nudged: list[dict[str, dict[str, list]]] = []
    noise: dict[str, float] = {}
    done: dict[str, Any] = {}
    for variant in tqdm(chosen, unit="variant", disable=None, file=sys.stderr):
        found: dict[str, dict[str, list]] = {}
        for row in rows:
            key = f"{variant.name} | {row.name}"
            if not variant.concerns(row, job["screen"]):
                continue
            if job["stop"] and variant.is_decided(worth(base, found, noise)):
                break
            case = inputs.case(row)  # is made by the filter as it is
            if not variant.apply(live):
                break
            done[key] = {"figures": judged(case)}
            live.restore()
            found[row.name] = done[key]["figures"]
        if variant.name == BASE:
            base = found
        elif variant.entry is None:
            nudged.append(found)
            noise = noise_of(base, nudged)
    write_text(job["results"], json.dumps(done))


def _watch(job: dict[str, Any], inputs: Inputs, live: Live) -> None:
    """The rules over streams and residuals, by the filter as it is."""
    rows = watched.rows(inputs)
    rows = [row for row in rows if not job["rows"] or any(word in row.name for word in job["rows"])]
    chosen = [watching.Patch(BASE, watching.KINDS, {}), *watching.patches(job["tuned"])]
    chosen = [
        one for one in chosen if one.name == BASE or any(word in one.name for word in job["only"])
    ]
    base: dict[str, watched.Said] = {}
    hits: Counter[tuple[str, str]] = Counter()  # how often a row changes, by its name and a module
    done: dict[str, Any] = {}
    for patch in tqdm(chosen, unit="variant", disable=None, file=sys.stderr):
        changed, module = 0, patch.name.split(" x ")[0].rpartition(".")[0]
        enough = CHANGED_ROWS if patch.factor == 1.0 else 1
        for row in sorted(rows, key=lambda one: -hits[one.name, module]):
            key = f"{patch.name} | {row.name}"
            if row.of not in patch.of or (job["stop"] and changed >= enough):
                continue
            inputs.anew = patch.entry is not None
            done[key] = {"said": _said(patch, row, live)}
            said = done[key]["said"]
            if patch.name == BASE:
                base[row.name] = said
            elif watching.differs(base[row.name], said):
                changed += 1
                hits[row.name, module] += 1
    write_text(job["results"], json.dumps(done))


def _said(patch: watching.Patch, row: watched.Watched, live: Live) -> watched.Said:
    """Findings of a row, or the exception that a variant raises."""
    with patch.applied(live):
        try:
            return row.said()
        except (ArithmeticError, IndexError, KeyError, TypeError, ValueError) as error:
            return {f"{type(error).__name__}": [0.0, 0.0, 0.0]}


if __name__ == "__main__":
    main(pickle.loads(Path(sys.argv[1]).read_bytes()))
