"""A survey that is certainly wrong is refused by itself; a usable one, of a table or of a large
hall, is not.
"""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.survey_faults import UNITS, refuse_faulty, survey_faults

ROOM = np.array(
    [[x, y, z] for x, y in ((-3.1, -4.0), (-3.2, 3.8), (3.7, 3.7), (4.0, -4.4)) for z in (0.2, 3.0)]
)


def sentence(positions):
    """The first fault, or ""."""
    faults = survey_faults(Anchors.from_positions(positions, ids=np.arange(len(positions)) + 10))
    return faults[0].sentence if faults else ""


@pytest.mark.parametrize("unit", ["millimetres", "centimetres"])
@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_a_survey_in_a_small_unit_is_named(unit, mirrored):
    said = sentence(ROOM * [mirrored, 1.0, 1.0] * UNITS[unit])
    assert f"the survey looks like {unit}" in said and f"divide it by {UNITS[unit]:g}" in said


@pytest.mark.parametrize("row", range(8))
def test_one_anchor_in_millimetres_is_named(row):
    positions = ROOM.copy()
    positions[row] *= 1000.0
    assert f"the position of anchor {row + 10} looks like millimetres" in sentence(positions)


def test_two_anchors_in_millimetres_are_named():
    positions = ROOM.copy()
    positions[[3, 5]] *= 1000.0
    assert "the positions of anchors 13 and 15 look like millimetres" in sentence(positions)


def test_a_mistyped_anchor_is_not_called_a_unit():
    positions = ROOM.copy()
    positions[2, 0] += 5e6
    assert "anchor 12 cannot be in metres" in sentence(positions)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (4.0, 5.0, 6.0)])
def test_all_at_one_place(place):
    assert "all anchors are at one place" in sentence(np.tile(place, (8, 1)))


def test_two_at_one_place_are_named():
    positions = ROOM.copy()
    positions[3] = positions[2]
    assert "anchors 12 and 13 are at one place" in sentence(positions)


def test_it_is_refused_with_its_source():
    with pytest.raises(InputError, match="^room.csv: the survey looks like millimetres"):
        refuse_faulty(Anchors.from_positions(1000.0 * ROOM), "room.csv")


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**31),
    st.integers(1, 40),
    st.floats(0.5, 300.0),
    st.floats(0.5, 200.0),
    st.floats(0.0, 20.0),
    st.sampled_from([0.0, 1e3, 5e6]),
)
def test_rooms_and_halls_are_usable(seed, count, length, width, height, origin):
    """From a table to a hall of 300 x 200 m, in any frame."""
    positions = (
        np.random.default_rng(seed).uniform(0.0, 1.0, (count, 3)) * [length, width, height] + origin
    )
    assert survey_faults(Anchors.from_positions(positions)) == []


def test_a_large_network_takes_little_work():
    """Ten thousand anchors over three kilometres, a grid of 30 m."""
    x, y = np.meshgrid(np.arange(100) * 30.0, np.arange(100) * 30.0)
    positions = np.column_stack([x.ravel(), y.ravel(), np.full(10_000, 5.0)])
    assert survey_faults(Anchors.from_positions(positions)) == []
