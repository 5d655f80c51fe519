# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a correction as C: a folder with both files, or the build for a Crazyflie."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.effects import EffectSet

from . import crazyflie
from .dense import Unsupported
from .left_out import left_out
from .vehicle import vehicle_code

if TYPE_CHECKING:
    from pathlib import Path

    from .correction import TracedCorrection
    from .left_out import LeftOut
    from .vehicle import VehicleCode

NOT_ESTIMATED = "the filter of the firmware estimates no acceleration and no rate"


def write_c(folder: Path, traced: TracedCorrection) -> None:
    """Write uwb_bias.h and uwb_bias.c of a TracedCorrection. Raises InputError."""
    _write(folder, _code(traced, traced.effects).files)


def write_crazyflie(folder: Path, traced: TracedCorrection) -> tuple[LeftOut, ...]:
    """Write an out-of-tree build of the firmware; return what it does not hold besides.

    Raises InputError.
    """
    anchors = traced.anchors
    high = anchors.ids[anchors.ids > crazyflie.LARGEST_ID]
    if len(high):
        raise InputError(
            f"anchors: the firmware has ids up to {crazyflie.LARGEST_ID}, and one is {high[0]}; "
            "give the anchor such an id, or leave it out of the survey."
        )
    held = traced.effects.where(
        lambda effect: not vehicle_code(anchors, EffectSet((effect,))).reads_rates
    )
    _write(folder, crazyflie.files(_code(traced, held), anchors))
    return tuple(
        replace(left_out(effect, anchors), why=NOT_ESTIMATED)
        for effect in traced.effects
        if effect not in held.effects
    )


def _code(traced: TracedCorrection, effects: EffectSet) -> VehicleCode:
    try:
        return vehicle_code(traced.anchors, effects, traced.network)
    except Unsupported as error:
        raise InputError(
            f"--model: C holds networks of dense layers, and of this one not: {error}; train "
            "--model paper or paper_no_orientation, or write it by --onnx."
        ) from error


def _write(folder: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
