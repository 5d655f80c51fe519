"""Rooms of simulated flights: constellations, walls, cells."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.rooms import (
    CONSTELLATIONS,
    Walls,
    constellation,
    heard_at,
    room_of,
)

NAMES = [*CONSTELLATIONS, "random-5", "random-1-4", "random-2-64"]


@pytest.mark.parametrize("name", NAMES)
def test_is_a_usable_constellation_that_faces_the_middle(name):
    anchors = constellation(name)
    assert (4 <= len(anchors) <= 64) or name == "pair"
    gaps = np.linalg.norm(anchors.positions[:, None] - anchors.positions, axis=2)[
        np.triu_indices(len(anchors), 1)
    ]
    assert gaps.min() > 0.4
    front = Rotation.from_quat(anchors.orientations).apply([1.0, 0.0, 0.0])
    inwards = -(anchors.positions - anchors.positions.mean(axis=0))
    assert (np.sum(front[:, :2] * inwards[:, :2], axis=1) > 0.0).all()
    low, high = room_of(anchors).flyable
    assert (high - low > 1.0).all()


def test_corners_are_like_the_surveyed_ones():
    anchors = constellation("corners")
    np.testing.assert_allclose(np.ptp(anchors.positions[:, :2], axis=0), [7.0, 8.0])
    assert np.count_nonzero(anchors.positions[:, 2] < 0.5) == 4
    up = Rotation.from_quat(anchors.orientations).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        up[:, 2], np.where(anchors.positions[:, 2] < 0.5, 1.0, -1.0), atol=1e-12
    )


def test_random_is_seeded():
    one, same, other = (
        constellation("random-7-12"),
        constellation("random-7-12"),
        constellation("random-8-12"),
    )
    assert len(one) == 12
    np.testing.assert_array_equal(one.orientations, same.orientations)
    assert np.abs(one.positions - other.positions).max() > 0.1


@pytest.mark.parametrize("name", ["nowhere", "random", "random-x", "random-1-3", "random-1-65", ""])
def test_unknown_names_are_refused(name):
    with pytest.raises(InputError, match="^constellation: "):
        constellation(name)


ACROSS = Walls(((4.0, -10.0, 4.0, 2.0, np.inf),))
SHELF = Walls(((4.0, -10.0, 4.0, 20.0, 3.0),))


def hall_of_cells():
    """32 Anchors in 28 x 14 m, whose ids are 256 times the number of their cell of 16, and 0 ...
    15.
    """
    x, y = np.meshgrid(np.arange(8) * 4.0, np.arange(4) * 14.0 / 3.0)
    positions = np.column_stack([x.ravel(), y.ravel(), np.tile([0.5, 3.0, 5.5, 4.0], 8)])
    right = positions[:, 0] > 14.0
    ids = np.where(right, 256, 0) + np.where(right, np.cumsum(right), np.cumsum(~right)) - 1
    return Anchors.from_positions(positions, ids)


def flown(**kind):
    config = SimulationConfig(
        anchors=hall_of_cells(),
        bias=False,
        protocol="tdoa3",
        duration=20.0,
        start_in_air=True,
        radio_reach=12.0,
        **kind,
    )
    return simulate(config)


@pytest.mark.parametrize(
    "walls, p, q, blocked",
    [
        (ACROSS, (0, 0, 1), (8, 0, 1), True),
        (ACROSS, (0, 6, 1), (8, 6, 1), False),  # past its end
        (ACROSS, (0, 0, 1), (3, 0, 1), False),  # this side of it
        (ACROSS, (5, 0, 1), (8, 0, 1), False),
        (ACROSS, (4, -20, 1), (4, 20, 1), False),  # along it
        (ACROSS, (0, 0, 100), (8, 0, 100), True),
        (SHELF, (0, 0, 1), (8, 0, 4), True),
        (SHELF, (0, 0, 1), (8, 0, 6), False),  # over it
    ],
)
def test_a_wall_stands_between(walls, p, q, blocked):
    for one, other in ((p, q), (q, p)):
        assert walls.between(np.array([one], float), np.array([other], float)).tolist() == [blocked]


def test_nothing_is_heard_through_a_wall(monkeypatch):
    monkeypatch.setattr("uwb_tdoa_tools.simulation.rooms.AT_ONCE", 100)
    anchors, walls = hall_of_cells(), Walls(((15.0, -1.0, 15.0, 20.0, np.inf),))
    p = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (28.0, 14.0, 3.0), (50, 3))
    far = np.linalg.norm(p[:, None] - anchors.positions, axis=2) > 12.0
    behind = (p[:, None, 0] > 15.0) != (anchors.positions[:, 0] > 15.0)
    for rows, blocked in zip(heard_at(p, anchors.positions, 12.0, walls), far | behind):
        np.testing.assert_array_equal(rows, np.flatnonzero(~blocked))


def test_a_flight_hears_nothing_through_walls():
    walls = Walls(((14.0, -1.0, 14.0, 20.0, np.inf),))
    flight = flown(walls=walls)
    place = np.column_stack(
        [np.interp(flight.tdoa.t, flight.truth.t, column) for column in flight.truth.p.T]
    )
    for ids in (flight.tdoa.a, flight.tdoa.b):
        assert not walls.between(place, flight.anchors.positions[flight.anchors.index(ids)]).any()
    assert np.ptp(place[:, 0]) > 5.0 and flight.meta["config"]["walls"] == [
        [14.0, -1.0, 14.0, 20.0]
    ]
    assert walls.between(
        place, flown().anchors.positions[flown().anchors.index(flown().tdoa.a[: len(place)])]
    ).any()


def test_cells_that_use_the_same_ids_have_clocks_of_their_own():
    flight = flown(cell_ids=256)
    assert set(flight.anchors.ids % 256) == set(range(16))
    np.testing.assert_array_equal(flight.tdoa.a // 256, flight.tdoa.b // 256)
    assert set(flight.tdoa.a // 256) == {0, 1}
    assert (flown().tdoa.a // 256 != flown().tdoa.b // 256).any()


def test_a_tag_among_cells_is_found():
    flight = flown(cell_ids=256)
    odometry = run_offline(flight).odometry
    place = np.column_stack(
        [np.interp(odometry.t, flight.truth.t, column) for column in flight.truth.p.T]
    )
    assert np.linalg.norm(odometry.p - place, axis=1)[odometry.t > 5.0].max() < 0.5


@pytest.mark.parametrize(
    "text, wrong",
    [
        ("walls: []", "no list 'walls'"),
        ("[1, 2]", "no list 'walls'"),
        ("walls: [[0, 0, 1]]", "number 1 is"),
        ("walls: [[0, 0, 1, 1], [2, 2, 2, 2]]", "number 2 is"),
        ("walls: [[0, 0, x, 1]]", "number 1 is"),
    ],
)
def test_what_is_no_wall_is_refused(tmp_path, text, wrong):
    (tmp_path / "walls.yaml").write_text(text)
    with pytest.raises(InputError, match=wrong):
        Walls.from_yaml(tmp_path / "walls.yaml")


def test_walls_of_a_file(tmp_path):
    (tmp_path / "walls.yaml").write_text("walls:\n- [0, 1, 2.5, 3]\n- [0, 1, 2, 3, 4]\n")
    assert Walls.from_yaml(tmp_path / "walls.yaml").segments == (
        (0.0, 1.0, 2.5, 3.0, np.inf),
        (0.0, 1.0, 2.0, 3.0, 4.0),
    )


@pytest.mark.parametrize(
    "kind, wrong",
    [
        ({"walls": ACROSS}, "radio_reach"),
        ({"cell_ids": 256}, "radio_reach"),
        ({"cell_ids": 1, "radio_reach": 9.0}, "cell_ids"),
    ],
)
def test_what_does_not_fit_together_is_refused(kind, wrong):
    with pytest.raises(InputError, match=wrong):
        SimulationConfig(**kind)
