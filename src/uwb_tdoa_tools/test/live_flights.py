# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A vehicle_node and the nodes that it flies by, as processes.

A node of the test sends requests and subscribes.
"""

from contextlib import contextmanager
import json

from nav_msgs.msg import Odometry
from std_msgs.msg import String

from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS
from uwb_tdoa_tools.live.session import Processes, own_domain, session, wait

# s, limit of each wait; the first start compiles the filter and the vehicle
PATIENCE = 400.0


class Hall:
    """verdicts : [dict] in the order received; odometry : the newest, or None."""

    def __init__(self, node, processes):
        self.verdicts, self.odometry, self.node = [], None, node
        self._processes = processes
        self._ends = [
            node.create_subscription(
                String,
                "verdict",
                lambda message: self.verdicts.append(json.loads(message.data)),
                ANCHORS_QOS,
            ),
            node.create_subscription(Odometry, "odometry", self._on_odometry, 10),
        ]

    def _on_odometry(self, message):
        self.odometry = message

    def wait(self, condition, what, limit=PATIENCE):
        """Process messages until condition() is true."""
        wait(limit, what, self._processes, self.node, condition)

    def ask(self, kind, name, **request):
        """Return the response of a service."""
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, name)
        answer = client.call_async(kind.Request(**request))
        self.wait(answer.done, f"an answer of {name}")
        return answer.result()


@contextmanager
def hall(folder, *parameters, ekf=()):
    """Run all nodes on simulated time while the block lasts, and give a Hall.

    parameters, ekf : NAME:=VALUE, of vehicle_node and ekf_node
    """
    with own_domain(), session("test", []) as (node, stop), Processes(folder, stop) as processes:
        told = {
            ("uwb_tdoa_bias", "bias_node"): ["use_sim_time:=true"],
            ("uwb_tdoa_ekf", "ekf_node"): ["use_sim_time:=true", *ekf],
            ("uwb_tdoa_tools", "vehicle_node"): ["simulated_time:=true", *parameters],
        }
        for (package, name), values in told.items():
            arguments = ["--ros-args", *(word for value in values for word in ("-p", value))]
            processes.start(
                package, name, *arguments, may_end_with=(0, 1) if "mission:=true" in values else ()
            )
        yield Hall(node, processes)
