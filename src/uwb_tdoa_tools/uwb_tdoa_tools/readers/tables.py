"""CSV tables with a header line, of few columns."""

import csv
import io
import math

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import read_bytes
from uwb_tdoa_bias.foundation.limits import TABLE_BYTES


def read_table(path, columns=None):
    """[(line, {column: text})] of a CSV file that has at least the columns, others passed over; default: of all that it
    has. Raises InputError."""
    try:
        text = read_bytes(path, TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not text; give a CSV file.") from error
    rows, found = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True), []
    try:
        columns = columns if columns is not None else [name for name in rows.fieldnames or () if name]
        missing = [name for name in columns if name not in (rows.fieldnames or ())]
        if missing:
            raise InputError(f"{path}: has no column {missing[0]}; it needs columns {', '.join(columns)}.")
        for row in rows:
            if any(row[name] is None for name in columns):
                raise InputError(f"{path}: line {rows.line_num}: has fewer cells than the header; complete it.")
            found.append((rows.line_num, {name: row[name] for name in columns}))
    except csv.Error as error:
        raise InputError(f"{path}: line {rows.line_num}: is no CSV ({error}); correct it there.") from error
    return found


def number(path, line, row, column):
    """A cell as a float. Raises InputError unless it is a finite number."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {column} is {row[column][:40]!r}; it must be a finite number.")
    return value
