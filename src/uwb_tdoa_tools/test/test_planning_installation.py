import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.radio import DWM1000_AZIMUTH, Antenna
from uwb_tdoa_tools.planning.installation import (
    FixedNoise,
    Installation,
    RadioNoise,
    antenna_from_yaml,
    variance_gradient,
)
from uwb_tdoa_tools.simulation.rooms import corners, facing, planar


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


ONE = Anchors.from_positions([[0.0, 0.0, 0.0]])  # no orientation: omnidirectional


def test_link_budget_by_hand():
    """Eqs. 9 - 12 with pencil and paper: 10 m at 3.9936 GHz and 499.2 MHz, 25 degrees C, -10 dBm,
    mean gain.
    """
    got = RadioNoise(tx_power_dbm=-10.0).variance(np.array([[10.0, 0.0, 0.0]]), ONE)[0, 0]
    path_loss = 20 * np.log10(4 * np.pi * 10.0 * 3.9936e9 / 299792458.0)  # 64.48 dB
    thermal = 10 * np.log10(1.380649e-23 * 298.15 * 499.2e6 / 1e-3)  # -86.88 dBm
    snr = 10 ** ((-10.0 + np.mean(DWM1000_AZIMUTH) - path_loss - thermal) / 10)
    assert path_loss == pytest.approx(64.48, abs=0.01) and thermal == pytest.approx(
        -86.87, abs=0.01
    )
    assert got == pytest.approx((299792458.0 / 499.2e6) ** 2 / snr, rel=1e-9)


def test_twice_as_far_is_twice_as_noisy_and_near_is_no_better_than_at_full_strength():
    at = np.array([[0.01, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    std = np.sqrt(RadioNoise().variance(at, ONE)[:, 0])
    np.testing.assert_allclose(std / std[2], [1, 1, 1, 2, 4], rtol=1e-9)


def test_transmit_power_over_temperature_and_voltage():
    """Eq. 13."""
    assert RadioNoise(
        tx_power_dbm=-9.0, temperature=65.0, voltage=3.0
    ).transmitted_dbm == pytest.approx(-9 - 2 - 0.819)
    cold, hot = (
        RadioNoise(temperature=t).variance(np.array([[3.0, 0, 0]]), ONE) for t in (-20.0, 60.0)
    )
    power, noise = 0.05 * 80, 10 * np.log10((60 + 273.15) / (-20 + 273.15))
    assert 10 * np.log10(hot / cold) == pytest.approx(power + noise)
    with pytest.raises(InputError, match="voltage: 5"):
        RadioNoise(voltage=5.0)


def test_the_pattern_counts_and_the_receiver_does_not():
    anchor = facing([[0.0, 0.0, 1.0]], (5.0, 0.0, 1.0))
    front, above = RadioNoise().variance(np.array([[3.0, 0, 1], [0, 0, 4.0]]), anchor)[:, 0]
    difference = Antenna().gain(np.array([1.0, 0, 0])) - Antenna().gain(np.array([0, 0, 1.0]))
    assert 10 * np.log10(above / front) == pytest.approx(difference)
    louder = RadioNoise(Antenna(gain_offset=3.0)).variance(np.array([[3.0, 0, 1]]), anchor)[0, 0]
    assert 10 * np.log10(front / louder) == pytest.approx(3.0)


def test_an_anchor_without_orientation_among_others():
    anchors = corners()
    q = anchors.orientations.copy()
    q[3] = np.nan
    mixed = RadioNoise().variance(
        np.array([[0.3, 0.2, 1.0]]), Anchors(anchors.ids, anchors.positions, q)
    )
    whole = RadioNoise().variance(np.array([[0.3, 0.2, 1.0]]), anchors)
    assert np.isfinite(mixed).all()
    np.testing.assert_array_equal(np.delete(mixed, 3), np.delete(whole, 3))


def test_gradient_against_central_differences():
    noise, anchors = RadioNoise(), corners()
    points = np.random.default_rng(0).uniform([-3, -3.5, 0.5], [3, 3.5, 2.5], (50, 3))
    got = variance_gradient(noise, points, anchors, noise.variance(points, anchors), 3)
    for k, step in enumerate(1e-4 * np.eye(3)):
        wanted = (
            noise.variance(points + step, anchors) - noise.variance(points - step, anchors)
        ) / 2e-4
        np.testing.assert_allclose(got[..., k], wanted, rtol=2e-3, atol=1e-6)


def test_fixed_noise():
    fixed = FixedNoise(0.1)
    variance = fixed.variance(np.zeros((4, 3)), corners())
    assert variance.shape == (4, 8) and (variance == 0.1**2).all()
    assert not variance_gradient(fixed, np.zeros((4, 3)), corners(), variance, 2).any()
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="standard deviation"):
            FixedNoise(bad)


def test_antenna_file(tmp_path):
    file = tmp_path / "antenna.yaml"
    file.write_text(
        "azimuth: [0, 1, 2, 1]\nelevation_1: [0, -5, 2, -9]\nelevation_2: [1, -5, 1, "
        "-9]\ngain_offset: 2\n"
    )
    assert antenna_from_yaml(file).gain(np.array([-1.0, 0, 0])) == pytest.approx(4.0)
    for text in (
        "azimuth: [0, 1, 2, 1]",
        "- 3",
        "azimuth: 5\nelevation_1: 5\nelevation_2: 5",
        ": :",
        "a: [1",
    ):
        file.write_text(text)
        with pytest.raises(InputError, match="antenna"):
            antenna_from_yaml(file)
