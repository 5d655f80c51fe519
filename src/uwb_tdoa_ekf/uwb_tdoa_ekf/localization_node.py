"""localization_node: bias_node and ekf_node of one tag, or of several, in one process.

Both are nodes of their own for each tag, with the names, parameters, topics and diagnostics that they have as processes, in the
namespace of the tag. Corrected TDOAs and odometry are handed over in memory, and published for whoever else listens.
Every parameter of this node itself is documented in config/localization_node.yaml; those of bias_node and ekf_node may be given
too, for all tags, or in a parameter file for one: /tag1/ekf_node.
"""

import sys

from uwb_tdoa_bias import bias_node
from uwb_tdoa_bias.bias_node import BiasNode
from uwb_tdoa_bias.foundation import ros
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.ros_parameters import Parameter, declare_all, files_of, say_unused
from uwb_tdoa_bias.foundation.ros_streams import Turns

from .core.config import RENAMED
from .ekf_node import EkfNode
from .ekf_parameters import names_of_parameters

PARAMETERS = {
    "tags": Parameter([""], 'namespaces of the tags, below that of this node, e.g. ["tag1", "tag2"]; "" is its own'),
}
OF_PROCESS = "__ns", "__node", "__name"  # of this node, not of all


class LocalizationNode(ros.StreamNode):
    """Starts the nodes of the tags, and has them take their turns."""

    NAME = "localization_node"

    def __init__(self, arguments=()):
        """arguments : of the process."""
        super().__init__(self.NAME)
        tags = declare_all(self, PARAMETERS)["tags"]
        if not tags or len(set(tags)) < len(tags):
            raise InputError(f"tags: {list(tags)!r} must be a list of different namespaces, e.g. ['tag1', 'tag2'].")
        pairs = [Pair(*self._start(tag, list(arguments))) for tag in tags]
        self.members = [node for pair in pairs for node in (pair.bias, pair.ekf)]
        say_unused([self, *self.members], files_of(arguments))
        self.turns = Turns(pairs)
        self.get_logger().info(f"ready; tags: {', '.join(tags) or 'one'}")

    def _start(self, tag, arguments):
        """(BiasNode, EkfNode) of a tag."""
        namespace = f"{self.get_namespace().rstrip('/')}/{tag}".rstrip("/") or "/"
        given = ["--ros-args", *(["-p", f"body_frame:={tag}/base_link"] if tag else []), "--", *_for_all(arguments)]
        options = {"namespace": namespace, "cli_args": given, "use_global_arguments": False}
        names = {*bias_node.PARAMETERS, *names_of_parameters(), *RENAMED, *PARAMETERS}
        return tuple(kind(member=names, **options) for kind in (BiasNode, EkfNode))


class Pair:
    """The nodes of a tag, which hand over to each other."""

    def __init__(self, bias, ekf):
        """bias : BiasNode; ekf : EkfNode."""
        self.bias, self.ekf = bias, ekf
        self._corrected, self._odometry = ekf.streams.inputs["uwb/tdoa_corrected"], bias.streams.inputs["odometry"]
        bias.output.hand_to(self._corrected)
        ekf.outputs.odometry.hand_to(self._odometry)
        bias.streams.wait_for("uwb/tdoa", ekf.due)

    def take(self):
        """Give everything that has arrived to those that take it. Returns whether there was anything, or is."""
        busy = [self.bias.streams.take(), self.ekf.streams.take()]
        while self.bias.holds and len(self._odometry):  # poses that TDOAs wait for
            self.bias.streams.take(at_once=True)
            self.ekf.streams.take(at_once=True)
        return any(busy)


def _for_all(arguments):
    """The arguments of a process without the name and the namespace of its node."""
    flags = [k for k, word in enumerate(arguments) if word in ("-r", "--remap")]
    names = [k for k in flags if k + 1 < len(arguments) and arguments[k + 1].partition(":=")[0] in OF_PROCESS]
    dropped = {*names, *(k + 1 for k in names)}
    return [word for k, word in enumerate(arguments) if k not in dropped]


def main(argv=None):
    """Run the node; returns the exit code."""
    return ros.run(LocalizationNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
