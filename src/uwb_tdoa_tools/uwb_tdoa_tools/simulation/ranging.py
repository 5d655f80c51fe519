"""The TDOA measurements: geometry, and the errors of the two arrival times that each is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.antenna import Antenna
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_bias.foundation.radio import FLAT_MOUNT, RadioLink, arrival_bias

from .schedule import among_heard, make_schedule
from .walls import heard_at

if TYPE_CHECKING:
    from .config import SimulationConfig
    from .motion import Flyable
    from .room import Room
    from .schedule import Schedule

UNIT_GAIN_SPREAD = 0.7  # dB, tag to tag
UNIT_MOUNT_SPREAD = np.deg2rad(2.0)  # rad, tag to tag
MULTIPATH_HEIGHT = (0.1, 0.4)  # m, full strength below the first, none above the second
MULTIPATH_SIZE = (
    0.3  # m, standard deviation of the process whose positive part is the delay, at full strength
)
MULTIPATH_TIME = 0.5  # s, correlation time
# Outliers: share, smallest, largest size (m), of either sign. Three kinds are reported by users of
# the Loco Positioning
# System (crazyflie-firmware issues 277, 305, 375): about 0.5 m, 3 - 5 m, more than 20 m.
OUTLIER_KINDS = ((0.6, 0.4, 0.6), (0.3, 3.0, 5.0), (0.1, 20.0, 250.0))


def tag_link(unit: int) -> RadioLink:
    """The RadioLink of specimen `unit` of the tag: 0 is nominal, others differ a little in gain and
    mounting.
    """
    if unit == 0:
        return RadioLink()
    rng = np.random.default_rng([unit, 20])
    gain = UNIT_GAIN_SPREAD * rng.standard_normal()
    turn = Rotation.from_rotvec(UNIT_MOUNT_SPREAD * rng.standard_normal(3))
    mount = tuple((turn * Rotation.from_quat(FLAT_MOUNT)).as_quat().tolist())
    return RadioLink(tag_antenna=Antenna(gain_offset=gain), tag_mount=mount)


def measure(
    config: SimulationConfig, room: Room, trajectory: Flyable
) -> tuple[Tdoas, dict[str, np.ndarray], dict[str, Any]]:
    """All TDOAs of a flight: (Tdoas, truth, parameters). config as from
    SimulationConfig.complete().

    d_ab = (rho_b + e_b) - (rho_a + e_a) + outlier, where e, the error of one arrival, is bias +
    multipath + noise. Both distances are those at the stamp of the measurement.
    truth : dict of "t" and the (n,) parts of each d besides the geometry: "bias", "multipath",
        "noise", "outlier", m.
    parameters : the constants that the errors were made with.
    """
    assert config.anchors is not None  # complete
    anchors, random = config.anchors, config.random
    schedule = make_schedule(
        config.protocol, len(anchors), config.duration, random("schedule"), config.tdoa_rate
    )
    if config.radio_reach is not None:
        heard = heard_at(
            trajectory.motion(schedule.t).p, anchors.positions, config.radio_reach, config.walls
        )
        cells = None if config.cell_ids is None else anchors.ids // config.cell_ids
        schedule = among_heard(schedule, heard, config.protocol, random("reach"), cells)
        if not len(schedule.t):
            raise InputError(
                f"radio_reach: two anchors are nowhere heard within {config.radio_reach:g} m "
                "of the path; give a larger one, or another place."
            )
    t, a, b = schedule.t, schedule.a, schedule.b
    motion = trajectory.motion(t)
    p_tag = motion.p + Rotation.from_quat(motion.q).apply(config.tag_lever_arm)

    zero = np.zeros(len(t))
    link = tag_link(config.tag_unit)
    delays = config.anchor_delay_std * random("anchor delays").standard_normal(len(anchors))
    bias = zero
    if config.bias:
        late_b, late_a = (
            delays[k]
            + arrival_bias(p_tag, motion.q, anchors.positions[k], anchors.orientations[k], link)
            for k in (b, a)
        )
        bias = late_b - late_a
    multipath = zero
    if config.multipath:
        late = floor_multipath(
            t,
            p_tag[:, 2] - room.lower[2],
            np.stack([a, b]),
            len(anchors),
            random("multipath"),
            config.duration,
        )
        multipath = late[1] - late[0]
    noise = tdoa_noise(
        schedule, np.asarray(config.anchor_noise_std), config.shared_noise, random("tdoa noise")
    )
    outlier = outliers(len(t), config.outlier_probability, random("outliers"))

    d = tdoa(p_tag, anchors.positions[a], anchors.positions[b]) + bias + multipath + noise + outlier
    truth = {"t": t, "bias": bias, "multipath": multipath, "noise": noise, "outlier": outlier}
    parameters = {
        "anchor_delays": dict(
            zip(anchors.ids.tolist(), (delays if config.bias else 0.0 * delays).tolist())
        ),
        "tag_mount": list(link.tag_mount),
        "tag_gain_offset": link.tag_antenna.gain_offset,
    }
    return Tdoas(t, anchors.ids[a], anchors.ids[b], d), truth, parameters


def tdoa_noise(
    schedule: Schedule, anchor_std: np.ndarray, shared: bool, rng: np.random.Generator
) -> np.ndarray:
    """White noise of every measurement, (n,) m. shared: the difference of the noises of its two
    receptions, so that two TDOAs with the reception of anchor j in common have the covariance
    -std_j^2 (Grasso et al. 2022, eqs. 4 - 5).
    """
    if shared:
        arrival = anchor_std[schedule.sender] * rng.standard_normal(len(schedule.sender))
        return arrival[schedule.heard_b] - arrival[schedule.heard_a]
    return np.hypot(anchor_std[schedule.a], anchor_std[schedule.b]) * rng.standard_normal(
        len(schedule.t)
    )


def outliers(n: int, probability: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) m, zero but for the given share."""
    share, smallest, largest = np.array(OUTLIER_KINDS).T
    hit = rng.random(n) < probability
    kind = rng.choice(len(share), n, p=share)
    size = rng.uniform(smallest[kind], largest[kind])
    return np.where(hit, np.copysign(size, rng.uniform(-1.0, 1.0, n)), 0.0)


def floor_multipath(
    t: np.ndarray,
    height: np.ndarray,
    anchor: np.ndarray,
    n_anchors: int,
    rng: np.random.Generator,
    duration: float,
) -> np.ndarray:
    """Delay of the signals of anchors by reflection near the floor, (k, n) m, never negative.

    t : (n,) s in 0 ... duration; height : (n,) m of the tag above the floor; anchor : (k, n) rows
        of k of n_anchors at each t.
    Own model: the positive part of a Gaussian process with exponential correlation, one per anchor,
    fading out linearly with height.
    """
    from scipy.signal import lfilter  # takes a second to import

    dt = 0.05
    decay = np.exp(-dt / MULTIPATH_TIME)
    white = rng.standard_normal((int(duration / dt) + 2, n_anchors))
    white[1:] *= np.sqrt(1.0 - decay**2)
    process = lfilter([1.0], [1.0, -decay], white, axis=0)
    low, high = MULTIPATH_HEIGHT
    strength = MULTIPATH_SIZE * np.clip((high - height) / (high - low), 0.0, 1.0)
    late = np.zeros(anchor.shape)
    near = np.flatnonzero(strength > 0.0)
    at, which = t[near] / dt, anchor[:, near]
    row = at.astype(int)
    part = at - row
    late[:, near] = strength[near] * np.maximum(
        (1.0 - part) * process[row, which] + part * process[row + 1, which], 0.0
    )
    return late
