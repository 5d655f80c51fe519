from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.radio import (
    DWM1000_AZIMUTH,
    DWM1000_ELEVATION_1,
    DWM1000_ELEVATION_2,
    Antenna,
)

angles = st.floats(-np.pi, np.pi)


def towards(theta, phi):
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack(
        [np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=-1
    )


def test_azimuth_cut_is_met_exactly():
    theta = np.deg2rad(30.0 * np.arange(12))
    np.testing.assert_allclose(Antenna().gain(towards(theta, 0.0)), DWM1000_AZIMUTH, atol=1e-9)


@pytest.mark.parametrize(
    ("cut", "theta"), [(DWM1000_ELEVATION_1, 0.0), (DWM1000_ELEVATION_2, 90.0)]
)
def test_elevation_cuts_are_met_away_from_the_plane(cut, theta):
    """On an elevation cut, equation 14 leaves (1 - cos^40) of it: all but 0.4 % from 30 degrees on."""
    around = np.deg2rad(30.0 * np.arange(12))
    azimuth = np.deg2rad(theta)
    direction = np.cos(around)[:, None] * towards(azimuth, 0.0) + np.sin(around)[
        :, None
    ] * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(Antenna().gain(direction), cut, atol=0.05)
    steep = [2, 3, 4, 8, 9, 10]
    np.testing.assert_allclose(Antenna().gain(direction)[steep], np.array(cut)[steep], atol=1e-6)


def test_blend_is_equation_14():
    antenna = Antenna()
    theta, phi = np.deg2rad(30.0), np.deg2rad(30.0)
    a3 = np.cos(phi) ** 40
    a1, a2 = np.cos(theta) ** 2 * (1 - a3), (1 - np.cos(theta) ** 2) * (1 - a3)
    expected = a1 * DWM1000_ELEVATION_1[1] + a2 * DWM1000_ELEVATION_2[1] + a3 * DWM1000_AZIMUTH[1]
    assert antenna.gain(towards(theta, phi)) == pytest.approx(expected, abs=1e-9)
    # x < 0, y < 0
    expected = a1 * DWM1000_ELEVATION_1[5] + a2 * DWM1000_ELEVATION_2[5] + a3 * DWM1000_AZIMUTH[7]
    assert antenna.gain(towards(np.pi + theta, phi)) == pytest.approx(expected, abs=1e-9)


@given(angles, st.floats(-1.57, 1.57), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_pattern_is_continuous(theta, phi, d_theta, d_phi):
    antenna, step = Antenna(), 1e-6
    one, other = towards(theta, phi), towards(theta + step * d_theta, phi + step * d_phi)
    assert abs(antenna.gain(one) - antenna.gain(other)) < 200.0 * step
    assert abs(antenna.group_delay(one) - antenna.group_delay(other)) < 10.0 * step


def test_cuts_that_do_not_meet_are_refused():
    with pytest.raises(InputError, match=r"cross at \+x"):
        Antenna(azimuth=(0.0, *DWM1000_AZIMUTH[1:]))
    with pytest.raises(InputError, match="multiple of 4"):
        Antenna(azimuth=(1.0, 2.0, 3.0))


def test_delay_is_late_and_largest_in_the_nulls():
    antenna = Antenna()
    sphere = np.random.default_rng(1).standard_normal((20000, 3))
    delay = antenna.group_delay(sphere)
    assert delay.min() >= 0.0 and delay.max() <= antenna.delay_span
    down, up, front = (
        antenna.group_delay(np.array(v)) for v in ((0, 0, -1.0), (0, 0, 1.0), (1.0, 0, 0))
    )
    assert down > up > 0.08 and front < 1e-3
    assert np.corrcoef(antenna.gain(sphere), delay)[0, 1] < -0.9
