# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print a correction as C99: single precision, no memory of its own, libm only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
import re
from typing import Any

import numpy as np

from .graph import Pieces
from .scalars import Dense, Program, Scalar, needed

LONGEST = 72  # characters of an expression that is not given a name
OPERATORS = {
    "add": "+",
    "sub": "-",
    "mul": "*",
    "div": "/",
    "lt": "<",
    "le": "<=",
    "eq": "==",
    "and": "&&",
    "or": "||",
}
FUNCTIONS = {
    "abs": "fabsf",
    "sqrt": "sqrtf",
    "exp": "expf",
    "log": "logf",
    "sin": "sinf",
    "cos": "cosf",
    "floor": "floorf",
    "atan2": "atan2f",
    "max": "larger",
    "min": "smaller",
}
HELPERS = {  # as numpy: NaN if one of the numbers is NaN
    "larger": "static inline float larger(float x, float y) { return x >= y || x != x ? x : y; }",
    "smaller": "static inline float smaller(float x, float y) { return x <= y || x != x ? x : y; }",
}
PIECES = """
/* A function of polynomials: its `count` + 1 breaks, then `terms` numbers of each piece. If all
   pieces are equally wide, `scale` is their number per unit, else 0. */
static float pieces(const float *table, int count, int terms, float scale, float x) {
    int low = 0;
    if (scale > 0.0f) {
        const float at = (x - table[0]) * scale;
        low = at < (float)count ? (at > 0.0f ? (int)at : 0) : count - 1;
    } else {
        for (int high = count; high - low > 1;) {
            const int middle = (low + high) / 2;
            if (x >= table[middle]) {
                low = middle;
            } else {
                high = middle;
            }
        }
    }
    const float width = table[low + 1] - table[low];
    const float *of = table + count + 1 + low * terms;
    float inside = x > table[low] ? x - table[low] : 0.0f;
    inside = inside > width ? width : inside;
    float value = of[terms - 1];
    for (int k = terms - 2; k >= 0; k--) {
        value = value * inside + of[k];
    }
    return x == x ? value : x;
}
"""
DENSE = """
static void dense(const float *weights, const float *biases, const float *x, int inputs,
                  float *out, int outputs, int rectify) {
    for (int k = 0; k < outputs; k++) {
        float sum = biases[k];
        for (int i = 0; i < inputs; i++) {
            sum += x[i] * *weights++;
        }
        out[k] = rectify && sum <= 0.0f ? 0.0f : sum;
    }
}
"""
PER_LINE = 6  # numbers


def number(value: float | np.floating) -> str:
    """Return a float32 as a constant of C, exactly."""
    value = np.float32(value)
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    text = f"{value:.9g}"
    return f"{text}{'' if '.' in text or 'e' in text else '.0'}f"


def listed(values: Iterable[float | np.floating], indent: str = "    ") -> str:
    """Return numbers as the lines of an initializer."""
    numbers = [number(value) for value in values]
    rows = [numbers[k : k + PER_LINE] for k in range(0, len(numbers), PER_LINE)]
    return ",\n".join(indent + ", ".join(row) for row in rows)


