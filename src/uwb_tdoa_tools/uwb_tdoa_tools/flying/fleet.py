"""Many flights, on all cores, with what they came to kept on the way."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import parallel
from ..bags.bag import write_bag
from ..results_file import ResultsFile
from .plots import drawn
from .report import summary, text
from .rover import drive
from .trial import fly
from .verdict import verdict_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from contextlib import AbstractContextManager

    from .plots import Drawn
    from .trial import Task

    Verdicts = ResultsFile | dict[str, dict[str, Any]]  # {seed: verdict}


def kept(path: str | Path | None, asked: dict[str, Any]) -> AbstractContextManager[Verdicts]:
    """Context of a ResultsFile, or of a dict where path is None. asked : as of ResultsFile.

    Raises InputError.
    """
    return nullcontext({}) if path is None else ResultsFile(path, asked)


def flown(
    tasks: Sequence[Task],
    done: Verdicts,
    record: str | Path | None = None,
    draw: bool = False,
    jobs: int | None = None,
    dask: str | None = None,
) -> Iterator[tuple[dict[str, Any], Drawn | None]]:
    """Generator of (verdict, Drawn or None), of Tasks in turn; those that are in `done`, by their
    seeds, are not flown again.

    record : folder for a bag of each, or None; draw : give what is drawn; jobs, dask : as of
        `parallel.over`.
    """
    missing = [task for task in tasks if str(task.seed) not in done]
    made = parallel.over(partial(fly_one, record, draw), missing, jobs, dask)
    for task in tasks:
        key, picture = str(task.seed), None
        if key not in done:
            done[key], picture = next(made)
        yield (done.read(key, _sound) if isinstance(done, ResultsFile) else done[key]), picture
    next(made, None)  # to its end, so that its processes are kept


def _sound(verdict: dict[str, Any]) -> dict[str, Any]:
    """A verdict that a file holds, of which a summary can be made."""
    text(summary([verdict]))
    return verdict


def fly_one(
    record: str | Path | None, draw: bool, task: Task
) -> tuple[dict[str, Any], Drawn | None]:
    """(verdict, Drawn or None) of a Task that is flown; record, draw : as of `flown`."""
    one = drive(task) if task.vehicle == "rover" else fly(task)
    verdict = verdict_of(one)
    if record is not None:
        write_bag(one.flight, Path(record) / one.flight.name, "mcap", False)
    return verdict, drawn(one, verdict) if draw else None
