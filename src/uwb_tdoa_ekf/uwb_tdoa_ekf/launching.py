# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide which nodes the launch files start, in which namespace and with which parameters.

This module does not import launch: `./dev launch` starts the nodes without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
import json
import os
from pathlib import Path
import signal
from typing import Any

import yaml

from uwb_tdoa_bias import anchors_node, bias_node
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import new_folder_until_exit, write_text
from uwb_tdoa_bias.common.safe_yaml import read_yaml

from . import debias_node
from .ekf_parameters import names_of_parameters

EVERYWHERE = {"use_sim_time"}
FROZEN = (
    "true: the nodes refuse over ROS, once started, other parameters, anchors, static transforms "
    "and poses, and a reset"
)
NODES = {  # {executable: (package, names of its parameters)}
    "bias_node": ("uwb_tdoa_bias", {*bias_node.PARAMETERS} | EVERYWHERE),
    "ekf_node": ("uwb_tdoa_ekf", names_of_parameters() | EVERYWHERE),
    "debias_node": ("uwb_tdoa_ekf", {*debias_node.PARAMETERS} | EVERYWHERE),
    "calibration_node": (
        "uwb_tdoa_tools",  # below this package: test_calibration_node.py compares the names
        {"anchors_file", "effects_file", "ekf_params", "tape_std", "trusted", "calibration_folder"}
        | EVERYWHERE,
    ),
    "anchors_node": ("uwb_tdoa_bias", {*anchors_node.PARAMETERS} | EVERYWHERE),
}
PATHS = (  # parameters that are paths
    "anchors_file",
    "effects_file",
    "map",
    "flyable_volume",
    "calibration_folder",
    "ekf_params",
)
OF_FILES = {"params_file"}  # a parameter file for both nodes of a tag; launch arguments override it
RESPAWN = {  # launch arguments: (default, text, choices)
    "respawn": (
        "true",
        "start a node again that has crashed, after 1 s, 2 s, 4 s ... 30 s",
        ["true", "false"],
    ),
    "on_exit": (
        "shutdown",
        "when a node refuses at the start what it is given, or has crashed with "
        "respawn:=false: shutdown ends all, with code 1; "
        "stay lets the others go on",
        ["shutdown", "stay"],
    ),
}
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
NETWORK = {  # one more launch argument
    "discovery_range": (
        "",
        f"who discovers the nodes; default: {RANGE}, or LOCALHOST where that is not set",
        ["", "OFF", "LOCALHOST", "SUBNET", "SYSTEM_DEFAULT"],
    ),
}
WHO = {
    "OFF": "nobody, not even on this machine",
    "LOCALHOST": (
        "nodes on this machine{}, and whoever names it in ROS_STATIC_PEERS; with SUBNET by those "
        "of other machines, too"
    ),
    "SUBNET": (
        "nodes on every machine that multicast reaches{}, any of which can command these; with "
        "LOCALHOST by those of this machine"
    ),
    "SYSTEM_DEFAULT": "whom the settings of the middleware let through",
}
# Launch arguments: {name: (default or None, text, allowed values or None)}
Arguments = Mapping[str, tuple[str | None, str, Sequence[str] | None]]
COMMON: Arguments = {  # of both launch files
    "log_level": ("info", "debug, info, warn, error", None),
    "rviz": ("false", "true opens RViz with the frames, the covariance and the anchors", None),
    **RESPAWN,
    **NETWORK,
}
# parameters of the nodes of one tag; one that is not given is what the files say, or the node's default
OF_A_TAG = {
    "anchors_file": "survey of the anchors; without it they come on uwb/anchors",
    "effects_file": "effects.yaml that diagnose wrote",
    "model_file": "ONNX bias model",
    "map": "map.npz that debias wrote; starts debias_node",
    "calibrated": "true: calibrate the anchors while the tag moves; starts calibration_node",
    "calibration_folder": "folder in which calibrations are kept, and from which the next start takes one",
    "world_frame": "frame of the odometry",
    "body_frame": "frame of the robot",
    "publish_tf": "none, base (map -> base_link) or odom (map -> odom, REP 105)",
    "odom_frame": "frame of the robot's own odometry, for publish_tf odom",
    "use_sim_time": "true for bags that are played with --clock",
    "frozen": FROZEN,
}
OF_ALL_TAGS = {name: OF_A_TAG[name] for name in ("use_sim_time", "frozen")}
PARAMETER_FILES = {  # {node: launch argument}
    "bias_node": "bias_params",
    "ekf_node": "ekf_params",
    "calibration_node": "calibration_params",
}
AUTO = "auto"  # value of `processes`: one process for each core
# s until a node is started again after a crash; doubled each time
FIRST, LONGEST = (1.0, 30.0)
SOUND = 60.0  # s; after so long without a crash, the waiting time is FIRST again
ENDING = signal.SIGINT, signal.SIGTERM
REFUSED = 2  # exit code of a node that cannot use its input
IN_ORDER = (
    0,
    *(-number for number in ENDING),
    *(128 + number for number in ENDING),
)  # exit codes of a node that ended on request


