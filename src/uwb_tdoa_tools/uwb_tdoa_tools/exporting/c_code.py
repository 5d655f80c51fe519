# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print a correction as C99 for a vehicle: single precision, no memory of its own, libm only.

Bias and standard deviation are those of the ONNX file and of `Corrector`. There is no Jacobian.

`write_crazyflie` writes an out-of-tree build of the Crazyflie firmware. The build uses EXTRA_CFLAGS, as
docs/development/oot.md of the firmware describes. Kbuild puts these flags after those of the
firmware, so `-I` cannot replace a header. `-iquote` can: the compiler searches it before all `-I`.
The firmware's own Kalman filter stays as it is, with its logs and parameters. It gets each TDOA after
the correction at its own newest state.

The documented hook for estimators does not suffice. The Kalman filter takes TDOAs from the queue of
all measurements in its own task, where an out-of-tree estimator cannot change them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re
import textwrap
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper
import yaml

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError, version
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import Network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig

from .tracing import (
    LeftOut,
    Pieces,
    Program,
    Scalar,
    TracedCorrection,
    expressions_of,
    left_out,
    samples_of,
)

LARGEST_ID = 255  # of an anchor in the firmware
# stddev over tdoa_std, and the least stddev, m. The firmware takes each TDOA as independent, and their errors are
# correlated. Set on six flights of 0425: with 0.25 m the robust filter is lost on one of them, 0.62 m costs 4 %.
WIDER, LEAST = 1.6, 0.4

MAKEFILE = """\
# make CRAZYFLIE_BASE=/path/to/crazyflie-firmware
CRAZYFLIE_BASE ?= ../crazyflie-firmware
OOT_CONFIG := $(PWD)/config
EXTRA_CFLAGS += -I$(PWD)/src -iquote $(PWD)/overrides

include $(CRAZYFLIE_BASE)/tools/make/oot.mk
"""

CONFIG = "CONFIG_ESTIMATOR_KALMAN_ENABLE=y\nCONFIG_ESTIMATOR_KALMAN=y\n"

KBUILD = "obj-y += src/\n"
SOURCES = "obj-y += uwb_bias.o\nobj-y += uwb_bias_firmware.o\n"

OVERRIDE = """\
/* In place of the firmware's header of this name: its Kalman filter gets corrected TDOAs. */
#pragma once
#include_next "estimator_kalman.h"

#include "mm_tdoa.h"
#include "mm_tdoa_robust.h"
#include "uwb_bias_firmware.h"

#define kalmanCoreUpdateWithTdoa(core, tdoa, ...) \\
    kalmanCoreUpdateWithTdoa(core, uwbBiasCorrected(core, tdoa), __VA_ARGS__)
#define kalmanCoreRobustUpdateWithTdoa(core, tdoa, ...) \\
    kalmanCoreRobustUpdateWithTdoa(core, uwbBiasCorrected(core, tdoa), __VA_ARGS__)
"""

FIRMWARE_HEADER = """\
/* The correction between the Loco Positioning deck and the Kalman filter of the firmware. */
#pragma once
#include "kalman_core.h"

/* Subtract the bias of a TDOA at the state of the filter, set its standard deviation, and return it.
   A TDOA with an unknown anchor, or at a state that is not finite, keeps its difference. */
tdoaMeasurement_t *uwbBiasCorrected(const kalmanCoreData_t *core, tdoaMeasurement_t *tdoa);
"""

