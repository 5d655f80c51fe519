# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compile functions that only compiled code calls, without machine code of their own.

numba makes machine code of each function together with all functions that it calls, and once more
for each caller. Of the filter's 430 functions Python calls 40. Here a function that compiled code
calls (a callee) is only typed and lowered. A function that Python calls (a root) links all callees
below it once, optimizes them together and makes machine code. That takes 40 % of the processor
time, and the results are equal to the bit: `docs/notebook/speed.md`.

Three more things that a compilation spends a tenth of its time on are shortened, for the functions of
all packages: the values of flags are read one by one for each call of a function, timers run that
nobody reads, and the text of an error is compiled for each assignment to a slice.

`install` replaces methods and a class of numba, in versions in which this was tried. In others
numba compiles as usual, which takes longer. Functions of other packages have all callees, as usual.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext
import threading
from typing import Any

from numba import version_info
from numba.core import codegen, cpu, dispatcher, event, sigutils, targetconfig
from numba.core.caching import NullCache
from numba.core.environment import lookup_environment
from numba.extending import overload
from numba.np import arrayobj

TRIED = (0, 57), (0, 68)  # first and last version of numba
WITHOUT_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
ENVIRONMENT = "_ZN08NumbaEnv"  # prefix of a global variable that holds what a function may raise
OURS = "of_uwb_tdoa"  # attribute of dispatchers whose callees compile in this way


class _State(threading.local):
    """What this thread compiles: a function below one of ours, a callee; a callee is next."""

    below_ours = callee = callee_is_next = False


_state = _State()


class _Callee:
    """Key of a callee among the functions that can be called by compiled code."""


class _Library(codegen.JITCodeLibrary):
    """Code of a function: a root links its callees, a callee nothing."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.of_callee = _state.callee

    def finalize(self) -> None:
        if self.of_callee:
            self._raise_if_finalized()
            self._finalized = True
            return
        self._linking_libraries = _with_callees(self._linking_libraries)
        super().finalize()


def _with_callees(libraries: Iterable[Any]) -> list[Any]:
    """Return code libraries and all below them, callers first.

    LLVM links a function only if a function that is linked already calls it. A library that numba
    made before `install` has no callees.
    """
    found: list[Any] = []
    seen: set[Any] = set()

    def visit(library: Any) -> None:
        if library in seen:
            return
        seen.add(library)
        if getattr(library, "of_callee", False):
            for each in reversed(library._linking_libraries):
                visit(each)
        found.append(library)

    for library in reversed(list(libraries)):
        visit(library)
    return found[::-1]


def install() -> bool:
    """Let numba compile callees without machine code; return whether this version was tried."""
    first, last = TRIED
    if not first <= tuple(version_info[:2]) <= last:
        return False
    kind: Any = dispatcher.Dispatcher
    context: Any = cpu.CPUContext
    usual_template, usual_compile = kind.get_call_template, kind.compile
    usual_overload, usual_executable = kind.add_overload, context.get_executable

    def get_call_template(self: Any, args: Any, kws: Any) -> Any:
        """Compile what compiled code is about to call."""
        _state.callee_is_next = _state.below_ours
        try:
            return usual_template(self, args, kws)
        finally:
            _state.callee_is_next = False

    def compile_function(self: Any, sig: Any) -> Any:
        callee, _state.callee_is_next = _state.callee_is_next, False
        types = tuple(sigutils.normalize_signature(sig)[0])
        known = self.overloads.get(types)
        if known is not None and (callee or not isinstance(known.entry_point, _Callee)):
            return known.entry_point
        if known is not None:
            del self.overloads[types]  # Python calls it now
        before = _state.below_ours, _state.callee
        compiler, cache = self._compiler, self._cache
        options = compiler.targetoptions
        _state.below_ours, _state.callee = callee or hasattr(self, OURS), callee
        if callee:
            self._cache, compiler.targetoptions = NullCache(), {**options, **WITHOUT_WRAPPERS}
        try:
            return usual_compile(self, sig)
        finally:
            _state.below_ours, _state.callee = before
            self._cache, compiler.targetoptions = cache, options

    def add_overload(self: Any, cres: Any) -> None:
        if isinstance(cres.entry_point, _Callee):
            self.overloads[tuple(cres.signature.args)] = cres
        else:
            usual_overload(self, cres)

    def get_executable(self: Any, library: Any, fndesc: Any, env: Any) -> Any:
        if _state.callee:
            return _Callee()
        function = usual_executable(self, library, fndesc, env)
        for variable in library._final_module.global_variables:
            if variable.name.startswith(ENVIRONMENT):
                environment = lookup_environment(variable.name)
                if environment is not None:
                    library.codegen.set_env(variable.name, environment)
        return function

    kind.get_call_template, kind.compile = get_call_template, compile_function
    kind.add_overload = add_overload
    context.get_executable = get_executable
    codegen.JITCPUCodegen._library_class = _Library
    flags: Any = targetconfig.TargetConfig
    flags.values = _values
    event.install_timer = lambda *_: nullcontext()  # type: ignore[assignment]  # it enters and does nothing
    if hasattr(arrayobj, "ol_raise_with_shape_context_generic"):  # since numba 0.58
        overload(_wrong_shape)(arrayobj.ol_raise_with_shape_context_generic)
        arrayobj.raise_with_shape_context = _wrong_shape
    return True


def _values(self: Any) -> dict[str, Any]:
    """Return {option: its value} of numba's flags."""
    return {name: self._values.get(name, option._default) for name, option in self.options.items()}


def _wrong_shape(source: Any, target: Any) -> None:
    """Raise ValueError for an assignment to a slice of another shape; of compiled code only."""
