# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A correction as C for a vehicle: what is printed, its interface, and the folders with it.

The standard deviation is that at the state of the filter. It leaves out how far the bias is from its
linearization.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.text import version
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.network import Network
from uwb_tdoa_bias.effects import EffectSet

from . import crazyflie
from .c_code import Printer
from .correction import LeftOut, TracedCorrection, left_out
from .expressions import Program
from .tracing import expressions_of, samples_of

MEMBERS = {  # of the state, by the names of inputs
    **{name: f"position[{k}]" for k, name in enumerate(("x", "y", "z"))},
    **{name: f"attitude[{k}]" for k, name in enumerate(("qx", "qy", "qz", "qw"))},
    **{name: f"velocity[{k}]" for k, name in enumerate(("vx", "vy", "vz"))},
    **{name: f"acceleration[{k}]" for k, name in enumerate(("ax", "ay", "az"))},
    **{name: f"rate[{k}]" for k, name in enumerate(("wx", "wy", "wz"))},
    **{name: name for name in ("time", "interval", "previous_anchor")},
}
RATES = {"ax", "ay", "az", "wx", "wy", "wz"}  # inputs of acceleration and rate
NOT_ESTIMATED = "the filter of the firmware estimates no acceleration and no rate"
NO_PAIR, NOT_FINITE = 1, 2  # results of the functions in C

HEADER = """\
/* Systematic errors of UWB TDOAs, written by uwb_tdoa_tools {version}.
   Effects: {effects}. Network: {network}.

   A TDOA of the ordered pair a, b is d = |p - b| - |p - a|, in m, p being the position of the tag.
   Subtract the bias from it. All functions compute in single precision, and keep nothing between
   calls. They need libm. They always write their results. */
#ifndef UWB_BIAS_H
#define UWB_BIAS_H

#ifdef __cplusplus
extern "C" {{
#endif

#define UWB_BIAS_ANCHORS {count}
/* Whether the correction reads acceleration or rate. */
#define UWB_BIAS_READS_RATES {rates}

/* The state of the tag at a TDOA. Members that this correction reads: {inputs}. */
typedef struct {{
    float position[3];     /* m, world */
    float attitude[4];     /* x y z w, body to world */
    float velocity[3];     /* m/s, world */
    float acceleration[3]; /* m/s^2, world, mean of the last 0.2 s */
    float rate[3];         /* rad/s, body, mean of the last 0.2 s */
    float time;            /* s since the first TDOA */
    float interval;        /* s since the TDOA before */
    float previous_anchor; /* id of the second anchor of the TDOA before */
}} uwb_bias_state;

/* Results of the functions. If the result is not 0, they write zeros. */
enum {{
    UWB_BIAS_NO_PAIR = 1,   /* an anchor is unknown, or both are the same */
    UWB_BIAS_NOT_FINITE = 2 /* a member of the state is infinite or no number, or the bias is */
}};

/* Return the row of an anchor, 0 to UWB_BIAS_ANCHORS - 1, or -1 for an unknown id. */
int uwb_bias_row(int id);

/* Compute the bias of the TDOA of anchors with ids a and b, m, and the standard deviation of the
   error that stays, m. */
int uwb_bias(int a, int b, const uwb_bias_state *state, float *bias, float *std);

#ifdef __cplusplus
}}
#endif
#endif
"""

