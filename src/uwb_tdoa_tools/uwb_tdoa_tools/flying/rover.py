# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Drive a rover by its estimate: two driven wheels with encoders, and a path controller.

The origin of the body is the antenna, MAST above the floor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.sensors import Stream, Velocity

from ..simulation.config import WHEELS_RATE
from ..simulation.sensors import YAW_RATE_STD, slips
from .mission import LOST, SPEED, Journey, Polyline, Pose, Rules, yaw_of
from .simulator import TICK, Simulator
from .trial import REST_AFTER, Task, Trial, TrialResult
from .vehicle import GRAVITY, IMU_RATE, AuxiliarySensor, World, random

MAST = 0.4  # m
# parameters of the filter of a rover
FILTER: dict[str, Any] = {"planar": True, "fixed_height": MAST, "non_holonomic_std": 0.05}
SENSOR_NAMES = ("velocity",)  # sensors besides the IMU and the radio
TRACK = 0.4  # m between its wheels
SCALE, UNEQUAL = 0.03, 0.003  # largest common scale error; standard deviation of each wheel
SLIP = 0.1  # share by which a slipping wheel turns too fast
LAG = 0.1  # s, time constant of a wheel
MAX_ACCELERATION = 1.0  # m/s^2
MIN_WHEEL_SPEED = 0.005  # m/s; a braking wheel stops below this speed
WHEEL_STD = 0.02  # m/s, noise of the encoders
BUMPER = 0.2  # m from its middle
LOOK_AHEAD = 0.4  # m, distance of the target point on the path
TURN, MAX_YAW_RATE = 2.0, 1.2  # 1/s, yaw rate per direction error; rad/s
APPROACH_GAIN = 1.0  # 1/s, largest speed per distance to the end
STOP = 0.06  # m from the end, where it stops
WINDOW = 1.0  # m of the path in which the nearest point is searched
LOST_TIMEOUT = 30.0  # s, longest stop with a lost estimate


class Steering:
    """Hold the wanted speed, m/s, and yaw rate, rad/s."""

    def __init__(self) -> None:
        self.stop()

    def stop(self) -> None:
        """Stand still."""
        self.speed = self.turning = 0.0


class Wheels(AuxiliarySensor):
    """Simulate the encoders of both wheels."""

    def __init__(self, simulator: RoverSimulator, seed: int, duration: float) -> None:
        """Draw stamps and noise for `duration`, s."""
        self._simulator = simulator
        self.t = np.arange(0.5, duration * WHEELS_RATE) / WHEELS_RATE
        self._noise = random(seed, "Wheels").standard_normal((len(self.t), 2))

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, ground: float
    ) -> Stream:
        t, of = self.t[rows], self._simulator
        lately = slice(of.done - TICK, of.done + 1)
        wheels = np.column_stack(
            [np.interp(t, of.times[lately], column) for column in of.wheels[lately].T]
        )
        turns = wheels.any(axis=1)
        speed, turning = _unicycle(wheels.T)
        v, std = np.zeros((len(t), 3)), np.full((len(t), 3), WHEEL_STD)
        v[:, 0] = speed + WHEEL_STD * turns * self._noise[rows, 0]
        turning = turning + YAW_RATE_STD * turns * self._noise[rows, 1]
        return Velocity(t, v, std, turning, np.full(len(t), YAW_RATE_STD))


class RoverSimulator(Simulator):
    """Simulate a rover and its sensors for a given duration.

    Attributes
    ----------
    wheels : numpy.ndarray
        Speeds (n, 2) that the encoders measure, left and right, m/s.
    """

    def __init__(self, world: World, seed: int, duration: float) -> None:
        super().__init__(world, seed, duration)
        x, y = self.state[:2]
        self.state[:] = 0.0
        self.state[:3] = x, y, MAST
        self.state[8:10] = math.sin(0.5 * self.yaw), math.cos(0.5 * self.yaw)
        self.states[0] = self.state
        rng = random(seed, "wheels")
        self._scale = 1.0 + rng.uniform(-SCALE, SCALE) + UNEQUAL * rng.standard_normal(2)
        slipping = np.column_stack([slips(self.times, rng) for _ in range(2)])
        self._per_turn = 1.0 / (self._scale * (1.0 + SLIP * slipping))
        self._sensors = {"velocity": Wheels(self, seed, duration)}
        self.wheels = np.zeros((len(self.times), 2))

    def _move(self, controller: Steering, rows: slice) -> None:
        """Drive the samples in `rows` with the outputs of a Steering."""
        half, dt, state = 0.5 * TRACK * controller.turning, 1.0 / IMU_RATE, self.state
        wanted = np.array([controller.speed - half, controller.speed + half])
        for i in range(rows.start, rows.stop):
            wheels = self.wheels[i - 1]
            most = MAX_ACCELERATION * dt
            wheels = wheels + np.clip((wanted - wheels) * dt / LAG, -most, most)
            wheels[(wanted == 0.0) & (np.abs(wheels) < MIN_WHEEL_SPEED)] = 0.0
            before, after = self.wheels[i - 1] * self._per_turn[i - 1], wheels * self._per_turn[i]
            (speed, turning), (v, w) = _unicycle(0.5 * (before + after)), _unicycle(after)
            yaw = self.yaw + 0.5 * turning * dt
            state[:2] += speed * dt * np.array([math.cos(yaw), math.sin(yaw)])
            self.yaw += turning * dt
            state[3:5] = v * math.cos(self.yaw), v * math.sin(self.yaw)
            state[8:10], state[12] = (math.sin(0.5 * self.yaw), math.cos(0.5 * self.yaw)), w
            ahead = (v - _unicycle(before)[0]) / dt
            sample = np.array([0.0, 0.0, turning, ahead, speed * turning, GRAVITY])
            sample += self._inertial.errors[i]
            if wheels.any():
                sample[3:] += self._inertial.shaking[i]
            self.wheels[i], self.states[i], self.samples[i] = wheels, state, sample
            self.contact[i] = 2.0


