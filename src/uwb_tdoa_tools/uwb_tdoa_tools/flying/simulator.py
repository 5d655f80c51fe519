# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Control and move a vehicle turn by turn, simulate its sensors, and delay their messages.

The controller flies a quadrotor by an estimate of position, velocity and attitude, and by its
gyroscope. It is a cascade. Position and velocity give a wanted acceleration. The acceleration gives
thrust and attitude (geometric control on SE(3): Lee, Leok and McClamroch, CDC 2010). The attitude
gives body rates, and the rates give rotor speeds. The outer part runs once per estimate, the inner
part at each sample of the gyroscope. Between estimates the gyroscope predicts the attitude. The code
is compiled and needs no ROS.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.geometry import rotate
from uwb_tdoa_ekf.results import concatenated, rows_of

from .vehicle import (
    ATTITUDE,
    CORNERS,
    GRAVITY,
    IMU_RATE,
    POSITION,
    ROTORS,
    SPIN,
    STATE,
    STEP,
    VELOCITY,
    AuxiliarySensor,
    InertialErrors,
    Radio,
    Record,
    Vehicle,
    World,
    ground_at,
    gusts,
    random,
    specific_force,
    step,
)

SUPPORT_TIME = 0.1  # s over which the support by the ground is averaged


# gains, from an error to the first derivative of the next quantity
POSITION_GAIN = 1.5  # 1/s, position to velocity
VELOCITY_GAIN = 4.5  # 1/s, velocity to acceleration
INTEGRAL_GAIN = 0.7  # 1/s^2, integrated velocity error to acceleration
ATTITUDE_GAIN, YAW_GAIN = 8.0, 3.0  # 1/s, attitude to body rates
RATE_GAIN, YAW_RATE_GAIN = 40.0, 8.0  # 1/s, body rates to angular accelerations
DAMPING = 1.6  # share of the measured angular acceleration that acts against it
REACH = 0.75  # m, limit of the position error
MOST_INTEGRAL = 2.0  # m/s^2, limit of the integral part
MOST_TILT, MOST_RATE = 0.5, 6.0  # rad and rad/s
LEAST_THRUST, MOST_THRUST = 0.3, 1.8  # limits of the thrust, in units of the weight
YAW_SHARE = 0.1  # of the full thrust of a rotor: the yaw has the lowest priority
LEAST_SHARE = 0.01  # of the full thrust of a rotor, so that rotors do not stop in the air


class Controller:
    """Compute thrust and body rates from an estimate.

    Attributes
    ----------
    vehicle : Vehicle
        Vehicle as the controller assumes it.
    weight : float
        Its weight, N.
    thrust : float
        Wanted thrust of all rotors together, N.
    lift : float
        Thrust that the rotors have reached, averaged over SUPPORT_TIME, N.
    rates : numpy.ndarray
        Wanted body rates (3,), rad/s.
    integral : numpy.ndarray
        Integral part of the acceleration (3,), m/s^2, world frame.
    """

    def __init__(self, vehicle: Vehicle | None = None) -> None:
        """Start with the rotors off. The default is a Vehicle without deviations."""
        self.vehicle = vehicle or Vehicle()
        self.weight = self.vehicle.mass * GRAVITY
        self.rates, self.integral = np.zeros(3), np.zeros(3)
        self.thrust = self.lift = 0.0

    def fly(
        self, p: np.ndarray, v: np.ndarray, q: np.ndarray, wanted: np.ndarray, yaw: float, dt: float
    ) -> None:
        """Set thrust and rates for one turn.

        Parameters
        ----------
        p, v, q : numpy.ndarray
            Estimated position (3,) m, velocity (3,) m/s and attitude (4,) x y z w, world frame.
        wanted : numpy.ndarray
            Position, velocity and acceleration (3, 3), m and s. NaN in a position leaves it to the velocity.
        yaw : float
            Wanted yaw, rad.
        dt : float
            Time since the last call, s.
        """
        self.lift += min(1.0, dt / (self.vehicle.motor_time + 0.5 * SUPPORT_TIME)) * (
            self.thrust - self.lift
        )
        self.thrust = outer((p, v, q), wanted, yaw, dt, self.weight, self.integral, self.rates)

    def support(self, force: float) -> float:
        """Return the share of the weight that the ground carries.

        Parameters
        ----------
        force : float
            Measured specific force along the z axis of the body, m/s^2.
        """
        return force / GRAVITY - self.lift / (self.weight * (1.0 + self.integral[2] / GRAVITY))

    def stop(self) -> None:
        """Turn the rotors off."""
        self.thrust = self.lift = 0.0
        self.rates[:] = self.integral[:] = 0.0


