"""One function over many flights, on every core of this machine or on a Dask cluster that is
already there.

    parallel.add_options(parser)                                         # --jobs, --dask
    for row in parallel.over(judge, found, args.jobs, args.dask):        # in the order of `found`

Processes are kept from one call to the next, if each ends of itself: whoever stops before the last
result ends them too.
"""

from __future__ import annotations

import argparse
from contextlib import contextmanager, nullcontext
from functools import cache
import os
import signal
import sys
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
import warnings

from joblib import Parallel, cpu_count, delayed, parallel_config

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.executable import elsewhere

from .progress import Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

CONNECT_LIMIT = 10.0  # s for a Dask scheduler to answer

Item = TypeVar("Item")
Made = TypeVar("Made")


class MapFunction(Protocol):
    """What gives function(item) of every item, in their order: as `map` does, but for the time and
    the process in which each is done.
    """

    def __call__(
        self, function: Callable[[Item], Made], items: Iterable[Item], /
    ) -> Iterable[Made]: ...


def add_options(parser: argparse._ActionsContainer) -> None:
    """Add --jobs N and --dask ADDRESS to a tool that runs over many flights."""
    add = parser.add_mutually_exclusive_group().add_argument
    add(
        "--jobs",
        metavar="N",
        type=whole_number,
        help="flights at once (default: as many as there are cores)",
    )
    add(
        "--dask",
        metavar="ADDRESS",
        help="run on the Dask cluster whose scheduler is there, e.g. tcp://10.0.0.1:8786; its "
        "workers need these "
        "packages, and the recordings at the same paths; tls://... takes the certificates of "
        "Dask's configuration",
    )


def asked(args: argparse.Namespace, count: int, few: int) -> tuple[int | None, str | None]:
    """(jobs, dask) for several calls of `over`, about `count` items: as args ask for; else as many
    jobs as there are cores and items, one for fewer items than `few`.
    """
    if args.jobs or args.dask:
        return args.jobs, args.dask
    return (min(cpu_count(), count) if count >= few else 1), None


def over(
    function: Callable[[Item], Made],
    items: Iterable[Item],
    jobs: int | None = None,
    dask: str | None = None,
    unit: str | None = "flight",
) -> Iterator[Made]:
    """Generator of function(item) for every item, in order; prints meanwhile how many are done.

    To be called in the main thread. function, items, results : what pickle takes; jobs : processes,
    default one per core, and no more than items; dask : address of a scheduler; unit : of what is
    printed, None to print nothing. The first item runs in this process, so that what has to be
    compiled is compiled once, and is in numba's cache when the others start. What the function
    raises is raised here. Raises InputError where there is no Dask.
    """
    items = list(items)
    with Progress(total=len(items), unit=unit) if unit and items else nullcontext() as progress:
        for result in _results(function, items, jobs, dask):
            if progress is not None:
                progress.update()
            yield result


def _results(
    function: Callable[[Item], Made], items: list[Item], jobs: int | None, dask: str | None
) -> Iterator[Made]:
    first, rest = items[:1], items[1:]
    count = jobs or min(
        cpu_count(), len(rest)
    )  # of `jobs` as many as asked for: with another number, all are started anew
    if not rest or (min(count, len(rest)) == 1 and dask is None):
        yield from map(function, items)
        return
    os.environ["PYTHONSAFEPATH"] = (
        # for processes that joblib starts later, as Python 3.11 and newer understand it; see
        # `elsewhere`
        "1"
    )
    with _cluster(dask) as backend:

        def spread(calls: Iterable[Any]) -> Any:
            with parallel_config(
                **backend
            ):  # not around the loop: the caller's own use of joblib is its own affair
                # Arrays go as they are: numba compiles anew for those mapped from files, which
                # cannot be written to.
                pool = Parallel(count, return_as="generator", batch_size=1, max_nbytes=None)
            with (
                _children_ignore_interrupts(),
                elsewhere(),
            ):  # joblib starts Python by -m, which looks for modules in the present folder
                return pool(calls)

        folder = os.getcwd() if dask is None else None
        with _closing(spread(delayed(_import)(function) for _ in range(count))) as starting:
            yield from map(function, first)
            for _ in starting:
                pass
        with _closing(
            spread(delayed(_attempt)(function, item, folder) for item in rest)
        ) as outcomes:
            for result, error in outcomes:
                if error is not None:
                    raise error
                yield result


def _import(function: Callable[..., object]) -> None:
    """For a process that starts while the first item is done here: to have been handed `function`
    has imported it.
    """


@contextmanager
def _closing(outcomes: Any) -> Iterator[Any]:
    try:
        yield outcomes
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is not done and nobody wants any more
            outcomes.close()


def _attempt(
    function: Callable[[Item], Made], item: Item, folder: str | None
) -> tuple[Made | None, Exception | None]:
    """(result, None), or (None, what cli tells in one sentence): else joblib would raise it before
    earlier results. folder : in which paths of the item are, or None.
    """
    try:
        if folder is not None:
            os.chdir(folder)
        return function(item), None
    except (InputError, OSError) as error:
        return None, error


@contextmanager
def _children_ignore_interrupts() -> Iterator[None]:
    """What is started in the block does not hear Ctrl-C: this process does, and ends them without
    their tracebacks.
    """
    before = signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # inherited; a mask would not do: joblib clears it
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _cluster(address: str | None) -> Iterator[dict[str, Any]]:
    """Arguments for parallel_config while the block lasts: none for this machine."""
    if address is None:
        yield {}
        return
    try:
        from dask.distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise InputError(
            "--dask: needs dask.distributed, which is not installed; pip install distributed."
        ) from error
    try:
        get_address_host_port(
            address
        )  # raises ValueError; Client would too, but not end well; TypeError without certificates
        client = Client(address, timeout=CONNECT_LIMIT, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--dask: no scheduler answers at {address} ({reason}); start one, or correct it."
        ) from error
    _say_whom_it_trusts(client.scheduler.address)
    with client:
        yield {"backend": "dask", "client": client}


@cache  # once
def _say_whom_it_trusts(address: str) -> None:
    """Say that a connection is not encrypted: what Dask sends are pickles, which run code where
    they are read.
    """
    if not address.startswith(("tls://", "wss://")):
        print(
            f"--dask: {address} is not encrypted: whoever reaches it, or can change what is "
            "sent, runs code here and on its workers; use "
            "tls:// with certificates, or a network of your own",
            file=sys.stderr,
        )


def whole_number(text: str) -> int:
    """Above 0, for argparse."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)
