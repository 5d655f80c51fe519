# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The experiment of the paper: its halls, its training, its table; the flights themselves are in
the study alone.
"""

import json

import numpy as np
import pytest
from test_flying_verdict import made_up

from studies import __main__ as study
from studies.closed_loop import experiment
from studies.closed_loop.experiment import (
    BASELINE,
    ESTIMATORS,
    KNOWN,
    TRAINING,
    UNSEEN,
    WITH,
    WITHOUT,
)
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.flying.fleet import drawn_flight
from uwb_tdoa_tools.flying.verdict import verdict_of

OFF = dict(zip(ESTIMATORS, (0.4, 0.3, 0.24, 0.36, 0.1)))  # m, of the estimates of made-up flights


def test_halls_differ_in_where_anchors_are_and_how_they_are_turned_and_in_nothing_else():
    halls = {name: experiment.world_of(name) for name in (*TRAINING, *UNSEEN)}
    assert not set(TRAINING) & set(UNSEEN) and KNOWN in TRAINING
    for name, hall in halls.items():
        anchors = hall.anchors
        assert (
            len(anchors) == 8
            and (np.abs(anchors.positions) <= 0.5 * np.array(hall.size) * [1, 1, 2] + 1e-9).all()
        )
        up = anchors.orientations[:, 0] ** 2 + anchors.orientations[:, 1] ** 2
        assert (np.minimum(up, 1.0 - up) < 0.2).all()  # upright or upside down, but for a tilt
        same = experiment.world_of(name).anchors
        np.testing.assert_array_equal(same.orientations, anchors.orientations)
    assert (
        len(
            {
                (hall.delay, hall.installation, hall.antennas, hall.floor_effect)
                for hall in halls.values()
            }
        )
        == 1
    )


@pytest.mark.slow
def test_it_trains_flies_tells_and_draws(tmp_path, monkeypatch, capsys):
    trained = tmp_path / "before"
    (trained / "paper").mkdir(parents=True)
    EffectSet().to_yaml(trained / "effects.yaml")
    flown = []

    def judged(record, draw, task):
        by = next(
            name
            for name, one in ESTIMATORS.items()
            if experiment.task((name, KNOWN, "A"), 1, trained).model == task.model
            and one.config == task.config
            and one.diagnosed == (task.effects is not None)
        )
        flown.append((by, task.seed, task.path.swing))
        one = made_up(off=OFF[by])
        return verdict_of(one), drawn_flight(one, verdict_of(one))

    monkeypatch.setattr(experiment.fleet, "fly_task", judged)
    arguments = [
        "closed-loop",
        "--flights",
        "2",
        "--seed",
        "5",
        "--jobs",
        "1",
        "--trained",
        str(trained),
        "--out",
        str(tmp_path),
    ]
    assert study.main(arguments) == 0
    assert sorted(set(flown)) == sorted(
        (by, seed, swing) for by in ESTIMATORS for seed in (5, 6) for swing in (0.0, 0.4)
    )
    rows = json.loads((tmp_path / "flights.json").read_text())["kinds"]
    assert len(rows) == 5 * 4 * 2 and all(len(row["flights"]) == 2 for row in rows)
    printed = capsys.readouterr().out
    assert "| not trained in, mean | 0.400 | 0.300 | 0.240 | 0.360 | 0.100 |" in printed
    assert f"| {WITH}: than {BASELINE} | 40% | 40% | 40% (12) | 42% |" in printed
    assert f"| {WITH}: than {WITHOUT} | 20% | 20% | 20% (12) | 20% |" in printed
    assert "landed, all constellations | 16 of 16" in printed
    for name in ("rmse.png", "paths.png", "errors.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


def test_one_flight_to_train_on_is_too_few(tmp_path, capsys):
    assert study.main(["closed-loop", "--training", "1", "--out", str(tmp_path)]) == 2
    assert "leaves none to validate on" in capsys.readouterr().err