class Printer:
    """Print the functions and tables of Programs with the same anchors.

    Attributes
    ----------
    anchors, pairs : bytes of (N,) and (N, N) float32, rows of the tables
    networks, pieces : those that are called
    used : names of FUNCTIONS that were printed
    inputs : names of inputs that are read
    """

    def __init__(self, members: dict[str, str]) -> None:
        """Start without a function.

        members : {name of an input: member of the state, as "position[0]"}
        """
        self._members = members
        self.anchors: list[bytes] = []
        self.pairs: list[bytes] = []
        self.networks: list[Dense] = []
        self.pieces: list[Pieces] = []
        self.used: set[str] = set()
        self.inputs: set[str] = set()

    def function(self, name: str, program: Program) -> str:
        """Return a function that writes the outputs of a Program to `out`.

        Its signature is (int a, int b, const uwb_bias_state *s, float out[]). What is the same for
        both anchors becomes a function of one anchor.
        """
        return _Function(self, name, program).text()

    def tables(self, count: int) -> str:
        """Return the definitions of all tables and networks. count : N, number of anchors."""
        parts = []
        if self.anchors:
            rows = np.stack([np.frombuffer(row, np.float32) for row in self.anchors], axis=1)
            lines = ",\n".join(f"    {{\n{listed(row, '        ')}}}" for row in rows)
            size = f"[{count}][{len(self.anchors)}]"
            parts.append(f"static const float of_anchor{size} = {{\n{lines}}};\n")
        if self.pairs:
            blocks = []
            for pair in self.pairs:
                table = np.frombuffer(pair, np.float32).reshape(count, count)
                inner = ",\n".join(f"        {{\n{listed(row, ' ' * 12)}}}" for row in table)
                blocks.append(f"    {{\n{inner}}}")
            size = f"[{len(self.pairs)}][{count}][{count}]"
            lines = ",\n".join(blocks)
            parts.append(f"static const float of_pair{size} = {{\n{lines}}};\n")
        parts += [_pieces(k, one) for k, one in enumerate(self.pieces)]
        parts += [_network(k, one) for k, one in enumerate(self.networks)]
        return "\n".join(parts)

    def helpers(self) -> str:
        """Return the definitions of functions that C does not have."""
        parts = [HELPERS[name] for name in sorted(self.used & set(HELPERS))]
        parts += [PIECES] if self.pieces else []
        parts += [DENSE] if self.networks else []
        return "".join(f"{part}\n" for part in parts)

    def member(self, name: str) -> str:
        """Return the expression of an input."""
        self.inputs.add(name)
        return f"s->{self._members[name]}"


