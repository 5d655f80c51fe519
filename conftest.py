# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures and hooks that the tests of all packages share."""

from collections import Counter, deque
from functools import cache
import gc
import os
from pathlib import Path
import random
import re
import signal
import sys

import pytest

# If a shell starts pytest in the background, interrupts are ignored.
# Child processes of the tests would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(20_000, 5, 100)  # as in commands: modules and tests are many objects that stay
# As in ./dev: without bytecode, each process compiles all tests and modules that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Before anything imports rclpy: only processes on this machine are discovered.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# Before anything imports numpy, as in the executables: BLAS threads only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
try:
    from domain_coordinator import domain_id
except ImportError:  # without ROS: the tests of the cores need none
    domain_id = None
# Reserved domains, oldest first. Each stays reserved until this process ends or KEPT newer follow.
_taken = deque()
# Test files that take half a minute or more, the longest first.
LONGEST = """surveying walks checking_check distribution commands diagnosis_diagnose
    checking_trials diagnosis_attribution surveying_stream lockstep calibrating first_map studies
    moved_anchors demo launch_files diagnosis_channels diagnosis_streams planning_layouts
    python_api hall waiting vehicle_node diagnosis_validation localizing stream_faults rovers
    profiles stream_watch study_bench calibration_node planning_hall startup nodes study_faults
    plan flying_trial clock_recordings lint checking_report alignment""".split()
USES_ROS = re.compile(r'(importorskip\("|^from |^import )(rclpy|uwb_tdoa_msgs)', re.MULTILINE)
# Number of later tests that may not reuse the domain of a test.
# A killed node stays visible for 20 s.
KEPT = 3


def _take_domain():
    """Reserve a ROS domain that no other session uses and no recent test has used."""
    if len(_taken) > KEPT:
        # A node whose constructor failed stays visible in its domain until it is collected.
        gc.collect()
    while len(_taken) > KEPT:
        _taken.popleft().__exit__(None, None, None)
    while True:
        # random, so unlikely to equal a recent domain
        reservation = domain_id(lambda: random.randint(1, 100))
        try:
            os.environ["ROS_DOMAIN_ID"] = str(reservation.__enter__())
        except RuntimeError:  # other sessions use the remaining domains
            if _taken:
                _taken.popleft().__exit__(None, None, None)
            continue
        _taken.append(reservation)
        return


@cache
def _uses_ros(path):
    return USES_ROS.search(path.read_text())


def pytest_collection_modifyitems(items):
    """Run the longest files first, so that all workers finish at about the same time."""
    place = {f"test_{name}": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


class ProcessorTimes:
    """Processor time of each test file, with that of ended child processes.

    Each report of a test carries the time since the last one, also from a worker of xdist.
    """

    NAME = "processor_time"

    def __init__(self):
        self.last = 0.0  # s, of this process at the last report
        self.of_files = Counter()  # s

    def pytest_runtest_logstart(self):
        """Leave out what happened between two tests."""
        self.last = sum(os.times()[:4])

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self):
        outcome = yield
        now = sum(os.times()[:4])
        outcome.get_result().user_properties.append((self.NAME, now - self.last))
        self.last = now

    def pytest_runtest_logreport(self, report):
        file = report.nodeid.partition("::")[0]
        self.of_files[file] += dict(report.user_properties).get(self.NAME, 0.0)

    def pytest_terminal_summary(self, terminalreporter):
        terminalreporter.section("processor time of each file, s")
        for file, seconds in self.of_files.most_common():
            terminalreporter.write_line(f"{seconds:8.1f} {file}")
        terminalreporter.write_line(f"{sum(self.of_files.values()):8.1f} in all")


def pytest_configure(config):
    config.pluginmanager.register(ProcessorTimes())


def pytest_collection_finish():
    """Exclude the modules imported so far from garbage collection.

    They stay, and scanning takes time.
    """
    gc.collect()
    gc.freeze()


@cache
def _begin_file(path):
    """Exclude what earlier files left from the collections before each test of this file."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Give each test that starts nodes its own ROS domain."""
    if domain_id is not None and _uses_ros(item.path):
        _begin_file(item.path)
        _take_domain()


if domain_id is not None:
    _take_domain()


@pytest.fixture
def must_end():
    """Fail after two minutes of processor time.

    For inputs that once took much longer or never ended. This is no performance test.
    """

    def hangs(number, frame):
        pytest.fail("it does not end: two minutes of processor time are gone")

    before = signal.signal(signal.SIGVTALRM, hangs)
    signal.setitimer(signal.ITIMER_VIRTUAL, 120.0)
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    signal.signal(signal.SIGVTALRM, before)


@pytest.fixture(scope="session")
def shared_data():
    """Return the folder of measured flights, ../shared/data. Skip the test if it does not exist."""
    folder = Path(__file__).resolve().parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no measured flights in ../shared/data")
    return folder
