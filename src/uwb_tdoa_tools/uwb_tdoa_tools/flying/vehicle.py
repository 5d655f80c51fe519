# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a small quadrotor: rigid body, motors, drag, wind, and ground contact.

The rigid body follows Newton and Euler. Thrust and yaw moment grow with the square of the rotor
speed. Rotor drag grows with the rotor speed and the air speed. The values are from Foerster, System
Identification of the Crazyflie 2.0 Nano Quadrocopter, ETH 2015, as in rotorpy. Motors are first-order
lags. The ground effect follows Cheeseman and Bennett (ARC R&M 3021, 1955). Feet are springs with
dampers and Coulomb friction.

Frames: world z up; body x forward, y left, z up. Quaternions are x y z w, body to world.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.geometry import rotate

# Compiled code reads the fields of a structured row as attributes. Python has no type for that.
Record = Any

GRAVITY = 9.81  # m/s^2
STEP = 0.625e-3  # s, of the integration (midpoint)
IMU_RATE = 400.0  # Hz
ROTORS = 4
POSITION, VELOCITY, ATTITUDE, RATE, SPEED = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 10),
    slice(10, 13),
    slice(13, 17),
)  # of a state
STATE = 17  # numbers in it: m, m/s, x y z w, rad/s in the body frame, rad/s of each rotor
# directions of arms, body frame
CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) * math.sqrt(0.5)
SPIN = np.array([1.0, -1.0, 1.0, -1.0])  # sign of the yaw moment on the body


@dataclass(frozen=True)
class Vehicle:
    """Describe a Crazyflie 2.x with its deck.

    Parameters
    ----------
    mass : float
        kg.
    inertia_xy, inertia_z : float
        kg m^2.
    arm : float
        From the center to each rotor, m.
    thrust, moment : float
        Thrust, N/(rad/s)^2, and yaw moment, Nm/(rad/s)^2, of a rotor.
    rotor_drag, inflow : float
        Drag of a rotor across and along the z axis of the body, N/(rad/s)/(m/s).
    motor_time, top_speed : float
        Time constant, s, and largest speed, rad/s, of a motor.
    radius : float
        Of a rotor for the ground effect, m. 0 switches the effect off.
    leg : float
        From the center down to the feet, m.
    stiffness, damping, friction_damping : float
        Of a foot, N/m, N/(m/s) and N/(m/s).
    friction : float
        Coefficient of friction.
    table, table_x, table_y, table_radius : float
        Height above the floor, place and radius of a round table, m. A radius of 0 means no table.
    """

    mass: float = 0.030
    inertia_xy: float = 1.43e-5
    inertia_z: float = 2.89e-5
    arm: float = 0.043
    thrust: float = 2.3e-8
    moment: float = 7.8e-10
    rotor_drag: float = 10.2506e-7
    inflow: float = 7.553e-7
    motor_time: float = 0.072
    top_speed: float = 2500.0
    radius: float = 0.023
    leg: float = 0.03
    stiffness: float = 60.0
    damping: float = 0.6
    friction_damping: float = 0.5
    friction: float = 0.6
    table: float = 0.0
    table_x: float = 0.0
    table_y: float = 0.0
    table_radius: float = 0.0

    def record(self) -> Record:
        """Return the parameters as a record for compiled code."""
        return np.array([tuple(asdict(self).values())], RECORD)[0]

    def at_rest(self, x: float, y: float, yaw: float) -> np.ndarray:
        """Return the state (17,) of a vehicle that stands on the ground or the table.

        Parameters
        ----------
        x, y : float
            Place, m.
        yaw : float
            rad.
        """
        state = np.zeros(STATE)
        sag = self.mass * GRAVITY / (ROTORS * self.stiffness)
        state[POSITION] = x, y, ground_at(self.record(), x, y) + self.leg - sag
        state[ATTITUDE] = 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        return state


RECORD = np.dtype([(field.name, float) for field in fields(Vehicle)], align=True)


@compiled
def ground_at(record: Record, x: float, y: float) -> float:
    """Return the height of the ground or the table at (x, y), m."""
    if (
        record.table_radius > 0.0
        and math.hypot(x - record.table_x, y - record.table_y) <= record.table_radius
    ):
        return record.table
    return 0.0


@compiled
def step(
    state: np.ndarray,
    speeds: np.ndarray,
    wind: np.ndarray,
    dt: float,
    record: Record,
    scratch: np.ndarray,
) -> int:
    """Integrate the state over one time step and return the number of feet on the ground.

    Parameters
    ----------
    state : numpy.ndarray
        State (17,), updated in place.
    speeds : numpy.ndarray
        Commanded rotor speeds (4,), rad/s.
    wind : numpy.ndarray
        Wind (3,), m/s, world frame.
    dt : float
        Time step, s.
    record : Record
        Record of a Vehicle.
    scratch : numpy.ndarray
        Working memory (2, 17).
    """
    _derivative(state, speeds, wind, record, scratch[0])
    for k in range(STATE):
        scratch[1, k] = state[k] + 0.5 * dt * scratch[0, k]
    feet = _derivative(scratch[1], speeds, wind, record, scratch[0])
    for k in range(STATE):
        state[k] += dt * scratch[0, k]
    length = math.sqrt(state[6] ** 2 + state[7] ** 2 + state[8] ** 2 + state[9] ** 2)
    for k in range(6, 10):
        state[k] /= length
    return feet


