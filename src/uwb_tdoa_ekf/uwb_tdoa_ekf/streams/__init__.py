"""Streams checked by themselves: units, stamps, rates, repeats, several senders. Without a filter
and without ROS.

streams = StreamRules(anchors)
streams.feed_imu(t, arrival, gyro, force)
streams.feed_tdoa(t, arrival, a, b, d)
streams.finish()
for finding in streams.findings():
    print(finding.cause, finding.evidence, finding.remedy)
"""

from .finding import ERROR, NOTE, SEVERITIES, WARNING, Finding, Steady, most_severe_first
from .rules import StreamRules

__all__ = [
    "ERROR",
    "NOTE",
    "SEVERITIES",
    "WARNING",
    "Finding",
    "Steady",
    "StreamRules",
    "most_severe_first",
]
