# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ask running nodes for their parameters."""

from __future__ import annotations

from functools import partial
import time
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from .session import answer_of

if TYPE_CHECKING:
    from rclpy.node import Node

SPIN = 0.05  # s
ANSWER_LIMIT = 10.0  # s for a node's parameters
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # what rmw calls a node whose name has not come yet


def wait_for_names(node: Node) -> None:
    """Wait until the node of each publisher and subscription has a name: DDS sends names later."""
    until = time.monotonic() + ANSWER_LIMIT
    while time.monotonic() < until:
        ends = [node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic]
        topics = [topic for topic, _ in node.get_topic_names_and_types()]
        if not any(
            end.node_name == UNKNOWN for find in ends for topic in topics for end in find(topic)
        ):
            return
        time.sleep(SPIN)


def parameter_of(node: Node, name: str, parameter: str) -> Any:
    """Return the value of a parameter, or None without an answer within ANSWER_LIMIT.

    Parameters
    ----------
    node : Node
        Our node, which nothing else serves meanwhile.
    name : str
        Absolute name of the node that has the parameter.
    parameter : str
        Its name.
    """
    client = AsyncParameterClient(node, name)
    answered, future = answer_of(partial(client.get_parameters, [parameter])), None
    if client.wait_for_services(ANSWER_LIMIT):
        until = time.monotonic() + ANSWER_LIMIT
        while (future := answered()) is None and time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=SPIN)
    if future is None or future.result() is None or not future.result().values:
        return None
    return parameter_value_to_python(future.result().values[0])
