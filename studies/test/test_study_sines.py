# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flights in sines, to train on."""

import numpy as np
import pytest

from studies.closed_loop.sines import Sines
from uwb_tdoa_tools.flying.mission import SINK
from uwb_tdoa_tools.simulation.rooms import constellation, room_of

ROOM = room_of(constellation("corners"))
GROUND = 0.03


def followed(seed, place):
    """(Reference, t (n,) s, wanted (n, 3, 3)) up to where it sinks."""
    path = Sines(ROOM, seed)
    reference, t = path.starting_at(np.array(place), GROUND), np.arange(0.0, path.duration, 0.01)
    return reference, t, reference.at(t)


def test_it_begins_and_ends_at_rest_in_one_place_and_then_sinks():
    reference, t, wanted = followed(3, (0.3, -0.2))
    for k, height in ((0, GROUND), (-1, GROUND + 0.4)):
        np.testing.assert_allclose(wanted[k, 0], [0.3, -0.2, height], atol=0.01)
        np.testing.assert_allclose(wanted[k, 1], 0.0, atol=0.02)
    np.testing.assert_allclose(
        np.gradient(wanted[:, 0], t, axis=0)[1:-1], wanted[1:-1, 1], atol=0.02
    )
    after = reference.at(np.array([t[-1] + 1.1]))[0]
    assert np.isnan(after[0, 2]) and after[1, 2] == -SINK


def test_sines_fill_the_room_stay_inside_and_turn():
    reference, t, wanted = followed(3, (0.0, 0.0))
    air = wanted[(t > 10.0) & (t < 56.0), 0]
    low, high = ROOM.path_box
    assert (
        (air >= low).all()
        and (air <= high).all()
        and (np.ptp(air, axis=0) > 0.4 * (high - low)).all()
    )
    speed = np.linalg.norm(wanted[:, 1], axis=1)
    assert np.sqrt(np.mean(speed**2)) == pytest.approx(0.7, abs=0.2) and speed.max() < 2.0
    assert reference.yaw_offset(10.0) == pytest.approx(3.0)
    assert np.abs(followed(4, (0.0, 0.0))[2] - wanted).max() > 0.5
