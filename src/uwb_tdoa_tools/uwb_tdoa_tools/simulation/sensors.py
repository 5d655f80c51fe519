# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors: TDOAs with the errors of both arrival times, the inertial sensor, and SENSORS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu, Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.radio import FLAT_MOUNT, Antenna, RadioLink, arrival_bias
from uwb_tdoa_bias.common.sensors import SENSORS, Stream, Velocity

from .config import WHEELS_RATE, Complete, ImuErrors, Room, heard_at
from .vehicles import Flyable

SLOT = 2.0e-3  # s, TDOA2: one packet per slot
SLOT_JITTER = 1.0e-4  # s, standard deviation of a stamp around its slot
PACKET_LOSS = 0.025  # TDOA2: share of lost packets; each costs its two pairs
TDOA3_DEAD_TIME = 0.5e-3  # s, the shortest time between two measurements
TDOA3_MEAN_WAIT = 3.6e-3  # s, mean of the additional exponential wait: 240 TDOAs per second
UNIT_GAIN_SPREAD = 0.7  # dB, tag to tag
UNIT_MOUNT_SPREAD = np.deg2rad(2.0)  # rad, tag to tag
MULTIPATH_HEIGHT = (0.1, 0.4)  # m, full strength below the first, none above the second
MULTIPATH_SIZE = 0.3  # m, standard deviation of the process at full strength
MULTIPATH_TIME = 0.5  # s, correlation time
# Outliers: share, smallest, largest size (m), of either sign. Three kinds are reported by users of
# the Loco Positioning
# System (crazyflie-firmware issues 277, 305, 375): about 0.5 m, 3 - 5 m, more than 20 m.
OUTLIER_KINDS = ((0.6, 0.4, 0.6), (0.3, 3.0, 5.0), (0.1, 20.0, 250.0))