@compiled
def _derivative(
    state: np.ndarray, speeds: np.ndarray, wind: np.ndarray, record: Record, out: np.ndarray
) -> int:
    """Write the time derivative of a state to `out` (17,) and return the number of feet on the ground."""
    q, w = state[6:10], state[10:13]
    # columns of the rotation matrix: axes of the body in the world frame
    x, y, z, s = q[0], q[1], q[2], q[3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * s), 2.0 * (x * z + y * s)
    r10, r11, r12 = 2.0 * (x * y + z * s), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * s)
    r20, r21, r22 = 2.0 * (x * z - y * s), 2.0 * (y * z + x * s), 1.0 - 2.0 * (x * x + y * y)
    ax, ay, az = state[3] - wind[0], state[4] - wind[1], state[5] - wind[2]
    air_x, air_y, air_z = (
        r00 * ax + r10 * ay + r20 * az,
        r01 * ax + r11 * ay + r21 * az,
        r02 * ax + r12 * ay + r22 * az,
    )
    fx, fy, fz = 0.0, 0.0, 0.0  # force and moment, body frame
    mx, my, mz = 0.0, 0.0, 0.0
    world_x, world_y, world_z = 0.0, 0.0, -GRAVITY * record.mass  # force, world frame
    feet = 0
    for k in range(ROTORS):
        px, py = record.arm * CORNERS[k, 0], record.arm * CORNERS[k, 1]
        speed = state[13 + k]
        lift = record.thrust * speed * speed
        height = state[2] + r20 * px + r21 * py - ground_at(record, state[0], state[1])
        if record.radius > 0.0:
            share = record.radius / (4.0 * max(height, record.radius))
            lift /= 1.0 - share * share
        hx = -record.rotor_drag * speed * (air_x - w[2] * py)
        hy = -record.rotor_drag * speed * (air_y + w[2] * px)
        hz = -record.inflow * speed * (air_z + w[0] * py - w[1] * px)
        fx += hx
        fy += hy
        fz += lift + hz
        mx += py * (lift + hz)
        my -= px * (lift + hz)
        mz += px * hy - py * hx + SPIN[k] * record.moment * speed * speed
        out[13 + k] = (min(max(speeds[k], 0.0), record.top_speed) - speed) / record.motor_time

        foot_z = height - r22 * record.leg
        if foot_z < 0.0:
            feet += 1
            # velocity of the foot: v + R (w x foot), foot = (px, py, -leg)
            bx, by, bz = (
                -w[1] * record.leg - w[2] * py,
                w[2] * px + w[0] * record.leg,
                w[0] * py - w[1] * px,
            )
            vx = state[3] + r00 * bx + r01 * by + r02 * bz
            vy = state[4] + r10 * bx + r11 * by + r12 * bz
            vz = state[5] + r20 * bx + r21 * by + r22 * bz
            normal = max(0.0, -record.stiffness * foot_z - record.damping * vz)
            slip = math.hypot(vx, vy)
            rub = min(record.friction_damping, record.friction * normal / max(slip, 1e-9))
            gx, gy, gz = -rub * vx, -rub * vy, normal
            world_x += gx
            world_y += gy
            world_z += gz
            cx, cy, cz = (
                r00 * gx + r10 * gy + r20 * gz,
                r01 * gx + r11 * gy + r21 * gz,
                r02 * gx + r12 * gy + r22 * gz,
            )
            mx += py * cz + record.leg * cy
            my += -record.leg * cx - px * cz
            mz += px * cy - py * cx
    out[0], out[1], out[2] = state[3], state[4], state[5]
    out[3] = (world_x + r00 * fx + r01 * fy + r02 * fz) / record.mass
    out[4] = (world_y + r10 * fx + r11 * fy + r12 * fz) / record.mass
    out[5] = (world_z + r20 * fx + r21 * fy + r22 * fz) / record.mass
    out[6] = 0.5 * (s * w[0] + y * w[2] - z * w[1])
    out[7] = 0.5 * (s * w[1] + z * w[0] - x * w[2])
    out[8] = 0.5 * (s * w[2] + x * w[1] - y * w[0])
    out[9] = 0.5 * (-x * w[0] - y * w[1] - z * w[2])
    ixy, iz = record.inertia_xy, record.inertia_z
    out[10] = (mx - (iz - ixy) * w[1] * w[2]) / ixy
    out[11] = (my - (ixy - iz) * w[2] * w[0]) / ixy
    out[12] = mz / iz
    return feet


@compiled
def specific_force(before: np.ndarray, after: np.ndarray, dt: float, out: np.ndarray) -> None:
    """Compute the mean specific force between two states.

    Parameters
    ----------
    before, after : numpy.ndarray
        States (17,).
    dt : float
        Time between them, s.
    out : numpy.ndarray
        Specific force (3,), m/s^2, body frame of `after`. It is written.
    """
    back = np.empty(4)
    back[0], back[1], back[2], back[3] = -after[6], -after[7], -after[8], after[9]
    a = np.empty(3)
    for k in range(3):
        a[k] = (after[3 + k] - before[3 + k]) / dt
    a[2] += GRAVITY
    rotate(back, a, out)