@compiled
def outer(
    estimate: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: np.ndarray,
    yaw: float,
    dt: float,
    weight: float,
    integral: np.ndarray,
    rates: np.ndarray,
) -> float:
    """Return the wanted thrust, N, and write `integral` and `rates`.

    Parameters
    ----------
    estimate : tuple
        Position, velocity and attitude, as in `Controller.fly`.
    wanted, yaw, dt
        As in `Controller.fly`.
    weight : float
        N.
    integral, rates : numpy.ndarray
        Integral part (3,) m/s^2 and body rates (3,) rad/s. Both are written.
    """
    p, v, q = estimate[0], estimate[1], estimate[2]
    error = np.where(np.isnan(wanted[0]), 0.0, wanted[0] - p)
    far = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    slow = wanted[1] + POSITION_GAIN * min(1.0, REACH / max(far, 1e-9)) * error - v
    grown = integral + INTEGRAL_GAIN * np.clip(slow, -0.5, 0.5) * dt
    integral[:] = np.clip(grown, -MOST_INTEGRAL, MOST_INTEGRAL)
    a = wanted[2] + VELOCITY_GAIN * slow + integral
    a[2] = max(a[2] + GRAVITY, LEAST_THRUST * GRAVITY)
    level, most = math.hypot(a[0], a[1]), math.tan(MOST_TILT) * a[2]
    a[:2] *= most / max(level, most)
    size = math.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    zx, zy, zz = a[0] / size, a[1] / size, a[2] / size
    # wanted axes: z along the thrust, x toward the yaw
    cy, sy = math.cos(yaw), math.sin(yaw)
    yx, yy, yz = -zz * sy, zz * cy, zx * sy - zy * cy
    length = math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / length, yy / length, yz / length
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    x, y, z, s = q[0], q[1], q[2], q[3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * s), 2.0 * (x * z + y * s)
    r10, r11, r12 = 2.0 * (x * y + z * s), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * s)
    r20, r21, r22 = 2.0 * (x * z - y * s), 2.0 * (y * z + x * s), 1.0 - 2.0 * (x * x + y * y)
    # the three numbers of e = (Rd' R - R' Rd) / 2
    yz_, zy_ = yx * r02 + yy * r12 + yz * r22, zx * r01 + zy * r11 + zz * r21
    zx_, xz_ = zx * r00 + zy * r10 + zz * r20, xx * r02 + xy * r12 + xz * r22
    xy_, yx_ = xx * r01 + xy * r11 + xz * r21, yx * r00 + yy * r10 + yz * r20
    rates[0] = -ATTITUDE_GAIN * 0.5 * (zy_ - yz_)
    rates[1] = -ATTITUDE_GAIN * 0.5 * (xz_ - zx_)
    rates[2] = -YAW_GAIN * 0.5 * (yx_ - xy_)
    rates[:] = np.clip(rates, -MOST_RATE, MOST_RATE)
    along = a[0] * r02 + a[1] * r12 + a[2] * r22
    return weight / GRAVITY * min(max(along, LEAST_THRUST * GRAVITY), MOST_THRUST * GRAVITY)