class _Function:
    """A Program as a function, and as one of a single anchor."""

    def __init__(self, printer: Printer, name: str, program: Program) -> None:
        self._printer, self._name, self._program = printer, name, program
        self._scalars = program.scalars
        self._uses = Counter(k for one in self._scalars for k in one.inputs)
        self._uses.update(program.outputs)
        self._of_ends = ends_of(self._scalars)
        self._twins = twins(self._scalars, self._of_ends)  # {place at a: place at b}
        self._split()

    def _split(self) -> None:
        """Find which Scalars are computed in the function of one anchor, and what passes."""
        self._one = {*self._twins, *self._twins.values()}
        main = [k for k in range(len(self._scalars)) if k not in self._one]
        from_main = {i for k in main for i in self._scalars[k].inputs} | set(self._program.outputs)
        back = {b: a for a, b in self._twins.items()}
        roots = sorted({back.get(k, k) for k in from_main & self._one})
        self._roots = {a: k for k, a in enumerate(roots)}
        inner = needed(self._scalars, self._roots)
        self._inner = [k for k in inner if k in self._one]
        shared = {
            i
            for k in self._inner
            for i in self._scalars[k].inputs
            if i not in self._one and not _is_leaf(self._scalars[i])
        }
        self._shared = {k: number for number, k in enumerate(sorted(shared))}
        self._main = main

    def text(self) -> str:
        """Return the C of the function, after that of one anchor."""
        parts = []
        if self._roots:
            parts.append(self._of_one_anchor())
        parts.append(self._whole())
        return "\n".join(parts)

    def _of_one_anchor(self) -> str:
        known = {k: f"shared[{number}]" for k, number in self._shared.items()}
        lines = self._statements(self._inner, known, {"a": "of", "b": "of"}, set(self._roots))
        lines += [f"out[{number}] = {known[k]};" for k, number in self._roots.items()]
        head = (
            f"static void {self._name}_at_anchor(const float *of, const uwb_bias_state *s,\n"
            "    const float *shared, float *out)"
        )
        return _body(head, lines, ("of", "s", "shared"))

    def _whole(self) -> str:
        known: dict[int, str] = {}
        lines = []
        first = [k for k in self._main if k in needed(self._scalars, self._shared)]
        tables = {"a": "of_a", "b": "of_b"}
        if any(one.kind == "anchor" for one in self._scalars):
            lines += [f"const float *of_{end} = of_anchor[{end}];" for end in "ab"]
        lines += self._statements(first, known, tables, set(self._shared))
        if self._roots:
            size = len(self._roots)
            lines.append(f"float at_a[{size}], at_b[{size}];")
            shared = "0"
            if self._shared:
                values = ", ".join(known[k] for k in self._shared)
                lines.append(f"const float shared[] = {{{values}}};")
                shared = "shared"
            lines += [f"{self._name}_at_anchor(of_{e}, s, {shared}, at_{e});" for e in "ab"]
        for a, number in self._roots.items():
            known[a], known[self._twins[a]] = f"at_a[{number}]", f"at_b[{number}]"
        rest = [k for k in self._main if k not in first]
        lines += self._statements(rest, known, tables, set())
        lines += [f"out[{k}] = {known[place]};" for k, place in enumerate(self._program.outputs)]
        head = f"static void {self._name}(int a, int b, const uwb_bias_state *s, float *out)"
        return _body(head, lines, ("a", "b", "s", "of_a", "of_b"))

    def _statements(
        self, places: Sequence[int], known: dict[int, str], tables: dict[str, str], kept: set[int]
    ) -> list[str]:
        """Return statements that compute some Scalars; their expressions are added to known."""
        lines: list[str] = []
        for k in places:
            one = self._scalars[k]
            for i in one.inputs:
                if i not in known:  # a leaf
                    known[i] = self._expression(self._scalars[i], known, tables)
            if k in known:
                continue
            if one.kind == "network":
                self._call(k, one, known, lines)
                continue
            text = self._expression(one, known, tables)
            is_operation = not _is_leaf(one) and one.kind not in (*FUNCTIONS, "pieces")
            inline = f"({text})" if is_operation else text
            named = k in kept or self._uses[k] > 1 or len(inline) > LONGEST
            if _is_leaf(one) or not named:
                known[k] = inline
                continue
            kind = "int" if one.is_bool else "float"
            known[k] = f"v{k}"
            lines.append(f"const {kind} v{k} = {text};")
        return lines

    def _call(self, place: int, one: Scalar, known: dict[int, str], lines: list[str]) -> None:
        """Append a call of a network, once for all its outputs."""
        network, output = one.value
        number_of = _place(self._printer.networks, network)
        outputs = len(network.layers[-1][1])
        call = f"network_{number_of}(x_{number_of}, y_{number_of});"
        if call not in lines:
            inputs = ", ".join(known[i] for i in one.inputs)
            lines.append(f"const float x_{number_of}[] = {{{inputs}}};")
            lines.append(f"float y_{number_of}[{outputs}];")
            lines.append(call)
        if output < outputs:
            known[place] = f"y_{number_of}[{output}]"
        else:
            known[place] = number(network.constants[output - outputs])

    def _expression(self, one: Scalar, known: dict[int, str], tables: dict[str, str]) -> str:
        """Return the C of one operation, without parentheses around it."""
        printer = self._printer
        if one.kind == "input":
            return printer.member(one.value)
        if one.kind == "constant":
            return number(one.value)
        if one.kind == "anchor":
            end, row = one.value
            return f"{tables[end]}[{_place(printer.anchors, row)}]"
        if one.kind == "pair":
            return f"of_pair[{_place(printer.pairs, one.value)}][a][b]"
        inputs = [known[i] for i in one.inputs]
        if one.kind in OPERATORS:
            return f"{inputs[0]} {OPERATORS[one.kind]} {inputs[1]}"
        if one.kind == "neg":
            return f"-{inputs[0]}"
        if one.kind == "not":
            return f"!{inputs[0]}"
        if one.kind == "where":
            return f"{inputs[0]} ? {inputs[1]} : {inputs[2]}"
        if one.kind == "pieces":
            number_of = _place(printer.pieces, one.value)
            count, terms = np.shape(one.value.table)
            scale = number(one.value.scale)
            return f"pieces(pieces_{number_of}, {count}, {terms}, {scale}, {inputs[0]})"
        name = FUNCTIONS[one.kind]
        printer.used.add(name)
        return f"{name}({', '.join(inputs)})"


