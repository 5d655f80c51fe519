# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A copy of the filter whose constants and rules are read from one table while it runs.

Compiled code freezes its constants, and compiling it takes minutes. So the sources are copied once.
Each constant in a compiled function becomes a load from a table at a fixed address. Each rule reads
from that table whether it is on. A variant is then a number in the table.
"""

from __future__ import annotations

import ast
import ctypes
from dataclasses import dataclass
from functools import cache
import hashlib
import importlib
import mmap
from pathlib import Path
import shutil

from uwb_tdoa_bias.common.files import write_text
import uwb_tdoa_ekf

from .catalogue import COUNTS, RULES, STRUCTURE, Rule

ADDRESS, SIZE = 0x5A0000000000, 1 << 16  # of the table: bytes
FIRST_RULE = 4096  # place of the first rule, behind all constants
PACKAGE = "uwb_tdoa_ekf"
FOLDERS = "core", "monitoring"  # with compiled functions
LOADS = '''"""Loads from the table of the study `rules`."""

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

_I64, _F64 = ir.IntType(64), ir.DoubleType()


def _load(builder, place):
    address = builder.add(ir.Constant(_I64, {address}), builder.mul(place, ir.Constant(_I64, 8)))
    return builder.load(builder.inttoptr(address, _F64.as_pointer()))


@intrinsic
def tuned_number(typingctx, place):
    def codegen(context, builder, signature, args):
        return _load(builder, args[0])

    return types.float64(types.int64), codegen


@intrinsic
def tuned_count(typingctx, place):
    def codegen(context, builder, signature, args):
        return builder.fptosi(_load(builder, args[0]), _I64)

    return types.int64(types.int64), codegen


@intrinsic
def tuned_on(typingctx, place):
    def codegen(context, builder, signature, args):
        return builder.fcmp_ordered("!=", _load(builder, args[0]), ir.Constant(_F64, 0.0))

    return types.boolean(types.int64), codegen
'''


@dataclass(frozen=True)
class Entry:
    """What the table holds from a place on. name : of a constant, "plane.PERIOD", or of a rule;
    values : as they are, 1.0 for a rule that is on; is_count : they are whole numbers.
    """

    name: str
    place: int
    values: tuple[float, ...]
    is_count: bool = False


@dataclass(frozen=True)
class Tuned:
    """A copy in `folder`, to be imported before the original; constants and rules in its table."""

    folder: Path
    constants: tuple[Entry, ...]
    rules: tuple[Entry, ...]

    @property
    def core(self) -> tuple[Entry, ...]:
        """The constants of the core."""
        return tuple(one for one in self.constants if not one.name.startswith("monitoring."))

    @property
    def initial(self) -> list[float]:
        """All values of the table, as they are."""
        table = [0.0] * (FIRST_RULE + len(self.rules))
        for entry in (*self.constants, *self.rules):
            table[entry.place : entry.place + len(entry.values)] = entry.values
        return table


def copy_to(cache: Path, rules: tuple[Rule, ...] = RULES) -> Tuned:
    """Write the copy below `cache`, in a folder that is named after its content. Raises ValueError
    if a Rule is not where the catalogue says.
    """
    source = Path(uwb_tdoa_ekf.__file__).resolve().parent
    table = _Table()
    files = {}
    for folder in FOLDERS:
        for path in sorted((source / folder).glob("*.py")):
            module = f"{folder}.{path.stem}"
            changed = _Copy(module, _tree(module), table).changed(rules)
            if changed is not None:
                files[f"{folder}/{path.name}"] = ast.unparse(changed)
    missing = [rule.name for rule in rules if rule.name not in table.rules]
    if missing:
        raise ValueError(f"the core has no such place: {', '.join(missing)}; see catalogue.py")
    files["core/_tuned.py"] = LOADS.format(address=ADDRESS)
    digest = hashlib.sha256(repr(sorted(files.items())).encode())
    for path in sorted(source.rglob("*.py")):
        digest.update(path.read_bytes())
    folder = cache / digest.hexdigest()[:16]
    if not folder.is_dir():
        part = cache / f"{folder.name}.part"
        shutil.rmtree(part, ignore_errors=True)
        leave = shutil.ignore_patterns("__pycache__")
        shutil.copytree(source, part / PACKAGE, ignore=leave)
        for name, text in files.items():
            write_text(part / PACKAGE / name, text)
        part.rename(folder)
    return Tuned(folder, tuple(table.constants.values()), tuple(table.rules.values()))


class Live:
    """The table in the memory of this process."""

    def __init__(self, tuned: Tuned) -> None:
        """Map it, with all values as they are. Raises OSError if the address is taken."""
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        libc.mmap.argtypes = (
            [ctypes.c_void_p, ctypes.c_size_t] + 3 * [ctypes.c_int] + [ctypes.c_long]
        )
        fixed = 0x100000  # MAP_FIXED_NOREPLACE
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | fixed
        at = libc.mmap(ADDRESS, SIZE, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)
        if at != ADDRESS:
            raise OSError(ctypes.get_errno(), "the address of the table is taken")
        self._constants = tuned.constants
        self._initial = tuned.initial
        self._values = (ctypes.c_double * len(self._initial)).from_address(ADDRESS)
        self.restore()

    def restore(self) -> None:
        """All constants as they are, and all rules on."""
        self._values[:] = self._initial

    def switch_off(self, rule: Entry) -> None:
        """Let a rule not apply."""
        self._values[rule.place] = 0.0

    def nudge(self, factor: float) -> None:
        """Multiply all constants that are no counts."""
        for entry in self._constants:
            if not entry.is_count:
                self.scale(entry, factor)

    def scale(self, constant: Entry, factor: float) -> bool:
        """Multiply a constant. Returns False if it stays what it is: 0, or a count that is rounded."""
        for k, value in enumerate(constant.values):
            scaled = factor * value
            if constant.is_count:
                scaled = float(max(1, round(scaled)))
            self._values[constant.place + k] = scaled
        places = range(constant.place, constant.place + len(constant.values))
        return any(self._values[k] != self._initial[k] for k in places)


class _Table:
    def __init__(self) -> None:
        self.constants: dict[str, Entry] = {}
        self._rules: list[str] = []

    @property
    def rules(self) -> dict[str, Entry]:
        """Entries of the rules, behind all constants."""
        return {name: Entry(name, FIRST_RULE + k, (1.0,)) for k, name in enumerate(self._rules)}

    def place_of(self, name: str, values: tuple[float, ...], is_count: bool) -> int:
        if name not in self.constants:
            place = sum(len(entry.values) for entry in self.constants.values())
            self.constants[name] = Entry(name, place, values, is_count)
        return self.constants[name].place

    def place_of_rule(self, rule: Rule) -> int:
        if rule.name not in self._rules:
            self._rules.append(rule.name)
        return FIRST_RULE + self._rules.index(rule.name)


class _Copy(ast.NodeTransformer):
    """Of one module of the core."""

    def __init__(self, module: str, tree: ast.Module, table: _Table) -> None:
        self._module, self._tree, self._table = module, tree, table
        self._names: dict[str, tuple[str, str]] = {}  # as they are called here: module, name
        self._modules: dict[str, str] = {}
        self._definitions: dict[str, ast.expr] = {}
        self._rules: list[tuple[Rule, str]] = []
        self._inside = False
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.level:
                folder = f"{module.split('.')[0]}." if node.level == 1 else ""
                for alias in node.names:
                    called = alias.asname or alias.name
                    if node.module is None:
                        self._modules[called] = folder + alias.name
                    else:
                        self._names[called] = folder + node.module, alias.name
            elif isinstance(node, ast.Assign):
                if isinstance(node.targets[0], ast.Name):
                    self._definitions[node.targets[0].id] = node.value
                for target in ast.walk(node):
                    if isinstance(target, ast.Name) and isinstance(target.ctx, ast.Store):
                        self._names[target.id] = module, target.id

    def changed(self, rules: tuple[Rule, ...]) -> ast.Module | None:
        """The module with its loads, None if it has no compiled function."""
        if not any(_is_compiled(node) for node in self._tree.body):
            return None
        self._all = [rule for rule in rules if f"core.{rule.module}" == self._module]
        tree = self.visit(self._tree)
        first = next(
            k
            for k, node in enumerate(tree.body)
            if not (isinstance(node, ast.Expr) or _is_future(node))
        )
        loads = ast.parse("from ..core._tuned import tuned_count, tuned_number, tuned_on").body
        tree.body[first:first] = loads
        return ast.fix_missing_locations(tree)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        if not _is_compiled(node):
            return node
        self._rules = [
            (rule, _normal(rule.place)) for rule in self._all if rule.function in (node.name, "")
        ]
        self._inside = True
        node.body = [self.visit(part) for part in node.body]
        self._inside = False
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.stmt:
        """A statement that calls what a rule is."""
        rule = self._rule_of(node.value)
        if rule is None:
            return self.generic_visit(node)
        inner = ast.Expr(self.generic_visit(node.value))
        return ast.If(self._on(rule), [inner], [])

    def visit(self, node: ast.AST) -> ast.AST:
        if not self._inside or not isinstance(node, ast.expr) or isinstance(node, ast.Constant):
            return super().visit(node)
        if isinstance(getattr(node, "ctx", None), (ast.Store, ast.Del)):
            return self.generic_visit(node)
        rule = self._rule_of(node)
        constant = self._constant(node)
        if constant is not None:
            return constant
        if rule is None:
            return super().visit(node)
        self._rules.remove((rule, _normal(rule.place)))
        kept = self.visit(node)
        instead = self.visit(ast.parse(rule.instead, mode="eval").body)
        self._rules.append((rule, _normal(rule.place)))
        return ast.IfExp(self._on(rule), kept, instead)

    def _rule_of(self, node: ast.expr) -> Rule | None:
        text = ast.unparse(node)
        return next((rule for rule, place in self._rules if place == text), None)

    def _on(self, rule: Rule) -> ast.expr:
        return ast.parse(f"tuned_on({self._table.place_of_rule(rule)})", mode="eval").body

    def derived(self, name: str) -> ast.expr | None:
        """What computes a constant of this module that follows from others: NIS = GATE**2."""
        definition = self._definitions.get(name)
        if definition is None:
            return None
        names = [node.id for node in ast.walk(definition) if isinstance(node, ast.Name)]
        if not names or not all(_is_tuned(*self._names.get(one, ("", one))) for one in names):
            return None
        self._inside = True
        return self.visit(definition)

    def _constant(self, node: ast.expr) -> ast.expr | None:
        """What loads a constant, where node is one."""
        if isinstance(node, ast.Name) and node.id in self._names:
            module, name = self._names[node.id]
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in self._modules
        ):
            module, name = self._modules[node.value.id], node.attr
        else:
            return None
        derived = _Copy(module, _tree(module), self._table).derived(name)
        if derived is not None:
            return derived
        if not _is_tuned(module, name):
            return None
        value = _value(module, name)
        values = value if isinstance(value, tuple) else (value,)
        is_count = all(type(one) is int for one in values)
        place = self._table.place_of(_key(module, name), tuple(map(float, values)), is_count)
        load = "tuned_count" if is_count else "tuned_number"
        parts = [f"{load}({place + k})" for k in range(len(values))]
        text = parts[0] if not isinstance(value, tuple) else f"({', '.join(parts)},)"
        return ast.parse(text, mode="eval").body


@cache
def _source(module: str) -> str:
    path = Path(uwb_tdoa_ekf.__file__).resolve().parent / f"{module.replace('.', '/')}.py"
    return path.read_text() if path.exists() else ""


def _tree(module: str) -> ast.Module:
    """A tree of a module of the package, to be changed. For other modules, it is empty."""
    return ast.parse(_source(module))


def _key(module: str, name: str) -> str:
    """Name of a constant, "plane.PERIOD" of the core or "monitoring.change.OUTLIER"."""
    return f"{module}.{name}".removeprefix("core.")


def _is_tuned(module: str, name: str) -> bool:
    """Whether a name is a number, or some, that were chosen: no size, and no property of nature."""
    value, key = _value(module, name), _key(module, name)
    values = value if isinstance(value, tuple) else (value,)
    if key in STRUCTURE or not values or not all(type(one) in (int, float) for one in values):
        return False
    if any(one == float("inf") for one in values):
        return False
    return key in COUNTS or not all(type(one) is int for one in values)


def _value(module: str, name: str) -> object:
    try:
        return getattr(importlib.import_module(f"{PACKAGE}.{module}"), name, None)
    except ModuleNotFoundError:
        return None


def _is_compiled(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(one, ast.Name) and one.id == "compiled" for one in node.decorator_list
    )


def _is_future(node: ast.stmt) -> bool:
    return isinstance(node, ast.ImportFrom) and node.module == "__future__"


def _normal(text: str) -> str:
    return ast.unparse(ast.parse(text, mode="eval"))