@dataclass(frozen=True)
class Schedule:
    """One row per measurement, of the ordered pair (a, b) at the arrival of b's packet.

    Attributes
    ----------
    t : (n,) s, rising.
    a, b : (n,) rows of the anchors.
    heard_a, heard_b : (n,) number of the reception of each arrival time. Two measurements with the
        same reception share its noise.
    sender : (m,) row of the anchor of each reception.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    heard_a: np.ndarray
    heard_b: np.ndarray
    sender: np.ndarray


def make_schedule(
    protocol: str,
    n_anchors: int,
    duration: float,
    rng: np.random.Generator,
    rate: float | None = None,
) -> Schedule:
    """Return the Schedule of "tdoa2" or "tdoa3" from 0 to `duration`, s, for at least 2 anchors.

    `rate` is TDOAs per second, by losses (tdoa2) or waits (tdoa3); default: of the protocol.
    """
    if protocol == "tdoa2":
        return _tdoa2(
            n_anchors,
            duration,
            rng,
            PACKET_LOSS if rate is None else 1.0 - np.sqrt(min(rate * SLOT, 1.0)),
        )
    return _tdoa3(
        n_anchors,
        duration,
        rng,
        TDOA3_MEAN_WAIT if rate is None else max(1.0 / rate - TDOA3_DEAD_TIME, 0.0),
    )


def restrict_to_heard(
    schedule: Schedule,
    heard: Sequence[np.ndarray],
    protocol: str,
    rng: np.random.Generator,
    cells: np.ndarray | None = None,
) -> Schedule:
    """Restrict a Schedule to the anchors that the tag hears.

    TDOA2: the heard anchors of a cell send in turn, in the order of their rows. Cells out of reach
    of each other use the same slots. TDOA3: any two heard anchors of a cell. The cell is drawn,
    weighted by its number of heard anchors. With fewer than two anchors there is no measurement.

    Parameters
    ----------
    heard : n arrays of rising rows, the heard anchors at each measurement.
    cells : (N,) number of the cell of each anchor. Each cell has a clock, and a TDOA needs two
        anchors of a cell. None for a single clock.
    """
    rows, pairs, numbers = [], [], []  # of measurements, (a, b) and their receptions
    senders: list[int] = []  # row of the anchor of each reception
    latest: dict[int, int] = {}  # the latest reception of each anchor

    def receive(anchor: int) -> None:
        latest[anchor] = len(senders)
        senders.append(anchor)

    chosen = rng.random((len(heard), 2))
    if cells is not None:
        heard = [
            _of_one_cell(near, cells, draw) for near, draw in zip(heard, rng.random(len(heard)))
        ]
    for row, (near, (first, second)) in enumerate(zip(heard, chosen)):
        if len(near) < 2:
            continue
        if protocol == "tdoa2":
            b = row % len(near)
            a = b - 1
        else:
            b = int(first * len(near))
            a = (b + 1 + int(second * (len(near) - 1))) % len(near)
        a, b = int(near[a]), int(near[b])
        if a not in latest:
            receive(a)
        of_a = latest[a]
        receive(b)
        rows.append(row)
        pairs.append((a, b))
        numbers.append((of_a, latest[b]))
    (rows_a, rows_b), (heard_a, heard_b) = (
        np.array(each, int).reshape(-1, 2).T for each in (pairs, numbers)
    )
    sender = np.array(senders, int)
    return replace(
        schedule,
        t=schedule.t[rows],
        a=rows_a,
        b=rows_b,
        heard_a=heard_a,
        heard_b=heard_b,
        sender=sender,
    )


def _of_one_cell(near: np.ndarray, cells: np.ndarray, draw: float) -> np.ndarray:
    """Return the rows of anchors, (k,), in the cell of the anchor that `draw`, 0 ... 1, selects."""
    return near[cells[near] == cells[near[int(draw * len(near))]]] if len(near) else near


def _tdoa2(n_anchors: int, duration: float, rng: np.random.Generator, loss: float) -> Schedule:
    """Make a ring: anchors send in turn, and each packet is compared with the previous slot."""
    n = max(int(duration / SLOT), 2)
    sender = np.arange(n) % n_anchors
    jitter = np.clip(SLOT_JITTER * rng.standard_normal(n), -0.4 * SLOT, 0.4 * SLOT)
    t = (np.arange(n) + 0.5) * SLOT + jitter
    received = rng.random(n) >= loss
    k = 1 + np.flatnonzero(received[1:] & received[:-1])
    return Schedule(t[k], sender[k - 1], sender[k], k - 1, k, sender)


def _tdoa3(n_anchors: int, duration: float, rng: np.random.Generator, wait: float) -> Schedule:
    """Make random pairs: a packet is compared with the newest packet of a random other anchor."""
    n = int(1.3 * duration / (TDOA3_DEAD_TIME + wait)) + 50
    t = np.cumsum(TDOA3_DEAD_TIME + rng.exponential(wait, n))
    b = rng.integers(0, n_anchors, n)
    a = (b + rng.integers(1, n_anchors, n)) % n_anchors
    n = int(np.searchsorted(t, duration))
    t, a, b = t[:n], a[:n], b[:n]
    sender = np.concatenate([np.arange(n_anchors), b])  # all anchors are heard once at the start
    heard_b = n_anchors + np.arange(n)
    heard_a = np.empty(n, dtype=np.int64)
    for anchor in range(n_anchors):
        heard = np.flatnonzero(sender == anchor)
        rows = np.flatnonzero(a == anchor)
        heard_a[rows] = heard[np.searchsorted(heard, heard_b[rows]) - 1]
    return Schedule(t, a, b, heard_a, heard_b, sender)


def tag_link(unit: int) -> RadioLink:
    """Return the RadioLink of a tag specimen: 0 is nominal, others differ in gain and mounting."""
    if unit == 0:
        return RadioLink()
    rng = np.random.default_rng([unit, 20])
    gain = UNIT_GAIN_SPREAD * rng.standard_normal()
    turn = Rotation.from_rotvec(UNIT_MOUNT_SPREAD * rng.standard_normal(3))
    mount = tuple((turn * Rotation.from_quat(FLAT_MOUNT)).as_quat().tolist())
    return RadioLink(tag_antenna=Antenna(gain_offset=gain), tag_mount=mount)


def measure_tdoas(
    config: Complete, room: Room, trajectory: Flyable
) -> tuple[Tdoas, dict[str, np.ndarray], dict[str, Any]]:
    """Simulate all TDOAs of a flight with a complete config: (Tdoas, truth, parameters).

    d_ab = (rho_b + e_b) - (rho_a + e_a) + outlier. The error e of an arrival is bias + multipath +
    noise. Both distances are at the stamp of the measurement.

    Returns
    -------
    truth : dict of "t" and the (n,) errors "bias", "multipath", "noise", "outlier", m.
    parameters : the constants of the errors.
    """
    anchors, random = config.anchors, config.random
    schedule = make_schedule(
        config.protocol, len(anchors), config.duration, random("schedule"), config.tdoa_rate
    )
    if config.radio_reach is not None:
        heard = heard_at(
            trajectory.motion(schedule.t).p, anchors.positions, config.radio_reach, config.walls
        )
        cells = None if config.cell_ids is None else anchors.ids // config.cell_ids
        schedule = restrict_to_heard(schedule, heard, config.protocol, random("reach"), cells)
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
    """Return the white noise of every measurement, (n,) m.

    If `shared`, it is the difference of the noises of both receptions. Two TDOAs with the reception
    of anchor j in common then have the covariance -std_j^2 (Grasso et al. 2022, eqs. 4 - 5).
    """
    if shared:
        arrival = anchor_std[schedule.sender] * rng.standard_normal(len(schedule.sender))
        return arrival[schedule.heard_b] - arrival[schedule.heard_a]
    return np.hypot(anchor_std[schedule.a], anchor_std[schedule.b]) * rng.standard_normal(
        len(schedule.t)
    )


def outliers(n: int, probability: float, rng: np.random.Generator) -> np.ndarray:
    """Return errors, (n,) m, that are zero except for the given share."""
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
    """Return delays of anchors by reflection near the floor, (k, n) m, never negative.

    Own model: the positive part of a Gaussian process with exponential correlation, one per anchor.
    It fades out linearly with height.

    Parameters
    ----------
    t : (n,) s in 0 ... duration.
    height : (n,) m, tag above the floor.
    anchor : (k, n) rows of k of n_anchors at each t.
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


