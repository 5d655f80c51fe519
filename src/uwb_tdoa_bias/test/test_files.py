import os
from pathlib import Path
import stat
import subprocess
import sys
import threading

import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import keeping, write_bytes, write_filled, write_text


def test_text_is_utf8_whatever_the_locale(tmp_path):
    write_text(tmp_path / "a.md", "Höhe ± 0.1 m, σ\n")
    assert (tmp_path / "a.md").read_bytes() == "Höhe ± 0.1 m, σ\n".encode()


@pytest.mark.parametrize(
    "text, content",
    [
        (os.fsdecode("flüge".encode()), "flüge".encode()),
        ("fl\udcc3\udcbcge", "flüge".encode()),  # as Python gets an argument in an ASCII locale
        ("a\udcffb", "a\ufffdb".encode()),
        ("a\ud800b", b"a?b"),
    ],
)
def test_a_name_that_python_could_not_decode_is_written_in_utf8(tmp_path, text, content):
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
    with keeping([survey, bag, flights]):
        for path in refused:
            with pytest.raises(
                InputError, match=f"{tmp_path}.*(is|lies in) {tmp_path}/.*, which is read"
            ):
                write_bytes(path, b"new")
        for path in (tmp_path / "new", flights / "new"):
            write_bytes(path, b"new")
    write_bytes(survey, b"new")
    assert (tmp_path / "hard").read_bytes() == (bag / "one").read_bytes() == b"precious"


def test_what_standard_output_goes_to_is_written_in_place(tmp_path):
    code = "from uwb_tdoa_bias.common.files import write_text; write_text('/dev/stdout', 'said')"
    with open(tmp_path / "said", "wb") as said:
        subprocess.run([sys.executable, "-c", code], stdout=said, check=True)
    assert (tmp_path / "said").read_text() == "said" and os.path.islink("/dev/stdout")


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
