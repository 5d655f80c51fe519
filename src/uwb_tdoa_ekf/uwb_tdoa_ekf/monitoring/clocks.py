"""Say what is wrong with the clock of a stream, and why the filter started anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.sensors import SENSORS

from ..streams import WARNING, Finding

if TYPE_CHECKING:
    from ..reorder_buffer import Restart

TOPICS = {"imu": "imu/data", "tdoa": "uwb/tdoa"} | {
    name: sensor.topics[0][0] for name, sensor in SENSORS.items()
}  # by stream
STAMP_LINE = (
    "message.header.stamp = ...  # when the sample was measured, by the clock of the other streams"
)


def clock_ahead(stream: str, lead: float, count: int) -> Finding:
    """Return the finding for a stream of STREAMS that is ahead of the others by `lead`, s; count :
    its invalid messages so far.
    """
    what = (
        f"the stamps of {TOPICS[stream]} are {lead:.3g} s ahead of those of the other streams; "
        "its messages are not used"
    )
    return Finding(
        "clock_ahead", WARNING, what, f"{count} invalid messages so far", STAMP_LINE, lead
    )


def restarted(cause: Restart) -> Finding:
    """Return the finding for a Restart of the filter."""
    topic = TOPICS[cause.stream]
    how = "are before the time of the other streams" if cause.overtaken else "fell back"
    evidence = f"the new time begins at {cause.at:.3f} s after the first stamp"
    remedy = (
        "keep the clocks of all drivers in step (chronyc tracking); a recording that is played "
        "again does this, too"
    )
    what = (
        f"the filter has started anew, because the stamps of {topic} {how} by {-cause.step:.3g} s"
    )
    return Finding("restarted", WARNING, what, evidence, remedy, cause.step)
