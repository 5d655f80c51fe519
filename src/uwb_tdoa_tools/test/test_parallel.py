# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs over many flights in parallel.

The other processes import this module for its functions.
"""

import io
import os
from pathlib import Path
import signal
import sys
from threading import Event
import time

from joblib import cpu_count
from programs import python, start
import pytest

from uwb_tdoa_bias.common import executable
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import cli, parallel
from uwb_tdoa_tools.cli import Progress
from uwb_tdoa_tools.options import JOBS


def times_ten(number):
    time.sleep(0.02 * (number % 3))  # the items do not end in the order of their start
    return 10 * number


def process(_):
    return os.getpid()


def refuse_three(number):
    if number == 3:
        raise InputError("number: 3 is too few; give more.")
    return number


def resolution(_):
    """Return the resolution of pictures, which is set when matplotlib is imported."""
    import matplotlib

    return matplotlib.rcParams["savefig.dpi"]


@pytest.fixture
def importable(monkeypatch):
    """Make this module importable in new processes."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_items(importable, count, jobs):
    assert list(parallel.over(times_ten, range(count), jobs)) == [10 * k for k in range(count)]


def test_the_first_item_runs_in_this_process(importable):
    here, *others = parallel.over(process, range(6), 2)
    assert here == os.getpid() and here not in others and 1 <= len(set(others)) <= 2


def test_settings_in_the_present_folder_do_not_count(importable, tmp_path, monkeypatch):
    (tmp_path / "matplotlibrc").write_text("savefig.dpi: 100000\n")
    monkeypatch.chdir(tmp_path)
    assert list(parallel.over(resolution, range(4), 2))[1:] == ["figure"] * 3


def test_one_item_and_one_job_need_no_other_process():
    assert list(parallel.over(process, ["only"], 2)) == [os.getpid()]
    assert set(parallel.over(process, range(4), 1)) == {os.getpid()}


def test_results_come_before_all_are_computed():
    seen = []
    results = parallel.over(seen.append, range(5), 1)
    next(results)
    assert seen == [0]


@pytest.mark.parametrize("jobs", [1, 2])
def test_bad_input_in_another_process_is_the_same_sentence(importable, jobs, capsys):
    def command(args):
        for result in parallel.over(refuse_three, range(6), jobs):
            print(result)

    assert cli.run(command, cli.parser("count", "Count."), []) == 2
    out, err = capsys.readouterr()
    assert out.split() == ["0", "1", "2"]
    assert err == "count: error: number: 3 is too few; give more.\n"


@pytest.mark.slow
def test_an_interrupt_ends_all_processes_silently(importable):
    code = (
        "import sys, time; from uwb_tdoa_tools import cli, parallel\n"
        "def work(args):\n"
        "    for number in parallel.over(time.sleep, [0.0] + 200 * [0.2], 2): print('done', "
        "flush=True)\n"
        "sys.exit(cli.run(work, cli.parser('work', 'Work.'), []))"
    )
    work = start("-c", code, start_new_session=True)
    for _ in range(3):
        assert (
            work.stdout.readline() == "done\n"
        )  # the first runs in this process, the others in its children
    os.killpg(work.pid, signal.SIGINT)  # as a terminal does
    _, err = work.communicate(timeout=120)  # returns when the children have closed their pipes, too
    assert work.returncode == 130 and all(
        " of 201 flights done, " in line for line in err.splitlines()
    )


@pytest.mark.slow
def test_modules_in_the_present_folder_do_not_run(tmp_path, importable):
    """With -m, as joblib uses it, Python imports modules from the working directory.

    Any file there could run.
    """
    for name in ("joblib", "struct", "selectors", "runpy", "pickle"):
        (tmp_path / f"{name}.py").write_text(
            f"open('{tmp_path}/ran', 'w').close(); raise SystemExit(1)"
        )
    (tmp_path / "work.py").write_text(
        "import os, sys; sys.path.pop(0)\n"
        "from uwb_tdoa_tools import parallel\n"
        "print([*parallel.over(os.path.abspath, ['a', 'b', 'c', 'd'], 2)])\n"
    )
    ended = python("work.py", cwd=tmp_path, timeout=100)
    assert ended.stdout == f"{[str(tmp_path / name) for name in 'abcd']}\n", ended.stderr
    assert not (tmp_path / "ran").exists()


