import math
import time

from hypothesis import example, given
from hypothesis import strategies as st
import pytest
import yaml

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.limits import YAML_BYTES
from uwb_tdoa_bias.common.safe_yaml import parse_yaml, read_yaml

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(1 - 2**63, 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    # no 1e3: YAML 1.1
    st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Nd"]), max_size=8),
)
KEYS = st.text("abcxyz01-", max_size=4)
CONTENT = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner), max_leaves=12
)


@given(CONTENT)
def test_what_others_write_comes_back(content):
    text = yaml.safe_dump(content)
    assert parse_yaml(text, "f") == content == parse_yaml(text.encode(), "f")


def test_numbers_are_those_that_people_mean():
    content = parse_yaml(
        "a: 1e-3\nb: 010\nc: 1:30\nd: -.5\ne: 2026-01-01\nf: yes\ng: '1'\nh: +3\ni: 1.\nj: 0x10",
        "f",
    )
    assert content == {
        "a": 0.001,
        "b": "010",
        "c": "1:30",
        "d": -0.5,
        "e": "2026-01-01",
        "f": True,
        "g": "1",
        "h": 3,
        "i": 1.0,
        "j": "0x10",
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3: 'a' is there twice"),
        ("0: 1\n+0: 2\n", r"line 2: '\+0' is there twice"),
        ("a: &x [1, 2]\nb: *x\n", r"line 2: \*x is an alias"),
        ("a:\n  - !!int x\n", "line 2: tag:yaml.org,2002:int is a tag"),
        ("a: !!python/object/apply:os.system [ls]", "is a tag"),
        ("a: .nan", "line 1: .nan is not finite"),
        ("a: -.INF", "line 1: -.INF is not finite"),
        ("a: 1e999", "line 1: 1e999 is not finite"),
        ("a: 12345678901234567890", "line 1: 12345678901234567890 does not fit into 64 bits"),
        ("? [a, b]\n: 1", "line 1: a list or mapping is used as a key"),
        ("a: 1\n--- \nb: 2", "line 2: is no YAML .*single document"),
        ("a: [1, 2", "line 1: is no YAML"),
        ("a: \t- b", "is no YAML"),
        ("a: \x07", "is no YAML"),
        ("[" * 30 + "]" * 30, "more than 20 levels"),
        ("[" * 5000, "more than 20 levels"),
        ("[" + "1," * 200_001 + "1]", "more than 200000 entries"),
        (b"a: \xff", "byte 3 is not UTF-8"),
        ("a: 1".encode("utf-16"), "byte 0 is not UTF-8"),
    ],
)
def test_what_could_be_misread_is_refused(text, said):
    with pytest.raises(InputError, match=f"^f: .*{said}"):
        parse_yaml(text, "f")


def test_aliases_cannot_unfold(tmp_path):
    lines = [f"{b}: &{b} [{('*' + a + ',') * 9}]\n" for a, b in zip("abcdefgh", "bcdefghi")]
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(lines)
    began = time.process_time()
    with pytest.raises(InputError, match="alias"):
        parse_yaml(bomb, "f")
    assert time.process_time() - began < 10.0


def test_files(tmp_path):
    path = tmp_path / "f.yaml"
    path.write_bytes("\ufeffa: ü\n".encode())
    assert read_yaml(path) == {"a": "ü"}
    path.write_text("a" * (YAML_BYTES + 1))
    with pytest.raises(InputError, match="has more than 2000000 bytes"):
        read_yaml(path)
    with pytest.raises(InputError, match="cannot be read|a pipe, a device or a folder"):
        read_yaml(tmp_path)
    with pytest.raises(InputError, match="nowhere.yaml: cannot be read as YAML"):
        read_yaml(tmp_path / "nowhere.yaml")


@given(
    st.binary(max_size=60)
    | st.text("ab:-[]{}#&*!|>'\"%@`,? \n\t019.~<=e", max_size=60).map(str.encode)
)
@example(b"<<: {a: 1}")
@example(b"=: 1")
@example(b"? \n: 1")
@example(b"a: .e1")
def test_anything_is_read_or_refused(data):
    try:
        content = parse_yaml(data, "f")
    except InputError as error:
        assert str(error).startswith("f: ")
    else:
        assert_plain(content)


def assert_plain(content):
    if isinstance(content, dict):
        content = [*content, *content.values()]
    if isinstance(content, list):
        for entry in content:
            assert_plain(entry)
    else:
        assert content is None or isinstance(content, (str, bool, int, float))
        assert not isinstance(content, float) or math.isfinite(content)


@pytest.mark.parametrize(
    "number", ["9" * 1_000_000, "-" + "9" * 1_000_000 + ".0", "1e" + "9" * 1_000_000]
)
def test_a_long_number_is_refused_at_once_and_not_repeated(number):
    began = time.process_time()
    with pytest.raises(InputError) as refused:
        parse_yaml(f"a: {number}", "f")
    assert len(str(refused.value)) < 200 and time.process_time() - began < 2.0
