"""No peer fills the disk by what it makes a node log."""

import pytest

from uwb_tdoa_bias.foundation import ros_log
from uwb_tdoa_bias.foundation.limits import LINE_LENGTH
from uwb_tdoa_bias.foundation.ros_log import BURST, REFILL, Log


class Written:
    """Stands for a logger of rclpy."""

    def __init__(self):
        self.lines = []
        self.info = self.warning = self.error = self.lines.append


@pytest.fixture
def clock(monkeypatch):
    """The time, s, that a Log sees: a list of one."""
    now = [1000.0]
    monkeypatch.setattr(ros_log.time, "monotonic", lambda: now[0])
    return now


def test_ten_seconds_of_frames_with_names_of_4_kb(clock):
    """75 000 messages, each in a frame of another name, made 298 MB of log."""
    written = Written()
    log = Log(written)
    for k in range(75_000):
        clock[0] += 10.0 / 75_000
        log.warning(
            f"imu/data is in frame '{k}{'x' * 4096}', which /tf_static does not connect with "
            "'base_link'"
        )
    assert sum(map(len, written.lines)) < 1e6 and BURST <= len(written.lines) <= BURST + 2


def test_a_flood_hides_no_other_statement_and_is_counted(clock):
    written = Written()
    log = Log(written)
    for _k in range(1000):
        log.info("flood")
    log.error("another")
    assert written.lines[-1] == "another" and len(written.lines) == BURST + 1


def test_what_was_left_out_is_said_with_the_next_line(clock):
    written = Written()
    log = Log(written)
    for k in range(BURST + 11):
        if k == BURST + 10:
            clock[0] += 3.0 * REFILL
        log.info("flood")
    assert (
        written.lines[-1] == "flood (10 such lines were left out before)"
        and len(written.lines) == BURST + 1
    )


@pytest.mark.parametrize("severity", ["info", "warning", "error"])
def test_lines_are_printable_and_bounded(severity):
    written = Written()
    getattr(Log(written), severity)(
        "frame '\x1b]52;c;eA==\x07\n[ERROR] forged " + "x" * 100_000 + "'; correct it"
    )
    (line,) = written.lines
    assert line.isprintable() and len(line) < LINE_LENGTH + 20 and line.endswith("; correct it")