def options(*argv):
    return cli.parser("tool", "A tool.", options=[cli.option("--out"), JOBS]).parse_args(argv)


def test_few_items_run_in_one_process_by_default():
    assert parallel.workers_for(options(), 4, 5)[0] == 1
    assert parallel.workers_for(options(), 5, 5)[0] == min(cpu_count(), 5)
    assert parallel.workers_for(options("--jobs", "2"), 4, 5)[0] == 2


@pytest.mark.parametrize(
    "argv, sentence",
    [
        (["--jobs", "0"], "'0' is not a whole number above 0"),
        (["--jobs", "two"], "'two' is not a whole number above 0"),
    ],
)
def test_bad_options(argv, sentence, capsys):
    with pytest.raises(SystemExit):
        options(*argv)
    assert sentence in capsys.readouterr().err


class Lines(io.StringIO):
    """A stream that is no terminal. Sets `full` when it holds `wanted` lines."""

    def __init__(self, wanted):
        super().__init__()
        self.wanted, self.full = wanted, Event()

    def write(self, text):
        super().write(text)
        if self.getvalue().count("\n") >= self.wanted:
            self.full.set()


class Terminal(Lines):
    def isatty(self):
        return True


@pytest.fixture
def often(monkeypatch):
    for name in ("FIRST", "EVERY", "OFTEN"):
        monkeypatch.setattr(cli, name, 0.01)


def test_progress_shows_the_work_and_its_share(often):
    lines = Lines(3)
    with Progress("weigh", 8, "flight", lines) as told:
        told("weighing")
        told.update()
        assert lines.full.wait(120.0)
    first, *others = lines.getvalue().splitlines()
    assert first.startswith("weigh: ") and "weigh: weighing, 1 of 8 flights done, 0 s" in others


def test_progress_shows_what_compiles(often, monkeypatch):
    monkeypatch.setattr(executable.COMPILING, "text", "compiling, soon done")
    lines = Lines(2)
    with Progress("weigh", stream=lines):
        assert executable.COMPILING.shown and lines.full.wait(120.0)
    assert not executable.COMPILING.shown
    assert lines.getvalue().splitlines()[0] == "weigh: 0 s, compiling, soon done"


def test_short_work_prints_no_progress(monkeypatch):
    # short also on a loaded machine
    monkeypatch.setattr(cli, "FIRST", 600.0)
    lines = Lines(1)
    with Progress("weigh", stream=lines):
        pass
    assert lines.getvalue() == ""


@pytest.mark.parametrize("total", [None, 4])
def test_progress_on_a_terminal_is_one_line_that_is_removed(often, total):
    stream = Terminal(1)
    with Progress("weigh", total, "flight", stream) as told:
        told("weighing")
        end = time.monotonic() + 120.0
        while stream.getvalue().count("\r") < 4 and time.monotonic() < end:
            told.update()
            time.sleep(0.01)
    assert (
        "weigh" in stream.getvalue()
        and stream.getvalue().endswith("\r")
        and "\n" not in stream.getvalue().strip()
    )


def test_progress_counts_flights(often, monkeypatch):
    lines = Lines(1)
    monkeypatch.setattr(sys, "stderr", lines)

    def work(item):
        end = time.monotonic() + 120.0
        while (
            item == 2 and "2 of 3 flights done" not in lines.getvalue() and time.monotonic() < end
        ):
            time.sleep(0.01)

    list(parallel.over(work, range(3), 1))
    said = lines.getvalue()
    assert "2 of 3 flights done" in said
    list(parallel.over(lambda item: time.sleep(0.1), range(3), 1, unit=None))
    assert lines.getvalue() == said
