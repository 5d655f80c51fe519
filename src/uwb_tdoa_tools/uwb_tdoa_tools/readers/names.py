# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Surveys whose anchors have names: surveys say "NE corner" or "A3", messages have numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
import re
from typing import Any

from uwb_tdoa_bias.common import survey
from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import refuse_faulty

LARGEST_ID = 65535


@dataclass(frozen=True)
class NamedAnchors:
    """Anchors, and their names in the survey.

    Attributes
    ----------
    anchors : Anchors.
    ids : {name: id}; empty if the names are the ids.
    """

    anchors: Anchors
    ids: dict[str, int] = field(default_factory=dict)

    def id_of(self, value: Any) -> int | None:
        """Return the id of an anchor from its name or id (decimal or 0x1A2B); None if unknown.

        Names come first. Where anchors have names, an id counts if the name ends with it.
        """
        text = survey.name_of(value)
        if text in self.ids:
            return self.ids[text]
        folded = [number for name, number in self.ids.items() if name.casefold() == text.casefold()]
        if len(folded) == 1:
            return folded[0]
        decimal = _decimal(text)
        number = int(decimal) if survey.is_id(decimal) and int(decimal) <= LARGEST_ID else None
        if self.ids and not any(
            of == number and name.endswith(str(number)) for name, of in self.ids.items()
        ):
            return None
        return number


def read_named_anchors(path: str | Path) -> NamedAnchors:
    """Read a survey file of any form of `survey.read_entries`, with ids or any names.

    Names that all end with different numbers get these as ids. Other names get their line number in
    the survey, from 0. Raises InputError, also for a survey that is certainly wrong.
    """
    named = named_anchors(path, *survey.read_entries(path))
    refuse_faulty(named.anchors, str(path))
    return named


def named_anchors(path: str | Path, entries: list[survey.Entry], frame: str) -> NamedAnchors:
    """Return the NamedAnchors of entries, see `read_named_anchors`; `path` is for messages."""
    names = [_decimal(entry.name) for entry in entries]
    if all(map(survey.is_id, names)):
        return NamedAnchors(survey.anchors_of(path, entries, [int(name) for name in names], frame))
    if len(set(names)) < len(names):
        raise InputError(
            f"{path}: anchor {next(name for name in names if names.count(name) > 1)!r} is "
            "there twice; every anchor needs its own name."
        )
    ends = [re.search(r"(\d{1,5})$", name) for name in names]
    ids = [int(end[1]) for end in ends if end]
    if len(set(ids)) < len(names) or max(ids) > LARGEST_ID:
        ids = list(range(len(names)))
    return NamedAnchors(survey.anchors_of(path, entries, ids, frame), dict(zip(names, ids)))


def _decimal(name: str) -> str:
    """Return the decimal id of a name like 0x1A2B; other names as they are."""
    return str(int(name, 16)) if re.fullmatch("0[xX][0-9A-Fa-f]{1,4}", name) else name


def read_survey(path: str | Path) -> Anchors:
    """Read the Anchors of a survey file, see `read_named_anchors`."""
    return read_named_anchors(path).anchors
