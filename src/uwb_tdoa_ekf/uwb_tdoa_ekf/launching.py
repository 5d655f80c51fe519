"""What the launch files start: which node, in which namespace, with which of the values.

Without launch itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
import json
import os
from pathlib import Path
import signal
import socket

import yaml

from uwb_tdoa_bias import anchors_node, bias_node
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import folder_of_process, write_text
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
    "anchors_node": ("uwb_tdoa_bias", {*anchors_node.PARAMETERS} | EVERYWHERE),
}
PATHS = "anchors_file", "effects_file", "map", "flyable_volume"  # parameters that are paths
OF_FILES = {"params_file"}  # a parameter file for both nodes of a tag, which the values override
RESPAWN = {  # arguments of the launch files: (default, text, choices)
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
NETWORK = {  # another argument of the launch files
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
AUTO = "auto"  # processes: one for each core
# s, until a node that has crashed is started again: twice as long each time
FIRST, LONGEST = (1.0, 30.0)
SOUND = 60.0  # s; a node that lived for so long has crashed for the first time again
ENDING = signal.SIGINT, signal.SIGTERM
REFUSED = 2  # exit code of a node that cannot use what it is given
IN_ORDER = (
    0,
    *(-number for number in ENDING),
    *(128 + number for number in ENDING),
)  # exit codes of a node that was asked to end


@dataclass(frozen=True)
class Start:
    """One node. parameters : paths of files and {name: value}, of which later ones count; name : of
    the node, if it is another than the executable's; remaps : {name of a topic: the name it has
    here}.
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
        """What it is called in messages."""
        return f"{self.namespace.strip('/')}/{self.name or self.executable}".lstrip("/")

    @property
    def words(self) -> list[str]:
        """Its parameters, remaps and log level, as arguments after --ros-args."""
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
    """What is done when a node has ended. again : s after which it is started again, or None; text
    : what is said, or None;
    everything : whether the others end, too.
    """

    again: float | None = None
    text: str | None = None
    everything: bool = False


class Lives:
    """Those of one node: whether it is started again."""

    def __init__(self, label: str, respawn: bool, on_exit: str) -> None:
        """respawn : bool; on_exit : "shutdown" or "stay"."""
        self._label, self._respawn, self._on_exit = label, respawn, on_exit
        self._crashes = 0  # in a row

    def ended(self, code: int, alive: float) -> Ended:
        """Ended, of a node that has ended by itself with this exit code, or by minus this signal,
        after so many seconds.
        """
        if code in IN_ORDER:
            return Ended()
        if (
            code == REFUSED and not self._crashes and alive < SOUND
        ):  # later its files may just be being written: again, then
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
    """Variables with which nodes are started: this machine alone discovers them, unless the user
    says otherwise. environment : variables; given : the argument discovery_range.
    """
    return {RANGE: given or environment.get(RANGE) or "LOCALHOST"}


def network(environment: Mapping[str, str]) -> str:
    """Who can hear the nodes, and command them, in a sentence. environment : variables."""
    found, peers = environment.get(RANGE) or "SUBNET", environment.get("ROS_STATIC_PEERS")
    if environment.get("ROS_LOCALHOST_ONLY") == "1":  # old, and counts
        found, peers = "LOCALHOST", None
    elif found not in WHO:  # rcl says so
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
    """Start of an executable with those of {name: value} that it has, and with the parameter files."""
    package, names = NODES[executable]
    own = {name: value for name, value in values.items() if name in names}
    return Start(package, executable, namespace, [*files, *([own] if own else [])], log_level)


def tag(
    namespace: str,
    values: dict[str, bool | str | float],
    files: dict | None = None,
    log_level: str = "info",
) -> list[Start]:
    """[Start] of bias_node and ekf_node of one tag; with a `map` of debias_node too. files :
    {executable: [paths]}.

    Raises InputError for a value that none of them has.
    """
    refuse_unknown(values, "bias_node", "ekf_node", "debias_node")
    nodes = ["bias_node", "ekf_node"] + ["debias_node"] * bool(values.get("map"))
    return [
        start(name, namespace, values, (files or {}).get(name, ()), log_level) for name in nodes
    ]


