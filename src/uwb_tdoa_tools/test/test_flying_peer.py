"""Another filter to fly by: a tiny library, compiled here, that stays where it was told to be."""

import numpy as np
import pytest
from test_benchmark_peer import SOURCE, built, pytestmark  # noqa: F401

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.benchmark.peer import Peer
from uwb_tdoa_tools.flying.path import Circles
from uwb_tdoa_tools.flying.trial import Task, fly
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.flying.world import HALL

STATE = """
void tdoa_peer_state(double *at, double *v, double *q) {
  for (int k = 0; k < 3; k++) { at[k] = wrong ? NAN : p[k]; v[k] = q[k] = 0; }
  q[3] = 1;
}
"""


def test_it_is_flown_by_and_judged_like_ours(tmp_path):
    """It says that it stands on the floor while it climbs: the vehicle goes up and up."""
    library = built(tmp_path, SOURCE + STATE)
    flown = fly(
        Task(HALL, seed=2, told="place", peer=str(library), path=Circles(turns=1, turn_time=4.0))
    )
    place = flown.odometry.p[0]
    assert np.linalg.norm(place - flown.states[0, :3]) < 0.5 and (flown.odometry.p == place).all()
    verdict = verdict_of(flown)
    assert (
        verdict["why"] == "flew into the ceiling"
        or "wall" in verdict["why"]
        or verdict["why"] == "tipped over"
    )
    assert verdict["armed_deviations"] is None and verdict["phases"]["before"]["nees"] is None
    assert verdict["phases"]["before"]["rmse"] == pytest.approx(
        np.linalg.norm(place - flown.states[0, :3]), abs=1e-6
    )


def test_one_that_nobody_told_where_it_is_has_no_place(tmp_path):
    flown = fly(
        Task(
            HALL,
            seed=2,
            peer=str(built(tmp_path, SOURCE + STATE)),
            path=Circles(turns=1, turn_time=4.0),
        )
    )
    assert (
        verdict_of(flown)["why"] == "refused to arm"
    )  # the start was NaN, and this one stays there


def test_one_whose_estimate_becomes_no_number_in_flight_is_lost_and_ends_nothing(tmp_path):
    ends = STATE.replace("{\n  for", "{\n  static int calls;\n  wrong |= ++calls > 450;\n  for", 1)
    flown = fly(
        Task(
            HALL,
            seed=2,
            told="place",
            peer=str(built(tmp_path, SOURCE + ends)),
            path=Circles(turns=1, turn_time=4.0),
        )
    )
    assert (
        verdict_of(flown)["said_lost"] is not None
        and not verdict_of(flown)["landed"]
        and np.isnan(flown.odometry.p[-1]).all()
    )


def test_what_a_library_remembers_of_one_flight_is_not_in_the_next(tmp_path):
    counting = (
        "void tdoa_peer_state(double *at, double *v, double *q) { static int calls; at[0] = "
        "++calls; }"
    )
    library = built(tmp_path, SOURCE + counting)
    first, second = Peer(library, own=True), Peer(library, own=True)
    assert [peer.state()[0][0] for peer in (first, first, second)] == [1.0, 2.0, 1.0]


def test_one_that_does_not_tell_its_state_cannot_be_flown_by(tmp_path):
    with pytest.raises(
        InputError, match="does not export tdoa_peer_state; add it as docs/speed.md shows"
    ):
        fly(Task(HALL, seed=2, peer=str(built(tmp_path))))
