# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag over ROS topics, for those who have no `ros2 bag play`."""

from __future__ import annotations

import argparse
from functools import partial

from .. import cli
from ..choices import WAIT
from ..cli import option, positive

DESCRIPTION = """Replay a bag over ROS topics with its own timing, like `ros2 bag play`.

Every topic is published with the durability it was recorded with, and always reliably, which serves best-effort
subscriptions too. A reliable subscription gets every message at any rate: the replay waits for it. A best-effort
one may miss messages. The replay starts with the first subscription. With --follow it stays within 2 s of the followed
topic. While ekf_node publishes uwb/residual, it also waits until older TDOAs (0.08 s) have left the filter: a slow
computer takes longer, and gets the same result. The replay ends when every reliable subscription has every message. It
prints its progress, the counts and the largest delay, and ends with code 1 if the followed nodes were late or lost messages. ROS
arguments move all topics (except /tf, /clock and the like) into the namespace of a tag, or single topics, as in the
last examples. If all nodes that subscribe to the anchors have anchors_file, the anchors of the bag are left out.
"""


def parser() -> argparse.ArgumentParser:
    """Its options."""
    return cli.parser(
        "replay",
        DESCRIPTION,
        "replay flight_bag",
        "replay flight_bag --rate 4 --clock",
        "replay flight_bag --rate 10 --follow odometry",
        "replay flight_bag --wait-matched 30 --wait-topics imu/data uwb/tdoa",
        "replay flight_bag --ros-args -r __ns:=/tag1",
        "replay flight_bag --ros-args -r uwb/tdoa:=uwb/raw",
        options=[
            option("bag", help="bag directory, or its .mcap or .db3 file"),
            option(
                "-r",
                "--rate",
                type=positive,
                default=1.0,
                help="times as fast as recorded (default 1)",
            ),
            option(
                "-l", "--loop", action="store_true", help="start again at the end, until stopped"
            ),
            option(
                "--clock",
                type=positive,
                nargs="?",
                const=40.0,
                metavar="HZ",
                help="publish the bag's time on /clock (default 40 Hz)",
            ),
            option(
                "--wait-matched",
                type=positive,
                default=WAIT,
                metavar="SECONDS",
                help=f"wait at most this long until somebody subscribes, or fail (default {WAIT:g})",
            ),
            option(
                "--wait-topics",
                nargs="+",
                default=[],
                metavar="TOPIC",
                help="wait until somebody subscribes to each of these topics",
            ),
            option("--follow", metavar="TOPIC", help="keep in step with this topic, e.g. odometry"),
            option(
                "--package",
                action="append",
                default=[],
                metavar="NAME",
                help=(
                    "import message types of this package, too; the usual ones of ROS, and ours, are known; "
                    "may be repeated"
                ),
            ),
        ],
    )


def _replay(args: argparse.Namespace) -> int:
    from ..live.replay import ACKNOWLEDGE_LIMIT, ReplayOptions, replay

    say = partial(cli.say, "replay")
    done = replay(
        args.bag,
        ReplayOptions(
            args.rate,
            args.loop,
            args.clock,
            args.wait_matched,
            args.wait_topics,
            args.follow,
            args.ros_arguments,
            args.package,
        ),
        say,
    )
    played = done.played
    for topic, count in sorted(played.counts.items()):
        cli.show(f"{topic}: {count} messages")
    waited = f", waited {played.waited:.2f} s for {args.follow}" if args.follow else ""
    cli.show(
        f"{sum(played.counts.values())} messages in {done.took:.2f} s, at most "
        f"{1e3 * played.behind:.1f} ms late, "
        f"stretched by {1e3 * played.stretched:.1f} ms{waited}"
    )
    if done.stopped_by is not None:
        say("stopped")
        return 0 if args.loop else 128 + done.stopped_by
    if not done.acknowledged:
        say(f"not every subscription acknowledged every message within {ACKNOWLEDGE_LIMIT:g} s")
    slower = ", or replay slower (--rate)" if args.rate > 1.0 else ""
    for what, count in done.wrong.items():
        say(f"{count} {what}; the result is not that of the bag: look at /diagnostics{slower}")
    return int(bool(done.wrong) or not done.acknowledged)


main = cli.executable(_replay, parser, ros=True)