@compiled
def inner(
    thrust: float,
    rates: np.ndarray,
    gyro: np.ndarray,
    dt: float,
    vehicle: Record,
    speeds: np.ndarray,
) -> None:
    """Compute rotor speeds from thrust and body rates: rate control and mixing.

    The body axes are x forward, y left, z up. Rotors are in the order of CORNERS. Without a wanted
    thrust all rotors stop.

    Parameters
    ----------
    thrust : float
        Wanted thrust, N.
    rates : numpy.ndarray
        Wanted body rates (3,), rad/s.
    gyro : numpy.ndarray
        Measured body rates (2, 3), rad/s, now and `dt` ago.
    dt : float
        Time between samples, s.
    vehicle : Record
        Record of the Vehicle that the controller assumes.
    speeds : numpy.ndarray
        Rotor speeds (4,), rad/s. They are written.
    """
    if thrust <= 0.0:
        speeds[:] = 0.0
        return
    mx = vehicle.inertia_xy * (
        RATE_GAIN * (rates[0] - gyro[0, 0]) - DAMPING * (gyro[0, 0] - gyro[1, 0]) / dt
    )
    my = vehicle.inertia_xy * (
        RATE_GAIN * (rates[1] - gyro[0, 1]) - DAMPING * (gyro[0, 1] - gyro[1, 1]) / dt
    )
    mz = vehicle.inertia_z * YAW_RATE_GAIN * (rates[2] - gyro[0, 2])
    full = vehicle.thrust * vehicle.top_speed**2  # N, of one rotor
    for k in range(ROTORS):
        # forces, N: each square of CORNERS is 0.5, so 0.5 arm is the lever of a rotor over CORNERS
        of_tilt = 0.25 * (CORNERS[k, 1] * mx - CORNERS[k, 0] * my) / (0.5 * vehicle.arm)
        of_yaw = 0.25 * SPIN[k] * mz * vehicle.thrust / vehicle.moment
        of_yaw = min(max(of_yaw, -YAW_SHARE * full), YAW_SHARE * full)
        force = 0.25 * thrust + of_tilt + of_yaw
        speeds[k] = math.sqrt(min(max(force, LEAST_SHARE * full), full) / vehicle.thrust)


@compiled
def integrate(
    since: float,
    p: np.ndarray,
    v: np.ndarray,
    q: np.ndarray,
    times: np.ndarray,
    samples: np.ndarray,
) -> None:
    """Propagate position, velocity and attitude by inertial samples, in place.

    Parameters
    ----------
    since : float
        Stamp of the three, s.
    p, v, q : numpy.ndarray
        Position (3,), m, and velocity (3,), m/s, world frame, and attitude (4,) x y z w.
    times, samples : numpy.ndarray
        Later stamps (n,), s. Body rates, rad/s, and specific forces, m/s^2 (n, 6).
    """
    force = np.empty(3)
    for j in range(len(times)):
        dt, since = times[j] - since, times[j]
        rotate_attitude(q, samples[j, :3], dt)
        rotate(q, samples[j, 3:], force)
        force[2] -= GRAVITY
        for k in range(3):
            v[k] += force[k] * dt
            p[k] += v[k] * dt


@compiled
def rotate_attitude(q: np.ndarray, rate: np.ndarray, dt: float) -> None:
    """Rotate an attitude by a constant body rate, in place.

    Parameters
    ----------
    q : numpy.ndarray
        Attitude (4,) x y z w, body to world.
    rate : numpy.ndarray
        Body rate (3,), rad/s.
    dt : float
        Duration, s.
    """
    angle = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2) * dt
    share = 0.5 * dt if angle < 1e-9 else math.sin(0.5 * angle) / angle * dt
    a, b, c, d = rate[0] * share, rate[1] * share, rate[2] * share, math.cos(0.5 * angle)
    x, y, z, w = q[0], q[1], q[2], q[3]
    q[0], q[1] = w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a
    q[2], q[3] = w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c


STEPS = round(1.0 / (IMU_RATE * STEP))  # of the integration, per sample
TURNING = 50.0  # rad/s, rotor speed above which the vehicle vibrates


