"""What the launch files start: which node, in which namespace, with which of the values. Without launch itself."""

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
import tempfile

import yaml
from uwb_tdoa_bias import anchors_node, bias_node
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.safe_yaml import read_yaml

from . import debias_node
from .ekf_parameters import names_of_parameters

EVERYWHERE = {"use_sim_time"}
NODES = {  # {executable: (package, names of its parameters)}
    "bias_node": ("uwb_tdoa_bias", {*bias_node.PARAMETERS} | EVERYWHERE),
    "ekf_node": ("uwb_tdoa_ekf", names_of_parameters() | EVERYWHERE),
    "debias_node": ("uwb_tdoa_ekf", {*debias_node.PARAMETERS} | EVERYWHERE),
    "anchors_node": ("uwb_tdoa_bias", {*anchors_node.PARAMETERS} | EVERYWHERE),
}
OF_FILES = {"params_file"}  # a parameter file for both nodes of a tag, which the values override


@dataclass(frozen=True)
class Start:
    """One node. parameters : paths of files and {name: value}, of which later ones count; name : of the node, if it is another than
    the executable's."""

    package: str
    executable: str
    namespace: str
    parameters: list
    log_level: str = "info"
    name: str | None = None


def start(executable, namespace, values, files=(), log_level="info"):
    """Start of an executable with those of {name: value} that it has, and with the parameter files."""
    package, names = NODES[executable]
    own = {name: value for name, value in values.items() if name in names}
    return Start(package, executable, namespace, [*files, *([own] if own else [])], log_level)


def tag(namespace, values, files=None, log_level="info"):
    """[Start] of bias_node and ekf_node of one tag; with a `map` of debias_node too. files : {executable: [paths]}.

    Raises InputError for a value that none of them has.
    """
    refuse_unknown(values, "bias_node", "ekf_node", "debias_node")
    nodes = ["bias_node", "ekf_node"] + ["debias_node"] * bool(values.get("map"))
    return [start(name, namespace, values, (files or {}).get(name, ()), log_level) for name in nodes]


def tags(path, values, log_level="info"):
    """[Start] of all tags of a YAML file, and of anchors_node if it names an anchors_file. values : override the file's.

    `tags: {NAMESPACE: {parameter: value}}`, and beside `tags` what all of them share. Each tag has a frame of its own,
    NAMESPACE/base_link, unless it names another. Raises InputError.
    """
    content = read_yaml(path)
    listed = content.pop("tags", None) if isinstance(content, dict) else None
    if not isinstance(listed, dict) or not listed:
        raise InputError(f"{path}: expected a mapping 'tags' of namespace to parameters, e.g. 'tags: {{tag1: {{}}}}'.")
    starts = []
    try:
        for namespace, own in listed.items():
            if not isinstance(own or {}, dict):
                raise InputError(f"tags: {namespace}: {own!r} must be a mapping of parameters, or {{}}.")
            merged = {"body_frame": f"{namespace}/base_link", **content, **(own or {}), **values}
            file = merged.pop("params_file", None)
            files = {name: [_beside(path, file)] for name in ("bias_node", "ekf_node")} if file else {}
            merged |= {name: _beside(path, merged[name]) for name in ("anchors_file", "effects_file") if merged.get(name)}
            starts += tag(str(namespace), merged, files, log_level)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    anchors = {node.parameters[-1].get("anchors_file") for node in starts if node.parameters} - {None}
    if len(anchors) == 1:
        shared = {"anchors_file": anchors.pop(), **{name: values[name] for name in EVERYWHERE if name in values}}
        starts.append(start("anchors_node", "", shared, (), log_level))
    return starts


def pooled(starts, processes):
    """The same of `tags` with so many localization_nodes instead of bias_nodes and ekf_nodes; what these are told is in a file that
    is written for them. processes : number, or its text. Raises InputError if it is none, or a tag has a parameter file of its own."""
    if not str(processes).isdecimal() or not int(processes):
        raise InputError(f"processes: {processes!r} must be a whole number above 0, or left out for two nodes for each tag.")
    members = [each for each in starts if each.executable in ("bias_node", "ekf_node")]
    if any(isinstance(part, str) for each in members for part in each.parameters):
        raise InputError("params_file: does not go with processes; write its values into the file of the tags.")
    told = {f"/{each.namespace}/{each.executable}": {"ros__parameters": each.parameters[-1]} for each in members if each.parameters}
    with tempfile.NamedTemporaryFile("w", prefix="uwb_tdoa_tags_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(told, file)
    namespaces, out = list(dict.fromkeys(each.namespace for each in members)), [each for each in starts if each not in members]
    for k in range(min(int(processes), len(namespaces))):
        parameters, name = [file.name, {"tags": namespaces[k :: int(processes)]}], f"localization_node_{k + 1}"
        out.append(Start("uwb_tdoa_ekf", "localization_node", "", parameters, members[0].log_level, name))
    return out


def refuse_unknown(values, *executables):
    """Raise InputError for a value that none of the executables has."""
    known = set().union(*(NODES[name][1] for name in executables))
    for name in values:
        if name not in known:
            near = get_close_matches(str(name), known | OF_FILES, n=1, cutoff=0.5)
            raise InputError(f"{name}: is no parameter of {', '.join(executables)}; " + (f"write {near[0]}." if near else "leave it out."))


def typed(texts):
    """{name: value} of {name: text} as they come on a command line; empty ones are left out."""
    kinds = {"true": True, "false": False}
    return {name: kinds.get(text, text) for name, text in texts.items() if text != ""}


def _beside(path, file):
    """A path that a file names, relative to that file."""
    return str(Path(path).parent / file)
