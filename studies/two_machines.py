# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""two-machines: test which of two machines hears the other, by their discovery settings.

The machines are two network namespaces of this machine, joined by a virtual cable. This needs root.
"""

from contextlib import contextmanager
import os
import subprocess
import sys

ROBOT, HERE = (f"uwb{os.getpid()}{side}" for side in "ab")
ADDRESS = {ROBOT: "10.99.0.1", HERE: "10.99.0.2"}
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCALHOST, SUBNET, PEER = (
    f"{RANGE}=LOCALHOST",
    f"{RANGE}=SUBNET",
    f"ROS_STATIC_PEERS={ADDRESS[ROBOT]}",
)
CASES = [  # settings of the robot, settings of our machine
    ((), ()),
    ((LOCALHOST,), (LOCALHOST,)),
    ((SUBNET,), (LOCALHOST,)),
    ((SUBNET,), (SUBNET,)),
    ((LOCALHOST,), (LOCALHOST, PEER)),
    ((SUBNET, "ROS_DOMAIN_ID=3"), (SUBNET, "ROS_DOMAIN_ID=4")),
    ((SUBNET, "ROS_DOMAIN_ID=3"), (SUBNET, "ROS_DOMAIN_ID=3")),
]
TALK = """
import rclpy, time
from uwb_tdoa_msgs.msg import Tdoa
rclpy.init()
node = rclpy.create_node("{name}")
{body}
"""
ROBOTS = """
publisher = node.create_publisher(Tdoa, "uwb/tdoa", 10)
while True:
    publisher.publish(Tdoa())
    time.sleep(0.05)
"""
OURS = """
heard = []
node.create_subscription(Tdoa, "uwb/tdoa", heard.append, 10)
until = time.monotonic() + 10.0
while not heard and time.monotonic() < until:
    rclpy.spin_once(node, timeout_sec=0.1)
print("heard" if heard else "not heard in 10 s")
"""


@contextmanager
def cable():
    """Two network namespaces that are joined."""

    def ip(*words):
        subprocess.run(["ip", *words], check=True)

    try:
        for name in ADDRESS:
            ip("netns", "add", name)
        ip(
            "link",
            "add",
            "cable",
            "netns",
            ROBOT,
            "type",
            "veth",
            "peer",
            "name",
            "cable",
            "netns",
            HERE,
        )
        for name, address in ADDRESS.items():
            ip("-n", name, "addr", "add", f"{address}/24", "dev", "cable")
            for device in ("lo", "cable"):
                ip("-n", name, "link", "set", device, "up")
        yield
    finally:
        for name in ADDRESS:
            subprocess.run(["ip", "netns", "del", name])


def started(name, told, body):
    """A process in a namespace, with these variables and no others of ROS's network."""
    words = ["ip", "netns", "exec", name, "env", "-u", RANGE, "-u", "ROS_DOMAIN_ID", *told]
    return subprocess.Popen(
        [*words, sys.executable, "-c", TALK.format(name=name, body=body)],
        stdout=subprocess.PIPE,
        text=True,
    )


def add_options(add):
    """The options of the study: none."""


def run(args):
    """Print the table."""
    print("| the robot is told | we are told | its TDOAs are |\n|---|---|---|")
    with cable():
        for robots, ours in CASES:
            robot, here = started(ROBOT, robots, ROBOTS), started(HERE, ours, OURS)
            said = here.communicate()[0].strip()
            robot.kill()
            robot.communicate()
            told = (
                ", ".join(f"`{word}`" for word in words) or "nothing" for words in (robots, ours)
            )
            print("|", " | ".join([*told, said]), "|", flush=True)