FIRMWARE_SOURCE = """\
#include "uwb_bias_firmware.h"

#include <math.h>

#include "log.h"
#include "param.h"
#include "usec_time.h"
#include "uwb_bias.h"

#if UWB_BIAS_READS_RATES
#error "The filter of the firmware gives no acceleration and no rate: export other effects."
#endif

uint8_t uwbBiasEnable = 1;
static float stddev = STDDEV; /* m, measured; 0 for that of tdoa2.stddev or tdoa3.stddev */
static float bias, std;
static uint32_t corrected, refused;

/* Return the state of the filter in the units and frames of uwb_bias.h. */
static uwb_bias_state state_of(const kalmanCoreData_t *core) {
    uwb_bias_state state = {0};
    for (int k = 0; k < 3; k++) {
        state.position[k] = core->S[KC_STATE_X + k];
        state.attitude[k] = core->q[1 + k]; /* the firmware keeps w first */
        for (int i = 0; i < 3; i++) {
            state.velocity[k] += core->R[k][i] * core->S[KC_STATE_PX + i]; /* body to world */
        }
    }
    state.attitude[3] = core->q[0];
    return state;
}

tdoaMeasurement_t *uwbBiasCorrected(const kalmanCoreData_t *core, tdoaMeasurement_t *tdoa) {
    static uint64_t first, last; /* us */
    static float previous = -1.0f;
    const uint64_t now = usecTimestamp();
    if (!first) {
        first = last = now;
    }
    uwb_bias_state state = state_of(core);
    state.time = (float)(now - first) * 1e-6f;
    state.interval = (float)(now - last) * 1e-6f;
    state.previous_anchor = previous;
    last = now;
    previous = (float)tdoa->anchorIds[1];
    const int wrong = uwb_bias(tdoa->anchorIds[0], tdoa->anchorIds[1], &state, &bias, &std);
    if (wrong) {
        refused++;
    }
    if (uwbBiasEnable) {
        const float noise = stddev > 0.0f ? stddev : tdoa->stdDev;
        tdoa->stdDev = sqrtf(noise * noise + std * std);
        tdoa->distanceDiff -= bias; /* both are 0 if it is wrong */
        corrected += !wrong;
    }
    return tdoa;
}

PARAM_GROUP_START(uwbBias)
PARAM_ADD(PARAM_UINT8, enable, &uwbBiasEnable)
PARAM_ADD(PARAM_FLOAT, stddev, &stddev)
PARAM_GROUP_STOP(uwbBias)

LOG_GROUP_START(uwbBias)
LOG_ADD(LOG_FLOAT, bias, &bias)
LOG_ADD(LOG_FLOAT, std, &std)
LOG_ADD(LOG_UINT32, corrected, &corrected)
LOG_ADD(LOG_UINT32, refused, &refused)
LOG_GROUP_STOP(uwbBias)
"""

README = """\
# Corrected TDOAs for a Crazyflie

This folder is an out-of-tree build of the Crazyflie firmware. It corrects each TDOA of the Loco
Positioning deck before the Kalman filter uses it. The filter itself stays as it is.

1. Load `anchors.yaml` in the client (Loco Positioning tab) and write it to the anchors. The
   correction belongs to these positions and ids.
2. Build. `overrides/` replaces one header of the firmware. Its flags and headers were checked with
   the firmware of August 2026 (2a18fc29). The whole firmware was not linked.

       git clone --recursive https://github.com/bitcraze/crazyflie-firmware
       make CRAZYFLIE_BASE=$PWD/crazyflie-firmware

3. Write it to the vehicle: `make CRAZYFLIE_BASE=$PWD/crazyflie-firmware cload`
4. Log `uwbBias.corrected`: it rises with each TDOA. If `uwbBias.refused` rises, the id of an anchor
   is not in `anchors.yaml`. If both stay at 0, the firmware did not use `overrides/`: run
   `make clean` and build again.
5. Fly with and without the correction: the parameter `uwbBias.enable` is 1 or 0.

The correction sets the standard deviation of each TDOA, too: the root of stddev^2 + std^2. `std` is
that of the correction at this place. `stddev` is {stddev:.3f} m: 1.6
times tdoa_std of ekf_node.yaml, and at least 0.4 m. The parameter `uwbBias.stddev` changes it; with 0 it is that
of the firmware (`tdoa2.stddev` or `tdoa3.stddev`, 0.15 m). Without a correction, set `tdoa2.stddev`
or `tdoa3.stddev` to {stddev:.3f}.

Fly with `kalman.robustTdoa` 1 only if stddev is 0.3 m or more. This filter weighs each TDOA by its
own standard deviation alone. With a small one it rejects most TDOAs once it is half a metre off, and
does not come back. Then restart it with `kalman.robustTdoa` 0: it does not forget a state that is not
a number.

Before you fly: the C of the correction was tested in emulation. This build was not flown.
"""


def client_yaml(anchors: Anchors) -> str:
    """Return the anchor file of the Crazyflie client: {id: {x, y, z}}, m."""
    content = {
        int(i): dict(zip("xyz", map(float, position)))
        for i, position in zip(anchors.ids, anchors.positions)
    }
    return yaml.safe_dump(content, sort_keys=True)


