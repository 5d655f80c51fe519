# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of moved anchors at the real nodes; the nodes themselves run in the study alone."""

import argparse

from studies import moved_anchors_live as study


def test_ids_are_those_of_the_sentences_on_anchors():
    assert study.ids_of("nothing") == []
    text = (
        "anchor 3 does not stand where the survey has it; "
        "two anchors are exchanged, 1 and 5 (since 12 s); TDOAs are 2 s late"
    )
    assert study.ids_of(text) == [1, 3, 5]


def test_each_recording_is_a_row_and_agreement_is_counted(monkeypatch, capsys):
    def named(kind, seed):
        node = [] if seed == 8 else [2]
        return {"kind": kind, "seed": seed, "ids": [2], "offline": [2], "node": node, "lost": 0}

    monkeypatch.setattr(study, "named", named)
    parser = argparse.ArgumentParser()
    study.add_options(parser.add_argument)
    study.run(parser.parse_args(["--draws", "2", "--first", "7", "--only", "moved before"]))
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:4] == [
        "| moved before | 7 | 2 | 2 | 2 | 0 |",
        "| moved before | 8 | 2 | 2 | none | 0 |",
    ]
    assert lines[-1].startswith("In 1 of 2 recordings")
