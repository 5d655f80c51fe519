# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A safe subset of YAML: anything ambiguous is refused with its line.

It reads mappings, lists, texts, finite numbers, true, false and null. The rules are those of the
core schema of YAML 1.2, with yes, no, on and off as in ROS. It refuses tags, aliases (as ROS does),
repeated keys, a second document, and numbers that are not finite.
"""

from __future__ import annotations

import math
from pathlib import Path
import re
from typing import Any

import yaml
from yaml import CollectionNode, MappingNode, Mark, Node, ScalarNode
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

from .errors import YAML_BYTES, YAML_DEPTH, YAML_NODES, Budget, InputError
from .files import open_file


def read_yaml(path: str | Path) -> Any:
    """Return the content of a YAML file: dict, list, str, int, float, bool or None.

    Raises InputError that names file and line.
    """
    try:
        with open_file(path) as file:
            data = file.read(YAML_BYTES + 1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read as YAML ({error.strerror}); give the path of a YAML file."
        ) from error
    Budget(path).spend("bytes", len(data), YAML_BYTES)
    return parse_yaml(data, path)


def parse_yaml(data: bytes | str, name: str | Path, texts: bool = False) -> Any:
    """Return the content of YAML text or bytes, as `read_yaml`.

    name : for messages; texts : return numbers that are not whole, yes and no as texts: ids such as
    1E10 and NO are names
    """
    try:
        text = data.decode("utf-8-sig") if isinstance(data, bytes) else data
    except UnicodeDecodeError as error:
        raise InputError(
            f"{name}: byte {error.start} is not UTF-8; save the file as UTF-8 text."
        ) from error
    try:
        loader = _Loader(text, Budget(name, len(text)), texts)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except _Refused as error:
        raise InputError(f"{name}: line {error.line}: {error}") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        said = " ".join(part for part in (error.context, error.problem) if part)
        line = min(mark.line, text.count("\n")) + 1  # libyaml reports the end one line too late
        raise InputError(f"{name}: line {line}: is no YAML ({said}); correct it there.") from error
    except yaml.YAMLError as error:
        raise InputError(
            f"{name}: is no YAML ({' '.join(str(error).split())}); give a YAML file."
        ) from error


class _Refused(Exception):
    def __init__(self, mark: Mark, sentence: str) -> None:
        super().__init__(sentence)
        self.line = mark.line + 1


class _WithLibyaml(Composer, SafeConstructor, Resolver):
    """A loader on the parser of libyaml, which reads 10 000 anchors in 1 s instead of 4 s.

    Python makes nodes and values here, where they are checked.
    """

    def __init__(self, text: str) -> None:
        self._parser = yaml.cyaml.CParser(text)
        self.check_event, self.peek_event, self.get_event = (
            self._parser.check_event,
            self._parser.peek_event,
            self._parser.get_event,
        )
        for base in (Composer, SafeConstructor, Resolver):
            base.__init__(self)

    def dispose(self) -> None:
        self._parser.dispose()


_Base: Any = _WithLibyaml if yaml.__with_libyaml__ else yaml.SafeLoader


class _Loader(_Base):
    yaml_implicit_resolvers: dict = {}  # YAML 1.1 would read 1:30 as 90, and 1e-3 as text

    def __init__(self, text: str, budget: Budget, texts: bool) -> None:
        super().__init__(text)
        self._budget, self._depth, self._texts = budget, 0, texts

    def compose_node(self, parent: CollectionNode | None, index: int | ScalarNode | None) -> Node:
        event = self.peek_event()
        self._budget.spend("entries", 1, YAML_NODES)
        self._depth += 1
        if isinstance(event, yaml.AliasEvent):
            raise _Refused(
                event.start_mark, f"*{event.anchor} is an alias; write the value itself."
            )
        if event.tag is not None:
            raise _Refused(event.start_mark, f"{event.tag} is a tag; leave it out.")
        if self._depth > YAML_DEPTH:
            self._budget.spend("levels", self._depth, YAML_DEPTH)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: MappingNode, deep: bool = False) -> dict[Any, Any]:
        content = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise _Refused(
                    key_node.start_mark,
                    "a list or mapping is used as a key; use a text or a number.",
                )
            is_text = key_node.tag in (f"{_TAG}float", f"{_TAG}bool")  # 1E10 and NO are names
            key = key_node.value if is_text else self.construct_object(key_node)
            if key in content:
                raise _Refused(key_node.start_mark, f"{key_node.value!r} is there twice; keep one.")
            content[key] = self.construct_object(value_node, deep)
        return content

    def construct_yaml_int(self, node: ScalarNode) -> int:
        text = node.value.lstrip("+-0")
        if len(text) > 19 or abs(int(node.value)) >= 2**63:
            raise _Refused(
                node.start_mark,
                f"{node.value[:40]} does not fit into 64 bits; give a smaller number.",
            )
        return int(node.value)

    def construct_yaml_float(self, node: ScalarNode) -> float | str:
        value = float(re.sub(r"\.(nan|inf)$", r"\1", node.value.lower()))
        if not math.isfinite(value):
            raise _Refused(node.start_mark, f"{node.value[:40]} is not finite; give a number.")
        return node.value if self._texts else value

    def construct_yaml_bool(self, node: ScalarNode) -> bool | str:
        return node.value if self._texts else super().construct_yaml_bool(node)


_TAG = "tag:yaml.org,2002:"
_IMPLICIT = {
    "bool": (
        r"yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF",
        "yYnNtTfFoO",
    ),
    # 010 is a text: YAML 1.1 reads it as 8, YAML 1.2 as 10.
    "int": (r"[-+]?(0|[1-9][0-9]*)", "-+0123456789"),
    "float": (
        r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
}
for _name, (_pattern, _first) in _IMPLICIT.items():
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(f"^(?:{_pattern})$"), list(_first))
_Loader.add_constructor(_TAG + "int", _Loader.construct_yaml_int)
_Loader.add_constructor(_TAG + "float", _Loader.construct_yaml_float)
_Loader.add_constructor(_TAG + "bool", _Loader.construct_yaml_bool)
