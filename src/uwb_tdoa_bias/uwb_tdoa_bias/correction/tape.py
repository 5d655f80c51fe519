"""A small ONNX graph as a tape of operations on rows of numbers, which one compiled function plays.

A graph comes from anywhere. So the operators are those of a list, each row of the output follows from one row of the input, and what
is held and done for a row is bounded (`limits`) before anything is played. What a tape cannot hold is Unplayable. Where a model has
an operator of OF_RUNTIME, the tape tells how large it is, and onnxruntime plays it, which takes three times as long for one row.
"""

import math

import numpy as np

from ..foundation.compiled import compiled, contracted
from ..foundation.limits import MODEL_NODES, MODEL_NUMBERS, MODEL_WORK

BATCH = 16  # rows of the input that are played together: what they need stays in the cache
NOTHING_BELOW = np.float32(-40.0)  # exp of which is 0 here: numbers that float32 cannot hold well take a hundred times as long
UNARY = "Identity", "Abs", "Neg", "Exp", "Log", "Sqrt", "Sin", "Cos", "Tanh", "Relu", "Sigmoid", "Erf", "Softplus"
BINARY = "Add", "Sub", "Mul", "Div", "Max", "Min"
GATHER, ROW_SUM, ROW_MAX, MATMUL = range(len(UNARY) + len(BINARY), len(UNARY) + len(BINARY) + 4)
CODES = {name: code for code, name in enumerate(UNARY + BINARY)}
OTHERS = "Sum", "MatMul", "Gemm", "Gather", "Reshape", "Concat", "ReduceSum", "ReduceMax", "LeakyRelu", "Clip", "Constant"
# Of each element, or of each row: as many numbers come out as go in. Their order among the columns is the only attribute with a say.
OF_RUNTIME = "Elu", "Selu", "Celu", "HardSigmoid", "Softsign", "Softmax", "LogSoftmax", "Reciprocal", "Floor", "Ceil", "Sign"
(IDENTITY, ABS, NEG, EXP, LOG, SQRT, SIN, COS, TANH, RELU, SIGMOID, ERF, SOFTPLUS, ADD, SUB, MUL, DIV, MAX, MIN) = range(19)

# One operation. An operand lies at fixed + per_row * (rows of the input), its element (i, j) at + i * row + j * column.
OPERATION = np.dtype(
    [
        ("code", int), ("rows", int), ("columns", int),  # of the result; rows for each row of the input
        ("fixed", int), ("per_row", int), ("row", int),  # where the result goes
        ("a_fixed", int), ("a_per_row", int), ("a_row", int), ("a_column", int),
        ("b_fixed", int), ("b_per_row", int), ("b_row", int), ("b_column", int),
        ("inner", int),  # columns of a, for sums and products
    ],
    align=True,
)  # fmt: skip


class Unplayable(ValueError):
    """The graph has an operator, or a use of one, that a tape does not know, or is too large."""


