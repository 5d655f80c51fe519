# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""localization_node: bias_node and ekf_node of one tag, or of several, in one process.

Both are nodes of their own for each tag, with the names, parameters, topics and diagnostics that
they have as processes, in the namespace of the tag. Corrected TDOAs and odometry are handed over in
memory, and published for whoever else listens. The nodes of a tag that fail do not take the others
along: they are started again after 1 s, 2 s, 4 s ... 30 s.
  -> /diagnostics (diagnostic_msgs/DiagnosticArray): which tags are not there, beside what their
  nodes say.
Every parameter of this node itself is documented in config/localization_node.yaml; those of
bias_node and ekf_node may be given too, for all tags, or in a parameter file for one:
/tag1/ekf_node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
import math
import sys
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from uwb_tdoa_bias import bias_node
from uwb_tdoa_bias.bias_node import BiasNode
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.ros.node import (
    FROZEN,
    Diagnostics,
    Parameter,
    Report,
    StreamNode,
    StreamPoller,
    declare_all,
    run,
)
from uwb_tdoa_bias.ros.topics import InMemoryReceiver

from .ekf_node import EkfNode
from .ekf_parameters import names_of_parameters

PARAMETERS = {
    "tags": Parameter(
        [""],
        'namespaces of the tags, below that of this node, e.g. ["tag1", "tag2"]; "" is its own',
    ),
    "frozen": FROZEN,
}
OWN_REMAPPINGS = "__ns", "__node", "__name"  # they hold for this node, not for its members
# s until the nodes of a tag are started again after a failure; doubled each time
FIRST, LONGEST = (1.0, 30.0)
SOUND = 60.0  # s; after so long without a failure, the waiting time is FIRST again


class LocalizationNode(StreamNode):
    """Start the nodes of all tags and let them take turns."""

    NAME = "localization_node"

    def __init__(self, arguments: Sequence[str] | None) -> None:
        """Start the nodes of each tag.

        Parameters
        ----------
        arguments : sequence of str or None
            Command line arguments of the process; default: sys.argv[1:].
        """
        super().__init__(self.NAME)
        tags = declare_all(self, PARAMETERS)["tags"]
        if not tags or len(set(tags)) < len(tags):
            raise InputError(
                f"tags: {list(tags)!r} must be a list of different namespaces, e.g. ['tag1', "
                "'tag2']."
            )
        given = sys.argv[1:] if arguments is None else [*arguments]
        self._tags = [Tag(self, tag, partial(self._start, tag, given)) for tag in tags]
        for tag in self._tags:
            tag.begin()
        refused = [tag.refused for tag in self._tags if tag.refused is not None]
        if len(refused) == len(self._tags):
            raise refused[0]
        self.members = [node for tag in self._tags for node in tag.members]
        self.turns = StreamPoller([each.take for each in self._tags])
        self._diagnostics = Diagnostics(self, self._report)
        self.ready = f"ready; tags: {', '.join(tags) or 'one'}"

    def _report(self) -> Report:
        troubles = [tag.trouble for tag in self._tags if tag.trouble]
        level, text = (
            (DiagnosticStatus.ERROR, troubles[0])
            if troubles
            else (DiagnosticStatus.OK, "all tags are served")
        )
        return level, text, {"tags": len(self._tags), "not served": "; ".join(troubles) or "none"}

    def _start(self, tag: str, arguments: list[str]) -> Pair:
        """Create the two nodes of a tag in its namespace and return them as a Pair.

        They get the arguments of the process without the remappings of this node. Their `body_frame`
        is TAG/base_link, unless the arguments say otherwise. After an exception no node is left.

        tag : relative namespace, "" for that of this node; arguments : of the process
        """
        namespace = f"{self.get_namespace().rstrip('/')}/{tag}".rstrip("/") or "/"
        frame = ["-p", f"body_frame:={tag}/base_link"] if tag else []
        options: dict[str, Any] = {
            "namespace": namespace,
            # ROS takes the last of equal parameters: the process's own win over `frame`
            "cli_args": ["--ros-args", *frame, "--", *_without_own_remappings(arguments)],
            "use_global_arguments": False,  # else __ns and __node would rename these nodes, too
        }
        # of all members: a parameter that another one has is not refused as unknown
        names = {*bias_node.PARAMETERS, *names_of_parameters(), *PARAMETERS}
        bias = BiasNode(member=names, **options)
        try:
            return Pair(bias, EkfNode(member=names, **options))
        except Exception:
            bias.destroy_node()
            raise


