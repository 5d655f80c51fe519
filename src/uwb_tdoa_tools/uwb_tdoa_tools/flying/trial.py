"""One flight in lockstep: the same task gives the same flight, whatever the computer does beside it."""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.flight import Flight, Truth
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.estimator import Odometry

from .controller import FELT, Controller, Gains, turned
from .estimates import OurFilter, TheirFilter
from .loop import IMU_RATE
from .mission import DONE, REFUSED, Mission, Rules
from .path import Circles
from .sensors import random
from .simulator import DT, Simulator
from .transport import Transport
from .vehicle import ATTITUDE, POSITION
from .world import World

REST_AFTER = 3.0  # s of the recording after the rotors have stopped
PAUSE, CARRIED, CARRY_TIME = 60.0, 2.0, 6.0  # s at rest between two flights, m and s by which it is carried then
OUTSIDE = 0.5  # m beyond the hall, where a flight ends
TIPPED = math.radians(75.0)  # tilt of a vehicle that touches something, and does not get up again
TOLD_AT, TOLD_STD = 0.3, 0.1  # s after switching on; m and rad, standard deviation of what is told


@dataclass(frozen=True)
class Task:
    """One flight. world : World; seed : of all that is random; told : "place" or "nothing"; yaw : "known", to 0.1 rad, or "unknown";
    config : FilterConfig; effects : EffectSet, to correct what is measured with, or None; again : fly twice, carried by hand in between;
    peer : path of a library to fly by instead of our filter, always with a known yaw; path, rules, gains : of the vehicle."""

    world: World
    seed: int = 0
    told: str = "nothing"
    yaw: str = "known"
    config: FilterConfig = field(default_factory=FilterConfig)
    effects: EffectSet | None = None
    again: bool = False
    peer: str | None = None
    path: Circles = Circles()
    rules: Rules = Rules()
    gains: Gains = Gains()


@dataclass(frozen=True)
class Flown:
    """What became of it. flight : Flight, all that arrived, its truth at every sample of the inertial sensor; states (n, 17) and
    contact (n,), number of feet on the ground, beside that; odometry : Odometry, all that came out; missions : [Mission], one for each
    take-off; crash : what ended it, text, or ""."""

    task: Task
    flight: Flight
    states: np.ndarray
    contact: np.ndarray
    odometry: Odometry
    missions: list
    crash: str