def stddev_of(config: FilterConfig) -> float:
    """Return the standard deviation of a TDOA for the filters of the firmware, m."""
    return max(WIDER * config.tdoa_std, LEAST)


def firmware_files(code: dict[str, str], anchors: Anchors, stddev: float) -> dict[str, str]:
    """Return {path: text} of the build.

    code : {name: text} of the C of the correction; stddev : m, of a TDOA
    """
    return {
        "Makefile": MAKEFILE,
        "Kbuild": KBUILD,
        "config": CONFIG,
        "README.md": README.format(stddev=stddev),
        "anchors.yaml": client_yaml(anchors),
        "overrides/estimator_kalman.h": OVERRIDE,
        "src/Kbuild": SOURCES,
        **{f"src/{name}": text for name, text in code.items()},
        "src/uwb_bias_firmware.h": FIRMWARE_HEADER,
        "src/uwb_bias_firmware.c": FIRMWARE_SOURCE.replace("STDDEV", f"{stddev:.3f}f"),
    }


OPERATORS = {
    "neg": "-{}",
    "not": "!{}",
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "eq": "{} == {}",
    "and": "{} && {}",
    "or": "{} || {}",
    "where": "{} ? {} : {}",
    "abs": "fabsf({})",
    "sqrt": "sqrtf({})",
    "exp": "expf({})",
    "log": "logf({})",
    "sin": "sinf({})",
    "cos": "cosf({})",
    "floor": "floorf({})",
    "atan2": "atan2f({}, {})",
    "max": "larger({}, {})",
    "min": "smaller({}, {})",
}
HELPERS = {
    "larger(": """
/* As numpy: NaN if one of the numbers is NaN. */
static inline float larger(float x, float y) { return x >= y || x != x ? x : y; }
""",
    "smaller(": """
static inline float smaller(float x, float y) { return x <= y || x != x ? x : y; }
""",
    "pieces(": """
/* A function of polynomials: its `count` + 1 breaks, then `terms` numbers of each piece. If all
   pieces are equally wide, `scale` is their number per unit, else 0. */
static float pieces(const float *table, int count, int terms, float scale, float x) {
    int low = 0;
    if (scale > 0.0f) {
        const float at = (x - table[0]) * scale;
        low = at < (float)count ? (at > 0.0f ? (int)at : 0) : count - 1;
    } else {
        for (int high = count; high - low > 1;) {
            const int middle = (low + high) / 2;
            if (x >= table[middle]) {
                low = middle;
            } else {
                high = middle;
            }
        }
    }
    const float width = table[low + 1] - table[low];
    const float *of = table + count + 1 + low * terms;
    float inside = x > table[low] ? x - table[low] : 0.0f;
    inside = inside > width ? width : inside;
    float value = of[terms - 1];
    for (int k = terms - 2; k >= 0; k--) {
        value = value * inside + of[k];
    }
    return x == x ? value : x;
}
""",
    "network_": """
static void dense(const float *weights, const float *biases, const float *x, int inputs,
                  float *out, int outputs, int rectify) {
    for (int k = 0; k < outputs; k++) {
        float sum = biases[k];
        for (int i = 0; i < inputs; i++) {
            sum += x[i] * *weights++;
        }
        out[k] = rectify && sum <= 0.0f ? 0.0f : sum;
    }
}
""",
}
LONGEST = 72  # characters of an expression that is not given a name
WIDTH = 96  # characters of a line of numbers
CHAIN = r"Gemm( Relu Gemm)*( Mul Add Concat)?"  # operators of a network that C holds


