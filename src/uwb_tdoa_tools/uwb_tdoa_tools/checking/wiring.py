"""Who publishes and hears what, of live topics. A rule takes a Recording and yields Findings."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.streams import ERROR, WARNING, Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..live.record import End
    from .recording import Recording


def _by_topic(recording: Recording) -> Iterator[tuple[str, list[End], list[End]]]:
    """(topic, publishers, subscriptions) of each."""
    for topic in sorted({end.topic for end in recording.ends}):
        ends = [end for end in recording.ends if end.topic == topic]
        yield (
            topic,
            [end for end in ends if end.publishes],
            [end for end in ends if not end.publishes],
        )


def kinds(recording: Recording) -> Iterator[Finding]:
    """Ends of one topic that speak of different types never meet."""
    for topic, publishers, subscriptions in _by_topic(recording):
        found = {end.kind for end in (*publishers, *subscriptions)}
        if len(found) > 1:
            evidence = ", ".join(
                sorted(f"{end.node}: {end.kind}" for end in (*publishers, *subscriptions))
            )
            cause, line = (
                f"{topic} has several types",
                f"start the driver of the other type with --ros-args -r {topic}:={topic}_other",
            )
            yield Finding("type_other", ERROR, cause, evidence, line, float(len(found)))


def unmatched(recording: Recording) -> Iterator[Finding]:
    """A subscription that asks for more than a publisher offers gets nothing from it."""
    for topic, publishers, subscriptions in _by_topic(recording):
        deaf = {
            (publisher.node, end.node): (publisher, end)
            for publisher, end in product(publishers, subscriptions)
            if not any(other.gets(publisher) for other in subscriptions if other.node == end.node)
        }
        for publisher, end in deaf.values():
            cause = (
                f"{end.node} hears nothing of what {publisher.node} publishes on {topic}: it asks "
                "for more than is offered"
            )
            evidence = f"published {publisher.qos}; asked for: {end.qos}"
            yield Finding(
                "qos_unmatched", ERROR, cause, evidence, _stronger(publisher, end), np.nan
            )


def _stronger(publisher: End, end: End) -> str:
    """What to write in the node that publishes."""
    policies = ["reliability=ReliabilityPolicy.RELIABLE"] * end.reliable + [
        "durability=DurabilityPolicy.TRANSIENT_LOCAL"
    ] * end.latched
    return (
        f"qos = QoSProfile(depth=100, {', '.join(policies)})  # in {publisher.node}, or ask for "
        f"less in {end.node}"
    )


def several(recording: Recording) -> Iterator[Finding]:
    """Two that publish one stream."""
    for topic, publishers, _ in _by_topic(recording):
        if len(publishers) > 1 and not topic.startswith("/tf"):
            names = ", ".join(sorted(end.node for end in publishers))
            line = (
                "give each tag a namespace of its own: start its driver with --ros-args -r "
                "__ns:=/tag2, or stop all but one"
            )
            yield Finding(
                "publishers_several",
                ERROR,
                f"{len(publishers)} publish on {topic}",
                names,
                line,
                float(len(publishers)),
            )


def volatile_anchors(recording: Recording) -> Iterator[Finding]:
    """Anchors that who comes later does not get, unless they are repeated."""
    for topic, publishers, _ in _by_topic(recording):
        for publisher in publishers:
            if topic.endswith("uwb/anchors") and not publisher.latched:
                yield Finding(
                    "anchors_volatile",
                    WARNING,
                    "nodes that start later get no anchors, unless they are repeated",
                    f"{publisher.node} publishes {topic} {publisher.qos}",
                    (
                        "qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  "
                        "# or anchors_file of both nodes"
                    ),
                    np.nan,
                )


WIRING_RULES = (kinds, unmatched, several, volatile_anchors)
