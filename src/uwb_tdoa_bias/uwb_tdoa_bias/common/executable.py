"""How every executable starts: Ctrl-C ends it quietly, whenever it comes, and the present folder
has no say in what it does.

    evaluate = executable("uwb_tdoa_tools.commands.evaluate")        # an entry point; the module has a main()
    ekf_node = node_executable("uwb_tdoa_ekf.ekf_node")

Nothing but the standard library is imported here.
"""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
import gc
from importlib import import_module
from importlib.machinery import PathFinder
import os
import signal
import sys
from threading import Timer
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from importlib.machinery import ModuleSpec
    from types import FrameType, ModuleType

INTERRUPTED = 130  # exit code, as a shell gives it: 128 + SIGINT
SOON = 0.05  # s, until an interrupt that was lost comes again
SAID = 1.5  # s of importing after which it is said that something goes on
# Paths in which an empty entry, as a dot, is the present folder. `.dev/paths.sh` has the same list,
# for what a shell starts.
PATHS = (
    "PATH LD_LIBRARY_PATH PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH "
    "PKG_CONFIG_PATH"
).split()


def executable(module: str) -> Callable[..., Any]:
    """The entry point of a module with a main(): imports the module when it is called, returns what
    main returns. Its linear algebra, of small matrices, takes one thread: several would wait for
    each other by spinning. That is set in the environment, where libraries that are loaded later
    read it; a user's own setting stays.
    """
    return partial(_run, module)


def node_executable(module: str) -> Callable[..., Any]:
    """The same of a node."""
    return partial(_run_node, module)


def leave_present_folder_out() -> None:
    """Change the environment of this process, and of those that it starts, so that a file of the
    present folder is no library, module, program or setting of any. To be called before rclpy is
    imported. A folder of recordings may hold anything.
    """
    # or Fast DDS reads DEFAULT_FASTRTPS_PROFILES.xml there
    os.environ["SKIP_DEFAULT_XML_FILE"] = "1"
    for name in PATHS:
        entries = os.environ.get(name, "").split(os.pathsep)
        others = [entry for entry in entries if entry not in ("", ".")]
        if len(others) < len(entries) and name == "PYTHONPATH":
            sys.path[:] = [entry for entry in sys.path if entry != os.getcwd()]
        kept = os.pathsep.join(others)
        if kept:
            os.environ[name] = kept
        else:
            os.environ.pop(name, None)


@contextmanager
def outside_present_folder() -> Iterator[None]:
    """In the root folder while the block lasts: the present folder may hold modules for `python
    -m`, and settings.
    """
    here = os.open(".", os.O_PATH | os.O_DIRECTORY)  # also where its name is gone
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(here)
        os.close(here)


class _ImportedElsewhere:
    """Finder of modules that read settings of the present folder (matplotlibrc, .numba_config.yaml)
    when they are imported. They are imported in the root folder, whoever imports them.
    """

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """The ModuleSpec of such a module; None for all others."""
        spec = PathFinder.find_spec(name, path) if name in ("matplotlib", "numba") else None
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = outside_present_folder()(spec.loader.exec_module)  # type: ignore[method-assign]  # of this one loader
        return spec


sys.meta_path.insert(0, _ImportedElsewhere)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Signal handler: raises KeyboardInterrupt, for good.

    What C code calls back cannot raise, and a destructor cannot either: Python prints such an
    exception on stderr and goes on (the compiler of numba has both). From now on nothing of that
    kind is printed, objects that are half made included, and where it was the KeyboardInterrupt
    that was lost, SIGINT comes again in a moment.
    """

    def on_lost(lost: sys.UnraisableHookArgs) -> None:
        if lost.exc_type is KeyboardInterrupt:
            signal.setitimer(signal.ITIMER_REAL, SOON)

    sys.unraisablehook = on_lost
    signal.signal(signal.SIGALRM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    raise KeyboardInterrupt


def _run(module: str, *arguments: Any) -> Any:
    leave_present_folder_out()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    name = module.rpartition(".")[2]
    try:
        main = _imported(module).main
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, interrupt)
        return main(*arguments)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package.startswith("uwb_tdoa_") and package != "uwb_tdoa_msgs":
            raise  # ours is not whole: a defect, which needs its traceback
        print(
            f"{name}: error: the Python package {package} is missing; {_remedy(package)}.",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def _run_node(module: str, *arguments: Any) -> Any:
    # until the node runs: nothing that is imported is garbage, and searching it is a tenth of a
    # start
    gc.disable()
    return _run(module, *arguments)


def _imported(module: str) -> ModuleType:
    """Import a module, and say that it takes its time where it does. Meanwhile SIGINT ends the
    process at once: some of what is imported answers a KeyboardInterrupt with a traceback or not at
    all, and there is nothing yet to clean up.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # as in a job that a shell script put in the background
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    slow = Timer(
        SAID, lambda: print(f"{module.rpartition('.')[2]}: starting", file=sys.stderr, flush=True)
    )
    slow.daemon = True
    slow.start()
    try:
        with outside_present_folder():
            return import_module(module)
    finally:
        slow.cancel()
        signal.signal(signal.SIGINT, before)


def _remedy(package: str) -> str:
    if package.endswith(("_msgs", "_interfaces")) or package in (
        "rclpy",
        "ament_index_python",
        "domain_coordinator",
    ):
        return "source ROS 2 Jazzy and the built workspace, or use ./dev run"
    return "install it with pip"