class Dense:
    """A network of dense layers with rectifiers between them.

    Attributes
    ----------
    layers : list of (weights (i, o), biases (o,)), float32
    constants : numbers that are appended to the output of the last layer
    """

    def __init__(self, session: Any) -> None:
        """Read the model of a Session; raise InputError if it is no such network."""
        graph = onnx.load_from_string(session.content).graph
        known = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
        kinds = " ".join(node.op_type for node in graph.node)
        if re.fullmatch(CHAIN, kinds) is None:
            raise _no_chain(f"it has the operators {kinds[:80]}")
        layers = [node.input[1:] for node in graph.node if node.op_type == "Gemm"]
        self.layers = [(known[one], np.ravel(known[other])) for one, other in layers]
        added = [node.input[1] for node in graph.node if node.op_type == "Add"]
        self.constants = [np.float32(known[name].ravel()[0]) for name in added]
        x = np.random.default_rng(0).normal(size=(4, session.width)).astype(np.float32)
        if not np.allclose(self.run(x), session.run(x), atol=1e-5):
            raise _no_chain("its layers alone give other numbers")

    def run(self, x: np.ndarray) -> np.ndarray:
        """Return the outputs (n, k) for inputs (n, i), float32. Each sum adds its terms one by one."""
        for k, (weights, biases) in enumerate(self.layers):
            x = x if k == 0 else np.where(x <= 0.0, np.float32(0.0), x)
            total = np.tile(biases, (len(x), 1))
            for column, row in zip(x.T, weights):
                total = total + column[:, None] * row
            x = total
        return np.concatenate(
            [x, np.tile(np.array(self.constants, np.float32), (len(x), 1))], axis=1
        )


def _no_chain(why: str) -> InputError:
    return InputError(
        f"--model: C holds networks of dense layers, and of this one not: {why}; train "
        "--model paper, or write it by --onnx."
    )


class Printer:
    """Print a Program as the function `correction`, with its tables.

    Its signature is (int a, int b, const uwb_bias_state *s, float *out). What is the same for both
    anchors becomes a function of one anchor.

    Attributes
    ----------
    text : the C of all tables and functions
    inputs : names of inputs that are read
    """

    def __init__(self, program: Program, members: dict[str, str], count: int) -> None:
        """Print a Program.

        members : {name of an input: member of the state, as "position[0]"}
        count : N, number of anchors
        """
        self._scalars, self._outputs, self._members = program.scalars, program.outputs, members
        self._uses = Counter(k for one in self._scalars for k in one.inputs)
        sessions = dict.fromkeys(one.value[0] for one in self._scalars if one.kind == "network")
        self._networks = {session: Dense(session) for session in sessions}
        self._anchors: list[bytes] = []
        self._pairs: list[bytes] = []
        self._pieces: list[Pieces] = []
        self.inputs: set[str] = set()
        functions = self._functions()
        parts = [text for call, text in HELPERS.items() if call in functions]
        for name, rows, shape in (
            ("of_anchor", self._anchors, (-1, count)),
            ("of_pair", self._pairs, (-1, count, count)),
        ):
            values = np.frombuffer(b"".join(rows), np.float32).reshape(shape)
            parts += [_table(name, np.moveaxis(values, 0, -1))] if rows else []
        for k, one in enumerate(self._pieces):
            parts.append(_table(f"pieces_{k}", np.concatenate([one.breaks, np.ravel(one.table)])))
        parts += [_network(k, one) for k, one in enumerate(self._networks.values())]
        self.text = "\n".join([*parts, functions])

    def _functions(self) -> str:
        """Return the function, after that of one anchor."""
        ends = ends_of(self._scalars)
        twin = twins(self._scalars, ends)  # {place at a: place at b}
        both = {*twin, *twin.values()}
        operations = [k for k, one in enumerate(self._scalars) if one.inputs]
        of_none = [k for k in operations if not ends[k]]
        rest = [k for k in operations if ends[k] and k not in both]
        used = {i for k in rest for i in self._scalars[k].inputs} | set(self._outputs)
        roots = [a for a, b in sorted(twin.items()) if a in used or b in used]
        known: dict[int, str] = {}
        lines, parts = self._statements(of_none, known), []
        if any(one.kind == "anchor" for one in self._scalars):
            for end in "ab":
                lines += [f"const float *of_{end} = of_anchor[{end}];", f"(void)of_{end};"]
        if roots:
            passed = sorted({i for a in twin for i in self._scalars[a].inputs} & set(of_none))
            values = ", ".join(known[i] for i in passed) or "0.0f"
            lines.append(f"const float shared[] = {{{values}}};")
            lines.append(f"float at_a[{len(roots)}], at_b[{len(roots)}];")
            lines += [f"at_anchor(of_{end}, s, shared, at_{end});" for end in "ab"]
            inside = {i: f"shared[{k}]" for k, i in enumerate(passed)}
            of_one = self._statements(sorted(twin), inside)
            of_one += [f"out[{k}] = {inside[a]};" for k, a in enumerate(roots)]
            parts.append(
                _function(
                    "at_anchor", "const float *of_a", "s", "const float *shared", lines=of_one
                )
            )
        for k, a in enumerate(roots):
            known[a], known[twin[a]] = f"at_a[{k}]", f"at_b[{k}]"
        lines += self._statements(rest, known)
        lines += [f"out[{k}] = {self._name(i, known)};" for k, i in enumerate(self._outputs)]
        return "\n".join([*parts, _function("correction", "int a", "int b", "s", lines=lines)])

    def _statements(self, places: Sequence[int], known: dict[int, str]) -> list[str]:
        """Return statements that compute some Scalars; their names are added to known."""
        lines: list[str] = []
        for k in places:
            one = self._scalars[k]
            inputs = [self._name(i, known) for i in one.inputs]
            if one.kind == "network":
                known[k] = self._output(one, inputs, lines)
                continue
            text = self._operation(one, inputs)
            known[k] = f"({text})"
            if self._uses[k] > 1 or len(text) > LONGEST:
                kind, known[k] = "int" if one.is_bool else "float", f"v{k}"
                lines.append(f"const {kind} v{k} = {text};")
        return lines

    def _name(self, place: int, known: dict[int, str]) -> str:
        """Return the expression of an input of an operation: a known name, or that of a leaf."""
        kind, _, value = self._scalars[place]
        if place in known:
            return known[place]
        if kind == "input":
            self.inputs.add(value)
            return f"s->{self._members[value]}"
        if kind == "constant":
            return _number(value)
        if kind == "anchor":
            end, row = value
            return f"of_{end}[{_place(self._anchors, row)}]"
        return f"of_pair[a][b][{_place(self._pairs, value)}]"

    def _operation(self, one: Scalar, inputs: list[str]) -> str:
        if one.kind != "pieces":
            return OPERATORS[one.kind].format(*inputs)
        count, terms = np.shape(one.value.table)
        name, scale = f"pieces_{_place(self._pieces, one.value)}", _number(one.value.scale)
        return f"pieces({name}, {count}, {terms}, {scale}, {inputs[0]})"

    def _output(self, one: Scalar, inputs: list[str], lines: list[str]) -> str:
        """Return the name of an output of a network; append its call, once for all outputs."""
        session, output = one.value
        network, k = self._networks[session], list(self._networks).index(session)
        own = len(network.layers[-1][1])
        call = f"network_{k}(x_{k}, y_{k});"
        if call not in lines:
            lines.append(f"const float x_{k}[] = {{{', '.join(inputs)}}};")
            lines += [f"float y_{k}[{own}];", call]
        return f"y_{k}[{output}]" if output < own else _number(network.constants[output - own])


