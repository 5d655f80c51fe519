"""Run one function over many flights, on every core or on a Dask cluster that is already there,
and report the progress of long work.

    parallel.add_options(parser)                                         # --jobs, --dask
    for row in parallel.over(judge, found, args.jobs, args.dask):        # in the order of `found`
        ...
    with Progress("diagnose") as progress:                               # printed by a thread
        progress("looking at ids")

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
from threading import Event, Thread
import time
from typing import TYPE_CHECKING, Any, Protocol, TextIO, TypeVar
import warnings

from joblib import Parallel, cpu_count, delayed, parallel_config
from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.executable import elsewhere

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator


Item = TypeVar("Item")

FIRST, EVERY = 0.5, 4.0  # s until the first line where there is no terminal, and between two
OFTEN = 0.5  # s between two changes of the line on a terminal


class Progress:
    """As a context, says what is being done, how much of it is done, and for how long, until it
    ends; whatever takes shorter than FIRST says nothing. Call it with what is being done, as often
    as you like.
    """

    def __init__(
        self,
        name: str = "",
        total: int | None = None,
        unit: str = "",
        stream: TextIO | None = None,
        what: str = "",
    ) -> None:
        """name : what the lines begin with; total : of what is to be done, in `unit`, or None;
        stream : where to, default stderr; what : what is done first.
        """
        self._name, self._total, self._unit, self._stream = name, total, unit, stream
        self._what, self._done, self._ended = what, 0, Event()

    def __call__(self, what: str) -> None:
        self._what = what

    def update(self) -> None:
        """Count another unit as done."""
        self._done += 1
        if self._bar is not None and self._total is not None:
            self._bar.update()

    def over(self, items: Iterable[Item], what: str) -> Iterator[Item]:
        """Generator of items, which tells how many of them are done."""
        items = list(items)
        for done, item in enumerate(items):
            self(f"{what}, {done} of {len(items)} done")
            yield item
        self(f"{what} done, finishing")

    def __enter__(self) -> Progress:
        stream = self._stream or sys.stderr
        self._start, self._bar = time.monotonic(), None
        if stream.isatty():
            form = (
                {"bar_format": "{desc}"}
                if self._total is None
                else {"desc": self._name or None, "unit": self._unit}
            )
            self._bar = tqdm(total=self._total, file=stream, leave=False, **form)
        self._thread = Thread(target=self._tell, args=(stream,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()

    def _tell(self, stream: TextIO) -> None:
        """Until the end, in a thread of its own."""
        pause = FIRST if self._bar is None else OFTEN
        while not self._ended.wait(pause):
            if self._bar is None:
                pause = EVERY
                print(self._line(), file=stream, flush=True)
            elif self._total is None:
                self._bar.set_description_str(self._line())
            else:
                self._bar.refresh()

    def _line(self) -> str:
        share = f"{self._done} of {self._total} {self._unit}s done" if self._total else ""
        parts = filter(None, (self._what, share, f"{time.monotonic() - self._start:.0f} s"))
        return f"{self._name}: " * bool(self._name) + ", ".join(parts)


pass


CONNECT_LIMIT = 10.0  # s for a Dask scheduler to answer

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
