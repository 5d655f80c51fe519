import numpy as np
import pytest

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.flyable import FlyableVolume
from uwb_tdoa_ekf.monitoring.volume import VolumeCheck

ANCHORS = Anchors.from_positions([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 3]])
COVARIANCE = np.diag([0.01, 0.03, 0.12])


def volume(planar=False):
    cells = np.ones((2, 1, 1), bool)
    cells[1] = False
    bound = np.array([0.2, np.inf]).reshape(2, 1, 1)
    return FlyableVolume(
        [0, 0, 0], [1, 1, 1], cells, bound, ANCHORS.ids, ANCHORS.positions, planar=planar
    )


@pytest.mark.parametrize(
    ("planar", "claimed", "efficiency"), [(False, "0.400 m", "0.25"), (True, "0.200 m", "1")]
)
def test_the_covariance_is_compared_with_the_bound(planar, claimed, efficiency):
    trouble, values = VolumeCheck(volume(planar)).trouble_at(
        ANCHORS, np.array([0.5, 0.5, 0.5]), COVARIANCE
    )
    assert trouble is None and values == {
        "flyable": "yes",
        "bound of one round": "0.200 m",
        "claimed by the filter": claimed,
        "efficiency": efficiency,
    }


@pytest.mark.parametrize("p", [[1.5, 0.5, 0.5], [0.5, 0.5, 9.0], [np.nan, 0.5, 0.5]])
def test_outside_is_told(p):
    trouble, values = VolumeCheck(volume()).trouble_at(ANCHORS, np.array(p), COVARIANCE)
    assert "outside of the flyable volume" in trouble and values == {"flyable": "no"}


def test_a_volume_of_other_anchors_is_told():
    moved = Anchors.from_positions(ANCHORS.positions + 0.5)
    trouble, values = VolumeCheck(volume()).trouble_at(moved, np.array([0.5, 0.5, 0.5]), COVARIANCE)
    assert "other anchors" in trouble and values == {"flyable": "unknown"}


def test_without_a_volume_nothing_is_said():
    assert VolumeCheck().trouble_at(ANCHORS, np.zeros(3), COVARIANCE) == (None, {})