YAW_RATE_STD = 0.02  # rad/s
SLIP_EVERY, SLIP_TIME = 10.0, 0.5  # s


def measure_imu(
    t: np.ndarray,
    trajectory: Flyable,
    errors: ImuErrors,
    random: Callable[[str], np.random.Generator],
) -> tuple[Imu, np.ndarray, np.ndarray]:
    """Simulate the inertial sensor at equally spaced stamps t, (n,) s.

    Samples are values at an instant, not means over the sample time. `random(part)` returns the
    numpy Generator of a part.

    Returns (Imu, gyro bias (n, 3) rad/s, accel bias (n, 3) m/s^2).
    """
    n, dt = len(t), t[1] - t[0]
    motion = trajectory.motion(t)

    def bias_of(part: str, initial: float, walk: float) -> np.ndarray:
        """Return a random walk (n, 3) from a random value.

        initial : standard deviation of that value; walk : that of the walk after one second
        """
        rng = random(part)
        start = initial * rng.standard_normal(3)
        steps = walk * np.sqrt(dt) * rng.standard_normal((n, 3))
        steps[0] = 0.0
        return start + np.cumsum(steps, axis=0)

    gyro_bias = bias_of("gyro bias", errors.gyro_bias, errors.gyro_bias_walk)
    accel_bias = bias_of("accel bias", errors.accel_bias, errors.accel_bias_walk)
    gyro_noise = errors.gyro_noise / np.sqrt(dt) * random("gyro noise").standard_normal((n, 3))
    accel_noise = errors.accel_noise / np.sqrt(dt) * random("accel noise").standard_normal((n, 3))
    shaking = (
        errors.vibration
        * trajectory.motors(t)[:, None]
        * random("vibration").standard_normal((n, 3))
    )
    gyro = motion.body_rates + gyro_bias + gyro_noise
    accel = motion.specific_force + accel_bias + accel_noise + shaking
    return Imu(t, gyro, accel), gyro_bias, accel_bias


def measure_sensors(config: Complete, room: Room, trajectory: Flyable) -> dict[str, Stream]:
    """Simulate each of SENSORS that has a noise in the complete SimulationConfig: {name: Stream}.

    Streams have white noise; the wheels of a rover also have scale and slip.
    """
    out = {}
    for name, sensor in SENSORS.items():
        if getattr(config, f"{name}_noise") is None:
            continue
        wheels = name == "velocity" and config.vehicle == "rover"
        rate = WHEELS_RATE if wheels else sensor.rate
        t = np.arange(1, int(config.duration * rate) + 1) / rate
        motion, random = trajectory.motion(t), config.random(f"{name} noise")
        columns = sensor.simulated(
            config,
            room,
            motion,
            Rotation.from_quat(motion.q),
            lambda *shape: random.standard_normal((len(t), *shape)),
        )
        stream: Stream = sensor.stream(t, *columns)
        out[name] = _of_wheels(stream, config, motion.body_rates[:, 2]) if wheels else stream
    return out


def _of_wheels(velocity: Stream, config: Complete, turning: np.ndarray) -> Velocity:
    """Apply the errors of two wheels to a Velocity and the true turning rate (n,) rad/s."""
    assert isinstance(velocity, Velocity)
    n, t = len(velocity), velocity.t
    too_fast = (1.0 + config.wheel_scale) * (
        1.0 + config.wheel_slip * slips(t, config.random("slip"))
    )
    ahead = np.zeros((n, 3))
    ahead[:, 0] = too_fast * velocity.v[:, 0]
    yaw_rate = too_fast * turning + YAW_RATE_STD * config.random("yaw rate noise").standard_normal(
        n
    )
    return replace(velocity, v=ahead, yaw_rate=yaw_rate, yaw_rate_std=np.full(n, YAW_RATE_STD))


def slips(t: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return whether the wheels slip at stamps t (n,) s: (n,) bool."""
    begins = np.cumsum(random.exponential(SLIP_EVERY, int(2.0 * t[-1] / SLIP_EVERY) + 10))
    last = np.searchsorted(begins, t, "right") - 1
    slipping: np.ndarray = (last >= 0) & (t < begins[last] + SLIP_TIME)
    return slipping
