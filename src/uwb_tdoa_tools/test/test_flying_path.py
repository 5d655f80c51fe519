import numpy as np
import pytest

from uwb_tdoa_tools.flying.mission import SINK, Circles

GROUND = 0.03


def followed(path, place=(0.3, -0.2)):
    """(Reference, t (n,) s, wanted (n, 3, 3)) up to where it sinks."""
    reference = path.starting_at(np.array(place), GROUND)
    t = np.arange(0.0, path.duration, 0.01)
    return reference, t, reference.at(t)


@pytest.mark.parametrize("path", [Circles(), Circles(swing=0.4), Circles(radius=0.0)])
def test_it_begins_and_ends_at_rest_in_one_place_and_then_sinks(path):
    reference, t, wanted = followed(path)
    for k, height in ((0, GROUND), (-1, GROUND + 0.4)):
        np.testing.assert_allclose(wanted[k, 0], [0.3, -0.2, height], atol=0.01)
        np.testing.assert_allclose(wanted[k, 1], 0.0, atol=0.02)
    np.testing.assert_allclose(
        np.gradient(wanted[:, 0], t, axis=0)[1:-1], wanted[1:-1, 1], atol=0.02
    )
    after = reference.at(np.array([path.duration + 1.0]))[0]
    assert np.isnan(after[0, 2]) and after[1, 2] == -SINK


def test_a_swing_is_one_of_the_height_alone():
    level, swung = (followed(Circles(swing=swing))[2] for swing in (0.0, 0.4))
    off = swung[:, 0] - level[:, 0]
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-9)
    assert off[:, 2].max() == pytest.approx(0.4, abs=1e-3) and off[:, 2].min() == pytest.approx(
        -0.4, abs=1e-3
    )
