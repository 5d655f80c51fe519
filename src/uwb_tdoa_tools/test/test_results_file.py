# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import json
import os
from types import SimpleNamespace

import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import results_file
from uwb_tdoa_tools.results_file import ResultsFile, fingerprint_of, settings_of


def fill(path, keys, asked=None):
    """Return the keys that were computed. The result of a key is its length."""
    asked = asked or {"seed": 1}
    made = []
    with ResultsFile(path, asked) as done:
        for key in (key for key in keys if key not in done):
            done[key] = {"length": len(key)}
            made.append(key)
        assert [done[key]["length"] for key in keys] == [len(key) for key in keys]
    return made


def test_present_results_are_not_computed_again(tmp_path):
    path = tmp_path / "results"
    assert fill(path, ["a", "bb"]) == ["a", "bb"]
    assert fill(path, ["bb", "a", "ccc"]) == ["ccc"]
    assert fill(path, ["a", "bb", "ccc"]) == []
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0]["asked"]["seed"] == 1 and lines[1:] == [
        {"key": k, "result": {"length": len(k)}} for k in ("a", "bb", "ccc")
    ]


@pytest.mark.parametrize("left", [0, 1, 12, -1, -5])
def test_a_cut_file_is_continued(tmp_path, left):
    path = tmp_path / "results"
    fill(path, ["a", "bb", "ccc"])
    whole = path.read_bytes()
    os.truncate(path, left % len(whole))
    assert fill(path, ["a", "bb", "ccc"]) == (["ccc"] if left < 0 else ["a", "bb", "ccc"])
    assert path.read_bytes() == whole


def test_results_are_written_at_once(tmp_path):
    with ResultsFile(tmp_path / "results", {}) as done:
        done["a"] = 1
        assert json.loads((tmp_path / "results").read_text().splitlines()[-1]) == {
            "key": "a",
            "result": 1,
        }


def test_results_of_other_settings_are_refused(tmp_path):
    path = tmp_path / "results"
    fill(path, ["a"], {"seed": 1, "smooth": False, "effects": None})
    with pytest.raises(
        InputError,
        match="made with another effects and seed; ask for the same, or name another file",
    ):
        fill(path, ["a"], {"seed": 2, "smooth": False, "effects": "1f"})


def test_forged_results_are_refused(tmp_path):
    path = tmp_path / "results"
    fill(path, ["a"])
    with ResultsFile(path, {"seed": 1}) as done:
        assert done.read("a", lambda result: result["length"]) == 1
        for parse in (
            lambda result: result["width"],
            lambda result: result["length"]["of"],
            lambda result: float(result["length"] * "x"),
        ):
            with pytest.raises(InputError, match="holds something else"):
                done.read("a", parse)


def test_a_line_without_end_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "results"
    fill(path, ["a"])
    monkeypatch.setattr(results_file, "LINE", 1000)
    path.write_bytes(path.read_bytes() + b" " * 2000)
    with pytest.raises(InputError, match="holds something else"):
        fill(path, ["a"])


@pytest.mark.parametrize(
    "content",
    [
        "flight,rmse\n",
        "[1]\n",
        "not a result",
        '{"runs": []}\n',
        '{"asked": 1}\n',
        b"\xff\x00\n",
        "[" * 100_000 + "\n",
    ],
)
def test_a_file_of_another_kind_is_not_changed(tmp_path, content):
    path = tmp_path / "other"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = path.read_bytes()
    with pytest.raises(InputError, match="other: holds something else"):
        fill(path, ["a"])
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="directory does not exist"):
        fill(tmp_path / "no" / "results", ["a"])


def test_the_fingerprint_of_a_recording_changes_with_it(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "data").write_text("one")
    before = fingerprint_of(tmp_path / "bag")
    assert str(tmp_path) in before and fingerprint_of(tmp_path / "bag") == before
    (tmp_path / "bag" / "data").write_text("two, longer")
    assert fingerprint_of(tmp_path / "bag") != before and fingerprint_of(None) == "None"


def test_a_pipe_and_a_link_hold_no_results(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "bashrc")
    for name, said in (("pipe", "holds something else"), ("link", "is a link to .*bashrc")):
        with pytest.raises(InputError, match=said):
            ResultsFile(tmp_path / name, {})
    assert not (tmp_path / "bashrc").exists()


def test_a_recording_of_too_many_files_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(results_file, "FOLDER_ENTRIES", 3)
    for number in range(4):
        (tmp_path / str(number)).touch()
    with pytest.raises(InputError, match="more than 3 entries"):
        fingerprint_of(tmp_path)


def test_settings_are_the_options_and_the_content_of_their_files(tmp_path):
    file = tmp_path / "effects.yaml"
    file.write_text("one")
    args = SimpleNamespace(jobs=3, smooth=True, effects=str(file), model=None, config=None)
    asked = settings_of(args, ["jobs"], ["effects", "model", "config"])
    file.write_text("two")
    changed = settings_of(args, ["jobs"], ["effects", "model", "config"])
    assert asked == {
        "smooth": True,
        "effects": asked["effects"],
        "model": None,
        "config": None,
    }
    assert (
        changed["effects"] != asked["effects"] and {**changed, "effects": asked["effects"]} == asked
    )
