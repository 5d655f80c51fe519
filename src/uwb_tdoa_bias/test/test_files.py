# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files: how they are written, and which contents are refused when they are read."""

from functools import partial
import io
import math
import os
from pathlib import Path
import stat
import struct
import threading
import tracemalloc
import zipfile

from hypothesis import HealthCheck, example, given, settings, strategies as st
import numpy as np
import pytest
import yaml

from uwb_tdoa_bias.common import files
from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.errors import YAML_BYTES, InputError, printable, sanitize
from uwb_tdoa_bias.common.files import (
    protected_inputs,
    read_arrays,
    read_bytes,
    read_head,
    write_bytes,
    write_filled,
    write_picture,
    write_text,
)
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.safe_yaml import parse_yaml, read_yaml

# --- files ---


@pytest.mark.parametrize(
    "text, content",
    [
        ("Höhe ± 0.1 m, σ\n", "Höhe ± 0.1 m, σ\n".encode()),
        (os.fsdecode("flüge".encode()), "flüge".encode()),
        ("fl\udcc3\udcbcge", "flüge".encode()),  # an argument of Python in an ASCII locale
        ("a\udcffb", "a\ufffdb".encode()),
        ("a\ud800b", b"a?b"),
    ],
)
def test_text_is_written_in_utf8_even_if_python_could_not_decode_it(tmp_path, text, content):
    write_text(tmp_path / "a.txt", text)
    assert (tmp_path / "a.txt").read_bytes() == content


def test_a_new_file_has_the_permissions_of_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "a", b"1")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path):
    (tmp_path / "there").write_bytes(b"old")
    (tmp_path / "there").chmod(0o604)
    write_bytes(tmp_path / "there", b"new")
    assert (tmp_path / "there").read_bytes() == b"new" and stat.S_IMODE(
        (tmp_path / "there").stat().st_mode
    ) == 0o604
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]


def test_no_link_is_followed(tmp_path):
    (tmp_path / "bashrc").write_bytes(b"precious")
    (tmp_path / "link").symlink_to("bashrc")
    (tmp_path / "to nothing").symlink_to("new")
    for name in ("link", "to nothing"):
        with pytest.raises(InputError, match=f"{name}: is a link to (bashrc|new)"):
            write_bytes(tmp_path / name, b"new")
    assert (tmp_path / "bashrc").read_bytes() == b"precious" and not (tmp_path / "new").exists()


def test_nothing_is_written_over_what_is_kept(tmp_path):
    survey, bag, flights = tmp_path / "survey", tmp_path / "bag", tmp_path / "flights"
    survey.write_bytes(b"precious")
    (tmp_path / "hard").hardlink_to(survey)
    for folder in (bag, flights):
        folder.mkdir()
        (folder / "one").write_bytes(b"precious")
    (bag / "metadata.yaml").write_bytes(b"precious")
    refused = [
        survey,
        tmp_path / "bag" / ".." / "survey",
        tmp_path / "hard",
        bag / "one",
        bag / "new",
        flights / "one",
    ]
    with protected_inputs([survey, bag, flights]):
        for path in refused:
            with pytest.raises(
                InputError, match=f"{tmp_path}.*(is|lies in) {tmp_path}/.*, which is read"
            ):
                write_bytes(path, b"new")
        for path in (tmp_path / "new", flights / "new"):
            write_bytes(path, b"new")
    write_bytes(survey, b"new")
    assert (tmp_path / "hard").read_bytes() == (bag / "one").read_bytes() == b"precious"


def test_what_standard_output_goes_to_is_written_in_place(capfd):
    write_text("/dev/stdout", "said")
    assert capfd.readouterr().out == "said" and os.path.islink("/dev/stdout")


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_bytes(path, b"old")
    with pytest.raises(ValueError):
        write_filled(path, lambda file: [file.write(b"half"), int("none")])
    with monkeypatch.context() as patched, pytest.raises(OSError):
        patched.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old" and [one.name for one in tmp_path.iterdir()] == ["a.json"]


def test_a_pipe_and_a_device_are_written_in_place(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    found = []
    reader = threading.Thread(target=lambda: found.append((tmp_path / "pipe").read_bytes()))
    reader.start()
    write_text(tmp_path / "pipe", "to a pipe")
    reader.join()
    write_text("/dev/null", "to nobody")
    assert found == [b"to a pipe"] and not Path("/dev/null").is_file()


def test_readers_see_the_old_content_or_the_new_one(tmp_path):
    path, sizes, done = tmp_path / "a", set(), threading.Event()
    write_bytes(path, b"a" * 1_000_000)

    def read():
        while not done.is_set():
            content = path.read_bytes()
            sizes.add((len(content), len(set(content))))

    reader = threading.Thread(target=read)
    reader.start()
    for k in range(50):
        write_bytes(path, b"ab"[k % 2 : k % 2 + 1] * 1_000_000)
    done.set()
    reader.join()
    assert sizes == {(1_000_000, 1)}


# --- arrays file ---


ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "n": np.array(7),
    "t": np.array("hall"),
    "f": np.zeros((0, 3)),
}
KINDS = {"a": "f", "n": "i", "t": "U", "f": "f"}


