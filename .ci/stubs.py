# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write type stubs of ROS messages and services for mypy, from their installed classes.

The classes are generated from the .msg and .srv files, and hold the type of each field.
usage: python .ci/stubs.py FOLDER, in a workspace that is sourced
"""

from importlib import import_module
from pathlib import Path
import re
import sys

from rosidl_parser.definition import AbstractGenericString, Array, BasicType, NamespacedType

ROOT = Path(__file__).resolve().parents[1]
IMPORT = re.compile(r"^ *from (\w+)\.(msg|srv) import ", re.MULTILINE)
USE = re.compile(r"\b(\w+)\.(msg|srv)\.")
SCALARS = {"boolean": "bool", "octet": "bytes", "float": "float", "double": "float"}
NO_ARRAYS = (
    "boolean",
    "octet",
)  # Python keeps several of these in a list, other numbers in an array
HEADER = """# Written by .ci/stubs.py.
from array import array
from collections.abc import Sequence
from typing import ClassVar, TypeAlias

import numpy as np
"""


def main(folder):
    """Write the stubs of all packages that the sources import, and of those that these need."""
    waiting, done = set(), set()
    for path in ROOT.glob("src/*/*/**/*.py"):
        waiting |= set(IMPORT.findall(path.read_text()))
    while waiting:
        package, kind = waiting.pop()
        done.add((package, kind))
        lines = module_lines(import_module(f"{package}.{kind}"))
        needed = set(USE.findall("\n".join(lines)))
        imports = [f"import {other}.{its_kind}" for other, its_kind in sorted(needed)]
        path = folder / package / kind / "__init__.pyi"
        path.parent.mkdir(parents=True, exist_ok=True)
        (folder / package / "__init__.pyi").touch()
        path.write_text("\n".join([HEADER + "\n".join(imports), *lines, ""]))
        waiting |= needed - done


def module_lines(module):
    """Return the lines of the stub of a module of messages, or of services."""
    lines = []
    for one in vars(module).values():
        if hasattr(one, "SLOT_TYPES"):
            lines += class_lines(one)
        elif hasattr(one, "Request"):
            parts = ("Request", "Response")
            lines += [f"class {one.__name__}:"]
            lines += [f"    {part}: TypeAlias = {one.__name__}_{part}" for part in parts]
    return lines


def class_lines(message):
    """Return the lines of the stub of a message class."""
    lines, arguments = [f"class {message.__name__}:"], ["self"]
    constants = getattr(type(message), f"_{type(message).__name__}__constants")
    for name, value in constants.items():
        lines.append(f"    {name}: ClassVar[{type(value).__name__}]")
    for name, kind in zip(message.get_fields_and_field_types(), message.SLOT_TYPES):
        returned, accepted = types_of(kind)
        arguments.append(f"{name}: {accepted} = ...")
        if returned == accepted:
            lines.append(f"    {name}: {returned}")
            continue
        lines += ["    @property", f"    def {name}(self) -> {returned}: ..."]
        lines += [f"    @{name}.setter", f"    def {name}(self, value: {accepted}) -> None: ..."]
    if len(arguments) > 1:
        arguments.insert(1, "*")
    return [*lines, f"    def __init__({', '.join(arguments)}) -> None: ..."]


def types_of(kind):
    """Return the type of the value of a field, and the types that it can be set to."""
    if isinstance(kind, BasicType):
        scalar = SCALARS.get(kind.typename, "int")
        return scalar, scalar
    if isinstance(kind, AbstractGenericString):
        return "str", "str"
    if isinstance(kind, NamespacedType):
        name = ".".join([*kind.namespaces, kind.name])
        return name, name
    element, _ = types_of(kind.value_type)
    if not isinstance(kind.value_type, BasicType) or kind.value_type.typename in NO_ARRAYS:
        return f"list[{element}]", f"Sequence[{element}]"
    several = "np.ndarray" if isinstance(kind, Array) else f"array[{element}]"
    return several, f"Sequence[{element}] | array[{element}] | np.ndarray"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
