# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the tests of all packages share."""

from collections import deque
from functools import cache
import gc
import os
from pathlib import Path
import random
import signal

import pytest

# A shell that starts us in the background has interrupts ignored, and so would have every process that a test interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(20_000, 5, 100)  # as in commands: modules and tests are many objects that stay
# Before anything imports rclpy: this session talks to itself only, beside others on the same machine.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# before anything imports numpy, as executables do: threads of BLAS only wait for each other
os.environ.setdefault("OMP_NUM_THREADS", "1")
try:
    from domain_coordinator import domain_id
except ImportError:  # no ROS: the tests of the cores need none
    domain_id = None
# reservations of domains, oldest first; taken until this process ends, or KEPT others came
_taken = deque()
# files of tests: each takes half a minute or more, the longest first
LONGEST = """checking_check calibrating launch_files distribution surveying_known first_hour_without_truth
    moved_anchors first_hour diagnosis_self_calibration diagnosis_attribution waiting surveying diagnosis_diagnose
    lockstep plan demo hall stream_faults printed_lines diagnosis_references clock_recordings vehicle_node
    python_api types study_faults localizing diagnosis_validation study_bench checking_report diagnosis_report
    diagnosis_ranging study_plans first_map live_replay autopilot_flight train diagnosis_deviations alignment
    warehouse rerun each_node profiles evaluate study_odd_messages stream_watch nodes both_nodes executables
    checking_trials callees""".split()
KEPT = 3  # tests for which nobody gets the domain of a test that is over: others see a node that was killed for 20 s more


def _take_domain():
    """Live in a ROS domain that nobody else has, and nobody had lately."""
    while len(_taken) > KEPT:
        _taken.popleft().__exit__(None, None, None)
    while True:
        # by chance none of the last seconds
        reservation = domain_id(lambda: random.randint(1, 100))
        try:
            os.environ["ROS_DOMAIN_ID"] = str(reservation.__enter__())
        except RuntimeError:  # other sessions have those that are left
            if _taken:
                _taken.popleft().__exit__(None, None, None)
            continue
        _taken.append(reservation)
        return


@cache
def _uses_ros(path):
    return "rclpy" in path.read_text()


def pytest_collection_modifyitems(items):
    """The files that take longest come first: no process has one to itself when the others have nothing left to do."""
    place = {f"test_{name}": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_collection_finish():
    """Leave what is imported until now out of garbage collections: it stays, and looking at it takes time."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """A test that starts nodes, or processes that do, has a domain of its own."""
    if domain_id is not None and _uses_ros(item.path):
        _take_domain()


if domain_id is not None:
    _take_domain()


@pytest.fixture
def must_end():
    """Fail after two minutes of processor time: for input that once took much longer, or for ever. It times nothing."""

    def hangs(number, frame):
        pytest.fail("it does not end: two minutes of processor time are gone")

    before = signal.signal(signal.SIGVTALRM, hangs)
    signal.setitimer(signal.ITIMER_VIRTUAL, 120.0)
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    signal.signal(signal.SIGVTALRM, before)


@pytest.fixture(scope="session")
def shared_data():
    """The folder of measured flights, ../shared/data beside the repository; skips the test where there is none."""
    folder = Path(__file__).resolve().parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no measured flights in ../shared/data")
    return folder
