# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of moved and exchanged anchors: its tables."""

from types import SimpleNamespace

from studies import moved_anchors


def judged(case):
    kind, seed = case
    ids = [3] if kind != "nothing" else []
    of_kind = {"moved before": [[3, 5]], "moved on the way": [[3]], "exchanged on the way": [[3]]}
    named = of_kind.get(kind, [])
    said = {"check": named, "localize": named, "live": [[4]], "verdict": "doubtful"}
    row = {"kind": kind, "seed": seed, "calibrated": False, "ids": ids, "cost": 0.1, **said}
    if kind == "moved before":
        found = {"from": "a tape", "off": 0.05, "std": 0.1, "others": 0.4, "named": True}
        row["surveyed"] = [found, {**found, "off": 0.2, "std": 0.05, "others": 2.0}]
    return [row]


def test_what_is_named_and_what_is_placed_is_counted(monkeypatch, capsys):
    monkeypatch.setattr(moved_anchors, "judge", judged)
    given = {"flights": [], "draws": 1, "first": 1, "jobs": 1, "json": None}
    asked = SimpleNamespace(**given, only=moved_anchors.KINDS, tape=False)
    monkeypatch.setattr(moved_anchors.options, "reading_of", lambda args: None)
    moved_anchors.run(asked)
    lines = capsys.readouterr().out.splitlines()
    assert "| moved before | tape | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 0 | 1 | 0 |" in lines
    assert "| moved on the way | tape | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 0 | 0 | 0 |" in lines
    assert "| exchanged before | tape | 1 | 1 | 0 | 0 | 1 | 0 | 0 | 0 | 0 | 0 |" in lines
    assert "| nothing | tape | 2 |  | 0 | 0 | 2 |  |  |  |  |  |" in lines
    assert "| a tape | 2 | 2 | 1 | 0 of 1 | 0.125 | 1 |" in lines


def test_a_pair_is_right_if_it_holds_the_anchor_and_stands_alone():
    pair = "anchor 3 or 5 does not stand where the survey has it, but if it is anchor 3, "
    groups = moved_anchors._groups([pair, "two anchors are exchanged, 1 and 2"])
    assert groups == [[1], [2], [3, 5]]
    assert moved_anchors._right([[3, 5]], [5]) and moved_anchors._right([[1], [2]], [1, 2])
    wrong = [[3, 5], [4]], [[3, 4, 5]], [[3, 4]], []
    assert not any(moved_anchors._right(groups, [5]) for groups in wrong)
    assert not moved_anchors._right([[1, 2]], [1, 2])
