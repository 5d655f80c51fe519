# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compile the C code of a correction, run it here or on an emulated Cortex-M4F, and measure it."""

import ctypes
from dataclasses import replace
import math
from pathlib import Path
import shutil

from exported_states import network_of
import numpy as np
from programs import run
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.correction.model import FEATURES
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, Samples, SmoothTerm
from uwb_tdoa_bias.effects.samples import Motion
from uwb_tdoa_tools.exporting.c_code import MEMBERS, Dense
from uwb_tdoa_tools.exporting.tracing import ELEMENTWISE
from uwb_tdoa_tools.training.models import WITHOUT

HERE = Path(__file__).parent / "cortex_m"
GCC, ARM_GCC = shutil.which("gcc"), shutil.which("arm-none-eabi-gcc")
QEMU = shutil.which("qemu-system-arm")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")
PROCESSOR = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
# Flags of the Crazyflie firmware (its Makefile). They allow fused multiply-add.
FIRMWARE = (
    *("-Os", "-std=gnu11", "-fno-math-errno", "-mfp16-format=ieee", "-fno-strict-aliasing"),
    *("-ffunction-sections", "-fdata-sections"),
    *("-Wall", "-Wextra", "-Wmissing-braces", "-Wdouble-promotion", "-Werror"),
)
CLOCK = 168e6  # Hz, of the emulated processor. It executes one instruction in 1 ns.
# The state in C, all of 4 bytes each
STATE = np.dtype(
    [
        ("position", np.float32, 3),
        ("attitude", np.float32, 4),
        ("velocity", np.float32, 3),
        ("acceleration", np.float32, 3),
        ("rate", np.float32, 3),
        ("time", np.float32),
        ("interval", np.float32),
        ("previous_anchor", np.float32),
    ]
)
CASE = np.dtype([("a", np.int32), ("b", np.int32), ("state", STATE)])
RESULT = np.dtype(
    [
        ("wrong", np.int32),
        ("bias", np.float32),
        ("std", np.float32),
    ]
)
COUNTS = "ticks", "most", "stack", "cases"
COST = np.dtype([(name, np.uint32) for name in COUNTS])

RNG = np.random.default_rng(7)
POSITIONS = np.round(
    [[x, y, z] for x in (-3.5, 3.5) for y in (-4.0, 4.0) for z in (0.2, 2.9)]
    + RNG.uniform(-0.2, 0.2, (8, 3)),
    3,
)
ANCHORS = Anchors(np.array([0, 1, 2, 3, 4, 5, 9, 300]), POSITIONS, Rotation.random(8, 7).as_quat())
SPLINE = {f"c{k}": 0.1 * math.sin(k) for k in range(6)}
ONE_EACH = {
    "anchor_delay": {str(i): 0.02 * k for k, i in enumerate(ANCHORS.ids)},
    "anchor_position": {"0.x": 0.1, "3.z": -0.2, "300.y": 0.05},
    "tag_lever_arm": {"x": 0.02, "z": 0.05},
    "range_scale": {"scale": 0.01},
    "range_bias": {"quadratic": 0.002},
    "received_power_bias": {"scale": 1.0},
    "antenna_pattern": {"tag": 0.1, "anchor": 0.2},
    "anchor_clock_drift": {"2": 0.001},
    "nlos": {"1.delay": 0.3, "1.x": 1.0, "1.y": 0.0, "1.z": 1.0, "1.radius": 1.5, "4.delay": 0.1},
    "pair_offset": {"0-1": 0.1, "9-300": -0.2},
    "noise_level": {"0-1": 0.1, "3-4": 0.2},
    "noise_correlation": {"std": 0.05, "time": 0.5},
}
TERMS = {
    "spline over elevation": {
        "covariate": "elevation_in_tag",
        "form": "arrival",
        "knots": (-1.5, -0.7, 0.0, 0.7, 1.5),
    },
    "spline of an anchor": {"covariate": "range", "form": "anchor", "knots": (0.0, 2.0, 5.0, 12.0)},
    "spline over climb rate": {"covariate": "climb_rate", "knots": (-1.0, -0.2, 0.3, 1.0)},
    "spline over speed": {"covariate": "speed", "knots": (0.0, 0.5, 1.5, 2.0)},
    "line": {"covariate": "height", "knots": (0.0, 3.0), "shape": "line"},
    "wave": {"covariate": "x", "knots": (0.0, 2.5), "shape": "wave"},
    "step of a pair": {"covariate": "y", "form": "pair", "knots": (-3, 0.5, 3), "shape": "step"},
    "spline over tilt": {"covariate": "tilt", "knots": (0.0, 0.3, 1.0)},
    "turning": {"covariate": "turning_rate", "knots": (0.0, 0.4, 2.0)},
    "accelerating": {"covariate": "acceleration", "knots": (0.0, 1.0, 4.0)},
    "interval": {"covariate": "interval", "knots": (0.0, 0.003, 0.01)},
    "previous anchor": {"covariate": "previous_anchor", "knots": (0.0, 1.0, 9.0)},
    "time, limited": {"covariate": "time", "knots": (0.0, 30.0, 60.0), "domain": {"time": (0, 60)}},
}
PREFIXES = {"anchor": "3.", "pair": "0-1."}


