"""The study of moved and exchanged anchors: its tables."""

from types import SimpleNamespace

from studies import moved_anchors


def judged(case):
    kind, seed = case
    ids = [3] if kind != "nothing" else []
    named = ids if kind != "exchanged before" else []
    said = {"check": named, "localize": named, "live": [4], "verdict": "doubtful"}
    row = {"kind": kind, "seed": seed, "calibrated": False, "ids": ids, "cost": 0.1, **said}
    if kind == "moved before":
        found = {"from": "a tape", "off": 0.05, "std": 0.1, "others": 0.4, "named": True}
        row["surveyed"] = [found, {**found, "off": 0.2, "std": 0.05, "others": 2.0}]
    return [row]


def test_what_is_named_and_what_is_placed_is_counted(monkeypatch, capsys):
    monkeypatch.setattr(moved_anchors, "judge", judged)
    asked = SimpleNamespace(flights=[], draws=1, first=1, jobs=1, json=None)
    monkeypatch.setattr(moved_anchors.options, "reading_of", lambda args: None)
    moved_anchors.run(asked)
    lines = capsys.readouterr().out.splitlines()
    assert "| moved before | tape | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 0 |" in lines
    assert "| exchanged before | tape | 1 | 1 | 0 | 0 | 1 | 0 | 0 | 0 |" in lines
    assert "| nothing | tape | 2 |  | 0 | 0 | 2 |  |  |  |" in lines
    assert "| a tape | 2 | 2 | 1 | 0 of 1 | 0.125 | 1 |" in lines
