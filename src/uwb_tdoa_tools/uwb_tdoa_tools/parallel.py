# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run one function over many flights, on every core.

    for row in parallel.over(judge, found, args.jobs):        # in the order of `found`
        ...

The processes are kept for later calls if each call ends normally. A caller that stops before the
last result ends them too.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
import os
import signal
from typing import Any, Protocol, TypeVar
import warnings

from uwb_tdoa_bias.common import executable
from uwb_tdoa_bias.common.errors import InputError

from .cli import Item, Progress

Made = TypeVar("Made")

# flights; what fewer gain by other processes, these take to start (docs/notebook/speed.md)
FEW = 20


class MapFunction(Protocol):
    """Compute function(item) of every item, in order, as `map` does.

    The work may run elsewhere or at the same time.
    """

    def __call__(
        self, function: Callable[[Item], Made], items: Iterable[Item], /
    ) -> Iterable[Made]: ...


def workers_for(args: argparse.Namespace, count: int, few: int = FEW) -> tuple[int, MapFunction]:
    """Return the jobs for several calls of `over`, about `count` items, and `over` with these.

    That `over` shows no progress.

    Without options there are as many jobs as cores and items, and one for fewer items than `few`.
    """
    from joblib import cpu_count

    jobs = args.jobs or (min(cpu_count(), count) if count >= few else 1)
    return jobs, partial(over, jobs=jobs, unit=None)


def over(
    function: Callable[[Item], Made],
    items: Iterable[Item],
    jobs: int | None = None,
    unit: str | None = "flight",
) -> Iterator[Made]:
    """Yield function(item) for every item, in order, and show how many are done.

    Call it in the main thread. The first item runs in this process: numba compiles once, and its
    cache is filled when the other processes start.

    Parameters
    ----------
    function : callable
        Can be pickled, as the items and the results. Its exceptions are raised here.
    items : iterable
        Arguments, one for each call.
    jobs : int or None
        Number of processes; default one per core, at most one per item.
    unit : str or None
        Name of an item in the progress; None shows no progress.
    """
    items = list(items)
    with Progress(total=len(items), unit=unit) if unit and items else nullcontext() as progress:
        for result in _results(function, items, jobs):
            if progress is not None:
                progress.update()
            yield result


def _results(
    function: Callable[[Item], Made], items: list[Item], jobs: int | None
) -> Iterator[Made]:
    """Yield the results of `over` in order.

    The first item runs here while the processes start and import `function`. So numba fills its
    cache once. The others run there.
    """
    from joblib import Parallel, cpu_count, delayed

    first, rest = items[:1], items[1:]
    # Always exactly `jobs` if given: with another number, joblib restarts all processes.
    processes = jobs or min(cpu_count(), len(rest))
    # one process would be enough: stay here
    if min(processes, len(rest)) <= 1:
        yield from map(function, items)
        return
    # Processes that joblib starts later import nothing from their working directory (Python 3.11).
    # `outside_present_folder` below does so for those that it starts now.
    os.environ["PYTHONSAFEPATH"] = "1"

    def run_in_pool(calls: Iterable[Any]) -> Any:
        # Arrays are not mapped from files: numba compiles again for read-only arrays.
        pool = Parallel(processes, return_as="generator", batch_size=1, max_nbytes=None)
        # joblib starts Python by -m, which looks for modules in the present folder.
        with _children_ignore_interrupts(), executable.outside_present_folder():
            return pool(calls)

    folder = os.getcwd()
    with _closing(run_in_pool(delayed(_warm_up)(function) for _ in range(processes))) as warm_ups:
        yield from map(function, first)
        for _ in warm_ups:
            pass  # wait until all have imported it
    with _closing(
        run_in_pool(delayed(_attempt)(function, item, folder) for item in rest)
    ) as outcomes:
        for result, error in outcomes:
            if error is not None:
                raise error
            yield result


def _warm_up(function: Callable[..., object]) -> None:
    """Import `function` by unpickling it, in a process that starts with the first item.

    The first item runs in the parent process meanwhile.
    """


@contextmanager
def _closing(outcomes: Any) -> Iterator[Any]:
    try:
        yield outcomes
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about cancelled work
            outcomes.close()


def _attempt(
    function: Callable[[Item], Made], item: Item, folder: str
) -> tuple[Made | None, Exception | None]:
    """Return (result, None), or (None, an InputError or OSError): joblib would raise it too early.

    folder : folder of relative paths in the item.
    """
    try:
        os.chdir(folder)
        return function(item), None
    except (InputError, OSError) as error:
        return None, error


@contextmanager
def _children_ignore_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C.

    This process handles it, and ends them without tracebacks.
    """
    # Children inherit this; joblib would clear a mask.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def whole_number(text: str) -> int:
    """Return a whole number above 0, for argparse."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)