def effects():
    """Return {name: effect} of all kinds that the C code supports."""
    out = {name: EFFECTS[name](values) for name, values in ONE_EACH.items()}
    for name, settings in TERMS.items():
        prefix = PREFIXES.get(settings.get("form"), "")
        term = SmoothTerm(dict(), **settings)
        count = term.count
        out[name] = SmoothTerm({f"{prefix}c{k}": SPLINE[f"c{k}"] for k in range(count)}, **settings)
    return out


COMMON = (  # without antenna patterns
    *("anchor_delay", "anchor_position", "tag_lever_arm", "range_scale", "range_bias"),
    *("anchor_clock_drift", "nlos", "pair_offset", "noise_level", "spline over elevation"),
)


def chosen(*names):
    """Return the EffectSet of some effects."""
    known = effects()
    return EffectSet(tuple(known[name] for name in names))


def network(folder, orientations=True):
    """Return a Network of the first paper with random weights and 14 or 8 inputs."""
    names = FEATURES if orientations else WITHOUT
    return network_of(Path(folder), names, 3, clip=1.0, name="drawn")


def cases(n, seed=0):
    """Return n random states and pairs: array of CASE."""
    rng, out = np.random.default_rng(seed), np.zeros(n, CASE)
    a = rng.integers(0, 8, n)
    out["a"], out["b"] = ANCHORS.ids[a], ANCHORS.ids[(a + rng.integers(1, 8, n)) % 8]
    state = out["state"]
    state["position"] = rng.uniform([-4.0, -4.5, 0.0], [4.0, 4.5, 3.0], (n, 3))
    state["attitude"] = Rotation.random(n, seed).as_quat()
    for name in ("velocity", "acceleration", "rate"):
        state[name] = rng.normal(size=(n, 3))
    state["time"], state["interval"] = rng.uniform(0.0, 100.0, n), rng.uniform(0.0, 0.01, n)
    state["previous_anchor"] = rng.choice(ANCHORS.ids, n)
    return out


def samples_of(some):
    """Return the Samples of cases."""
    state = {name: some["state"][name].astype(float) for name in STATE.names}
    return Samples(
        state["time"],
        *(ANCHORS.index(some[end]) for end in "ab"),
        state["position"],
        state["attitude"],
        ANCHORS,
        motion=Motion(state["velocity"], state["acceleration"], state["rate"]),
        interval=state["interval"],
        previous=state["previous_anchor"],
    )


def _libm(name):
    function = getattr(ctypes.CDLL("libm.so.6"), name)
    function.restype = ctypes.c_float

    def of_arrays(*arrays):
        numbers = zip(*(one.tolist() for one in arrays))
        made = [function(*map(ctypes.c_float, some)) for some in numbers]
        return np.array(made, dtype=np.float32)

    return of_arrays


# IEEE 754 does not define these functions: the C library has its own.
LIBM = {name: _libm(f"{name}f") for name in ("exp", "log", "sin", "cos", "atan2")}
FUNCTIONS = {
    **ELEMENTWISE,
    **LIBM,
    "max": lambda x, y: np.where((x >= y) | (x != x), x, y),
    "min": lambda x, y: np.where((x <= y) | (x != x), x, y),
}


def by_numpy(code, some):
    """Return (bias (n,), std (n,)) of cases by numpy in single precision.

    The operations have the order of the C code.
    """
    columns = {}
    for name, member in MEMBERS.items():
        field, _, place = member.partition("[")
        values = some["state"][field]
        columns[name] = values[:, int(place[0])] if place else values
    rows = {end: ANCHORS.index(some[end]) for end in "ab"}
    return _outputs(code.program, columns, rows)


def _outputs(program, columns, rows):
    """Return the outputs of a Program, each (n,) float32.

    columns : {name of an input: (n,)}
    rows : {"a" and "b": rows (n,) of the anchors}
    """
    made = []
    with np.errstate(all="ignore"):
        for one in program.scalars:
            inputs = [made[k] for k in one.inputs]
            value = _value(one, inputs, columns, rows)
            assert value.dtype == (bool if one.is_bool else np.float32), one.kind
            made.append(value)
    return [made[k] for k in program.outputs]


def _value(one, inputs, columns, rows):
    """Return the value (n,) of a Scalar."""
    if one.kind == "input":
        return columns[one.value]
    if one.kind == "constant":
        return np.full(len(rows["a"]), one.value)
    if one.kind == "anchor":
        end, numbers = one.value
        return np.frombuffer(numbers, np.float32)[rows[end]]
    if one.kind == "pair":
        table = np.frombuffer(one.value, np.float32).reshape(len(ANCHORS), len(ANCHORS))
        return table[rows["a"], rows["b"]]
    if one.kind == "network":
        session, output = one.value
        return Dense(session).run(np.stack(inputs, axis=1))[:, output]
    if one.kind == "pieces":
        return _piecewise(one.value, *inputs)
    return FUNCTIONS[one.kind](*inputs)


