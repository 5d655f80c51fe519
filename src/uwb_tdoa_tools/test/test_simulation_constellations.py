import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.simulation.rooms import CONSTELLATIONS, constellation, facing, room_of

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


def test_planar_is_the_one_of_grasso():
    anchors = constellation("planar")
    assert len(anchors) == 4
    np.testing.assert_allclose(anchors.positions[:, 2], 0.2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(anchors.positions, axis=0), axis=1), 4.0)
    front = Rotation.from_quat(anchors.orientations).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        front * np.sqrt(8.0), [0.0, 0.0, 0.2] - anchors.positions, atol=1e-12
    )


def test_tilted_fronts_point_at_the_target_itself():
    positions = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 2.0], [-4.0, 1.0, 0.2]])
    target = np.array([0.0, 0.0, 1.0])
    anchors = facing(positions, target, level=False, inverted=[False, False, True])
    front = Rotation.from_quat(anchors.orientations).apply([1.0, 0.0, 0.0])
    expected = (target - positions) / np.linalg.norm(target - positions, axis=1, keepdims=True)
    np.testing.assert_allclose(front, expected, atol=1e-12)
    up = Rotation.from_quat(anchors.orientations).apply([0.0, 0.0, 1.0])
    assert up[0, 2] > 0.5 and up[2, 2] < -0.5


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
