"""The study of moved and exchanged anchors."""

from argparse import Namespace
import json

import pytest

from studies import moved_anchors


@pytest.mark.slow
def test_a_moved_anchor_is_named_and_placed_and_a_healthy_recording_is_not_blamed(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(moved_anchors, "KINDS", ("moved before", "nothing"))
    monkeypatch.setattr(moved_anchors, "SECONDS", 45.0)
    file = tmp_path / "rows.json"
    moved_anchors.run(
        Namespace(
            flights=[],
            survey=None,
            namespace=None,
            topic=[],
            salvage=False,
            draws=1,
            first=1,
            jobs=1,
            json=file,
        )
    )
    rows = json.loads(file.read_text())
    assert [row["kind"] for row in rows] == 2 * ["moved before"] + 4 * ["nothing"]
    moved, healthy = rows[:2], rows[2:]
    assert all(row["ids"] and row["cost"] > moved_anchors.MATTERS for row in moved)
    assert not any(row["check"] or row["localize"] for row in healthy)
    (exact,) = [one for row in moved for one in row["surveyed"] if "no errors" in one["from"]]
    assert exact["named"] and exact["off"] < 3.0 * exact["std"]
    printed = capsys.readouterr().out
    assert "| moved before | calibrated | 1 | 1 |" in printed
    assert "| a tape, no errors of antennas | 1 | 1 |" in printed
