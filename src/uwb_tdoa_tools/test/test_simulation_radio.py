import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.antenna import Antenna
from uwb_tdoa_bias.foundation.radio import (
    RadioLink,
    arrival_bias,
    into_frame,
    power_bias,
    received_power_dbm,
)
from uwb_tdoa_tools.simulation.rooms import pair
from uwb_tdoa_tools.simulation.tdoas import tag_link

ISOTROPIC = Antenna((0.0,) * 4, (0.0,) * 4, (0.0,) * 4)
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_power_bias_is_the_table_of_aps011():
    assert power_bias(-61.0) == pytest.approx(-0.110)
    assert power_bias(-77.0) == pytest.approx(0.0)
    assert power_bias(-75.0) == pytest.approx(-0.027)
    assert power_bias(-95.0) == pytest.approx(0.086)
    assert power_bias(-76.0) == pytest.approx(-0.0135)
    np.testing.assert_allclose(power_bias([-20.0, -130.0]), [-0.110, 0.086])


def test_friis_by_hand():
    """Two isotropic antennas: the free-space loss of the handbooks, 32.45 + 20 log10(km) + 20
    log10(MHz) dB.
    """
    link = RadioLink(ISOTROPIC, ISOTROPIC, tx_power_dbm=0.0, frequency=4.0e9)
    p = received_power_dbm(np.zeros(3), LEVEL, np.array([4.0, 0, 0]), LEVEL, link)
    assert p == pytest.approx(-(32.45 + 20 * np.log10(0.004) + 20 * np.log10(4000.0)), abs=0.01)
    farther = received_power_dbm(np.zeros(3), LEVEL, np.array([40.0, 0, 0]), LEVEL, link)
    assert p - farther == pytest.approx(20.0)


def test_gains_of_both_antennas_count():
    """Tag above the anchor, which it has at its back (-x of a flat antenna), in the upper null of
    the anchor.
    """
    link = RadioLink(tx_power_dbm=0.0)
    isotropic = RadioLink(ISOTROPIC, ISOTROPIC, tx_power_dbm=0.0)
    where = np.array([0.0, 0.0, 2.0]), LEVEL, np.zeros(3), LEVEL
    gains = Antenna().gain(np.array([-1.0, 0, 0])) + Antenna().gain(np.array([0, 0, 1.0]))
    assert received_power_dbm(*where, link) - received_power_dbm(
        *where, isotropic
    ) == pytest.approx(gains)


def test_only_relative_poses_matter():
    rng = np.random.default_rng(3)
    p_tag, p_anchor = rng.standard_normal((2, 50, 3)) * 3
    q_tag, q_anchor = (Rotation.random(50, random_state=k) for k in (1, 2))
    turn, shift = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]), np.array([1.0, -2.0, 0.5])
    one = arrival_bias(p_tag, q_tag.as_quat(), p_anchor, q_anchor.as_quat())
    other = arrival_bias(
        turn.apply(p_tag) + shift,
        (turn * q_tag).as_quat(),
        turn.apply(p_anchor) + shift,
        (turn * q_anchor).as_quat(),
    )
    np.testing.assert_allclose(one, other, atol=1e-9)
    assert np.ptp(one) > 0.1


def test_broadcasts_samples_against_anchors():
    anchors = pair()
    p_tag = np.random.default_rng(4).uniform(-1.0, 1.0, (7, 3))
    q_tag = np.tile(LEVEL, (7, 1))
    table = received_power_dbm(
        p_tag[:, None], q_tag[:, None], anchors.positions, anchors.orientations
    )
    assert table.shape == (7, 2)
    np.testing.assert_allclose(
        table[:, 1],
        received_power_dbm(p_tag, q_tag, anchors.positions[1], anchors.orientations[1]),
        rtol=1e-12,
    )


def test_into_frame_is_the_inverse_rotation():
    q = Rotation.random(20, random_state=5)
    v = np.random.default_rng(5).standard_normal((20, 3))
    np.testing.assert_allclose(into_frame(q.as_quat(), v), q.inv().apply(v), atol=1e-12)


def spin(anchors, link=RadioLink()):
    """TDOA bias of the pair (0, 1) over a full turn of the tag half-way between the anchors."""
    yaw = np.linspace(-np.pi, np.pi, 181)
    q_tag = Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0])).as_quat()
    late = arrival_bias(
        anchors.positions.mean(axis=0),
        q_tag[:, None],
        anchors.positions,
        anchors.orientations,
        link,
    )
    return late[:, 1] - late[:, 0]


def test_figure_4_left_bias_over_a_spin_depends_on_anchor_orientation():
    anchors = pair()
    curves = []
    for azimuth, elevation in ((0, 0), (90, 30), (200, 70)):
        turn = Rotation.from_euler("zy", [azimuth, elevation], degrees=True)
        orientations = anchors.orientations.copy()
        orientations[0] = (turn * Rotation.from_quat(orientations[0])).as_quat()
        curves.append(spin(Anchors(anchors.ids, anchors.positions, orientations)))
    for curve in curves:
        assert 0.1 < np.ptp(curve) < 0.8
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(curves[one] - curves[other]).max() > 0.03


def test_figure_4_right_five_tags_are_alike():
    curves = np.array([spin(pair(), tag_link(unit)) for unit in range(1, 6)])
    assert (curves.std(axis=0) > 1e-5).any()
    spread = np.abs(curves - curves.mean(axis=0)).max()
    assert spread < 0.2 * np.ptp(curves.mean(axis=0))
    assert np.corrcoef(curves).min() > 0.98
