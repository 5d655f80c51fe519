"""Progress: what it says, and when."""

import io
import sys
from threading import Event
import time

import pytest

from uwb_tdoa_tools import parallel
from uwb_tdoa_tools.parallel import Progress


class Lines(io.StringIO):
    """A stream without a terminal that tells when it holds so many lines."""

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
        monkeypatch.setattr(parallel, name, 0.01)


def test_it_says_what_is_done_and_how_much_though_nobody_calls_it(often):
    lines = Lines(3)
    with Progress("weigh", 8, "flight", lines) as told:
        told("weighing")
        told.update()
        assert lines.full.wait(120.0)
    first, *others = lines.getvalue().splitlines()
    assert first.startswith("weigh: ") and "weigh: weighing, 1 of 8 flights done, 0 s" in others


def test_short_work_says_nothing(monkeypatch):
    monkeypatch.setattr(
        parallel, "FIRST", 600.0
    )  # beside which it is short on a loaded machine, too
    lines = Lines(1)
    with Progress("weigh", stream=lines):
        pass
    assert lines.getvalue() == ""


def test_what_a_user_waits_for_is_said_in_time():
    assert parallel.FIRST <= 2.0 and parallel.EVERY <= 5.0


@pytest.mark.parametrize("total", [None, 4])
def test_on_a_terminal_it_is_one_line_that_goes_at_the_end(often, total):
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


def test_work_on_many_flights_says_how_many_are_done(often, monkeypatch):
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
