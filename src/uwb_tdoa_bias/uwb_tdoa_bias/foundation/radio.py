"""The radio link between a tag and an anchor: received power, and by how much a signal seems to
arrive late.

Pure functions that broadcast: give one anchor per sample as (n, 3) beside (n, 3), or all anchors
for all samples as (m, 3) beside (n, 1, 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from .antenna import Antenna

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

SPEED_OF_LIGHT = 299792458.0  # m/s

# Range error of the DW1000 over received power, 500 MHz channels, 64 MHz PRF: Decawave APS011,
# table 2.
APS011_POWER_DBM = np.arange(-61.0, -97.0, -2.0)
APS011_BIAS_MM = np.array(
    [-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86.0]
)

NOMINAL_GAIN = -3.3  # dBi, mean gain of the default antenna, for one whose attitude is not known

# An assumption: the tag's module lies flat on the vehicle, front (antenna x) up, null axis (antenna
# z) along body x.
FLAT_MOUNT = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)


@dataclass(frozen=True)
class RadioLink:
    """What a link is made of besides the poses.

    Attributes
    ----------
    anchor_antenna, tag_antenna : Antenna (default DWM1000-like)
    tag_mount : quaternion x y z w, tag antenna to body (default: lying flat, null axis along body
        x)
    tx_power_dbm : power into the transmitting antenna, dBm (default -8.3: the legal mean of -41.3
        dBm/MHz over
        500 MHz, and 6 dB that the chip's smart power adds to frames this short)
    frequency : centre of the channel, Hz (default channel 2)
    """

    anchor_antenna: Antenna = field(default_factory=Antenna)
    tag_antenna: Antenna = field(default_factory=Antenna)
    tag_mount: tuple[float, ...] = FLAT_MOUNT
    tx_power_dbm: float = -8.3
    frequency: float = 3.9936e9

    def path_loss_db(self, distance: np.ndarray) -> np.ndarray:
        """Free-space loss over `distance` m (not nearer than 1 cm), dB."""
        return 20.0 * np.log10(
            4.0 * np.pi * self.frequency * np.maximum(distance, 0.01) / SPEED_OF_LIGHT
        )

    def received_dbm(self, gains: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """What arrives over `distance` m with the `gains` of both antennas together, dBi: dBm."""
        return self.tx_power_dbm + gains - self.path_loss_db(distance)


def received_power_dbm(
    p_tag: ArrayLike,
    q_tag: ArrayLike,
    p_anchor: ArrayLike,
    q_anchor: ArrayLike,
    link: RadioLink = RadioLink(),
) -> np.ndarray:
    """Power that arrives at the tag, dBm, with the shape the arguments broadcast to.

    p_tag (..., 3) tag antenna and p_anchor (..., 3) anchor antenna, world, metres; q_tag (..., 4)
    body to world; q_anchor (..., 4) anchor antenna to world; quaternions x y z w. Source: Friis,
    eq. 11 of Grasso et al. (Sensors 2022, 22, 9136), in dB, with the losses inside the gains.
    Polarisation is not modelled, and nearer than 1 cm the distance counts as 1 cm.
    """
    of_tag, of_anchor, distance = _gains(p_tag, q_tag, p_anchor, q_anchor, link)
    return link.received_dbm(of_anchor + of_tag, distance)


def power_bias(power_dbm: np.ndarray) -> np.ndarray:
    """Range error of the DW1000 at a received power in dBm: metres, linear in the table of APS011,
    constant beyond.
    """
    return 1e-3 * np.interp(power_dbm, APS011_POWER_DBM[::-1], APS011_BIAS_MM[::-1])


def arrival_bias(
    p_tag: ArrayLike,
    q_tag: ArrayLike,
    p_anchor: ArrayLike,
    q_anchor: ArrayLike,
    link: RadioLink = RadioLink(),
) -> np.ndarray:
    """By how much the signal of an anchor seems to come from farther away: metres; arguments as
    `received_power_dbm`.

    The sum of the chip's error over received power (APS011) and of the group delays of both
    antennas.
    """
    of_tag, of_anchor, distance = _gains(p_tag, q_tag, p_anchor, q_anchor, link)
    return power_bias(link.received_dbm(of_anchor + of_tag, distance)) + (
        link.anchor_antenna.delay_at(of_anchor) + link.tag_antenna.delay_at(of_tag)
    )


def _gains(
    p_tag: ArrayLike, q_tag: ArrayLike, p_anchor: ArrayLike, q_anchor: ArrayLike, link: RadioLink
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain of the tag's antenna towards the anchor, that of the anchor's towards the tag, dBi, and
    their distance, m.
    """
    to_anchor = np.asarray(p_anchor, dtype=float) - np.asarray(p_tag, dtype=float)
    seen_from_tag = into_frame(link.tag_mount, into_frame(q_tag, to_anchor))
    seen_from_anchor = into_frame(q_anchor, -to_anchor)
    return (
        link.tag_antenna.gain(seen_from_tag),
        link.anchor_antenna.gain(seen_from_anchor),
        np.linalg.norm(seen_from_tag, axis=-1),
    )


def into_frame(q: ArrayLike, v: ArrayLike) -> np.ndarray:
    """R(q)^T v: world vectors (..., 3) in the frame whose orientation is q (..., 4), x y z w, frame
    to world.
    """
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    x, y, z, w = -q[..., 0], -q[..., 1], -q[..., 2], q[..., 3]
    vx, vy, vz = v[..., 0], v[..., 1], v[..., 2]
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return np.stack(
        [
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        ],
        axis=-1,
    )