def _piecewise(pieces, x):
    """Return the values (n,) of Pieces at x (n,)."""
    breaks, table = np.float32(pieces.breaks), np.float32(pieces.table)
    if pieces.scale:
        at = np.nan_to_num((x - breaks[0]) * pieces.scale)
        piece = np.clip(at, 0, len(table) - 1).astype(int)
    else:
        piece = np.searchsorted(breaks[1:-1], x, side="right")
    start = breaks[piece]
    width = breaks[piece + 1] - start
    inside = np.where(x > start, x - start, np.float32(0.0))
    inside = np.where(inside > width, width, inside)
    value, *lower = table[piece].T[::-1]
    for coefficients in lower:
        value = value * inside + coefficients
    return np.where(x == x, value, x)


def write(folder, code):
    """Make the folder, and write uwb_bias.h and uwb_bias.c to it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in code.files.items():
        (folder / name).write_text(text)


def on_host(folder, some, flags=STRICT):
    """Run cases on this computer and return their RESULT (n,)."""
    sources = [HERE / "main.c", HERE / "host.c", "uwb_bias.c"]
    command = [GCC, *flags, f"-I{HERE}", "-I.", *sources, "-lm", "-o", "host"]
    run(*command, cwd=folder, check=True)
    return _results(folder, ["./host"], some)


def linked(folder, flags=FIRMWARE):
    """Compile the test program for the board and return its size in flash, bytes."""
    sources = [HERE / "main.c", HERE / "board.c", "uwb_bias.c"]
    options = ["-nostartfiles", "-T", HERE / "netduinoplus2.ld", "-Wl,--gc-sections"]
    options += ["--specs=nano.specs", "--specs=nosys.specs", "-lm", "-o", "board.elf"]
    command = [ARM_GCC, *PROCESSOR, *flags, f"-I{HERE}", "-I.", *sources, *options]
    run(*command, cwd=folder, check=True)
    return sum(_size(folder, "board.elf")[:2])


def on_board(folder, some, flags=FIRMWARE):
    """Run cases on the emulated board and return (RESULT (n,), COST (1,))."""
    linked(folder, flags)
    quiet = ["-nographic", "-monitor", "none", "-serial", "none"]
    hosted = ["-semihosting-config", "enable=on,target=native", "-icount", "shift=0"]
    command = [QEMU, "-M", "netduinoplus2", *quiet, *hosted, "-kernel", "board.elf"]
    results = _results(folder, command, some)
    return results, np.fromfile(folder / "cost.bin", COST)


def _results(folder, command, some):
    (folder / "cases.bin").write_bytes(some.tobytes())
    run(*command, cwd=folder, check=True, timeout=300)
    return np.fromfile(folder / "results.bin", RESULT)


def _size(folder, name):
    """Return (text, data, bss) of a file, bytes."""
    out = run("arm-none-eabi-size", name, cwd=folder, check=True).stdout
    return tuple(map(int, out.splitlines()[1].split()[:3]))


def cost_of(folder, code, n=320):
    """Return the cost of a correction on the board.

    instructions, most : instructions per TDOA, mean and maximum
    own : bytes of flash of the correction alone
    flash : bytes of flash, including functions of libm
    ram : bytes of RAM
    """
    write(folder, code)
    whole = linked(folder)
    write(folder / "without", replace(code, files={**code.files, "uwb_bias.c": STUB}))
    empty = linked(folder / "without")
    symbols = [ARM_GCC, *PROCESSOR, *FIRMWARE, "-c", "uwb_bias.c", "-o", "own.o"]
    run(*symbols, cwd=folder, check=True)
    own = _own_flash(folder)
    _, cost = on_board(folder, cases(n))
    per_case = 1e9 / CLOCK / cost["cases"][0]
    return {
        "instructions": float(cost["ticks"][0] * per_case),
        "most": float(cost["most"][0] * 1e9 / CLOCK),
        "own": own,
        "flash": whole - empty,
        "ram": sum(_size(folder, "own.o")[1:]) + int(cost["stack"][0]) + STATE.itemsize,
    }


STUB = """
#include "uwb_bias.h"
int uwb_bias(int a, int b, const uwb_bias_state *state, float *bias, float *std) {
    (void)state;
    *bias = *std = 0.0f;
    return a - b;
}
"""


def _own_flash(folder):
    """Return the bytes of uwb_bias.c that remain in the test program."""
    command = ["arm-none-eabi-nm", "-S", "--defined-only", "board.elf"]
    out = run(*command, cwd=folder, check=True).stdout
    kept = {
        line.split()[-1]: int(line.split()[1], 16)
        for line in out.splitlines()
        if len(line.split()) == 4
    }
    out = run("arm-none-eabi-nm", "--defined-only", "own.o", cwd=folder, check=True).stdout
    return sum(kept.get(line.split()[-1], 0) for line in out.splitlines())