def saved(function=np.savez, **changes):
    stream = io.BytesIO()
    function(stream, **{**ARRAYS, **changes})
    return stream.getvalue()


@pytest.fixture
def read(tmp_path):
    def read(content, kinds=KINDS):
        file = tmp_path / "file.npz"
        file.write_bytes(content)
        return read_arrays(file, kinds, "table", "make one")

    return read


@pytest.mark.parametrize("function", [np.savez, np.savez_compressed])
def test_what_numpy_wrote_comes_back(read, function):
    for name, array in read(saved(function, a=np.asfortranarray(ARRAYS["a"]))).items():
        np.testing.assert_array_equal(array, ARRAYS[name])
        assert array.dtype == ARRAYS[name].dtype and array.shape == ARRAYS[name].shape


def forged(shape="(10000000000,)", kind="<f8", body=bytes(8), compress=zipfile.ZIP_DEFLATED):
    """Return an .npz file. The header of its array `a` states any given shape."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compress) as file:
        file.writestr("a.npy", data)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "File is not a zip file"),
        (b"something else", "File is not a zip file"),
        (saved()[:-30], "File is not a zip file"),
        (forged(), "a claims 80000000000 bytes, 8 are there"),
        (forged("(-1,)"), "a claims"),
        (forged("(1,)", "|O"), "a holds object"),
        (forged("(1,)", "<c8"), "a holds complex64"),
        (forged("'x'"), "shape"),
        (saved(a=np.array([1.0, np.nan])), "a holds NaN"),
        (saved(a=np.array(["x"], dtype=object)), "a holds object"),
        (saved(n=np.array(7.0)), "n holds float64"),
        (forged("(1"), "a has a header that cannot be read"),
        (forged("(1,)", "<U1", b"\xff\xff\xff\x7f"), "a holds no text"),
    ],
)
def test_refused_with_the_reason(read, content, said):
    with pytest.raises(InputError, match=rf"file\.npz: is no table \(.*{said}.*\); make one\."):
        read(content, {"a": "U" if "text" in said else "f"} if b"n.npy" not in content else KINDS)


def test_memory_is_not_taken_before_sizes_are_known(read, monkeypatch):
    monkeypatch.setattr(files, "ARRAYS_BYTES", 1_000_000)
    tracemalloc.start()
    with pytest.raises(InputError, match="more than 1000000 bytes"):
        read(forged("(20000000,)", body=bytes(160_000_000)), {"a": "f"})
    tracemalloc.reset_peak()
    with pytest.raises(InputError):
        read(forged(), {"a": "f"})
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: is no table \(No such file or directory\)"):
        read_arrays(tmp_path / "nowhere", KINDS, "table", "make one")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0.0, 1.0, exclude_max=True), mask=st.integers(1, 255), packed=st.booleans())
def test_any_changed_byte_is_told_or_harmless(read, at, mask, packed):
    content = bytearray(saved(np.savez_compressed if packed else np.savez))
    content[int(at * len(content))] ^= mask
    try:
        read(bytes(content))
    except InputError:
        pass


# --- flyable ---


ANCHORS = Anchors.from_positions([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3]], ids=[3, 1, 7, 5])
CELLS = np.random.default_rng(0).random((5, 4, 3)) < 0.5
BOUND = np.where(CELLS, np.arange(60.0).reshape(5, 4, 3), np.inf)


def volume(**changes):
    fields = {"lower": [-1.0, 0.0, 0.5], "step": [0.5, 0.5, 0.25], "flyable": CELLS, "bound": BOUND}
    if "flyable" in changes:
        fields["bound"] = np.ones(changes["flyable"].shape)
    return FlyableVolume(
        **{**fields, "ids": ANCHORS.ids, "positions": ANCHORS.positions, **changes}
    )


@given(st.tuples(*[st.floats(-3, 4)] * 3))
def test_contains_looks_into_the_right_cell(p):
    inside = -1.0 <= p[0] < 1.5 and 0.0 <= p[1] < 2.0 and 0.5 <= p[2] < 1.25
    wanted = inside and CELLS[int((p[0] + 1.0) // 0.5), int(p[1] // 0.5), int((p[2] - 0.5) // 0.25)]
    assert volume().contains(p) == wanted
    assert np.isfinite(volume().bound_at(p)) == wanted and np.isnan(volume().bound_at(p)) == (
        not inside
    )


def test_a_planar_one_asks_for_no_height():
    flat = volume(flyable=np.ones((5, 4, 1), bool), planar=True)
    assert flat.contains([[0.0, 1.0, 99.0], [0.0, 9.0, 0.6]]).tolist() == [True, False]
    assert not volume(flyable=np.ones((5, 4, 1), bool)).contains([0.0, 1.0, 99.0])


def test_a_saved_one_comes_back(tmp_path):
    file = tmp_path / "flyable.npz"
    volume(frame="hall", planar=False).save(file)
    back = FlyableVolume.load(file)
    assert (back.frame, back.planar) == ("hall", False)
    for name in ("lower", "step", "flyable", "bound", "ids", "positions"):
        np.testing.assert_array_equal(getattr(back, name), getattr(volume(), name))


def test_it_knows_its_anchors():
    positions, ids, order = ANCHORS.positions, ANCHORS.ids, [2, 0, 3, 1]
    assert volume().belongs_to(Anchors.from_positions(positions[order] + 0.05, ids[order]))
    for other in (
        Anchors.from_positions(positions + 0.2, ids),
        Anchors.from_positions(positions, [3, 1, 7, 6]),
        Anchors.from_positions(positions[:3], ids[:3]),
        Anchors.from_positions(positions, ids, frame="hall"),
    ):
        assert not volume().belongs_to(other)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text").write_bytes(b"flyable: all")
    np.savez(tmp_path / "other.npz", lower=np.zeros(3))
    for name in ("none", "text", "other.npz"):
        with pytest.raises(InputError, match="is no flyable volume"):
            FlyableVolume.load(tmp_path / name)
    for wrong in ({"step": [0.1, 0.1]}, {"bound": np.ones((5, 4, 2))}):
        with pytest.raises(InputError, match="do not fit together"):
            volume(**wrong)
    negative, unknown = np.full((5, 4, 3), -1.0), np.full((5, 4, 3), np.nan)
    for wrong in (
        {"step": [0.1, 0.1, 0.0]},
        {"lower": [0.0, np.nan, 0.0]},
        {"bound": negative},
        {"bound": unknown},
    ):
        with pytest.raises(
            InputError, match="not finite, a step that is not above 0 or a bound below 0"
        ):
            volume(**wrong)


# --- safe yaml ---


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(1 - 2**63, 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    # no digits: YAML 1.1 reads 1e3 as a text
    st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Nd"]), max_size=8),
)
KEYS = st.text("abcxyz01-", max_size=4)
CONTENT = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner), max_leaves=12
)


@pytest.mark.slow
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


def test_a_file_that_is_missing_or_empty_is_named_by_what_it_should_be(tmp_path):
    (tmp_path / "empty").touch()
    for read in (partial(read_bytes, most=9), partial(read_head, size=9)):
        for what, words in ({}, "recording"), ({"what": "survey file"}, "survey file"):
            with pytest.raises(InputError, match=f"nope: .*; give the path of a {words}."):
                read(tmp_path / "nope", **what)
            with pytest.raises(InputError, match=f"empty: .*; copy the {words} again."):
                read(tmp_path / "empty", **what)


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
    "number", ["9" * 5_000_000, "-" + "9" * 5_000_000 + ".0", "1e" + "9" * 5_000_000]
)
@pytest.mark.usefixtures("must_end")
def test_a_long_number_is_refused_and_not_repeated(number):
    with pytest.raises(InputError) as refused:
        parse_yaml(f"a: {number}", "f")
    assert len(str(refused.value)) < 200


# --- foreign text ---


ATTACK = "\x1b[2J\x1b]0;title\x07\r\nok \u202efdp.exe \ud800 \x9b31m"


def test_a_terminal_shows_what_would_steer_it():
    shown = printable(ATTACK)
    assert shown.isprintable() and shown.startswith(
        r"\x1b[2J\x1b]0;title\x07\r\nok \u202efdp.exe \ud800 \x9b31m"
    )
    assert printable("Größe, 3 m²: 'a' | $x$") == "Größe, 3 m²: 'a' | $x$"


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("0425-traj1", "0425-traj1"),
        ("Halle 3 (Süd), 2.5 m", "Halle 3 (Süd), 2.5 m"),
        ("physics+structured", "physics+structured"),
        ("$\\frac$", "__frac_"),
        ("<img src=x onerror=alert(1)>", "_img src=x onerror=alert(1)_"),
        ("a|b\n# c", "a_b_# c"),
        ("../../etc/passwd", ".._.._etc_passwd"),
        ("[x](javascript:y)", "_x_(javascript:y)"),
        ("`id` && $(id)", "_id_ __ _(id)"),
        ("x" * 999, "x" * 100),
    ],
)
def test_a_name_means_nothing_anywhere(name, left):
    assert sanitize(name) == left and sanitize(left) == left
    assert Flight(name, None, None).name == left


@pytest.mark.parametrize(
    ("name", "begins"),
    [("a.png", b"\x89PNG"), ("a.PDF", b"%PDF"), ("a.svg", b"<?xml"), ("a", b"\x89PNG")],
)
def test_a_picture_has_the_format_of_its_name(tmp_path, name, begins):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    write_picture(tmp_path / name, figure)
    assert (tmp_path / name).read_bytes().startswith(begins)
