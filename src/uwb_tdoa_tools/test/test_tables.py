# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import tracemalloc

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.readers.tables import number, read_numbers, read_rows


@pytest.fixture
def write(tmp_path):
    def write(content):
        file = tmp_path / "table.csv"
        file.write_bytes(content)
        return file

    return write


def test_columns_by_name(write):
    file = write(b"\xef\xbb\xbfb, a,c\r\n1, 2,3\r\n\r\n4,5,6\r\n")
    rows = list(read_rows(file, ("a", "b")))
    assert [row for _, row in rows] == [{"a": "2", "b": "1"}, {"a": "5", "b": "4"}]
    assert number(file, *rows[1], "a") == 5.0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"a\n1\n", "has no column b"),
        (b"a,b\n1,2\n3\n", "line 3: has fewer cells"),
        (b"a,b\n\xff,1\n", "byte 4 is not text"),
        (b'a,b\n"' + b"x" * 200_000 + b'",1\n', "is no CSV"),
        (
            b"a,b\n1,2\n" + b"1," * 60_000 + b"\n",
            "line 2: is no CSV .has a row of more than 100000 characters",
        ),
        (
            b"a,b\n" + b'"\n",' * 60_000 + b"\n",
            "is no CSV .has a row of more than 100000 characters",
        ),
        (b"a,b\n" + b"1,2\n" * 200_001, "has more than 400000 cells"),
    ],
)
def test_refused_with_the_line(write, content, said):
    with pytest.raises(InputError, match=f"table.csv: .*{said}"):
        list(read_rows(write(content), ("a", "b")))


@pytest.mark.parametrize("cell", [b"nan", b"-inf", b"one", b""])
def test_a_cell_that_is_no_number(write, cell):
    file = write(b"a\n" + cell + b"\n0\n")
    line, row = next(iter(read_rows(file, ("a",))), (2, {"a": ""}))
    if row["a"] != "0":
        with pytest.raises(InputError, match="line 2: a is .* finite number"):
            number(file, line, row, "a")


@pytest.mark.slow
def test_numbers_take_less_memory_than_their_text_would(write):
    file = write(b"a,b\n" + b"1,2\n" * 150_000)
    tracemalloc.start()
    numbers = read_numbers(file, ("b", "a"))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 22e6  # 17e6 for reading in blocks; 65e6 for rows of text
    np.testing.assert_array_equal(numbers, np.tile([2.0, 1.0], (150_000, 1)))
