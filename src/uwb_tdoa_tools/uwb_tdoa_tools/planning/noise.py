"""How precisely one reception is timed: its variance over the places of tag and anchor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.antenna import Antenna
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.radio import SPEED_OF_LIGHT, RadioLink, received_power_dbm
from uwb_tdoa_bias.foundation.safe_yaml import read_yaml

if TYPE_CHECKING:
    from pathlib import Path

    from uwb_tdoa_bias.foundation.anchors import Anchors

BOLTZMANN = 1.380649e-23  # J/K
ZERO_CELSIUS = 273.15  # K
_ANY_ATTITUDE = (0.0, 0.0, 0.0, 1.0)  # the tag's antenna is taken as omnidirectional
_STEP = 1e-5  # m, for numerical derivatives


@dataclass(frozen=True)
class Omnidirectional:
    """An antenna with one gain, dBi, in all directions."""

    dbi: float = 0.0

    def gain(self, direction: np.ndarray) -> np.ndarray:
        """Gain towards directions (..., 3): (...) dBi."""
        return np.full(np.shape(direction)[:-1], self.dbi)


@dataclass(frozen=True)
class RadioNoise:
    """Noise from the link budget: Friis, thermal noise and the anchors' radiation pattern.

    Source: eqs. 9 - 14 of Grasso et al. (Sensors 2022, 22, 9136). The gain of the receiving antenna
    is left out, as there.

    Attributes
    ----------
    antenna : Antenna of the anchors (default DWM1000-like); an anchor without orientation radiates
        the mean of the
        azimuth cut in all directions
    tx_power_dbm : into the antenna, at the reference temperature and voltage, dBm (default: that of
        RadioLink)
    temperature : degrees Celsius, of transmitter and thermal noise (default 25)
    voltage : supply of the transmitter, V (default 3.3)
    tx_power_per_degree, tx_power_per_volt : dB (default: typical of the DW1000 data sheet, channel
        2)
    bandwidth : Hz (default 499.2e6, channels 1, 2, 3 and 5)
    full_strength : m, nearer than this a reception becomes no better: r_0 of eq. 9 (default 1.0)
    """

    antenna: Antenna = field(default_factory=Antenna)
    tx_power_dbm: float = RadioLink.tx_power_dbm
    temperature: float = 25.0
    voltage: float = 3.3
    tx_power_per_degree: float = -0.05
    tx_power_per_volt: float = 2.73
    bandwidth: float = 499.2e6
    full_strength: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("tx_power_dbm", -60, 30),
            ("temperature", -40, 85),
            ("voltage", 2.8, 3.6),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(
                    f"{name}: {value!r} is outside {low} ... {high}, the range of a DW1000."
                )

    @property
    def transmitted_dbm(self) -> float:
        """Transmitted power at this temperature and voltage, dBm: eq. 13."""
        warmer, more = self.temperature - 25.0, self.voltage - 3.3
        return self.tx_power_dbm + self.tx_power_per_degree * warmer + self.tx_power_per_volt * more

    @property
    def thermal_noise_dbm(self) -> float:
        """Power of thermal noise in the bandwidth, dBm."""
        return 10.0 * np.log10(BOLTZMANN * (self.temperature + ZERO_CELSIUS) * self.bandwidth * 1e3)

    def variance(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """Variance of the range that one reception gives: (n, N) m^2, for points (n, 3) m and N
        Anchors. Eqs. 9, 12.
        """
        snr_db = self._received(points, anchors) - self.thermal_noise_dbm
        return (SPEED_OF_LIGHT / self.bandwidth) ** 2 * 10.0 ** (-0.1 * snr_db)

    def _received(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """Power at full_strength or farther, (n, N) dBm. Eq. 11."""
        away = points[:, None, :] - anchors.positions
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        away *= np.maximum(self.full_strength / np.maximum(distance, 1e-9), 1.0)
        power = np.empty(away.shape[:2])
        turned = np.isfinite(anchors.orientations).all(axis=1)
        mean = Omnidirectional(float(np.mean(self.antenna.azimuth)) + self.antenna.gain_offset)
        for rows, antenna in ((turned, self.antenna), (~turned, mean)):
            if rows.any():
                link = RadioLink(
                    antenna,  # type: ignore[arg-type]  # has `gain`
                    Omnidirectional(),  # type: ignore[arg-type]  # has `gain`
                    tx_power_dbm=self.transmitted_dbm,
                )
                q = np.where(turned[rows, None], anchors.orientations[rows], _ANY_ATTITUDE)
                power[:, rows] = received_power_dbm(
                    away[:, rows], _ANY_ATTITUDE, np.zeros(3), q, link
                )
        return power


@dataclass(frozen=True)
class FixedNoise:
    """The same noise everywhere. std : m, standard deviation of one reception."""

    std: float

    def __post_init__(self) -> None:
        if not 0.0 < self.std < 100.0:
            raise InputError(
                f"noise: {self.std!r} m is not a standard deviation; give one above 0, e.g. 0.06."
            )

    def variance(self, points: np.ndarray, anchors: Anchors) -> np.ndarray:
        """(n, N) m^2."""
        return np.full((len(points), len(anchors)), self.std**2)


def variance_gradient(
    noise: RadioNoise | FixedNoise,
    points: np.ndarray,
    anchors: Anchors,
    variance: np.ndarray,
    dimensions: int,
) -> np.ndarray:
    """Derivative of noise.variance along x, y (and z), by one-sided differences: (n, N, dimensions)
    m.

    variance : (n, N) m^2, noise.variance at the points.
    """
    if isinstance(noise, FixedNoise):
        return np.zeros((*variance.shape, dimensions))
    steps = _STEP * np.eye(3)[:dimensions]
    return (
        np.stack([noise.variance(points + step, anchors) - variance for step in steps], axis=-1)
        / _STEP
    )


def antenna_from_yaml(path: str | Path) -> Antenna:
    """Antenna of a YAML file with the fields of `uwb_tdoa_bias.foundation.antenna.Antenna`:
    azimuth, elevation_1, elevation_2 (dBi, around the full circle), and optionally gain_offset.
    Raises InputError.
    """
    content = read_yaml(path)
    try:
        cuts: dict[str, Any] = {
            name: tuple(content.pop(name)) for name in ("azimuth", "elevation_1", "elevation_2")
        }
        return Antenna(**cuts, **content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is no antenna ({error!r}); give lists azimuth, elevation_1 and "
            "elevation_2 of gains in dBi."
        ) from error
