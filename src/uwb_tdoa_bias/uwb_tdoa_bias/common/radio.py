# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The radio link of a tag and an anchor: antennas, received power, and late arrivals.

Antenna frame: z along the null axis of the doughnut, x out of its front face. The null axis is the
long side of an upright module. Azimuth runs from +x through +y, elevation from the xy plane
towards +z.

The functions broadcast. One anchor per sample has the shapes (n, 3) and (n, 3). All anchors for
all samples have the shapes (m, 3) and (n, 1, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import floats, interpolate, piecewise
from .errors import InputError

# Gain in dBi every 30 degrees around the full circle, of a DWM1000-like module near 4 GHz. These
# are not measured values. Their shape follows the plots in the DWM1000 data sheet, an uneven
# doughnut. The ripple around the upright module is 3 dB. The two nulls along its axis have unequal
# depth; the deeper one is where the board shadows the antenna. Decawave's support quotes their level
# for the upright module (-2 to -5 dB).
# Azimuth cut, from +x through +y.
DWM1000_AZIMUTH = (-2.0, -2.2, -3.0, -4.0, -3.6, -2.8, -3.0, -4.2, -5.0, -4.4, -3.2, -2.3)
# Elevation cut from +x through +z.
DWM1000_ELEVATION_1 = (-2.0, -2.5, -5.0, -11.0, -6.5, -3.5, -3.0, -4.5, -9.0, -20.0, -8.0, -3.0)
# Elevation cut from +y through +z.
DWM1000_ELEVATION_2 = (-4.0, -3.5, -5.5, -11.0, -7.0, -5.0, -4.4, -5.5, -10.0, -20.0, -9.0, -5.0)
LARGEST_GAIN = 200.0  # dB, magnitude; larger gains are input errors


@dataclass(frozen=True)
class Antenna:
    """A 3-D radiation pattern built from three cuts, and its group delay.

    Attributes
    ----------
    azimuth : gains around the xy plane from +x through +y, equally spaced over 360 degrees, dBi
    elevation_1 : gains around the xz plane from +x through +z, dBi
    elevation_2 : gains around the yz plane from +y through +z, dBi
    gain_offset : added to all gains, dB (default 0)
    delay_span : group delay of a direction without direct radiation, m (default 0.15: reports give
        10 - 15 cm for modules, 20 cm and more for poor antennas)

    Where two cuts cross they must agree to 0.01 dB; otherwise the pattern would jump.
    """

    azimuth: tuple[float, ...] = DWM1000_AZIMUTH
    elevation_1: tuple[float, ...] = DWM1000_ELEVATION_1
    elevation_2: tuple[float, ...] = DWM1000_ELEVATION_2
    gain_offset: float = 0.0
    delay_span: float = 0.15

    def __post_init__(self) -> None:
        """Check the numbers, and that cuts agree on the axes where they cross; raise InputError."""
        on_axes = []  # (4,) dBi for each cut: its gains on the four axes that it crosses
        for name, most in (("gain_offset", LARGEST_GAIN), ("delay_span", 10.0)):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not abs(value) <= most
            ):
                raise InputError(
                    f"antenna: {name}: {value!r} must be a number between -{most:g} and {most:g}."
                )
        for name in ("azimuth", "elevation_1", "elevation_2"):
            gains = np.asarray(getattr(self, name), dtype=float)
            if (
                gains.ndim != 1
                or len(gains) < 4
                or len(gains) % 4
                or not (np.abs(gains) <= LARGEST_GAIN).all()
            ):
                raise InputError(
                    f"antenna: {name} needs a multiple of 4 gains between -{LARGEST_GAIN:g} "
                    f"and {LARGEST_GAIN:g} dBi "
                    "around the full circle."
                )
            on_axes.append(gains[:: len(gains) // 4])
        azimuth, first, second = on_axes
        crossings = {
            "+x": (azimuth[0], first[0]),
            "-x": (azimuth[2], first[2]),
            "+y": (azimuth[1], second[0]),
            "-y": (azimuth[3], second[2]),
            "+z": (first[1], second[1]),
            "-z": (first[3], second[3]),
        }
        for axis, (one, other) in crossings.items():
            if abs(one - other) > 0.01:
                raise InputError(
                    f"antenna: two cuts cross at {axis} with {one:.2f} and {other:.2f} dBi; "
                    "make it one."
                )

    @cached_property
    def _cuts(self) -> tuple[Callable[..., np.ndarray], ...]:
        """Gain around each of the three cuts, dBi: functions of the angle, rad.

        Computed at the first use, because scipy takes long to load.
        """
        out = []
        for gains in map(np.asarray, (self.azimuth, self.elevation_1, self.elevation_2)):
            angle = np.linspace(0.0, 2.0 * np.pi, len(gains) + 1)
            out.append(
                interpolate.CubicSpline(angle, np.append(gains, gains[0]), bc_type="periodic")
            )
        return tuple(out)

    @cached_property
    def peak_gain(self) -> float:
        """Largest gain on the three cuts, dBi."""
        fine = np.linspace(0.0, 2.0 * np.pi, 721)
        return float(max(cut(fine).max() for cut in self._cuts)) + self.gain_offset

    def gain(self, direction: ArrayLike) -> np.ndarray:
        """Return the gain towards a direction, (...) dBi.

        Source: eq. 14 of Grasso et al. (Sensors 2022, 22, 9136). Each elevation cut is read on the side
        of the quadrant of the direction. The pattern equals the azimuth cut exactly. It equals the
        elevation cuts where cos(elevation)^40 vanishes, and where they cross the other cuts.

        direction : (..., 3), antenna frame, any length
        """
        along = floats(direction)
        x, y, z = along[..., 0], along[..., 1], along[..., 2]
        horizontal = np.hypot(x, y)
        theta, phi = np.arctan2(y, x), np.arctan2(z, horizontal)
        azimuth, first, second = self._cuts
        gain_theta = _around(azimuth, theta)
        gain_phi_1 = _around(first, np.where(x >= 0.0, phi, np.pi - phi))
        gain_phi_2 = _around(second, np.where(y >= 0.0, phi, np.pi - phi))
        near_plane = np.cos(phi) ** 40
        along_x = np.cos(theta) ** 2
        elevation = along_x * gain_phi_1 + (1.0 - along_x) * gain_phi_2
        return (1.0 - near_plane) * elevation + near_plane * gain_theta + self.gain_offset

    def group_delay(self, direction: ArrayLike) -> np.ndarray:
        """Return the group delay in a direction: (...) m, 0 ... delay_span.

        Own model. The share g = 10^((gain - peak gain) / 20) of the arriving field comes straight from
        the antenna. The rest, 1 - g, comes over the board by a path that is `delay_span` longer. The
        centroid of the two is late by delay_span (1 - g). Hence the best direction has no delay, and a
        null is late by nearly delay_span.

        direction : (..., 3), antenna frame, any length
        """
        return self.delay_at(self.gain(direction))

    def delay_at(self, gain: np.ndarray) -> np.ndarray:
        """Return the `group_delay` of directions with gains (...), dBi: (...) m."""
        amplitude = 10.0 ** ((gain - self.peak_gain) / 20.0)
        return self.delay_span * np.maximum(1.0 - amplitude, 0.0)


def _around(cut: Any, angle: np.ndarray) -> np.ndarray:
    """Return a periodic cubic spline at angles (...), rad."""
    return piecewise(cut, np.mod(angle, 2.0 * np.pi), cut.x, 3)


SPEED_OF_LIGHT = 299792458.0  # m/s
TICK = SPEED_OF_LIGHT / (128 * 499.2e6)  # m, clock tick of a DW1000

# Range error of the DW1000 over received power, 500 MHz channels, 64 MHz PRF. Source: Decawave
# APS011, table 2.
APS011_POWER_DBM = np.arange(-61.0, -97.0, -2.0)
APS011_BIAS_MM = np.array(
    [-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86.0]
)

NOMINAL_GAIN = -3.3  # dBi, mean gain of the default antenna, for an unknown attitude

# An assumption: the tag's module lies flat on the vehicle. Its front (antenna x) is up, its null
# axis (antenna z) is along body x.
FLAT_MOUNT = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)


@dataclass(frozen=True)
class RadioLink:
    """Properties of a link that do not depend on the poses.

    Attributes
    ----------
    anchor_antenna, tag_antenna : Antenna (default DWM1000-like)
    tag_mount : quaternion x y z w, tag antenna to body (default: lying flat, null axis along body x)
    tx_power_dbm : power into the transmitting antenna, dBm (default -8.3: the legal mean of
        -41.3 dBm/MHz over 500 MHz, and 6 dB that the chip's smart power adds to frames this short)
    frequency : centre of the channel, Hz (default channel 2)
    """

    anchor_antenna: Antenna = field(default_factory=Antenna)
    tag_antenna: Antenna = field(default_factory=Antenna)
    tag_mount: tuple[float, ...] = FLAT_MOUNT
    tx_power_dbm: float = -8.3
    frequency: float = 3.9936e9

    def path_loss_db(self, distance: np.ndarray) -> np.ndarray:
        """Return the free-space loss over `distance` m, dB; shorter distances count as 1 cm."""
        return 20.0 * np.log10(
            4.0 * np.pi * self.frequency * np.maximum(distance, 0.01) / SPEED_OF_LIGHT
        )

    def received_dbm(self, gains: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Return the power, dBm, received over `distance` m; gains : sum of both antennas, dBi."""
        return self.tx_power_dbm + gains - self.path_loss_db(distance)


def received_power_dbm(
    p_tag: ArrayLike,
    q_tag: ArrayLike,
    p_anchor: ArrayLike,
    q_anchor: ArrayLike,
    link: RadioLink = RadioLink(),
) -> np.ndarray:
    """Return the power that arrives at the tag, dBm, with the broadcast shape of the arguments.

    Source: Friis, eq. 11 of Grasso et al. (Sensors 2022, 22, 9136), in dB, with the losses inside the
    gains. Polarisation is not modelled. Below 1 cm the distance counts as 1 cm.

    Parameters
    ----------
    p_tag : (..., 3) m, tag antenna, world
    q_tag : (..., 4) x y z w, body to world
    p_anchor : (..., 3) m, anchor antenna, world
    q_anchor : (..., 4) x y z w, anchor antenna to world
    link : RadioLink
    """
    of_tag, of_anchor, distance = _gains(p_tag, q_tag, p_anchor, q_anchor, link)
    return link.received_dbm(of_anchor + of_tag, distance)


def power_bias(power_dbm: np.ndarray) -> np.ndarray:
    """Return the range error of the DW1000, m, at a received power, dBm.

    Linear between the entries of the table of APS011, constant beyond.
    """
    power, bias = APS011_POWER_DBM[::-1], APS011_BIAS_MM[::-1]
    return 1e-3 * piecewise(lambda at: np.interp(at, power, bias), power_dbm, power, 1)


def arrival_bias(
    p_tag: ArrayLike,
    q_tag: ArrayLike,
    p_anchor: ArrayLike,
    q_anchor: ArrayLike,
    link: RadioLink = RadioLink(),
) -> np.ndarray:
    """Return the range error of the signal of an anchor, m, positive for a late arrival.

    The sum of the chip's error over received power (APS011) and the group delays of both antennas.
    Parameters as for `received_power_dbm`.
    """
    of_tag, of_anchor, distance = _gains(p_tag, q_tag, p_anchor, q_anchor, link)
    return power_bias(link.received_dbm(of_anchor + of_tag, distance)) + (
        link.anchor_antenna.delay_at(of_anchor) + link.tag_antenna.delay_at(of_tag)
    )


def _gains(
    p_tag: ArrayLike, q_tag: ArrayLike, p_anchor: ArrayLike, q_anchor: ArrayLike, link: RadioLink
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the gains of the tag's and the anchor's antenna, dBi, and the distance, m."""
    to_anchor = floats(p_anchor) - floats(p_tag)
    seen_from_tag = into_frame(link.tag_mount, into_frame(q_tag, to_anchor))
    seen_from_anchor = into_frame(q_anchor, -to_anchor)
    return (
        link.tag_antenna.gain(seen_from_tag),
        link.anchor_antenna.gain(seen_from_anchor),
        np.linalg.norm(seen_from_tag, axis=-1),
    )


def into_frame(q: ArrayLike, v: ArrayLike) -> np.ndarray:
    """Return R(q)^T v: world vectors in the frame of orientation q.

    Parameters
    ----------
    q : (..., 4) x y z w, frame to world
    v : (..., 3), world
    """
    turn, world = floats(q), floats(v)
    x, y, z, w = -turn[..., 0], -turn[..., 1], -turn[..., 2], turn[..., 3]
    vx, vy, vz = world[..., 0], world[..., 1], world[..., 2]
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return np.stack(
        [
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        ],
        axis=-1,
    )
