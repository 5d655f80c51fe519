"""Whether both nodes can keep up with a replay that follows them, and whether they have."""

from __future__ import annotations

from functools import partial
import time
from typing import TYPE_CHECKING

import rclpy
from rclpy.parameter_client import AsyncParameterClient

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.sensors import SENSORS

from .follow import AID_SHARE, LAG, STEP
from .processes import DiagnosticsListener
from .session import answer_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node

    from .player import Player
    from .session import Stop

SPIN = 0.05  # s
ANSWER_LIMIT = 10.0  # s for a node's parameters
SETTLE_LIMIT = 60.0  # s for the diagnostics of the nodes to settle
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # what rmw calls a node whose name has not come yet
PATIENCE = {"bias_node": "hold", "ekf_node": "lag"}  # parameters, s of stamps
TROUBLE = {  # {node: {key in its diagnostics: words}}
    "bias_node": {"released before their pose": "TDOAs corrected before their pose was there"},
    "ekf_node": {
        "late": "TDOAs late",
        "imu_late": "IMU samples late",
        **{f"{name}_late": f"{of.plural} late" for name, of in SENSORS.items()},
    },
}
RECEIVED = {  # {node: {key in its diagnostics: what it counts}}
    "bias_node": {"received": "TDOAs"},
    "ekf_node": {"TDOAs received": "TDOAs", "IMU samples received": "IMU samples"},
}


class Nodes:
    """bias_node and ekf_node in our namespace, as far as they are there. lag : s, ekf_node's."""

    lag = LAG

    def __init__(self, node: Node) -> None:
        """Raises InputError if their parameters do not allow to wait for what is on its way, or if
        one says nothing on /diagnostics.
        """
        self._node, self._diagnostics = node, DiagnosticsListener(node)
        space = node.get_namespace()
        self._wait_for_names()
        there = node.get_node_names_and_namespaces()
        self._names = {
            name: f"{space.rstrip('/')}/{name}" for name in TROUBLE if (name, space) in there
        }
        if len(self._names) == len(TROUBLE):
            self._check_patience()
        self._before = self._counts(bool)
        for name in self._names:
            if not self._before[name]:
                raise InputError(
                    f"--follow: {self._names[name]} says nothing on /diagnostics for "
                    f"{SETTLE_LIMIT:g} s; start it again."
                )

    def wrong(self, player: Player, stop: Stop) -> dict[str, int]:
        """{what went wrong since: how often}, once the diagnostics have settled or `stop` is true.
        player : Player, who knows what was played.
        """
        after = self._counts(lambda _: stop or self._diagnostics.is_settled())
        since = {
            name: {
                key: count - self._before[name].get(key, 0) for key, count in after[name].items()
            }
            for name in self._names
        }
        wrong = {}
        for name, counts in since.items():
            for key, what in TROUBLE[name].items():
                wrong[what] = counts.get(key, 0)
            for key, what in RECEIVED[name].items() if len(self._names) == len(TROUBLE) else ():
                on_their_way = (
                    since["bias_node"].get("waiting", 0)
                    if (name, what) == ("ekf_node", "TDOAs")
                    else 0
                )
                lost = player.count(what) - counts.get(key, 0) - on_their_way
                wrong[f"{what} lost"] = max(lost, wrong.get(f"{what} lost", 0))
        return {what: count for what, count in wrong.items() if count > 0}

    def _counts(
        self, is_enough: Callable[[DiagnosticsListener], object]
    ) -> dict[str, dict[str, int]]:
        """{node: {key: count}} when each has said something and is_enough(diagnostics)."""
        until = time.monotonic() + SETTLE_LIMIT
        self._diagnostics.forget()
        newest = {}
        while self._names and time.monotonic() < until:
            rclpy.spin_once(self._node, timeout_sec=SPIN)
            newest = {
                name: self._diagnostics.newest(full.strip("/"))
                for name, full in self._names.items()
            }
            if all(newest.values()) and is_enough(self._diagnostics):
                break
        return {
            name: {key: int(text) for key, text in values.items() if text.isdigit()}
            for name, values in newest.items()
        }

    def _check_patience(self) -> None:
        """What may wait in the filter, for aids too, < hold < lag, or one of the nodes goes on
        without what is still on its way.
        """
        hold, self.lag = (self._parameter(name, parameter) for name, parameter in PATIENCE.items())
        least = 1e-9 * STEP + AID_SHARE * self.lag
        if not least < hold < self.lag:
            raise InputError(
                f"--follow: bias_node's hold is {hold:g} s and ekf_node's lag {self.lag:g} s; "
                "to be followed they need "
                f"{least:g} s < hold < lag."
            )

    def _wait_for_names(self) -> None:
        """Return when the node of every publisher and subscription is known: DDS tells that later
        than that they are.
        """
        node, until = self._node, time.monotonic() + ANSWER_LIMIT
        while time.monotonic() < until:
            ends = [node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic]
            topics = [topic for topic, _ in node.get_topic_names_and_types()]
            if not any(
                end.node_name == UNKNOWN for find in ends for topic in topics for end in find(topic)
            ):
                return
            time.sleep(SPIN)

    def _parameter(self, name: str, parameter: str) -> float:
        client = AsyncParameterClient(self._node, self._names[name])
        answered, future = answer_of(partial(client.get_parameters, [parameter])), None
        if client.wait_for_services(ANSWER_LIMIT):
            until = time.monotonic() + ANSWER_LIMIT
            while (future := answered()) is None and time.monotonic() < until:
                rclpy.spin_once(self._node, timeout_sec=SPIN)
        if future is None or future.result() is None:
            raise InputError(
                f"--follow: {self._names[name]} does not answer for {ANSWER_LIMIT:g} s; start "
                "it again."
            )
        return future.result().values[0].double_value
