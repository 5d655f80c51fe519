# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Verdicts of artificial flights."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_ekf.results import Odometry
from uwb_tdoa_tools.flying.mission import DONE, REFUSED
from uwb_tdoa_tools.flying.verdict import summary, text, verdict_of

T = np.arange(0.0, 20.0, 0.0025)
UP, DOWN = 4.0, 14.0  # s, start and end of the time in the air


def made_up(
    z=None,
    xy=(0.0, 0.0),
    tilt=0.0,
    off=0.1,
    deviation=0.1,
    sink=0.2,
    crash="",
    started=UP,
    ended=DOWN + 0.5,
    state=DONE,
):
    """Return a flight that climbs at UP and descends at DOWN, with constant speed, m/s."""
    states = np.zeros((len(T), 17))
    height = np.clip(np.minimum(T - UP, (DOWN - T) * sink), 0.0, 1.2) if z is None else z
    states[:, :2], states[:, 2] = np.where(T[:, None] > DOWN - 4.0, xy, 0.0), height
    states[:, 5] = np.gradient(height, T)
    states[:, 6], states[:, 9] = np.sin(0.5 * tilt), np.cos(0.5 * tilt)
    t = T[::2]
    p = states[::2, :3] + off / np.sqrt(3.0)
    odometry = Odometry(
        t,
        p,
        np.zeros((len(t), 3)),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1)),
        *np.zeros((2, len(t), 3)),
        np.tile(deviation**2 * np.eye(9), (len(t), 1, 1)),
        np.zeros((len(t), 3, 3)),
    )
    mission = SimpleNamespace(
        begin=0.0,
        started=started,
        ended=ended,
        lost=None,
        state=state,
        place=np.zeros(2),
        ground=0.0,
        wanted=lambda stamps: (
            np.column_stack([0.0 * stamps, 0.0 * stamps, np.interp(stamps, T, height)])[:, None]
            + [[[0.3, 0.0, 0.0]]]
        ),
    )
    return SimpleNamespace(
        task=SimpleNamespace(seed=7, again=False, vehicle="quadrotor"),
        flight=SimpleNamespace(known_truth=Truth(T, states[:, :3], states[:, 6:10])),
        states=states,
        contact=np.where(height <= 0.0, 4, 0),
        odometry=odometry,
        missions=[mission],
        crash=crash,
    )


def test_a_good_flight_has_landed_and_its_figures_are_right():
    verdict = verdict_of(made_up())
    assert verdict["landed"] and verdict["safe"] and verdict["why"] == "" and verdict["seed"] == 7
    assert verdict["touchdown"] == pytest.approx(0.2, abs=0.01) and verdict["place"] == 0.0
    assert verdict["tracking"] == pytest.approx(0.3) and verdict["estimation"] == pytest.approx(0.1)
    assert verdict["armed_off"] == pytest.approx(0.1) and verdict[
        "armed_deviations"
    ] == pytest.approx(1.0 / np.sqrt(3.0))
    for phase in ("before", "lift_off", "air", "landing", "after"):
        assert verdict["phases"][phase]["nees"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("why", "safe", "flown"),
    [
        ("refused to arm", True, {"z": 0.0 * T, "started": None, "ended": None, "state": REFUSED}),
        ("did not take off", True, {"z": 0.0 * T}),
        ("tipped over", False, {"crash": "tipped over"}),
        ("not upright", False, {"tilt": 1.0}),
        ("came down hard", True, {"sink": 0.7}),
        ("came down hard", False, {"sink": 1.1}),
        ("landed elsewhere", True, {"xy": (0.2, 0.23)}),
        ("did not come down", False, {"ended": None, "state": "flying"}),
    ],
)
def test_what_kept_it_from_landing_is_said(why, safe, flown):
    verdict = verdict_of(made_up(**flown))
    assert (verdict["why"], verdict["landed"], verdict["safe"]) == (why, False, safe)


def test_the_estimate_is_judged_and_does_not_judge():
    verdict = verdict_of(made_up(off=2.0, deviation=0.1))
    assert verdict["landed"] and verdict["armed_deviations"] > 3.0
    assert verdict["lost"] == pytest.approx(UP, abs=0.03)
    assert verdict["phases"]["air"]["nees"] == pytest.approx(400.0, rel=0.01)


def test_flights_are_summed_up():
    verdicts = [
        verdict_of(made_up()),
        verdict_of(made_up(xy=(1.0, 0.0))),
        verdict_of(made_up(off=2.0)),
    ]
    summed = summary(verdicts)
    assert (summed["flights"], summed["landed"], summed["safe"], summed["why"]) == (
        3,
        2,
        3,
        {"landed elsewhere": 1},
    )
    assert summed["armed_beyond_three_deviations"] == 1
    assert summed["armed_off"] == {
        "median": pytest.approx(0.1),
        "least": pytest.approx(0.1),
        "most": pytest.approx(2.0),
    }
    assert "2 of 3 landed" in text(summed) and "1 landed elsewhere" in text(summed)
