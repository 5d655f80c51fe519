# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct the TDOAs of a peer by exported C, as a vehicle does.

`export --c FOLDER` writes uwb_bias.h and uwb_bias.c. They are compiled here, together with a loop
over the events of a peer. Each TDOA is corrected at the newest state of the peer. Then the peer
gets it.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
import shutil
import subprocess
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import folder_of_process, write_text
from uwb_tdoa_bias.common.text import printable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

FILES = "uwb_bias.h", "uwb_bias.c"
FLAGS = "-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"
READS_RATES = "#define UWB_BIAS_READS_RATES 1"  # a line of uwb_bias.h
LOOP = """
#include <stdint.h>
#include "uwb_bias.h"

typedef struct { double t, gyro[3], accel[3], d; int32_t a, b; } event;
typedef struct { double first, last; int32_t previous, count; } past;

void corrected_run(const event *events, int32_t count, const int32_t *ids, past *known,
                   void (*run)(const event *, int32_t),
                   void (*state)(double *, double *, double *)) {
    for (; count--; events++) {
        event one = *events;
        if (one.a >= 0) {
            double p[3], v[3], q[4];
            uwb_bias_state at = {0};
            float bias, std;
            state(p, v, q);
            for (int k = 0; k < 3; k++) {
                at.position[k] = (float)p[k];
                at.velocity[k] = (float)v[k];
            }
            for (int k = 0; k < 4; k++) at.attitude[k] = (float)q[k];
            if (!known->count++) known->first = known->last = one.t;
            at.time = (float)(one.t - known->first);
            at.interval = (float)(one.t - known->last);
            at.previous_anchor = (float)known->previous;
            if (!uwb_bias(ids[one.a], ids[one.b], &at, &bias, &std)) one.d -= bias;
            known->last = one.t;
            known->previous = ids[one.b];
        }
        run(&one, 1);
    }
}
"""
PAST = np.dtype([("first", float), ("last", float), ("previous", np.int32), ("count", np.int32)])


class CompiledCorrection:
    """A correction in C, for the events of a peer."""

    def __init__(self, folder: str | Path) -> None:
        """Compile a folder that `export --c` wrote; raise InputError."""
        self._run = ctypes.CDLL(str(_library(Path(folder).absolute()))).corrected_run
        self.start(())

    def start(self, ids: ArrayLike) -> None:
        """Forget all TDOAs. ids : (n,) of the anchors, in the order of their rows."""
        self._ids = np.ascontiguousarray(ids, dtype=np.int32)
        self._past = np.zeros(1, PAST)
        self._past["previous"] = -1

    def run(self, events: np.ndarray, run: Any, state: Any) -> None:
        """Give corrected events (n,) of EVENT to a peer, by two functions of its library."""
        arrays = (events, self._ids, self._past)
        data, ids, past = (ctypes.c_void_p(one.ctypes.data) for one in arrays)
        self._run(data, ctypes.c_int32(len(events)), ids, past, run, state)


@cache
def _library(folder: Path) -> Path:
    """Return the compiled library of a folder, once per process; raise InputError."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise InputError("--correction: needs the C compiler cc, which is not installed.")
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"--correction: {folder} holds no {missing[0]}; give a folder that export --c wrote."
        )
    if READS_RATES in (folder / FILES[0]).read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            f"--correction: {folder} reads acceleration or rate, which a peer does not give; "
            "export the other effects alone."
        )
    made = Path(tempfile.mkdtemp(dir=folder_of_process()))
    write_text(made / "loop.c", LOOP)
    sources = [str(made / "loop.c"), str(folder / FILES[1])]
    library = made / "libcorrection.so"
    command = [compiler, *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        words = printable(done.stderr.strip().partition("\n")[0])
        raise InputError(
            f"--correction: {folder} cannot be compiled ({words}); write it again by export --c."
        )
    return library