@dataclass(frozen=True)
class Fleet:
    """What a YAML file of tags says: `tags: {NAMESPACE: {parameter: value, host: HOST, remaps:
    {topic: name}}}`, and beside `tags` what all of them share.

    path : of the file; tags : {namespace: {parameter: value}}; hosts : {namespace: name of the
        machine that runs its nodes, None where the
    file names none}; remaps : {namespace: {topic: name}}; processes : text, "" where the file does
    not say.
    """

    path: str
    tags: dict[str, dict]
    hosts: dict[str, str | None]
    remaps: dict[str, dict[str, str]]
    processes: str

    @classmethod
    def read(cls, path: str) -> Fleet:
        """Raises InputError."""
        content = read_yaml(path)
        listed = content.pop("tags", None) if isinstance(content, dict) else None
        if not isinstance(listed, dict) or not listed:
            raise InputError(
                f"{path}: expected a mapping 'tags' of namespace to parameters, e.g. 'tags: "
                f"{{tag1: {{}}}}'."
            )
        merged, hosts, remaps, processes = {}, {}, {}, content.pop("processes", "")
        shared = content.pop("remaps", None)
        for namespace, own in listed.items():
            if not isinstance(own or {}, dict):
                raise InputError(
                    f"{path}: tags: {namespace}: {own!r} must be a mapping of parameters, or {{}}."
                )
            parameters = {"body_frame": f"{namespace}/base_link", **content, **(own or {})}
            host, renamed = parameters.pop("host", None), parameters.pop("remaps", None)
            remaps[str(namespace)] = {**_remaps(path, shared), **_remaps(path, renamed)}
            if not isinstance(host, str | None):
                raise InputError(
                    f"{path}: tags: {namespace}: host: {host!r} is no name of a machine; "
                    "write a text."
                )
            merged[str(namespace)], hosts[str(namespace)] = parameters, host
        if None in hosts.values() and set(hosts.values()) != {None}:
            lacks = next(namespace for namespace, name in hosts.items() if name is None)
            raise InputError(
                f"{path}: tags: {lacks}: names no host, and other tags do; name it, or a host "
                "for all beside 'tags'."
            )
        return cls(str(path), merged, hosts, remaps, str(processes))

    def at(self, host: str) -> Fleet:
        """The tags whose nodes this machine runs: all, where the file names no host.

        Raises InputError if there is none.
        """
        if set(self.hosts.values()) == {None}:
            return self
        here = [
            namespace
            for namespace, name in self.hosts.items()
            if name in (host, host.partition(".")[0])
        ]
        if not here:
            known = ", ".join(dict.fromkeys(str(name) for name in self.hosts.values()))
            raise InputError(
                f"{self.path}: no tag has the host {host}; those named are {known}: correct "
                "the file, or give host:=NAME."
            )
        tags, hosts = (
            {name: self.tags[name] for name in here},
            {name: self.hosts[name] for name in here},
        )
        return Fleet(
            self.path, tags, hosts, {name: self.remaps[name] for name in here}, self.processes
        )

    def starts(self, values: Mapping, log_level: str = "info") -> list[Start]:
        """bias_node and ekf_node of each tag, each with a frame of its own, NAMESPACE/base_link,
        unless it names another; values : override the file's. Raises InputError.
        """
        starts = []
        try:
            for namespace, own in self.tags.items():
                merged = {**own, **values}
                file = merged.pop("params_file", None)
                files = (
                    {name: [_beside(self.path, file)] for name in ("bias_node", "ekf_node")}
                    if file not in (None, "")
                    else {}
                )
                merged |= {
                    name: _beside(self.path, merged[name])
                    for name in PATHS
                    if merged.get(name) not in (None, "")
                }
                starts += [
                    replace(each, remaps=self.remaps[namespace])
                    for each in tag(namespace, merged, files, log_level)
                ]
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from error
        return starts


def tags(
    path: str, values: Mapping, log_level: str = "info", processes: str = "", host: str = ""
) -> list[Start]:
    """What this machine starts of a YAML file of tags (Fleet): their nodes, and anchors_node if all
    name the same anchors_file. Of a file that names hosts, the host of the first tag alone starts
    anchors_node.

    values : override the file's; processes : overrides the file's, see `pooled`; host : what this
        machine is called, default: its name.
    Raises InputError.
    """
    fleet = Fleet.read(path)
    here = fleet.at(host or socket.gethostname())
    starts = here.starts(values, log_level)
    anchors = {node.parameters[-1].get("anchors_file") for node in starts if node.parameters} - {
        None
    }
    if len(anchors) == 1 and next(iter(here.tags)) == next(iter(fleet.tags)):
        shared = {
            "anchors_file": anchors.pop(),
            **{name: values[name] for name in (*EVERYWHERE, "frozen") if name in values},
        }
        starts.append(start("anchors_node", "", shared, (), log_level))
    processes = processes or fleet.processes
    return pooled(starts, processes) if processes else starts


def pooled(starts: list[Start], processes: int | str) -> list[Start]:
    """The same of `tags` with so many localization_nodes instead of bias_nodes and ekf_nodes; their
    parameters are in a file that is written for them. processes : number, or its text, or "auto":
    one for each core. Raises InputError if it is none, or a tag has a parameter file of its own.
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
    }  # in any namespace
    file = folder_of_process() / "tags.yaml"  # a node that is started again reads it again
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


def refuse_unknown(values: dict[str, bool | str | float], *executables: str) -> None:
    """Raise InputError for a value that none of the executables has, or that is none."""
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
    """{name: value} of {name: text} as they come on a command line; empty ones are left out."""
    kinds = {"true": True, "false": False}
    return {name: kinds.get(text, text) for name, text in texts.items() if text != ""}


def _remaps(path: str, given: object) -> dict[str, str]:
    """{topic: name} of what a file of tags says. Raises InputError."""
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
    """A path that a file names, relative to that file. Raises InputError."""
    if not isinstance(file, str):
        raise InputError(f"{file!r} is no path; write a text.")
    return str(Path(path).parent / file)
