import pytest
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.readers.tables import number, read_table


@pytest.fixture
def write(tmp_path):
    def write(content):
        file = tmp_path / "table.csv"
        file.write_bytes(content)
        return file

    return write


def test_columns_by_name(write):
    file = write(b"\xef\xbb\xbfb, a,c\r\n1, 2,3\r\n\r\n4,5,6\r\n")
    rows = read_table(file, ("a", "b"))
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
    ],
)
def test_refused_with_the_line(write, content, said):
    with pytest.raises(InputError, match=f"table.csv: .*{said}"):
        read_table(write(content), ("a", "b"))


@pytest.mark.parametrize("cell", [b"nan", b"-inf", b"one", b""])
def test_a_cell_that_is_no_number(write, cell):
    file = write(b"a\n" + cell + b"\n0\n")
    line, row = (read_table(file, ("a",)) or [(2, {"a": ""})])[0]
    if row["a"] != "0":
        with pytest.raises(InputError, match="line 2: a is .* finite number"):
            number(file, line, row, "a")