SOURCE = """\
/* Written by uwb_tdoa_tools {version}; do not edit. */
#include "uwb_bias.h"

#include <math.h>

static const unsigned short ids[UWB_BIAS_ANCHORS] = {{{ids}}};
{correction}
static int is_finite(float x) {{ return x - x == 0.0f; }}

static int usable(const uwb_bias_state *s) {{
    return {usable};
}}

int uwb_bias_row(int id) {{
    for (int row = 0; row < UWB_BIAS_ANCHORS; row++) {{
        if (ids[row] == id) {{
            return row;
        }}
    }}
    return -1;
}}

/* Return 0 and the rows of two anchors, or what is wrong. */
static int rows_of(int *a, int *b, const uwb_bias_state *s) {{
    *a = uwb_bias_row(*a);
    *b = uwb_bias_row(*b);
    if (*a < 0 || *b < 0 || *a == *b) {{
        return UWB_BIAS_NO_PAIR;
    }}
    return usable(s) ? 0 : UWB_BIAS_NOT_FINITE;
}}

int uwb_bias(int a, int b, const uwb_bias_state *state, float *bias, float *std) {{
    float out[2];
    *bias = *std = 0.0f;
    const int wrong = rows_of(&a, &b, state);
    if (wrong) {{
        return wrong;
    }}
    correction(a, b, state, out);
    if (!is_finite(out[0]) || !is_finite(out[1])) {{
        return UWB_BIAS_NOT_FINITE;
    }}
    *bias = out[0];
    *std = out[1];
    return 0;
}}
"""


@dataclass(frozen=True)
class VehicleCode:
    """A correction in C.

    Attributes
    ----------
    files : {name: text} of uwb_bias.h and uwb_bias.c
    inputs : names of the inputs that are read
    program : Program of (bias, standard deviation)
    """

    files: dict[str, str]
    inputs: tuple[str, ...]
    program: Program

    @property
    def reads_rates(self) -> bool:
        """Return whether it reads acceleration or rate, which not every filter estimates."""
        return not RATES.isdisjoint(self.inputs)


def vehicle_code(
    anchors: Anchors, effects: EffectSet, network: Network | None = None
) -> VehicleCode:
    """Return the C of a correction.

    Raises InputError if the network is not a chain of dense layers.
    """
    samples = replace(samples_of(anchors, motion=True), yaw_std=None)
    corrector = Corrector(anchors, effects, network)
    known = corrector.effects
    level = Corrector(anchors, known.state_independent, network).prediction(samples)
    bias, std = level.bias, level.std
    if len(known.state_dependent):
        bias = bias + known.state_dependent.bias(samples)
        std = np.hypot(std, known.state_dependent.noise_std(samples))
    outputs = [*expressions_of(samples, bias), *expressions_of(samples, std)]
    program = Program(outputs, len(anchors))
    printer = Printer(program, MEMBERS, len(anchors))
    inputs = tuple(name for name in MEMBERS if name in printer.inputs)
    made = {
        "version": version(),
        "effects": _in_comment(known.name),
        "network": _in_comment(network.name if network else "none"),
        "count": len(anchors),
        "ids": ", ".join(map(str, anchors.ids.tolist())),
        "rates": int(not RATES.isdisjoint(inputs)),
        "inputs": ", ".join(MEMBERS[name] for name in inputs) or "none",
        "correction": printer.text,
        "usable": _usable(inputs),
    }
    files = {"uwb_bias.h": HEADER.format(**made), "uwb_bias.c": SOURCE.format(**made)}
    return VehicleCode(files, inputs, program)


def _usable(inputs: tuple[str, ...]) -> str:
    """Return the condition that all members that are read are finite."""
    if not inputs:
        return "(void)s, 1"
    terms = [f"(s->{MEMBERS[name]} - s->{MEMBERS[name]})" for name in inputs]
    return " +\n           ".join(terms) + " == 0.0f"


def _in_comment(text: str) -> str:
    """Return a text that cannot end a comment of C."""
    return "".join(one if one.isalnum() or one in " _-+.," else "?" for one in text)


def write_c(folder: Path, traced: TracedCorrection) -> None:
    """Write uwb_bias.h and uwb_bias.c of a TracedCorrection. Raises InputError."""
    code = vehicle_code(traced.anchors, traced.effects, traced.network)
    _write(folder, code.files)


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
    code = vehicle_code(anchors, held, traced.network)
    _write(folder, crazyflie.files(code.files, anchors))
    return tuple(
        replace(left_out(effect, anchors), why=NOT_ESTIMATED)
        for effect in traced.effects
        if effect not in held.effects
    )


def _write(folder: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
