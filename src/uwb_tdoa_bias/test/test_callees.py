# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Functions that only compiled code calls have no machine code of their own."""

import os
from pathlib import Path
import sys

from numba.core.compiler import Flags
from programs import python
import pytest

from uwb_tdoa_bias.common import callees

pytestmark = pytest.mark.slow

SOURCES = Path(callees.__file__).parents[2]
PROGRAM = """
import numpy as np
from uwb_tdoa_bias.common.compiled import compiled

PAIR = np.dtype([("count", int), ("value", float, 2)], align=True)


@compiled
def scaled(pair, factor):
    if factor < 0.0:
        raise ValueError("a factor below 0")
    out = np.zeros((2, 3))
    out[:, :2] = np.concatenate((pair.value, pair.value)).reshape((2, 2)) * factor
    pair.count += 1
    return out


@compiled
def median(pair, factor):
    return np.median(scaled(pair, factor))


@compiled
def root(pairs, factor):
    total = 0.0
    for k in range(len(pairs)):
        total += median(pairs[k], factor) + scaled(pairs[k], factor).sum()
    return total


def outcome(root, scaled):
    pairs = np.ones(3, PAIR)
    print(root(pairs, 0.1).hex(), pairs["count"].tolist())
    for function, argument in (root, pairs), (scaled, pairs[0]):
        try:
            function(argument, -1.0)
        except ValueError as error:
            print(error)
    print(scaled(pairs[1], 0.3).tolist())  # now Python calls a callee


outcome(root, scaled)
print(sum(root.stats.cache_hits.values()) > 0)
"""


# numba compiles as usual if its version is untested
AS_USUAL = "import numba\nnumba.version_info = (9, 9)\n" + PROGRAM


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("callees")


@pytest.fixture(scope="module")
def run(folder):
    """Return a function that runs a program with a given cache.

    That function returns the printed lines, and whether numba loaded code from the cache.
    """

    def one(text, cache, place="program"):
        file = folder / f"{place} of {cache}" / "at" / "program.py"
        if not file.exists():
            file.parent.mkdir(parents=True)
            file.write_text(text)
        done = python(
            file,
            env={"PATH": "/usr/bin:/bin", "NUMBA_CACHE_DIR": str(folder / cache)}
            | {"PYTHONPATH": os.pathsep.join([str(SOURCES), *filter(None, sys.path)])},
            check=True,
        )
        *printed, cached = done.stdout.splitlines()
        return printed, cached == "True"

    return one


@pytest.fixture(scope="module")
def first(run):
    """Return the result of PROGRAM with an empty cache."""
    return run(PROGRAM, "cache")


def test_callees_give_the_bits_that_numba_gives_as_usual_also_from_the_cache(run, first):
    usual, _ = run(AS_USUAL, "usual")
    assert (usual, False) == first
    assert (usual, True) == run(PROGRAM, "cache")


def test_equal_sources_of_another_installation_are_not_compiled_again(run, first):
    assert run(PROGRAM, "cache", "another installation") == (first[0], True)


def test_only_what_python_calls_has_machine_code(first, folder):
    kept = {path.name.split("-")[0] for path in (folder / "cache").rglob("*.nbi")}
    assert kept == {"program.root", "program.scaled"}


BEFORE = """
import numba
import numpy as np

@numba.njit
def theirs(x):
    return np.median(x) + np.concatenate((x, x)).sum()

theirs(np.ones(3))  # libraries that numba made before the import of ours
"""
AFTER = """
@numba.njit(parallel=True)
def many(x):
    total = 0.0
    for i in numba.prange(len(x)):
        total += x[i] + theirs(x[:2])
    return total

@numba.njit
def caller(x):
    return many(x)

assert caller(np.ones(4)) == 4 * 6.0
(compiled_callee,) = many.overloads.values()
assert type(compiled_callee.entry_point).__name__ == "builtin_function_or_method"
print(True)
"""


def test_functions_of_other_packages_compile_as_usual_before_and_after_ours(run, first):
    printed, _ = run(BEFORE + PROGRAM + AFTER, "beside others")
    assert printed[:-1] == first[0]


@pytest.mark.quick
def test_another_version_of_numba_compiles_as_usual(monkeypatch):
    usual = callees.dispatcher.Dispatcher.compile
    for version in ((0, 56, 4), (0, callees.TRIED[1][1] + 1, 0), (1, 0, 0)):
        monkeypatch.setattr(callees, "version_info", version)
        assert not callees.install()
    assert callees.dispatcher.Dispatcher.compile is usual


def test_flags_have_the_values_of_their_options():
    flags = Flags()
    flags.nrt = True
    others = flags.copy()
    for changed in (None, "boundscheck"):
        if changed:
            setattr(others, changed, True)
        for one in (flags, others):
            assert list(one.values().items()) == [(k, getattr(one, k)) for k in one.options]
        assert (flags == others) == (changed is None)
    assert hash(flags) == hash(flags.copy())


def test_a_slice_of_another_shape_is_refused(run):
    program = """
import numpy as np
from uwb_tdoa_bias.common.compiled import compiled

@compiled
def assign(rows, more):
    rows[1:] = more

rows = np.zeros(4)
assign(rows, np.arange(3.0))
print(rows.tolist())
try:
    assign(rows, np.zeros(4))
except ValueError as error:
    print(error)
print(sum(assign.stats.cache_hits.values()) > 0)
"""
    said = ["[0.0, 0.0, 1.0, 2.0]", "cannot assign slice from input of different size"]
    for cached in (False, True):
        assert run(program, "slices") == (said, cached)
