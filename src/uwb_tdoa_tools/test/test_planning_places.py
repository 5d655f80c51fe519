import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.planning.layout import AnchorPlaces, lattice, spread

ROOM = np.array([0.0, 0.0, 0.0]), np.array([6.0, 5.0, 3.0])


def test_places_on_walls():
    places = AnchorPlaces.walls(*ROOM)
    assert places.numbers == 2
    p = places.positions(np.random.default_rng(0).random((2000, 2)))
    on_x, on_y = np.isin(p[:, 0], (0.0, 6.0)), np.isin(p[:, 1], (0.0, 5.0))
    assert (on_x | on_y).all() and 0.4 < on_y.mean() < 0.7
    assert (p >= [0, 0, 0.2]).all() and (p <= ROOM[1]).all()
    np.testing.assert_allclose(np.ptp(p, axis=0), [6, 5, 2.8], atol=0.02)


def test_places_along_walls():
    places = AnchorPlaces.walls(*ROOM, depth=0.5)
    assert places.numbers == 3
    np.testing.assert_allclose(places.lengths, [22.0, 2.8, 0.5])
    p = places.positions(np.random.default_rng(0).random((2000, 3)))
    away = np.minimum(p, ROOM[1] - p)[:, :2].min(axis=1)
    assert (away <= 0.5).all() and away.max() > 0.45 and (p[:, 2] >= 0.2).all()


def test_places_of_all_shapes():
    places = AnchorPlaces([[0, 0, 0, 1, 2, 3], [5, 5, 5, 5, 5, 5], [7, 0, 1, 9, 0, 1]])
    assert places.numbers == 3
    p = places.positions(np.random.default_rng(0).random((4000, 3)))
    block, post, rail = (
        p[:, 0] <= 1,
        (p == 5).all(axis=1),
        (p[:, 0] >= 7) & (p[:, 1] == 0) & (p[:, 2] == 1),
    )
    assert (block | post | rail).all() and block.any() and rail.any()
    np.testing.assert_allclose(p[block].max(axis=0), [1, 2, 3], atol=0.05)
    np.testing.assert_allclose(
        AnchorPlaces([[5, 5, 5, 5, 5, 5]]).positions(np.array([0.3, 0.9])), [5, 5, 5]
    )


def test_nearest_place():
    places = AnchorPlaces.walls(*ROOM)
    wanted = np.array([[6.3, 2.0, 1.0], [3.0, -0.5, 2.8], [0.0, 5.0, 0.2]])
    got = places.positions(places.nearest(wanted))
    np.testing.assert_allclose(got, [[6, 2, 1], [3, 0, 2.8], [0, 5, 0.2]], atol=0.15)


@pytest.mark.parametrize(
    "content",
    [
        "places: []",
        "places: [[1, 2, 3]]",
        "walls: 4",
        "- 1",
        "places: [[0, 0, 0, 1, 1, -1]]",
        "a: [",
        "places: [[0, 0, 0, 1, 1, x]]",
    ],
)
def test_bad_places(content, tmp_path):
    (tmp_path / "places.yaml").write_text(content)
    with pytest.raises(InputError, match="places"):
        AnchorPlaces.from_yaml(tmp_path / "places.yaml")


def test_a_lattice_holds_the_corners():
    p = lattice((0, 0, 1), (2, 1, 1), 0.6)
    assert {(0, 0, 1), (2, 1, 1), (0, 1, 1), (2, 0, 1)} <= set(map(tuple, p.tolist())) and len(
        p
    ) == 5 * 3
    assert np.diff(np.unique(p[:, 0])).max() <= 0.6


def test_a_spread_begins_with_the_corners_and_covers_the_rest():
    p = lattice((0, 0, 1), (5, 4, 2), 0.5)
    rows = spread(p, 40)
    assert len(set(rows)) == 40
    assert set(map(tuple, p[rows[:8]])) == {
        (x, y, z) for x in (0, 5) for y in (0, 4) for z in (1, 2)
    }
    assert np.linalg.norm(p[:, None] - p[rows], axis=-1).min(axis=1).max() <= 1.0
    assert sorted(spread(p[:5], 40)) == [0, 1, 2, 3, 4] and len(spread(p, 3)) == 3