class Tape:
    """A model of small operators. inputs : [(name, shape)]; meta : {key: text}; complete : whether it can be played, or only tells how
    large the model is, as there are operators of OF_RUNTIME."""

    def __init__(self, graph):
        """graph : onnx_file.Graph; raises Unplayable."""
        if len(graph.inputs) != 1 or len(graph.outputs) != 1 or len(graph.inputs[0][1]) != 2:
            raise Unplayable("more than one input or output")
        self._constants, self._given, self._start, self._work = [], {}, 0, 0  # start : numbers of the constants, so far
        self.inputs, self.meta, self.complete = graph.inputs, graph.meta, True
        self._named, self._operations, self._used = dict(graph.constants), [], 0  # used : numbers for each row of the input, so far
        (name, (_, self.width)), self._values = graph.inputs[0], {}  # name: (place, columns, all numbers for each row)
        if not self.width:
            raise Unplayable("an input of unknown width")
        self._values[name] = self._room(self.width, self.width)
        for node in graph.nodes:
            try:
                self._add(node)
            except Unplayable:
                raise
            except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:  # an input or an attribute lacks or is none
                raise Unplayable(f"{node.kind[:40]!r} cannot be used so, {error!r}") from error
        place, self.outputs, numbers = self._value(graph.outputs[0])
        if numbers != self.outputs:
            raise Unplayable("an output with other rows than the input")
        constants = np.concatenate([np.empty(0, np.float32), *self._constants]).astype(np.float32)
        self._room_of_numbers = np.concatenate([constants, np.zeros(BATCH * self._used, np.float32)])
        self._operations = np.array(self._operations, OPERATION)
        for part in ("", "a_", "b_"):  # constants come first
            moving = self._operations[f"{part}fixed"] < 0
            self._operations[f"{part}fixed"] = np.where(moving, self._start, self._operations[f"{part}fixed"])
        self._output = place

    def run(self, x):
        """x (n, width) float -> (n, outputs) float."""
        out = np.empty((len(x), self.outputs))
        operations, room, start, place, _ = self.playable
        play(operations, room, start, x, place, out)
        return out

    @property
    def playable(self):
        """(operations, room of numbers, first of them that is no constant, place of the output, its columns), for `play`."""
        return self._operations, self._room_of_numbers, self._start, self._output, self.outputs

    def _room(self, columns, numbers):
        if columns < 1 or self._used + numbers > MODEL_NUMBERS:
            raise Unplayable(f"no column, or more than {MODEL_NUMBERS} numbers for each row")
        place, self._used = self._used, self._used + numbers
        return place, columns, numbers

    def _value(self, name):
        if name not in self._values:
            raise Unplayable(f"{name} is no value")
        return self._values[name]

    def _constant(self, name):
        if name not in self._named:
            raise Unplayable(f"{name} is no constant")
        return self._named[name]

    def _place_constant(self, name, array, turned=False):
        if (name, turned) not in self._given:
            self._given[name, turned] = self._start
            self._constants.append(array.ravel())
            self._start += array.size
        return self._given[name, turned]

    def _operand(self, name, columns):
        """(fixed, per_row, row, column) of a value, or of a constant that is the same for all rows, of so many columns or one."""
        if name in self._named:
            array = self._constant(name)
            if array.dtype != np.float32 or array.size not in (1, columns) or array.shape[:-1] not in ((), (1,)):
                raise Unplayable("a constant that differs between rows")
            return self._place_constant(name, array), 0, 0, int(array.size > 1)
        place, own, _ = self._value(name)
        if own not in (1, columns):
            raise Unplayable("columns that do not fit")
        return -1, place, own, int(own > 1)

    def _append(self, code, columns, rows, a, b=(0, 0, 0, 0), inner=0):
        """An operation. Returns its value."""
        value = self._room(columns, columns * rows)
        self._write((code, rows, columns, -1, value[0], value[1], *a, *b, inner))
        return value

    def _write(self, operation):
        code, rows, columns, *_, inner = operation
        self._work += rows * columns * (inner if code in (ROW_SUM, ROW_MAX, MATMUL) else 1)
        if self._work > MODEL_WORK or len(self._operations) >= MODEL_NODES:
            raise Unplayable(f"more than {MODEL_WORK} additions and multiplications for each row, or {MODEL_NODES} operations")
        self._operations.append(operation)

    def _add(self, node):
        kind, inputs = node.kind, node.inputs
        if kind in (*UNARY, *OF_RUNTIME):
            if node.attributes.get("axis", -1) not in (-1, 1):
                raise Unplayable("rows of the input that mix")
            self.complete &= kind in UNARY
            _, columns, numbers = self._value(inputs[0])
            made = self._append(CODES.get(kind, IDENTITY), columns, numbers // columns, self._operand(inputs[0], columns))
        elif kind in (*BINARY, "Sum"):
            made = self._elementwise("Add" if kind == "Sum" else kind, inputs)
        elif kind in ("MatMul", "Gemm"):
            made = self._product(node)
        elif kind == "Constant":
            self._named[node.outputs[0]] = np.asarray(node.attributes["value"])
            return
        elif kind in OTHERS:
            made = getattr(self, f"_{kind.lower()}")(node)
        else:
            raise Unplayable(f"operator {kind[:40]!r} is none of {', '.join((*UNARY, *BINARY, *OTHERS, *OF_RUNTIME))}")
        self._values[node.outputs[0]] = made

    def _elementwise(self, kind, inputs):
        if len(inputs) < 2:
            raise Unplayable("less than two operands")
        first, *others = inputs
        for other in others:
            values = [self._values[name] for name in (first, other) if name in self._values]
            rows = {numbers // columns for _, columns, numbers in values}
            sizes = [columns for _, columns, _ in values]
            sizes += [self._constant(name).size for name in (first, other) if name not in self._values]
            if len(rows) != 1:
                raise Unplayable("rows that do not fit")
            columns = max(sizes)
            operands = [self._operand(name, columns) for name in (first, other)]
            first = f"\0{len(self._operations)}"  # a name that none has
            self._values[first] = made = self._append(CODES[kind], columns, rows.pop(), *operands)
        return made

    def _product(self, node):
        options = {"alpha": 1.0, "beta": 1.0, "transA": 0} | node.attributes
        if (options.pop("alpha"), options.pop("beta"), options.pop("transA")) != (1.0, 1.0, 0) or {*options} - {"transB"}:
            raise Unplayable("a product that is scaled")
        _, inner, numbers = self._value(node.inputs[0])
        weights, turned = self._constant(node.inputs[1]), bool(options.get("transB"))
        weights = weights.T if turned else weights
        if weights.dtype != np.float32 or weights.ndim != 2 or len(weights) != inner:
            raise Unplayable("a product that does not fit")
        columns, rows = weights.shape[1], numbers // inner
        b = (self._place_constant(node.inputs[1], weights, turned), 0, columns, 1)
        made = self._append(MATMUL, columns, rows, self._operand(node.inputs[0], inner), b, inner)
        if len(node.inputs) > 2:
            self._values["\0"] = made
            made = self._append(ADD, columns, rows, self._operand("\0", columns), self._operand(node.inputs[2], columns))
        return made

    def _gather(self, node):
        _, own, numbers = self._value(node.inputs[0])
        columns = self._constant(node.inputs[1])
        if node.attributes.get("axis", 0) != 1 or columns.ndim != 1 or not ((0 <= columns) & (columns < own)).all():
            raise Unplayable("other than columns taken")
        b = (self._place_constant(node.inputs[1], columns.astype(np.float32)), 0, 0, 1)
        return self._append(GATHER, len(columns), numbers // own, self._operand(node.inputs[0], own), b)

    def _reshape(self, node):
        place, _, numbers = self._value(node.inputs[0])
        shape = self._constant(node.inputs[1]).tolist()
        if len(shape) != 2 or shape[0] != -1 or shape[1] < 1 or numbers % shape[1]:
            raise Unplayable("a shape in which rows of the input mix")
        return place, shape[1], numbers

    def _concat(self, node):
        parts = [self._value(name) for name in node.inputs]
        rows = {numbers // columns for _, columns, numbers in parts}
        if node.attributes.get("axis") not in (1, -1) or len(rows) != 1:
            raise Unplayable("rows that do not fit")
        rows, total, first = rows.pop(), sum(columns for _, columns, _ in parts), 0
        place, *_ = made = self._room(total, total * rows)
        for name, (_, columns, _) in zip(node.inputs, parts):
            operation = (IDENTITY, rows, columns, -1, place, total, *self._operand(name, columns), 0, 0, 0, 0, first)
            self._write(operation)
            first += columns
        return made

    def _leakyrelu(self, node):
        slope = np.float32([node.attributes.get("alpha", 0.01)])
        if not 0.0 <= slope <= 1.0:
            raise Unplayable("a slope that is not between 0 and 1")
        name = f"\0{len(self._operations)}"  # that none has
        self._named[f"{name}s"] = slope
        self._values[name] = self._elementwise("Mul", [node.inputs[0], f"{name}s"])
        return self._elementwise("Max", [node.inputs[0], name])

    def _clip(self, node):
        name, *limits = node.inputs
        for kind, limit in zip(("Max", "Min"), limits):
            if limit:
                made = self._elementwise(kind, [name, limit])
                name = f"\0{len(self._operations)}"  # that none has
                self._values[name] = made
        return self._value(name)

    def _reducesum(self, node):
        return self._reduced(node, ROW_SUM)

    def _reducemax(self, node):
        return self._reduced(node, ROW_MAX)

    def _reduced(self, node, code):
        _, own, numbers = self._value(node.inputs[0])
        axes = node.attributes.get("axes") or (self._constant(node.inputs[1]).tolist() if len(node.inputs) > 1 else None)
        if axes not in ([1], [-1]) or node.attributes.get("keepdims", 1) != 1:
            raise Unplayable("other than rows reduced")
        return self._append(code, 1, numbers // own, self._operand(node.inputs[0], own), inner=own)


@compiled
def play(operations, room, start, x, output, out):
    """`Tape.run`, compiled, of the parts of a Tape; x (n, width), out (n, outputs)."""
    width, columns = x.shape[1], out.shape[1]
    for first in range(0, len(x), BATCH):
        n = min(BATCH, len(x) - first)
        for i in range(n):
            for j in range(width):
                room[start + i * width + j] = x[first + i, j]
        for k in range(len(operations)):
            _operate(operations[k], room, n)
        for i in range(n):
            for j in range(columns):
                out[first + i, j] = room[start + n * output + i * columns + j]


@compiled
def _operate(o, room, n):
    code, columns, rows = o.code, o.columns, n * o.rows
    to, a, b = o.fixed + n * o.per_row, o.a_fixed + n * o.a_per_row, o.b_fixed + n * o.b_per_row
    if code == MATMUL:
        _multiply(room, to, a, o.a_row, b, rows, o.inner, columns)
        return
    step_a, step_b = _step(o.a_row, o.a_column, columns), _step(o.b_row, o.b_column, columns)
    if IDENTITY < code < GATHER and o.row == columns and step_a >= 0 and step_b >= 0 and (code != EXP or step_a == 1):
        _all_rows(code, room, a, step_a, b, step_b, room[to : to + rows * columns])
        return
    for i in range(rows):
        of_a, of_b = a + i * o.a_row, b + i * o.b_row
        row = room[to + i * o.row : to + i * o.row + columns]
        if code == EXP:
            _exponentials(room[of_a : of_a + columns], row)
        elif code == IDENTITY:  # inner : the first of the columns that it fills
            room[to + i * o.row + o.inner : to + i * o.row + o.inner + columns] = room[of_a : of_a + columns]
        elif code == GATHER:
            for j in range(columns):
                row[j] = room[of_a + int(room[b + j])]
        elif code == ROW_SUM or code == ROW_MAX:
            row[0] = _reduce(room[of_a : of_a + o.inner], code == ROW_SUM)
        elif code < ADD:
            for j in range(columns):
                row[j] = _unary(code, room[of_a + j * o.a_column])
        else:
            _pairwise(code, room, of_a, o.a_column, of_b, o.b_column, row)


@compiled
def _step(row, column, columns):
    """From one number of an operand to the next, over all rows: 1 if they lie side by side, 0 if it is the same; else -1."""
    if row == columns and (column == 1 or columns == 1):
        return 1
    return 0 if row == 0 and column == 0 else -1


@compiled
def _all_rows(code, room, a, step_a, b, step_b, out):
    """Of operands whose rows lie side by side, too: what a row costs beside its numbers is paid once."""
    if code >= ADD:
        _pairwise(code, room, a, step_a, b, step_b, out)
    elif code == EXP:
        _exponentials(room[a : a + len(out)], out)
    else:
        for j in range(len(out)):
            out[j] = _unary(code, room[a + j * step_a])


@contracted
def _multiply(room, to, a, a_row, b, rows, inner, columns):
    """Rows of a times the matrix b, both in `room`. Two rows of a and four of b at a time; each row is summed in the same order,
    whatever comes with it."""
    whole, sums = inner - inner % 4, np.empty((2, columns), np.float32)
    p, q = sums[0], sums[1]
    for i in range(0, rows, 2):
        second = min(i + 1, rows - 1)  # the last of an odd number goes twice
        x, y = room[a + i * a_row : a + i * a_row + inner], room[a + second * a_row : a + second * a_row + inner]
        sums[:] = np.float32(0.0)
        for k in range(0, whole, 4):
            w = room[b + k * columns : b + (k + 4) * columns]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            y0, y1, y2, y3 = y[k], y[k + 1], y[k + 2], y[k + 3]
            for j in range(columns):
                w0, w1, w2, w3 = w[j], w[columns + j], w[2 * columns + j], w[3 * columns + j]
                p[j] += (x0 * w0 + x1 * w1) + (x2 * w2 + x3 * w3)
                q[j] += (y0 * w0 + y1 * w1) + (y2 * w2 + y3 * w3)
        for k in range(whole, inner):
            for j in range(columns):
                p[j] += x[k] * room[b + k * columns + j]
                q[j] += y[k] * room[b + k * columns + j]
        room[to + i * columns : to + (i + 1) * columns] = p
        room[to + second * columns : to + (second + 1) * columns] = q


@compiled
def _exponentials(x, out):
    """exp(x) as 2^n times a polynomial on half a step to either side (Cephes' expf), good to 2e-7, several at a time."""
    for j in range(len(x)):
        value = min(max(x[j], NOTHING_BELOW), np.float32(88.0))
        n = np.floor(value * np.float32(1.44269504) + np.float32(0.5))
        r = value - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
        y = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
        y = y * r + np.float32(8.3334519073e-3)
        y = y * r + np.float32(4.1665795894e-2)
        y = y * r + np.float32(1.6666665459e-1)
        y = y * r + np.float32(5.0000001201e-1)
        y = y * r * r + r + np.float32(1.0)
        scale = np.int32((int(n) + 127) << 23).view(np.float32)
        y = y * scale if x[j] > NOTHING_BELOW else np.float32(0.0)
        out[j] = y if x[j] == x[j] else x[j]


@compiled
def _reduce(x, added):
    total = x[0]
    for j in range(1, len(x)):
        total = total + x[j] if added else max(total, x[j])
    return total


@compiled
def _pairwise(code, room, a, a_column, b, b_column, row):
    x, y = room[a : a + len(row)], room[b : b + len(row)]
    if code == MUL and a_column == b_column == 1:
        for j in range(len(row)):
            row[j] = x[j] * y[j]
    elif code == ADD and a_column == b_column == 1:
        for j in range(len(row)):
            row[j] = x[j] + y[j]
    else:
        for j in range(len(row)):
            row[j] = _binary(code, room[a + j * a_column], room[b + j * b_column])


@compiled
def _unary(code, x):
    if code == RELU:
        return x if x > 0.0 or x != x else np.float32(0.0)
    if code == TANH:
        return math.tanh(x)
    if code == SQRT:
        return math.sqrt(x)
    if code == SIN:
        return math.sin(x)
    if code == COS:
        return math.cos(x)
    if code == LOG:
        return math.log(x)
    if code == ABS:
        return abs(x)
    if code == SIGMOID:
        return np.float32(1.0) / (np.float32(1.0) + math.exp(-x))
    if code == ERF:
        return math.erf(x)
    if code == SOFTPLUS:
        return max(x, 0.0) + math.log1p(math.exp(-abs(x)))
    return -x


@compiled
def _binary(code, x, y):
    if code == ADD:
        return x + y
    if code == MUL:
        return x * y
    if code == SUB:
        return x - y
    if code == DIV:
        return x / y
    if code == MAX:
        return x if x > y or x != x else y
    return x if x < y or x != x else y
