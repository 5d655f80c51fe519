# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of situations: its harness on a few seeds; the table itself is the study's."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from studies import __main__ as study, situations
from studies.situations import SITUATIONS, again, measure

FEW = ["situations", "--only", "on the floor, low", "1 m high", "--seeds", "2", "--jobs", "1"]


def run_of(seconds, right, rate=100.0):
    """What of an ErrorSeries `again` takes: right in spans ((begin, end), ...) s, else 2 m off."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    good = np.any([(t >= begin) & (t < end) for begin, end in right], axis=0)
    return SimpleNamespace(t=t, error=np.where(good, 0.1, 2.0)[:, None] * [0.0, 1.0, 0.0])


def test_right_again_is_right_for_two_seconds_or_to_the_end():
    assert again(run_of(20.0, [(0.0, 20.0)]), 5.0) == pytest.approx(0.0, abs=0.011)
    assert again(run_of(20.0, [(0.0, 6.0), (9.0, 20.0)]), 5.0) == pytest.approx(4.0, abs=0.021)
    assert again(run_of(20.0, [(6.0, 7.0), (8.0, 10.5), (11.0, 20.0)]), 5.0) == pytest.approx(
        3.0, abs=0.021
    )
    assert again(run_of(20.0, [(0.0, 6.0)]), 5.0) is None
    assert again(run_of(20.0, [(19.0, 20.0)]), 5.0) == pytest.approx(14.0, abs=0.021)
    assert again(run_of(20.0, [(0.0, 20.0)]), 25.0) is None  # no estimate any more


def test_every_situation_of_the_list_is_there_once():
    names = [one.name for one in SITUATIONS]
    assert len(set(names)) == len(names)
    wanted = (
        "on the floor",
        "at rest",
        "lift-off",
        "landing",
        "tumbling",
        "outside, 1 m",
        "outside, 3 m",
        "outside, 10 m",
        "one side",
        "3 anchors",
        "4 anchors",
        "in a plane",
        "in a line",
        "1 s without TDOAs",
        "5 s without TDOAs",
        "30 s without TDOAs",
        "without IMU",
        "without both",
        "fast",
        "rover",
        "pocket",
        "start in the air",
        "start moving",
        "start on a table",
    )
    for word in wanted:
        assert any(word in name for name in names), word


@pytest.mark.parametrize("situation", SITUATIONS, ids=lambda one: one.name)
def test_every_situation_can_be_simulated_and_is_judged_within_its_recording(situation):
    common = {
        "seed": 3,
        "imu_rate": 100.0,
        "truth_rate": 50.0,
        "protocol": "tdoa3",
        "anchors": situations.corners(),
    }
    flight = situation.make(np.random.default_rng(3), common)
    assert (
        flight.truth.t[0] <= situation.judged[0] + 0.02
        and situation.judged[1] <= flight.truth.t[-1] + 0.02
    )
    assert np.isfinite(flight.imu.accel).all() and np.isfinite(flight.tdoa.d).all()
    before = flight.tdoa.t <= (situation.judged[0] if situation.over is None else situation.over)
    assert before.sum() > 100 or situation.over is None


def test_low_anchors_are_late_on_the_floor_alone():
    name = "lift-off, low anchors 3.2 m late on the floor"
    late, plain = (
        next(one for one in SITUATIONS if one.name == n) for n in (name, "lift-off, 3 s")
    )
    common = {
        "seed": 3,
        "imu_rate": 100.0,
        "truth_rate": 50.0,
        "protocol": "tdoa3",
        "anchors": situations.corners(),
    }
    one, other = (of.make(np.random.default_rng(3), common) for of in (late, plain))
    added = one.tdoa.d - other.tdoa.d
    height = np.interp(one.tdoa.t, one.truth.t, one.truth.p[:, 2])
    low = one.anchors.ids[one.anchors.positions[:, 2] < 0.5]
    b_alone = np.isin(one.tdoa.b, low) & ~np.isin(one.tdoa.a, low)
    assert np.median(added[b_alone & (height < 0.05)]) == pytest.approx(3.2, abs=0.5)
    np.testing.assert_array_equal(added[height > 0.21], 0.0)
    np.testing.assert_array_equal(added[~np.isin(one.tdoa.a, low) & ~np.isin(one.tdoa.b, low)], 0.0)


def test_what_was_simulated_is_told(tmp_path, capsys):
    assert study.main([*FEW, "--json", str(tmp_path / "told.json")]) == 0
    first = capsys.readouterr().out
    assert first.startswith("| situation | error (RMSE), m |") and "| at rest, 1 m high |" in first
    told = json.loads((tmp_path / "told.json").read_text())
    assert (
        len(told["seeds"]["at rest, 1 m high"]) == 2
        and told["situations"]["at rest, 1 m high"]["rmse_3d"] < 0.5
    )


def test_a_word_that_no_situation_has_is_refused(capsys):
    assert study.main(["situations", "--only", "under water"]) == 2
    assert (
        "no situation has under water in its name; they are: on the floor"
        in capsys.readouterr().err
    )


def test_seeds_differ_and_are_the_same_again():
    first, second = measure(("at rest, 1 m high", 0)), measure(("at rest, 1 m high", 1))
    assert first == measure(("at rest, 1 m high", 0)) != second