def _unicycle(wheels: Any) -> tuple[Any, Any]:
    """Return speed, m/s, and yaw rate, rad/s, of the wheel speeds, left and right, m/s."""
    left, right = wheels
    return 0.5 * (left + right), (right - left) / TRACK


class Drive(Journey):
    """Run one drive along a polyline. The rover stands while its estimate is lost."""

    def __init__(self, path: Polyline, rules: Rules | None = None, begin: float = 0.0) -> None:
        """Wait for the start. begin : s, time of switching on"""
        super().__init__(rules, begin)
        self.path, self.place = path, path.end
        self._last_good = begin

    def decide(self, t: float, pose: Pose | None, deviation: float, steering: Steering) -> None:
        """Set the wanted motion in `steering`.

        Parameters
        ----------
        t : float
            s.
        pose : Pose or None
            Newest estimate.
        deviation : float
            Its largest standard deviation of a coordinate, m.
        steering : Steering
        """
        steering.stop()
        if not self._judge(t, pose, deviation):
            return
        if self.state == LOST:
            if t - self._last_good > LOST_TIMEOUT:
                self._end(t)
            return
        self._last_good = t
        assert pose is not None  # without a pose the state is LOST
        self._steer(t, pose, steering)

    def _steer(self, t: float, pose: Pose, steering: Steering) -> None:
        """Steer to a point ahead on the path (pure pursuit)."""
        p = pose[1][:2]
        before = self.path_time
        along = float(self.path.nearest(p[None], before, before + WINDOW)[0])
        self._clock.append((t, along))
        left = float(np.linalg.norm(self.path.end - p))
        if left < STOP or (along >= self.path.length and left < 2.0 * STOP):
            self._end(t)
            return
        target = self.path.at(np.array([along + LOOK_AHEAD]))[0, :2]
        x, y = target - p
        off = (math.atan2(y, x) - yaw_of(pose[3]) + math.pi) % (2.0 * math.pi) - math.pi
        to_go = self.path.length - along + left if along < self.path.length - LOOK_AHEAD else left
        steering.speed = min(SPEED, APPROACH_GAIN * to_go) * max(math.cos(off), 0.0)
        steering.turning = min(max(TURN * off, -MAX_YAW_RATE), MAX_YAW_RATE)

    def wanted(self, t: np.ndarray) -> np.ndarray:
        """Return the points of the path that were nearest (n, 1, 3), m, at t (n,) s."""
        if not self._clock:
            return np.full((len(t), 1, 3), np.nan)
        return self.path.at(self._along(t))[:, None]


class RoverTrial(Trial):
    """Run a Task with Waypoints."""

    def _longest(self) -> float:
        rules = self.task.rules
        drive = 2.0 * self.task.path.duration
        return rules.rest + rules.patience + drive + LOST_TIMEOUT + REST_AFTER

    def _simulator(self, duration: float) -> RoverSimulator:
        return RoverSimulator(self.task.world, self.task.seed, duration)

    def _controller(self) -> Steering:
        return Steering()

    def _mission(self, path: Any, rules: Rules) -> Any:
        way: Any = self.task.path.starting_at(self.simulator.state[:2].copy(), MAST)
        return Drive(way, rules, self.simulator.now)

    def _control(self, mission: Any) -> None:
        source = self.source
        mission.decide(self.simulator.now, source.pose, source.deviation, self.controller)

    def _crash(self) -> str:
        half = 0.5 * np.array(self.task.world.size[:2])
        hit = (np.abs(self.simulator.state[:2]) > half - BUMPER).any()
        return "drove into a wall" if hit else ""


def drive(task: Task) -> TrialResult:
    """Drive a Task with Waypoints and return the TrialResult."""
    trial = RoverTrial(task)
    trial.fly()
    return trial.result
