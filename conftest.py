"""What the tests of all packages share."""

import os
import signal
from pathlib import Path

import pytest

# A shell that starts us in the background has interrupts ignored, and so would have every process that a test interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Before anything imports rclpy: this session talks to itself only, beside others on the same machine.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
try:
    from domain_coordinator import domain_id
except ImportError:  # no ROS: the tests of the cores need none
    pass
else:
    _reservation = domain_id()  # taken until this process ends
    os.environ["ROS_DOMAIN_ID"] = str(_reservation.__enter__())


@pytest.fixture(scope="session")
def shared_data():
    """The folder of measured flights, ../shared/data beside the repository; skips the test where there is none."""
    folder = Path(__file__).resolve().parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no measured flights in ../shared/data")
    return folder
