import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.planning.installation import Installation
from uwb_tdoa_tools.simulation.constellations import corners, hall, planar


@pytest.mark.parametrize(
    ("positions", "dimensions", "says"),
    [
        (
            [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
            3,
            "3 were given; a position in space needs at least 4",
        ),
        ([[0, 0, 0], [1, 0, 0]], 2, "2 were given; a position at known height needs at least 3"),
        (
            [[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3], [4, 0, 0.005]],
            3,
            "1 and 4 are at the same place",
        ),
        ([[0, 0, 1], [4, 0, 1], [4, 4, 1.01], [0, 4, 1], [2, 3, 1]], 3, "all are in one plane"),
        ([[0, 0, 0], [1, 1, 1], [2, 2, 2], [5, 5, 5.01]], 3, "all are on one line to"),
        ([[0, 0, 0], [2, 2, 3], [5, 5, 0]], 2, "all are on one line seen from above"),
        ([[1, 1, 0], [1, 1, 1], [1, 1, 2], [1, 1, 3]], 2, "all are on one line seen from above"),
    ],
)
def test_anchors_that_locate_nothing_are_told_so(positions, dimensions, says):
    with pytest.raises(InputError, match="^anchors: ") as refusal:
        Installation(Anchors.from_positions(np.array(positions, float)), dimensions=dimensions)
    assert says in str(refusal.value) and str(refusal.value).endswith(".")


def test_a_tilted_plane_is_found_too():
    flat = np.column_stack([np.random.default_rng(1).uniform(-4, 4, (9, 2)), np.zeros(9)])
    tilt = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    with pytest.raises(InputError, match="in one plane"):
        Installation(Anchors.from_positions(flat @ tilt))


def test_usual_installations_are_accepted():
    for anchors in (corners(), hall()):
        assert len(Installation(anchors).pairing.a) == len(anchors)
    Installation(planar(), dimensions=2)


def test_link_noise_is_a_standard_deviation():
    with pytest.raises(InputError, match="link noise: -1"):
        Installation(corners(), link_std=-1.0)


def test_hull():
    installation = Installation(corners(4.0, 4.0, 3.0))
    points = np.array([[0, 0, 1.5], [1.9, 1.9, 1.0], [0, 0, 3.1], [2.1, 0, 1.0]])
    assert installation.inside_hull(points).tolist() == [True, True, False, False]
    above = Installation(corners(4.0, 4.0, 3.0), dimensions=2)
    assert above.inside_hull(points).tolist() == [True, True, True, False]


def test_with_a_height_sensor_anchors_in_a_plane_are_enough_and_the_hull_is_that_from_above():
    flat = Installation(planar(), height_std=0.02)
    high, low = flat.anchors.positions[:, :2].max(axis=0), flat.anchors.positions[:, :2].min(axis=0)
    points = np.array([[*(0.5 * (high + low)), 7.0], [*(high + 0.1), 1.0]])
    assert (
        flat.inside_hull(points).tolist() == [True, False]
        and flat.unknowns == 2
        and flat.dimensions == 3
    )
    for options in (
        {"height_std": 0.0},
        {"height_std": np.nan},
        {"height_std": 0.1, "dimensions": 2},
    ):
        with pytest.raises(InputError, match="height std"):
            Installation(planar(), **options)