@dataclass(frozen=True)
class Start:
    """Describe one node to start.

    Attributes
    ----------
    package, executable, namespace : str
        What to start, and where.
    parameters : list
        Paths of parameter files, and dicts {name: value}. Later entries override earlier ones.
    log_level : str
        Log level of the node.
    name : str or None
        Name of the node if it differs from that of the executable.
    remaps : mapping
        {topic: name of the topic here}.
    """

    package: str
    executable: str
    namespace: str
    parameters: list
    log_level: str = "info"
    name: str | None = None
    remaps: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Return the name of the node in messages."""
        return f"{self.namespace.strip('/')}/{self.name or self.executable}".lstrip("/")

    @property
    def words(self) -> list[str]:
        """Return parameters, remaps and log level as arguments after --ros-args."""
        words = [
            "--log-level",
            self.log_level,
            *(word for name, new in self.remaps.items() for word in ("-r", f"{name}:={new}")),
        ]
        for part in self.parameters:
            if isinstance(part, dict):
                words += [
                    word
                    for name, value in part.items()
                    for word in ("-p", f"{name}:={json.dumps(value, ensure_ascii=False)}")
                ]
            else:
                words += ["--params-file", str(part)]
        return words


@dataclass(frozen=True)
class Ended:
    """Describe what happens after a node has ended.

    Attributes
    ----------
    again : float or None
        Time until the node is started again, in s.
    text : str or None
        Message to log.
    everything : bool
        True to end all other nodes too.
    """

    again: float | None = None
    text: str | None = None
    everything: bool = False


class Lives:
    """Decide whether one node is started again after it has ended."""

    def __init__(self, label: str, respawn: bool, on_exit: str) -> None:
        """Store the launch arguments and count no crash.

        Parameters
        ----------
        label : str
            Name of the node in messages.
        respawn : bool
            Start the node again after a crash.
        on_exit : str
            "shutdown" or "stay": what happens to the other nodes.
        """
        self._label, self._respawn, self._on_exit = label, respawn, on_exit
        self._crashes = 0  # consecutive crashes

    def ended(self, code: int, alive: float) -> Ended:
        """Return the Ended of a node.

        Parameters
        ----------
        code : int
            Exit code, or minus the number of the signal that ended the node.
        alive : float
            Lifetime of the node, in s.
        """
        if code in IN_ORDER:
            return Ended()
        if (
            code == REFUSED and not self._crashes and alive < SOUND
        ):  # a later refusal may come from a file that is being written: start again
            what = (
                f"{self._label} refuses what it is given (see its message above), and is not "
                "started again"
            )
        elif not self._respawn:
            what = f"{self._label} has ended with exit code {code}"
        else:
            self._crashes = 1 if alive > SOUND else self._crashes + 1
            again = min(LONGEST, FIRST * 2.0 ** (self._crashes - 1))
            return Ended(
                again,
                (
                    f"{self._label} has ended with exit code {code}: it is started again in "
                    f"{again:g} s"
                ),
            )
        return Ended(text=what, everything=self._on_exit == "shutdown")


def discovery(environment: Mapping[str, str], given: str = "") -> dict[str, str]:
    """Return environment variables that limit which machines discover the nodes.

    Without another setting of the user, only this machine discovers them.

    Parameters
    ----------
    environment : mapping
        Environment variables.
    given : str
        Launch argument discovery_range.
    """
    return {RANGE: given or environment.get(RANGE) or "LOCALHOST"}


def network(environment: Mapping[str, str]) -> str:
    """Return a sentence on which machines can hear and command the nodes.

    Parameters
    ----------
    environment : mapping
        Environment variables of the nodes.
    """
    found, peers = environment.get(RANGE) or "SUBNET", environment.get("ROS_STATIC_PEERS")
    if environment.get("ROS_LOCALHOST_ONLY") == "1":  # an old variable that rcl still obeys
        found, peers = "LOCALHOST", None
    elif found not in WHO:  # rcl falls back to LOCALHOST for an unknown value
        found = "LOCALHOST"
    also = f" and of ROS_STATIC_PEERS={peers}" if peers else ""
    return (
        f"{RANGE}={found}, ROS_DOMAIN_ID={environment.get('ROS_DOMAIN_ID') or 0}: heard by "
        f"{WHO[found].format(also)}"
    )


def start(
    executable: str,
    namespace: str,
    values: Mapping,
    files: Sequence[str] = (),
    log_level: str = "info",
) -> Start:
    """Return the Start of an executable with its share of {name: value} and its files."""
    package, names = NODES[executable]
    own = {name: value for name, value in values.items() if name in names}
    return Start(package, executable, namespace, [*files, *([own] if own else [])], log_level)


def tag(
    namespace: str,
    values: Mapping[str, bool | str | float],
    files: dict | None = None,
    log_level: str = "info",
) -> list[Start]:
    """Return the Starts of bias_node and ekf_node of one tag.

    With a `map`, of debias_node, too; with `calibrated`, of calibration_node, too.

    Parameters
    ----------
    namespace : str
        Namespace of the tag.
    values : mapping
        {parameter: value} for all nodes.
    files : dict or None
        {executable: [paths of parameter files]}.
    log_level : str
        Log level of the nodes.

    Raises
    ------
    InputError
        If no node has one of the parameters.
    """
    refuse_unknown(values, "bias_node", "ekf_node", "debias_node", "calibration_node")
    nodes = ["bias_node", "ekf_node"] + ["debias_node"] * bool(values.get("map"))
    nodes += ["calibration_node"] * bool(values.get("calibrated"))
    return [
        start(name, namespace, values, (files or {}).get(name, ()), log_level) for name in nodes
    ]


def tags(path: str, values: Mapping, log_level: str = "info", processes: str = "") -> list[Start]:
    """Return the Starts for a YAML file of tags.

    The file has the form `tags: {NAMESPACE: {parameter: value, remaps: {topic: name}}}`. Keys next
    to `tags` hold for all tags. Each tag has its own body frame NAMESPACE/base_link, unless the file
    names another. If all tags name the same anchors_file, one anchors_node starts too. Of all
    tags that are `calibrated`, the first has a calibration_node, which serves all.

    Parameters
    ----------
    path : str
        Path of the file.
    values : mapping
        {parameter: value} that overrides the file.
    log_level : str
        Log level of the nodes.
    processes : str
        Overrides the value of the file; see `pooled`.

    Raises
    ------
    InputError
        If the file is wrong.
    """
    content = read_yaml(path)
    listed = content.pop("tags", None) if isinstance(content, dict) else None
    if not isinstance(listed, dict) or not listed:
        raise InputError(
            f"{path}: expected a mapping 'tags' of namespace to parameters, e.g. 'tags: {{tag1: {{}}}}'."
        )
    of_file = str(content.pop("processes", ""))
    shared = _remaps(path, content.pop("remaps", None))
    starts: list[Start] = []
    for namespace, own in listed.items():
        if not isinstance(own or {}, dict):
            raise InputError(
                f"{path}: tags: {namespace}: {own!r} must be a mapping of parameters, or {{}}."
            )
        parameters = {"body_frame": f"{namespace}/base_link", **content, **(own or {})}
        remaps = shared | _remaps(path, parameters.pop("remaps", None))
        try:
            nodes = _starts_of(path, str(namespace), {**parameters, **values}, log_level)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        starts += [replace(each, remaps=remaps) for each in nodes]
    others = [each for each in starts if each.executable == "calibration_node"][1:]
    starts = [each for each in starts if each not in others]
    anchors = {node.parameters[-1].get("anchors_file") for node in starts if node.parameters} - {
        None
    }
    if len(anchors) == 1:
        of_anchors = {
            "anchors_file": anchors.pop(),
            **{name: values[name] for name in (*EVERYWHERE, "frozen") if name in values},
        }
        starts.append(start("anchors_node", "", of_anchors, (), log_level))
    processes = processes or of_file
    return pooled(starts, processes) if processes else starts


def _starts_of(path: str, namespace: str, values: dict[str, Any], log_level: str) -> list[Start]:
    """Return the Starts of one tag of a file; its paths are relative to that file."""
    file = values.pop("params_file", None)
    files = {}
    if file not in (None, ""):
        files = {name: [_beside(path, file)] for name in ("bias_node", "ekf_node")}
    given = [name for name in PATHS if values.get(name) not in (None, "")]
    values |= {name: _beside(path, values[name]) for name in given}
    return tag(namespace, values, files, log_level)


def pooled(starts: list[Start], processes: int | str) -> list[Start]:
    """Replace all bias_nodes and ekf_nodes of `tags` by a number of localization_nodes.

    Their parameters go into a temporary file.

    Parameters
    ----------
    starts : list of Start
        Result of `tags`.
    processes : int or str
        Number of processes, or "auto" for one per core.

    Returns
    -------
    starts : list of Start
        The localization_nodes and all other nodes.

    Raises
    ------
    InputError
        If the number is wrong, or a tag has its own parameter file or remaps.
    """
    if processes == AUTO:
        processes = len(os.sched_getaffinity(0))
    if not str(processes).isdecimal() or not int(processes):
        raise InputError(
            f"processes: {processes!r} must be a whole number above 0, auto, or left out for "
            "two nodes for each tag."
        )
    members = [each for each in starts if each.executable in ("bias_node", "ekf_node")]
    if any(isinstance(part, str) for each in members for part in each.parameters):
        raise InputError(
            "params_file: does not go with processes; write its values into the file of the tags."
        )
    if any(each.remaps for each in members):
        raise InputError(
            "remaps: do not go with processes; leave processes out, or remap the drivers."
        )
    by_node = {
        f"/**/{each.label}": {"ros__parameters": each.parameters[-1]}
        for each in members
        if each.parameters
    }  # the key matches the node in any namespace
    # the file stays, because a restarted node reads it again
    file = new_folder_until_exit() / "tags.yaml"
    write_text(file, yaml.safe_dump(by_node, allow_unicode=True))
    frozen = all(each.parameters and each.parameters[-1].get("frozen") for each in members)
    namespaces, out = (
        list(dict.fromkeys(each.namespace for each in members)),
        [each for each in starts if each not in members],
    )
    for k in range(min(int(processes), len(namespaces))):
        own = {"tags": namespaces[k :: int(processes)]} | ({"frozen": True} if frozen else {})
        parameters, name = [str(file), own], f"localization_node_{k + 1}"
        out.append(
            Start("uwb_tdoa_ekf", "localization_node", "", parameters, members[0].log_level, name)
        )
    return out


def refuse_unknown(values: Mapping[str, bool | str | float], *executables: str) -> None:
    """Raise InputError for a parameter that no executable has, or whose value is missing."""
    known = set().union(*(NODES[name][1] for name in executables))
    for name, value in values.items():
        if name not in known:
            near = get_close_matches(str(name), known | OF_FILES, n=1, cutoff=0.5)
            raise InputError(
                f"{name}: is no parameter of {', '.join(executables)}; "
                + (f"write {near[0]}." if near else "leave it out.")
            )
        if value is None or isinstance(value, dict):
            raise InputError(
                f"{name}: {value!r} is no value; give a number, a text, true or false, or "
                "leave it out."
            )


def typed(texts: dict[str, str]) -> dict[str, bool | str]:
    """Return {name: value} of {name: text} from a command line, without empty texts."""
    kinds = {"true": True, "false": False}
    return {name: kinds.get(text, text) for name, text in texts.items() if text != ""}


def _remaps(path: str, given: object) -> dict[str, str]:
    """Return {topic: name} of an entry in a file of tags; raise InputError if it is wrong."""
    entries = {} if given is None else given
    texts = (
        [text for pair in entries.items() for text in pair] if isinstance(entries, dict) else [None]
    )
    if not isinstance(entries, dict) or not all(
        isinstance(text, str) and text and ":=" not in text for text in texts
    ):
        raise InputError(
            f"{path}: remaps: {given!r} must be a mapping of topics to names, e.g. "
            f"{{velocity/odometry: odom}}."
        )
    return entries


def _beside(path: str | Path, file: object) -> str:
    """Return a path that a file names, relative to that file; raise InputError if it is no text."""
    if not isinstance(file, str):
        raise InputError(f"{file!r} is no path; write a text.")
    return str(Path(path).parent / file)


def _one_tag(given: Mapping[str, str]) -> list[Start]:
    """Return the Starts of tdoa.launch.py."""
    values = typed({name: given[name] for name in OF_A_TAG})
    namespace, log_level = given["namespace"], given["log_level"]
    files = {node: [given[key]] for node, key in PARAMETER_FILES.items() if given[key]}
    if given["ekf_params"]:
        values["ekf_params"] = given["ekf_params"]
    starts = tag(namespace, values, files, log_level)
    if "anchors_file" in values:
        starts.append(start("anchors_node", namespace, values, (), log_level))
    return starts


def _several_tags(given: Mapping[str, str]) -> list[Start]:
    """Return the Starts of tags.launch.py."""
    values = typed({name: given[name] for name in OF_ALL_TAGS})
    return tags(given["tags"], values, given["log_level"], given["processes"])


@dataclass(frozen=True)
class LaunchFile:
    """Describe a launch file.

    Attributes
    ----------
    arguments : Arguments
    starts : callable
        Returns the Starts for {name: value} of all arguments.
    """

    arguments: Arguments
    starts: Callable[[Mapping[str, str]], list[Start]]


LAUNCH_FILES = {
    "tdoa.launch.py": LaunchFile(
        {
            **{name: ("", text, None) for name, text in OF_A_TAG.items()},
            "namespace": ("", "one per tag; the topics are relative to it", None),
            "bias_params": ("", "parameter file of bias_node, overridden by the above", None),
            "ekf_params": ("", "parameter file of ekf_node, overridden by the above", None),
            "calibration_params": (
                "",
                "parameter file of calibration_node, overridden by the above",
                None,
            ),
            **COMMON,
        },
        _one_tag,
    ),
    "tags.launch.py": LaunchFile(
        {
            "tags": (None, "YAML file of the tags", None),
            **{name: ("", text, None) for name, text in OF_ALL_TAGS.items()},
            "processes": (
                "",
                "localization_nodes that share the tags: a number, or auto, one for each core; "
                "default: as the file says, or two nodes for each tag",
                None,
            ),
            **COMMON,
            "on_exit": ("stay", *RESPAWN["on_exit"][1:]),  # one tag does not take the others along
        },
        _several_tags,
    ),
}