class Trial:
    """A Task under way."""

    def __init__(self, task):
        world, seed, rules = task.world, task.seed, task.rules
        longest = rules.rest + rules.patience + task.path.duration + rules.longest_sink + REST_AFTER
        duration = longest * (2 if task.again else 1) + (PAUSE + CARRY_TIME if task.again else 0.0)
        self.task, self.simulator = task, Simulator(world, seed, duration, task.path.radius)
        self._rng = random(seed, "task")
        told = random(seed, "told")
        place, off = self.simulator.state[POSITION] + TOLD_STD * told.standard_normal(3), TOLD_STD * told.standard_normal()
        yaw, config = self.simulator.yaw + off, task.config
        if task.peer is not None:
            self.source = TheirFilter(task.peer, world.anchors, yaw, place if task.told == "place" else None)
        else:
            if task.yaw == "known":
                config = replace(config, initial_yaw=yaw, initial_yaw_std=TOLD_STD)
            self.source = OurFilter(world.anchors, config, task.effects)
            if task.told == "place":
                self.source.tell(TOLD_AT, place, TOLD_STD)
        self.controller = Controller(task.gains, self.simulator.believed)
        self.transport = Transport(world.latency, world.jitter, random(seed, "transport"))
        self.missions, self.crash, self._arrived = [], "", []

    def fly(self):
        """One mission from where it stands, until it has rested for a while after it, or has come to an end."""
        simulator, rules, path = self.simulator, self.task.rules, self.task.path
        state = simulator.state
        mission = Mission(path, state[:2].copy(), state[2], rules, simulator.now)
        self.missions.append(mission)
        moment = _moment(self.task.world.silence, path, rules, self._rng)
        felt = int(FELT * IMU_RATE)
        while not (simulator.over or self.crash or mission.state == REFUSED):
            now, pose, k = simulator.now, self.source.pose, simulator.done
            started = mission.begin + rules.rest if mission.started is None else mission.started
            simulator.radio.happens(started + moment, started + 0.5 * path.duration)
            force = np.mean(simulator.samples[max(k - felt, 0) : k + 1, 5])
            wanted = mission.decide(now, pose, self.source.deviation, self.controller.support(force))
            if wanted is not None:
                attitude = self._turned_since(pose[3], pose[0], k)
                self.controller.fly(pose[1], pose[2], attitude, wanted, mission.yaw, DT)
            else:
                self.controller.stop()
                if mission.state == DONE and now > mission.ended + REST_AFTER:
                    return
            self._turn()

    def rest(self, seconds):
        """Stand, or be carried, with rotors off."""
        self.controller.stop()
        end = self.simulator.now + seconds
        while self.simulator.now < end and not (self.simulator.over or self.crash):
            self._turn()

    def _turn(self):
        measured = self.transport.arrived(self.simulator.advance(self.controller), self.simulator.now)
        self._arrived.append(measured)
        self.source.take(measured)
        self.crash = _crash(self.simulator, self.task.world)

    def _turned_since(self, attitude, since, k):
        """An attitude (4,) of `since`, s, turned by the rates that were felt until sample k."""
        times, samples, attitude = self.simulator.times, self.simulator.samples, attitude.copy()
        for j in range(max(int(np.searchsorted(times[: k + 1], since, side="right")), 1), k + 1):
            turned(attitude, samples[j, :3], times[j] - max(times[j - 1], since))
        return attitude

    @property
    def flown(self):
        """Flown."""
        simulator, world = self.simulator, self.task.world
        end = simulator.done + 1
        states = simulator.states[:end]
        parts = [_joined([getattr(one, name) for one in self._arrived]) for name in ("imu", "tdoa")]
        aids = {name: _joined([one.aids[name] for one in self._arrived]) for name in world.aids}
        truth = Truth(simulator.times[:end], states[:, POSITION], states[:, ATTITUDE])
        meta = {"source": "fly", "format": "simulation", "protocol": world.protocol}
        flight = Flight(f"flown-{self.task.seed}", world.anchors, parts[1], parts[0], truth, meta=meta, **aids)
        return Flown(self.task, flight, states, simulator.contact[:end], self.source.odometry, self.missions, self.crash)


def fly(task):
    """Flown, of a Task."""
    trial = Trial(task)
    trial.fly()
    if task.again and not trial.crash and trial.missions[0].state == DONE:
        trial.rest(PAUSE)
        angle = random(task.seed, "carried").uniform(-np.pi, np.pi)
        trial.simulator.lift(CARRIED * np.array([np.cos(angle), np.sin(angle)]), CARRY_TIME)
        trial.rest(CARRY_TIME)
        trial.fly()
    return trial.flown


def _moment(silence, path, rules, rng):
    """s since the rotors started, at which a silence begins; inf without one."""
    anywhere = rng.uniform(-0.5 * rules.rest, path.duration)
    if silence is None:
        return math.inf
    return {
        "rest": -0.5 * rules.rest, "lift-off": 0.5, "circle": path.rise + 4.0, "landing": path.duration - 2.0, "anywhere": anywhere,
    }[silence[0]]  # fmt: skip


def _crash(simulator, world):
    """What ends a flight in the state of a Simulator, in words, or ""."""
    state = simulator.state
    x, y, z = state[POSITION]
    tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (state[6] ** 2 + state[7] ** 2))))
    if tilt > TIPPED and simulator.contact[simulator.done]:
        return "tipped over"
    if abs(x) > 0.5 * world.size[0] + OUTSIDE or abs(y) > 0.5 * world.size[1] + OUTSIDE:
        return "flew into a wall"
    if z > world.size[2] + OUTSIDE:
        return "flew into the ceiling"
    return ""


def _joined(parts):
    """One stream of its parts."""
    return type(parts[0])(*map(np.concatenate, zip(*(vars(part).values() for part in parts))))
