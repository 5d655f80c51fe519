# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of how the tools grow, and its cases; the tools themselves run in the study alone."""

import argparse

from studies import scale
from uwb_tdoa_tools.readers import read_flight


def test_cases_are_done_once_and_make_one_table(tmp_path, monkeypatch, capsys):
    made = []

    def measure(case, folder):
        made.append(case)
        return {"cpu": 2.0 + 0.5 * case.flights, "memory": 200.0 + 3.0 * case.flights}

    monkeypatch.setattr(scale, "measure", measure)
    parser = argparse.ArgumentParser()
    scale.add_options(parser.add_argument)
    scale.run(parser.parse_args(["--out", str(tmp_path), "--only", "evaluate", "--most", "100"]))
    counted = [case for case in made if case != scale.Case("evaluate", 1)]
    assert len(counted) == len(set(counted)) and {case.flights for case in counted} == {3, 10, 100}
    first, rule, *rows = capsys.readouterr().out.splitlines()[-12:]
    assert first.startswith("| tool | flights |") and rule.count("|") == first.count("|")
    assert "| evaluate | 100 | 8 | 0 | 52.0 | 0.500 | 500 | 3.000 |" in rows
    assert (
        "| evaluate | 10 | 8 | 5 | 7.0 |  | 230 |  |" in rows
    )  # none with fewer flights to compare it with
    assert rows == sorted(
        rows, key=lambda row: [int(cell) for cell in (row.split(" | ")[k] for k in (2, 3, 1))]
    )


def test_flights_are_made_once_each_with_another_seed(tmp_path):
    paths = scale.make_flights(2, 8, tmp_path)
    flights = [read_flight(path) for path in paths]
    assert flights[0].name != flights[1].name and len(flights[0].tdoa) > 2000
    before = [path.stat().st_mtime_ns for path in paths]
    assert (
        scale.make_flights(2, 8, tmp_path) == paths
        and [path.stat().st_mtime_ns for path in paths] == before
    )
