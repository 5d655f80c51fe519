# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compile functions that only compiled code calls, without machine code of their own.

numba makes machine code of each function together with all functions that it calls, and once more
for each caller. Of the filter's 430 functions Python calls 40. Here a function that compiled code
calls (a callee) is only typed and lowered. A function that Python calls (a root) links all callees
below it once, optimizes them together and makes machine code. That takes 40 % of the processor
time, and the results are equal to the bit: `docs/notebook/speed.md`.

A function that is marked by `apart` has machine code of its own also where compiled code calls it.
Its caller only knows its name and types. So another process can compile it meanwhile.

`install` replaces four methods and a class of numba, in versions in which this was tried. In others
numba compiles as usual, which takes longer. Functions of other packages compile as usual, too.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
import hashlib
from importlib import import_module
import os
import pickle
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

from numba import types, version_info
from numba.core import codegen, compiler, cpu, dispatcher, funcdesc, sigutils
from numba.core.caching import NullCache
from numba.core.environment import lookup_environment
from numba.core.typing import signature

if TYPE_CHECKING:
    from collections.abc import Iterable

TRIED = (0, 57), (0, 68)  # first and last version of numba
WITHOUT_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
ENVIRONMENT = "_ZN08NumbaEnv"  # prefix of a global variable that holds what a function may raise
OURS = "of_uwb_tdoa"  # attribute of dispatchers whose callees compile in this way
APART = "apart"  # attribute of dispatchers: the dispatcher that makes their own machine code
RETURNS = {  # what a function apart may return, by its annotation
    "None": types.none,
    "bool": types.boolean,
    "float": types.float64,
}


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
        self.apart: list[Any] = []  # functions apart, each with its types

    def finalize(self) -> None:
        if self.of_callee:
            self._raise_if_finalized()
            self._finalized = True
            return
        below = _with_callees(self._linking_libraries)
        self._linking_libraries = [each for each in below if not getattr(each, "apart", [])]
        for library in below:
            self.apart += getattr(library, "apart", [])
        super().finalize()

    def _finalize_final_module(self) -> None:
        for function, argument_types in self.apart:
            _link(*_name(function), argument_types)
        super()._finalize_final_module()


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


def apart(made: Any, own: Any) -> Any:
    """Let compiled code call a compiled function by its address.

    Parameters
    ----------
    made : Dispatcher
        The function. It returns nothing, a bool or a float, by its annotation, and stands in a module.
    own : Dispatcher
        The same function. It makes the machine code.

    Returns
    -------
    Dispatcher
        The first of both.
    """
    setattr(made, APART, own)
    return made


def _name(function: Any) -> tuple[str, str]:
    """Return the module and the name of a function apart."""
    return function.py_func.__module__, function.py_func.__name__


def _returned(function: Any) -> Any:
    """Return the type that a function apart returns, by its annotation: an object, or its name."""
    annotation = function.py_func.__annotations__["return"]
    return RETURNS[getattr(annotation, "__name__", str(annotation))]


def _symbol(module: str, name: str, argument_types: Any) -> str:
    """Return the name by which machine code calls a function apart."""
    digest = hashlib.sha256(repr(argument_types).encode()).hexdigest()[:16]
    return f"{module}.{name}.{digest}"


def _declare(function: Any, argument_types: Any) -> Any:
    """Add a function apart to those that compiled code can call, without its code."""
    argument_types = tuple(types.unliteral(each) for each in argument_types)
    known = function.overloads.get(argument_types)
    if known is not None:
        return known.entry_point
    symbol = _symbol(*_name(function), argument_types)
    returned = _returned(function)
    context, entry_point = function.targetctx, _Callee()
    before, _state.callee = _state.callee, True
    library = context.codegen().create_library(symbol)
    _state.callee = before
    library.finalize()
    library.apart.append((function, argument_types))
    described = funcdesc.ExternalFunctionDescriptor(symbol, returned, argument_types)
    function.overloads[argument_types] = compiler.compile_result(
        typing_context=function.typingctx,
        target_context=context,
        signature=signature(returned, *argument_types),
        library=library,
        fndesc=described,
        entry_point=entry_point,
        objectmode=False,
    )
    context.insert_user_function(entry_point, described, [library])
    _meanwhile.compile(*_name(function), argument_types)
    return entry_point


def _link(module: str, name: str, argument_types: Any) -> None:
    """Make the address of a function apart known to machine code."""
    _meanwhile.wait()
    own = getattr(getattr(import_module(module), name), APART)
    own.compile(argument_types)
    result = own.overloads[argument_types]
    if result.signature.return_type != _returned(own):
        raise TypeError(f"{module}.{name} returns {result.signature.return_type}")
    address = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
    codegen.ll.add_symbol(_symbol(module, name, argument_types), address)


class _Meanwhile:
    """Another process that compiles functions apart, if there is a processor for it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def compile(self, module: str, name: str, argument_types: Any) -> None:
        """Let the other process compile a function into the cache."""
        if self._process is None and _processors() > 1:
            # The search path is ours: `python -c` would look for modules in the present folder first.
            text = f"import sys; sys.path[:] = {sys.path!r}; from {__package__} import compiled"
            self._process = subprocess.Popen(
                [sys.executable, "-c", f"{text}; compiled.callees.serve()"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        if self._process is not None and self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it has ended: then this process compiles
                self._process.stdin.write(pickle.dumps((module, name, argument_types)))
                self._process.stdin.flush()

    def wait(self) -> None:
        """Wait until the other process has compiled all that it was given."""
        if self._process is not None:
            self._process.communicate()
            self._process = None


_meanwhile = _Meanwhile()


def _processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def serve() -> None:
    """Compile into the cache what `_Meanwhile.compile` writes to standard input."""
    _meanwhile.compile = lambda *_: None  # type: ignore[method-assign]  # one process is enough
    with suppress(EOFError):
        while True:
            module, name, argument_types = pickle.load(sys.stdin.buffer)
            with suppress(Exception):  # the process that needs the function reports it
                getattr(getattr(import_module(module), name), APART).compile(argument_types)


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
        argument_types = tuple(sigutils.normalize_signature(sig)[0])
        if callee and hasattr(self, APART):
            return _declare(self, argument_types)
        known = self.overloads.get(argument_types)
        if known is not None and (callee or not isinstance(known.entry_point, _Callee)):
            return known.entry_point
        if known is not None:
            del self.overloads[argument_types]  # Python calls it now
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
            for function, argument_types in cres.library.apart:
                cres.reload_init.append(partial(_link, *_name(function), argument_types))
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
    return True
