"""Listening to live topics for a while: what came, as a bag, and who publishes and hears what."""

from __future__ import annotations

from functools import partial
import time
from typing import TYPE_CHECKING

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from uwb_tdoa_bias.foundation.errors import InputError

from ..bags.files import new_bag
from .ends import End
from .record import Recorder
from .session import session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rclpy.node import Node

FIRST_LIMIT = 20.0  # s until there must be a message on the first topic


def listen(
    topics: Sequence[str], bag: str | Path, seconds: float, say: Callable[[str], object] = print
) -> tuple[dict[str, str], list[End]]:
    """Record topics to a new bag, from the first message on the first of them on for `seconds`, or
    until SIGINT.

    topics : absolute names. Returns ({topic: type} of all that there are, [End] of topics, who is
        not us).
    Raises InputError if nothing comes on the first one.
    """
    with session("check", []) as (node, stop), new_bag(bag) as writer:
        recorder = Recorder(node, writer, set(topics), say)
        say(f"waiting for {topics[0]}")
        heard = partial(recorder.counts.get, topics[0], 0)
        until = time.monotonic() + FIRST_LIMIT
        recorder.run(lambda: stop or heard() or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        if not heard():
            raise InputError(
                f"no message on {topics[0]} within {FIRST_LIMIT:g} s; "
                f"{_elsewhere(topics[0], kinds)}."
            )
        say(
            f"listening for {seconds:g} s; carry the tag through the room, turn, lift and "
            "lower it (Ctrl-C ends it earlier)"
        )
        until = time.monotonic() + seconds
        recorder.run(lambda: stop or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        ends = [
            end
            for topic in topics
            for end in _ends(node, topic)
            if end.node != node.get_fully_qualified_name()
        ]
    return kinds, ends


def _ends(node: Node, topic: str) -> Iterator[End]:
    for publishes, infos in (
        (True, node.get_publishers_info_by_topic(topic)),
        (False, node.get_subscriptions_info_by_topic(topic)),
    ):
        for info in infos:
            qos = info.qos_profile
            yield End(
                topic,
                f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                info.topic_type,
                publishes,
                qos.reliability == ReliabilityPolicy.RELIABLE,
                qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            )


def _elsewhere(topic: str, kinds: dict[str, str]) -> str:
    """What to do about a topic that nobody publishes."""
    others = sorted(
        name for name, kind in kinds.items() if kind == "uwb_tdoa_msgs/msg/Tdoa" and name != topic
    )
    if others:
        return "say where they are: " + " or ".join(f"--topic uwb/tdoa={name}" for name in others)
    return "start the tag's driver, in this ROS_DOMAIN_ID"