def ends_of(scalars: Sequence[Scalar]) -> list[frozenset[str]]:
    """Return on which anchors, "a" and "b", each Scalar depends."""
    out: list[frozenset[str]] = []
    for one in scalars:
        ends = {"a", "b"} if one.kind == "pair" else set()
        if one.kind == "anchor":
            ends = {one.value[0]}
        out.append(frozenset(ends).union(*(out[i] for i in one.inputs)))
    return out


def twins(scalars: Sequence[Scalar], ends: Sequence[frozenset[str]]) -> dict[int, int]:
    """Return {place of an operation of anchor a: place of the same operation of anchor b}."""
    known: dict[tuple[object, ...], dict[str, int]] = {}
    functions: list[object] = []
    for k, one in enumerate(scalars):
        if len(ends[k]) != 1:
            functions.append(k)
            continue
        value = ("anchor", one.value[1]) if one.kind == "anchor" else str(one.value)
        key = one.kind, tuple(functions[i] for i in one.inputs), value
        (end,) = ends[k]
        of_ends = known.setdefault(key, {})
        of_ends[end] = k
        functions.append(("function", id(of_ends)))
    return {
        both["a"]: both["b"]
        for key, both in known.items()
        if len(both) == 2 and key[0] not in ("anchor", "network")
    }