@compiled
def interval(
    state: np.ndarray,
    gyro: np.ndarray,
    wanted: tuple[float, np.ndarray],
    assumed: Record,
    vehicle: Record,
    disturbances: tuple[np.ndarray, np.ndarray, np.ndarray],
    measured: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Fly for n samples of the inertial sensor.

    Parameters
    ----------
    state : numpy.ndarray
        State (17,) as in `vehicle`: position, velocity, quaternion, rates (10 to 12), rotor speeds
        (13 to 16). Updated in place.
    gyro : numpy.ndarray
        The last two measured body rates (2, 3), rad/s, newest first, updated in place.
    wanted : tuple
        Thrust, N, and body rates (3,), rad/s.
    assumed, vehicle : Record
        Records of the vehicle that the controller assumes, and of the true vehicle.
    disturbances : tuple
        Wind (n, 3) m/s. Sensor errors (n, 6) of rates, rad/s, and specific force, m/s^2. Vibration
        (n, 3) m/s^2 while rotors turn.
    measured : tuple
        Outputs: true states (n, 17); mean rates and specific force (n, 6) since the sample before;
        largest number of feet on the ground in that time (n,).
    """
    thrust, rates = wanted[0], wanted[1]
    wind, errors, shaking = disturbances[0], disturbances[1], disturbances[2]
    truth, samples, contact = measured[0], measured[1], measured[2]
    dt = STEP * STEPS
    speeds, scratch, force, earlier = (
        np.empty(4),
        np.empty((2, STATE)),
        np.empty(3),
        np.empty(STATE),
    )
    for i in range(len(truth)):
        inner(thrust, rates, gyro, dt, assumed, speeds)  # writes speeds, of the rotors
        earlier[:] = state
        feet = 0
        turn = np.zeros(3)
        for _ in range(STEPS):
            feet = max(feet, step(state, speeds, wind[i], STEP, vehicle, scratch))
            for k in range(3):
                turn[k] += state[10 + k] / STEPS
        specific_force(earlier, state, dt, force)  # writes force
        turning = state[13] > TURNING  # one rotor stands for all
        for k in range(3):
            samples[i, k] = turn[k] + errors[i, k]
            samples[i, 3 + k] = force[k] + errors[i, 3 + k] + (shaking[i, k] if turning else 0.0)
        gyro[1] = gyro[0]
        gyro[0] = samples[i, :3]
        truth[i] = state
        contact[i] = feet


TICK = 4  # inertial samples per turn of the controller
DT = TICK / IMU_RATE  # s
START_SPREAD = 0.5  # m, largest offset of the path from the middle of the hall along each axis
MASS = 0.027, 0.033  # kg, least and largest mass
MASS_ERROR = 0.05  # largest relative error of the mass in the controller
TABLE_RADIUS = 0.4  # m
CARRY_HEIGHT = 0.5  # m, height at which it is carried
RECENT = round(0.3 * IMU_RATE)  # samples of the truth that effects use


# the samples of one turn by streams: imu, tdoa, and the further sensors of the world
Streams = dict[str, Any]


class Simulator:
    """Simulate one quadrotor and its sensors for a given duration.

    Attributes
    ----------
    state : numpy.ndarray
        True state (17,), see `vehicle`.
    vehicle, nominal : Vehicle
        The true vehicle, and the vehicle that its controller assumes.
    times, states, contact : numpy.ndarray
        Stamps (n,) s, states (n, 17) and number of feet on the ground (n,) at each inertial sample.
        Rows up to `done` are valid.
    """

    def __init__(self, world: World, seed: int, duration: float, radius: float = 0.0) -> None:
        """Draw the start, the errors and the disturbances.

        Parameters
        ----------
        world : World
        seed : int
        duration : float
            s.
        radius : float
            Radius of the circle whose point nearest to +x is the start, m.
        """
        self.world, rng = world, random(seed, "place")
        middle, yaw = rng.uniform(-START_SPREAD, START_SPREAD, 2), rng.uniform(-np.pi, np.pi)
        mass = rng.uniform(*MASS)
        x, y = middle[0] + radius, middle[1]
        table = (
            {"table": world.table, "table_x": x, "table_y": y, "table_radius": TABLE_RADIUS}
            if world.table
            else {}
        )
        self.vehicle = Vehicle(mass=mass, **table)
        self.nominal = Vehicle(mass=mass * (1.0 + rng.uniform(-MASS_ERROR, MASS_ERROR)))
        self.yaw, self.state = yaw, self.vehicle.at_rest(x, y, yaw)
        self._record, self._nominal_record = self.vehicle.record(), self.nominal.record()
        self.radio = Radio(world, seed, duration)
        self._inertial = InertialErrors(world, seed, duration)
        self._sensors = {
            name: AuxiliarySensor(name, world, seed, duration) for name in world.sensors
        }
        self._wind, self._rng = gusts(world, seed, duration), random(seed, "effects")
        n = len(self._wind)
        self.times = np.arange(n) / IMU_RATE
        self.states = np.empty((n, STATE))
        self.states[0] = self.state
        self.contact = np.zeros(n)
        self.samples = np.zeros((n, 6))
        self.done = 0
        self._gyro = np.zeros((2, 3))
        # state and time at the start, time at the end, path
        self._carrying: tuple[np.ndarray, float, float, np.ndarray] | None = None
        self._heard = dict.fromkeys(("tdoa", *world.sensors), 0)
        # first TDOAs, and the state at that time
        self._first: tuple[Tdoas, np.ndarray] | None = None

    @property
    def now(self) -> float:
        """Return the time since switching on, s."""
        return self.times[self.done]

    @property
    def over(self) -> bool:
        """Return whether the duration is used up."""
        return self.done + TICK >= len(self.times)

    @property
    def ground(self) -> float:
        """Return the height of the ground or table below the vehicle, m."""
        return ground_at(self._record, self.state[0], self.state[1])

    def advance(self, controller: Any) -> Streams:
        """Move for one turn and return the sensor samples.

        Parameters
        ----------
        controller : Controller or Steering
            Controller of this vehicle.

        Returns
        -------
        Streams
        """
        k = self.done
        rows, lately = slice(k + 1, k + TICK + 1), slice(k, k + TICK + 1)
        if self._carrying is None:
            self._move(controller, rows)
        else:
            self._carry(rows)
        self.done += TICK
        imu = Imu(self.times[rows], self.samples[rows, :3], self.samples[rows, 3:])
        new, p, _ = self._poses("tdoa", self.radio.t, lately)
        radio, ids = self.radio, self.world.anchors.ids
        d = radio.measured(new, p)
        heard = np.isfinite(d)
        tdoa = Tdoas(
            radio.t[new][heard], ids[radio.a[new][heard]], ids[radio.b[new][heard]], d[heard]
        )
        streams: Streams = {"imu": imu, "tdoa": tdoa}
        for name, sensor in self._sensors.items():
            new, p, q = self._poses(name, sensor.t, lately)
            v = np.broadcast_to(self.state[VELOCITY], p.shape)
            streams[name] = sensor.measured(new, p, q, v, self.ground)
        return self._with_effects(streams)

    def _move(self, controller: Any, rows: slice) -> None:
        """Fly the samples in `rows` with the outputs of a Controller."""
        interval(
            self.state,
            self._gyro,
            (controller.thrust, controller.rates),
            self._nominal_record,
            self._record,
            (self._wind[rows], self._inertial.errors[rows], self._inertial.shaking[rows]),
            (self.states[rows], self.samples[rows], self.contact[rows]),
        )

    def carry(self, by: np.ndarray, seconds: float) -> None:
        """Lift the vehicle, move it and put it down, from now on.

        Parameters
        ----------
        by : numpy.ndarray
            Displacement (2,), m.
        seconds : float
            Duration, s.
        """
        begin, end = self.state.copy(), self.now + seconds
        way = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, CARRY_HEIGHT], [*by, CARRY_HEIGHT], [*by, 0.0]])
        self._carrying = begin, self.now, end, way

    def _carry(self, rows: slice) -> None:
        """Move along the path of the hands, with the rotors off."""
        assert self._carrying is not None
        begin, since, until, way = self._carrying
        t, h = self.times[rows], 0.5 / IMU_RATE
        at = [
            begin[POSITION] + _along(way, (t + shift - since) / (until - since))
            for shift in (-2.0 * h, 0.0, 2.0 * h)
        ]
        v, a = (at[2] - at[0]) / (4.0 * h), (at[2] - 2.0 * at[1] + at[0]) / (2.0 * h) ** 2
        states = np.tile(begin, (len(t), 1))
        states[:, POSITION], states[:, VELOCITY], states[:, 10:] = at[1], v, 0.0
        self.states[rows], self.contact[rows] = states, 0.0
        self.samples[rows] = self._inertial.errors[rows]
        back = Rotation.from_quat(begin[ATTITUDE]).inv()
        self.samples[rows, 3:] += back.apply(a + np.array([0.0, 0.0, GRAVITY]))
        self.state[:] = states[-1]
        self._gyro[:] = self.samples[rows.stop - 1, :3]
        if t[-1] >= until:
            self._carrying = None
            self.state[VELOCITY] = 0.0

    def _poses(
        self, stream: str, t: np.ndarray, lately: slice
    ) -> tuple[slice, np.ndarray, np.ndarray]:
        """Return the new rows of a stream with stamps t (n,) s, and their poses.

        The result is (slice, p (k, 3) m, q (k, 4)).
        """
        first = self._heard[stream]
        new = slice(first, int(np.searchsorted(t, self.now, side="right")))
        at = np.array([np.interp(t[new], self.times[lately], of) for of in self.states[lately].T]).T
        q = at[:, ATTITUDE] / np.linalg.norm(at[:, ATTITUDE], axis=1, keepdims=True)
        self._heard[stream] = new.stop
        return new, at[:, POSITION].copy(), q

    def _with_effects(self, streams: Streams) -> Streams:
        """Return the samples with the effects of the world added by `Effect.inject`."""
        tdoa = streams["tdoa"]
        if not len(self.world.effects) or not len(tdoa):
            return streams
        self._first = self._first if self._first is not None else (tdoa, self.states[0])
        first, at = self._first  # effects count time from the first TDOA
        columns = (
            np.concatenate([getattr(first, name)[:1], getattr(tdoa, name)])
            for name in ("t", "a", "b", "d")
        )
        recent = slice(max(self.done - RECENT, 0), self.done + 1)
        states = np.concatenate([at[None], self.states[recent]])
        t = np.concatenate([first.t[:1] - 1e-3, self.times[recent]])
        truth = Truth(t, states[:, POSITION], states[:, ATTITUDE])
        measured = streams | {"tdoa": Tdoas(*columns), "truth": truth}
        flight = Flight("turn", self.world.anchors, **measured)
        for effect in self.world.effects.effects:
            flight = effect.inject(flight, self._rng)
        changed = {name: getattr(flight, name) for name in streams}
        return changed | {"tdoa": rows_of(flight.tdoa, slice(1, None))}


def _along(way: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return places (n, 3), m, on a smooth motion through `way` (m, 3).

    `share` (n,) is the share of the whole duration.
    """
    part = np.clip(share, 0.0, 1.0) * (len(way) - 1)
    k = np.minimum(part.astype(int), len(way) - 2)
    x = (part - k)[:, None]
    return way[k] + x**3 * (10.0 - 15.0 * x + 6.0 * x**2) * (way[k + 1] - way[k])


class Transport:
    """Delay sensor messages on their way to the estimator.

    Messages of one stream keep their order.
    """

    def __init__(self, latency: float, jitter: float, rng: np.random.Generator) -> None:
        """Set the delays.

        Parameters
        ----------
        latency : float
            Delay of every message, s.
        jitter : float
            Mean of an additional exponential delay, s.
        rng : numpy.random.Generator
        """
        self._latency, self._jitter, self._rng = latency, jitter, rng
        # by stream: (waiting rows, their arrivals (n,) s, the last arrival)
        self._waiting: dict[str, tuple[Any, np.ndarray, float]] = {}

    def arrived(self, streams: Streams, now: float) -> Streams:
        """Add new samples and return the samples that have arrived by `now`, s."""
        if not self._latency and not self._jitter:
            return streams
        return {name: self._due(name, part, now) for name, part in streams.items()}

    def _due(self, stream: str, part: Any, now: float) -> Any:
        """Return the rows of one stream that have arrived."""
        held, arrival, last = self._waiting.get(stream, (None, np.empty(0), 0.0))
        delay = (
            self._latency + self._rng.exponential(self._jitter, len(part))
            if self._jitter
            else np.full(len(part), self._latency)
        )
        came = np.maximum.accumulate(np.maximum(part.t + delay, last))
        part = part if held is None else concatenated([held, part])
        arrival = np.concatenate([arrival, came])
        due = int(np.searchsorted(arrival, now, side="right"))
        self._waiting[stream] = (
            rows_of(part, slice(due, None)),
            arrival[due:],
            came[-1] if len(came) else last,
        )
        return rows_of(part, slice(0, due))