def ends_of(scalars: Sequence[Scalar]) -> list[frozenset[str]]:
    """Return on which anchors, "a" and "b", each Scalar depends."""
    out: list[frozenset[str]] = []
    for one in scalars:
        ends = {"a", "b"} if one.kind == "pair" else set()
        if one.kind == "anchor":
            ends = {one.value[0]}
        out.append(frozenset(ends).union(*(out[i] for i in one.inputs)))
    return out


def twins(scalars: Sequence[Scalar], ends: Sequence[frozenset[str]]) -> dict[int, int]:
    """Return {place of a Scalar of anchor a: place of the same function of anchor b}."""
    known: dict[tuple[object, ...], dict[str, int]] = {}
    functions: list[object] = []
    for k, one in enumerate(scalars):
        if len(ends[k]) != 1:
            functions.append(k)
            continue
        value = ("anchor", one.value[1]) if one.kind == "anchor" else str(one.value)
        key = one.kind, tuple(functions[i] for i in one.inputs), value
        (end,) = ends[k]
        known.setdefault(key, {})[end] = k
        functions.append(("function", list(known).index(key)))
    return {
        both["a"]: both["b"]
        for key, both in known.items()
        if len(both) == 2 and key[0] not in ("anchor", "network")
    }


def _place(known: list[Any], value: Any) -> int:
    """Return the place of a value in a list, to which it is added unless it is there."""
    if value not in known:
        known.append(value)
    return known.index(value)


def _is_leaf(one: Scalar) -> bool:
    return not one.inputs


def _body(head: str, lines: Sequence[str], unused: Iterable[str]) -> str:
    """Return a function. unused : names that may be unused."""
    silent = [f"(void){name};" for name in unused if not any(_names(name, line) for line in lines)]
    declared = [name for name in silent if name[6:-1] in head]
    text = "".join(f"    {line}\n" for line in (*declared, *lines))
    return f"{head} {{\n{text}}}\n"


def _names(name: str, line: str) -> bool:
    return re.search(rf"\b{name}\b", line) is not None


def _pieces(number_of: int, pieces: Pieces) -> str:
    """Return the table of a function of pieces."""
    values = np.concatenate([pieces.breaks, np.ravel(pieces.table)])
    return f"static const float pieces_{number_of}[{len(values)}] = {{\n{listed(values)}}};\n"


def _network(number_of: int, network: Dense) -> str:
    """Return the weights and the function of a network."""
    parts, calls = [], []
    source, n = "x", len(network.layers)
    for k, (weights, biases, activation) in enumerate(network.layers):
        name = f"layer_{number_of}_{k}"
        inputs, outputs = weights.shape
        parts.append(f"static const float {name}_bias[{outputs}] = {{\n{listed(biases)}}};")
        rows = ",\n".join(f"    {{\n{listed(row, '        ')}}}" for row in weights.T)
        parts.append(f"static const float {name}[{outputs}][{inputs}] = {{\n{rows}}};")
        into = "out" if k == n - 1 else f"h[{k % 2}]"
        relu = "1" if activation else "0"
        calls.append(
            f"dense({name}[0], {name}_bias, {source}, {inputs}, {into}, {outputs}, {relu});"
        )
        source = into
    parts.append(
        f"static void network_{number_of}(const float *x, float *out) {{\n"
        f"    float h[2][{network.widest}];\n" + "".join(f"    {call}\n" for call in calls) + "}\n"
    )
    return "\n".join(parts)
