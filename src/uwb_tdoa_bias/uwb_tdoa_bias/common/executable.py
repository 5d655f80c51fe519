# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start of every executable: quiet Ctrl-C, and no influence of the present folder.

Ctrl-C ends an executable quietly at any moment. Files in the present folder do not change what it
does.

    evaluate = executable("uwb_tdoa_tools.commands.evaluate")        # an entry point; the module has a main()
    ekf_node = node_executable("uwb_tdoa_ekf.ekf_node")

This module imports only the standard library.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
import gc
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
import os
import signal
import sys
from threading import Timer, main_thread
from types import FrameType, SimpleNamespace
from typing import Any

INTERRUPTED = 130  # exit code, as a shell gives it: 128 + SIGINT
SOON = 0.05  # s, until a lost interrupt is repeated
HAS_ALARM = hasattr(signal, "SIGALRM")  # Windows has none
# Thresholds of Python's garbage collection in commands, and while numba compiles: imports, messages and
# compilers make many objects that stay. A command takes 4 % less time than with the usual ones, a
# compilation 10 % less and 60 MB more.
COLLECT = 20_000, 5, 100
COMPILING = SimpleNamespace(
    text="", shown=False
)  # what compiles, and whether lines of progress show it
SAID = 1.5  # s after which a line reports that the imports take long
# Path variables in which an entry that does not begin at the root begins in the present folder. An
# empty one means that folder. `.dev/paths.sh` has the same list, for programs that a shell starts.
PATHS = (
    "PATH LD_LIBRARY_PATH PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH "
    "PKG_CONFIG_PATH"
).split()


def executable(module: str) -> Callable[..., Any]:
    """Return the entry point of a module with a main().

    The entry point imports the module when it is called and returns the result of main. It sets
    NUMBA_OPT to 2, and OMP_NUM_THREADS to 1, unless the user has set it: the matrices are small, and several threads of
    linear algebra would wait for each other by spinning. Libraries that are loaded later read it.
    """
    return partial(_run, module)


def node_executable(module: str) -> Callable[..., Any]:
    """Return the entry point of a node; otherwise as `executable`."""
    return partial(_run_node, module)


def leave_present_folder_out() -> None:
    """Remove the present folder from all search paths of this process and its children.

    A folder of recordings may hold any file. Afterwards no such file is loaded as a library, module,
    program or setting. Call this before rclpy is imported.
    """
    # Otherwise Fast DDS reads DEFAULT_FASTRTPS_PROFILES.xml in the present folder.
    os.environ["SKIP_DEFAULT_XML_FILE"] = "1"
    for name in PATHS:
        entries = os.environ.pop(name, "").split(os.pathsep)
        if kept := os.pathsep.join(filter(os.path.isabs, entries)):
            os.environ[name] = kept
        if name == "PYTHONPATH":
            relative = {os.path.abspath(entry) for entry in entries if not os.path.isabs(entry)}
            sys.path[:] = [entry for entry in sys.path if entry not in relative]


@contextmanager
def outside_present_folder() -> Iterator[None]:
    """Change to the root folder while the block runs.

    The present folder may hold settings, and modules that `python -m` would import.
    """
    with ExitStack() as back:
        if hasattr(os, "O_PATH"):
            here = os.open(".", os.O_PATH | os.O_DIRECTORY)  # works even if the folder was removed
            back.callback(os.close, here)
            back.callback(os.fchdir, here)
        else:
            back.callback(os.chdir, os.getcwd())
        os.chdir(os.sep)
        yield


class _ImportedElsewhere:
    """Finder that imports matplotlib and numba in the root folder.

    On import, both read settings of the present folder: matplotlibrc and .numba_config.yaml.
    """

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the ModuleSpec of matplotlib or numba; None for all other modules."""
        spec = PathFinder.find_spec(name, path) if name in ("matplotlib", "numba") else None
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = outside_present_folder()(spec.loader.exec_module)  # type: ignore[method-assign]  # of this one loader
        return spec


sys.meta_path.insert(0, _ImportedElsewhere)


def interrupt(number: int, frame: FrameType | None, compiling: bool = False) -> None:
    """Raise KeyboardInterrupt for a signal, and repeat SIGINT until the exception arrives.

    During an import the process ends at once, and with `compiling` while numba compiles, too. Some
    packages answer a KeyboardInterrupt with a traceback or ignore it.

    Callbacks from C code and destructors cannot raise. Python prints such an exception on stderr and
    continues; numba's compiler has both. From now on Python prints no such exception, including
    those of half-made objects. If the lost exception is a KeyboardInterrupt, SIGINT comes again
    after SOON seconds.
    """
    if is_importing(frame) or (compiling and is_compiling(frame)):
        os._exit(128 + number)

    def on_lost(lost: sys.UnraisableHookArgs) -> None:
        if lost.exc_type is KeyboardInterrupt and HAS_ALARM:
            signal.setitimer(signal.ITIMER_REAL, SOON)
        elif lost.exc_type is KeyboardInterrupt:
            Timer(SOON, signal.raise_signal, [signal.SIGINT]).start()

    sys.unraisablehook = on_lost
    if HAS_ALARM:
        signal.signal(signal.SIGALRM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    raise KeyboardInterrupt


def is_importing(frame: FrameType | None) -> bool:
    """Return whether a frame of the main thread runs within an import."""
    while frame is not None and frame.f_globals.get("__name__") != "importlib._bootstrap":
        frame = frame.f_back
    return frame is not None


def is_compiling(frame: FrameType | None) -> bool:
    """Return whether a frame runs within numba."""
    while frame is not None and not frame.f_globals.get("__name__", "").startswith("numba."):
        frame = frame.f_back
    return frame is not None


def _run(module: str, *arguments: Any) -> Any:
    leave_present_folder_out()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault(
        "NUMBA_OPT", "2"
    )  # 7 % less to compile than at 3; as fast, and the same bits
    if gc.isenabled():  # not in a node
        gc.set_threshold(*COLLECT)
    name = module.rpartition(".")[2]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    slow = Timer(SAID, _say_if_importing, [name])
    slow.daemon = True
    slow.start()
    try:
        with outside_present_folder():
            main = import_module(module).main
        return main(*arguments)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package.startswith("uwb_tdoa_") and package != "uwb_tdoa_msgs":
            raise  # our package is incomplete: a defect, keep the traceback
        print(
            f"{name}: error: the Python package {package} is missing; {_remedy(package)}.",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        slow.cancel()


def _say_if_importing(name: str) -> None:
    """Report on stderr that an executable starts if its main thread imports."""
    if is_importing(sys._current_frames().get(main_thread().ident or 0)):
        print(f"{name}: starting", file=sys.stderr, flush=True)


def _run_node(module: str, *arguments: Any) -> Any:
    # Imported objects are no garbage until the node runs. Searching them takes a tenth of a start.
    gc.disable()
    return _run(module, *arguments)


def _remedy(package: str) -> str:
    if package.endswith(("_msgs", "_interfaces")) or package in (
        "rclpy",
        "ament_index_python",
        "domain_coordinator",
    ):
        return "source ROS 2 Jazzy and the built workspace, or use ./dev run"
    return "install it with pip"