def _place(known: list[Any], value: Any) -> int:
    """Return the place of a value in a list, to which it is added unless it is there."""
    if value not in known:
        known.append(value)
    return known.index(value)


def _number(value: float | np.floating) -> str:
    """Return a float32 as a constant of C, exactly."""
    value = np.float32(value)
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    text = f"{value:.9g}"
    return f"{text}{'' if '.' in text or 'e' in text else '.0'}f"


def _table(name: str, values: np.ndarray) -> str:
    """Return the definition of a constant array of any number of axes."""
    size = "".join(f"[{length}]" for length in values.shape)
    return f"static const float {name}{size} = {_listed(values)};\n"


def _listed(values: np.ndarray) -> str:
    """Return an array as an initializer, a row in a line."""
    if values.ndim > 1:
        return "{\n" + ",\n".join(map(_listed, values)) + "}"
    return textwrap.fill("{" + ", ".join(map(_number, values)) + "}", WIDTH)


def _function(name: str, *parameters: str, lines: Iterable[str]) -> str:
    """Return a function with some parameters, which may be unused, and the array `out`."""
    unused = [f"(void){one.split()[-1].lstrip('*')};" for one in parameters]
    declared = ["const uwb_bias_state *s" if one == "s" else one for one in parameters]
    text = "".join(f"    {line}\n" for line in (*unused, *lines))
    return f"static void {name}({', '.join(declared)}, float *out) {{\n{text}}}\n"


def _network(k: int, network: Dense) -> str:
    """Return the weights and the function of a network."""
    parts, calls, source = [], [], "x"
    for layer, (weights, biases) in enumerate(network.layers):
        name, (inputs, outputs) = f"layer_{k}_{layer}", weights.shape
        parts += [_table(f"{name}_bias", biases), _table(name, weights.T)]
        is_last = layer == len(network.layers) - 1
        into, rectify = ("out", 0) if is_last else (f"h[{layer % 2}]", 1)
        sizes = f"{inputs}, {into}, {outputs}, {rectify}"
        calls.append(f"dense({name}[0], {name}_bias, {source}, {sizes});")
        source = into
    widest = max(len(biases) for _, biases in network.layers)
    lines = "".join(f"    {line}\n" for line in (f"float h[2][{widest}];", *calls))
    return "\n".join(parts) + f"static void network_{k}(const float *x, float *out) {{\n{lines}}}\n"


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
   error that remains, m. Its square adds to the variance of the TDOA. It includes the deviation of
   the bias from a line if the position is 0.3 m off, and the velocity 0.3 m/s. */
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


def vehicle_code(
    anchors: Anchors, effects: EffectSet, network: Network | None = None
) -> VehicleCode:
    """Return the C of a correction.

    Raises InputError if the network is not a chain of dense layers.
    """
    samples = replace(samples_of(anchors, motion=True), yaw_std=None)
    corrector = Corrector(anchors, effects, network)
    found = corrector.prediction(samples)
    outputs = [*expressions_of(samples, found.bias), *expressions_of(samples, found.std)]
    program = Program(outputs, len(anchors))
    printer = Printer(program, MEMBERS, len(anchors))
    inputs = tuple(name for name in MEMBERS if name in printer.inputs)
    made = {
        "version": version(),
        "effects": _in_comment(corrector.effects.name),
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
    held = EffectSet((*traced.effects, *traced.floor))
    code = vehicle_code(traced.anchors, held, traced.network)
    _write(folder, code.files)


def write_crazyflie(folder: Path, traced: TracedCorrection, stddev: float) -> tuple[LeftOut, ...]:
    """Write an out-of-tree build of the firmware; return what it does not hold besides.

    stddev : m, of a TDOA. Raises InputError.
    """
    anchors = traced.anchors
    high = anchors.ids[anchors.ids > LARGEST_ID]
    if len(high):
        raise InputError(
            f"anchors: the firmware has ids up to {LARGEST_ID}, and one is {high[0]}; "
            "give the anchor such an id, or leave it out of the survey."
        )
    held = traced.effects.where(
        lambda effect: RATES.isdisjoint(vehicle_code(anchors, EffectSet((effect,))).inputs)
    )
    code = vehicle_code(anchors, EffectSet((*held, *traced.floor)), traced.network)
    _write(folder, firmware_files(code.files, anchors, stddev))
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
