# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The figures of surveys from flights."""

import argparse
from pathlib import Path

from known_effects import MARK_STD, clean_flight, marks_of
import numpy as np
import pytest

from studies.surveying import END_STD, add_options, draw, ends_of, odometry_of, third
from uwb_tdoa_tools.diagnosis.self_calibration import Tape


@pytest.fixture(scope="module")
def flight():
    return clean_flight(210, 40.0)


def test_a_third_of_the_coordinates_are_trusted(flight):
    std = Tape(0.3, trusted=third(flight.anchors)).position_std(flight.anchors)
    assert (std < 0.1).sum() == 8 and std.size == 24


def test_marks_are_where_the_tag_was(flight):
    for mark in marks_of(flight, 6, np.random.default_rng(0)):
        inside = (flight.truth.t - flight.tdoa.t[0] >= mark.first) & (
            flight.truth.t - flight.tdoa.t[0] <= mark.last
        )
        assert np.linalg.norm(flight.truth.p[inside].mean(axis=0) - mark.position) < 5.0 * MARK_STD


def test_marks_of_the_ends_are_on_the_floor(flight):
    first, last = ends_of(flight, 1, np.random.default_rng(0))
    assert (
        first.last < last.first
        and max(abs(first.position[2]), abs(last.position[2])) < 5.0 * END_STD
    )


def test_an_odometry_is_the_path_in_another_frame_that_drifts(flight):
    (path,) = odometry_of(flight, 1, np.random.default_rng(0))
    true = np.stack(
        [np.interp(path.t, flight.truth.t, column) for column in flight.truth.p.T], axis=1
    )
    assert np.abs(path.p - true).max() > 0.5
    laid, _ = path.laid(path.t[::40], true[::40], [], path.t[0], path.t)
    assert np.sqrt(np.mean((laid - true) ** 2)) < 0.1


@pytest.mark.slow
def test_a_draw_makes_a_shaken_survey_better_and_repeats(flight):
    first, again = (draw([flight], [clean_flight(211, 30.0)], 0.3, 0) for _ in range(2))
    assert first == again and first["applied"]
    assert (
        first["surveyed"] < 0.5 * first["shaken"]
        and first["anchors_surveyed"] < first["anchors_shaken"]
    )


def test_its_options_are_read():
    parser = argparse.ArgumentParser()
    add_options(parser.add_argument)
    args = parser.parse_args(["--data", "here", "--known", "odometry", "--split", "const1"])
    assert (args.data, args.known, args.split) == (Path("here"), "odometry", "const1")