class Tag:
    """Own the nodes of one tag and start them again when they fail.

    Attributes
    ----------
    refused : InputError or None
        Reason why the nodes refused to start the first time.
    trouble : str or None
        Message while the nodes do not run.
    """

    def __init__(self, node: LocalizationNode, name: str, start: Callable[[], Pair]) -> None:
        """Prepare a tag without starting its nodes.

        Parameters
        ----------
        node : LocalizationNode
            Node that owns this tag.
        name : str
            Namespace of the tag.
        start : callable
            Creates and returns the Pair of the tag; raises InputError.
        """
        self.refused: InputError | None = None
        self.trouble: str | None = None
        self._pair: Pair | None = None
        self._failure: Exception | None = None
        self._node, self._name, self._start = node, name, start
        # s, by time.monotonic(): the last start, and the next one
        self._began, self._due = 0.0, math.inf
        self._wait = 0.0  # s between failure and start; 0 before a failure, and after SOUND without

    @property
    def members(self) -> list[StreamNode]:
        """Return the nodes that run."""
        return [] if self._pair is None else [self._pair.bias, self._pair.ekf]

    def begin(self) -> None:
        """Start the nodes of this tag.

        An InputError at the first start is final. Any other exception affects this tag only.
        """
        try:
            self._pair = self._start()
        except Exception as error:
            first_start = not self._wait  # no start has failed yet
            if first_start and isinstance(error, InputError):
                self.refused = error
            self._plan_restart(error)
            return
        self.trouble, self._began = None, time.monotonic()
        for node in self.members:
            node.on_failure = self._fail

    def take(self) -> bool:
        """Let the nodes take a turn, if they run; return whether there was or is work."""
        if self._failure is not None:
            self._end(self._failure)
        if self._pair is None:
            if time.monotonic() < self._due:
                return False
            self.begin()
            self._replace([])
            for node in self.members:
                node.say_ready()
            return False
        try:
            return self._pair.take()
        except Exception as error:
            self._fail(error)
            return False

    def _fail(self, error: Exception) -> None:
        """Store an exception; the nodes end at the next turn, when none of their callbacks runs."""
        self._failure = error

    def _end(self, error: Exception) -> None:
        gone, self._failure, self._pair = self.members, None, None
        for line in "".join(traceback.format_exception(error)).splitlines():
            self._node.get_logger().error(line)
        if time.monotonic() > self._began + SOUND:
            self._wait = 0.0
        self._plan_restart(error)
        self._replace(gone)
        for node in gone:
            node.destroy_node()

    def _replace(self, gone: list[StreamNode]) -> None:
        """Let the executor serve the nodes that run now and drop the nodes that are gone."""
        assert self._node.spinner is not None  # a node that takes turns has a spinner
        self._node.spinner.replace(gone, self.members)

    def _plan_restart(self, error: Exception) -> None:
        """Set when the nodes are started again, unless they were refused; log it with the error."""
        then = "is not started again"
        if self.refused is None:
            self._wait = min(LONGEST, 2.0 * self._wait) or FIRST
            self._due = time.monotonic() + self._wait
            then = f"is started again in {self._wait:g} s"
        self.trouble = f"tag '{self._name}' has failed and {then}: {error or repr(error)}"
        self._node.get_logger().error(self.trouble)


class Pair:
    """Connect bias_node and ekf_node of one tag in memory."""

    def __init__(self, bias: BiasNode, ekf: EkfNode) -> None:
        """Connect the outputs of each node with the inputs of the other.

        Parameters
        ----------
        bias : BiasNode
            Node that corrects TDOAs.
        ekf : EkfNode
            Node that runs the filter.
        """
        self.bias, self.ekf = bias, ekf
        corrected, odometry = (
            ekf.streams.inputs["uwb/tdoa_corrected"],
            bias.streams.inputs["odometry"],
        )
        assert isinstance(corrected, InMemoryReceiver) and isinstance(
            odometry, InMemoryReceiver
        )  # members receive these topics in memory
        self._odometry = odometry
        bias.output.deliver_to(corrected)
        ekf.outputs.odometry.deliver_to(odometry)
        bias.streams.wait_for("uwb/tdoa", ekf.due)

    def take(self) -> bool:
        """Let both nodes process all messages that arrived; return whether there was or is any."""
        busy = [self.bias.streams.take(), self.ekf.streams.take()]
        while self.bias.holds and len(self._odometry):  # poses for which TDOAs wait
            self.bias.streams.take(at_once=True)
            self.ekf.streams.take(at_once=True)
        return any(busy)


def _without_own_remappings(arguments: list[str]) -> list[str]:
    """Return command line arguments without those that name this node or its namespace."""
    flags = [k for k, word in enumerate(arguments) if word in ("-r", "--remap")]
    names = [
        k
        for k in flags
        if k + 1 < len(arguments) and arguments[k + 1].partition(":=")[0] in OWN_REMAPPINGS
    ]
    dropped = {*names, *(k + 1 for k in names)}
    return [word for k, word in enumerate(arguments) if k not in dropped]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node and return the exit code."""
    return run(LocalizationNode, __doc__, argv, arguments=argv)


if __name__ == "__main__":
    sys.exit(main())
