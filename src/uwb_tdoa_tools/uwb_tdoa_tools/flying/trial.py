"""One flight in lockstep: the same task gives the same flight, whatever the computer does beside
it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.correction.network import load_network
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.flight import Flight, Truth
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import Odometry, concatenated

from .controller import SUPPORT_TIME, Controller, Gains, rotate_attitude
from .estimates import OwnFilter, PeerFilter
from .mission import DONE, REFUSED, Circles, Mission, Rules, Waypoints
from .sensors import random
from .simulator import DT, Simulator, Transport
from .vehicle import ATTITUDE, IMU_RATE, POSITION
from .world import World

if TYPE_CHECKING:
    from .estimates import EstimateSource
    from .mission import Plan
    from .simulator import SensorReadings

REST_AFTER = 3.0  # s of the recording after the rotors have stopped
PAUSE, CARRIED, CARRY_TIME = (
    60.0,
    2.0,
    6.0,
)  # s at rest between two flights, m and s by which it is carried then
OUTSIDE = 0.5  # m beyond the hall, where a flight ends
VEHICLES = "quadrotor", "rover"
TIPPED = math.radians(75.0)  # tilt of a vehicle that touches something, and does not get up again
GIVEN_AT, GIVEN_STD = (
    0.3,
    0.1,
)  # s after switching on; m and rad, standard deviation of the place and yaw that are given


@dataclass(frozen=True)
class Task:
    """One flight. world : World; seed : of all that is random; told : "place" or "nothing"; yaw :
    "known", to 0.1 rad, or "unknown";
    config : FilterConfig; effects : EffectSet, and model : path of a bias network, to correct what
        is measured with, or None; again : fly
    twice, carried by hand in between;
    peer : path of a library to fly by instead of our filter, always with a known yaw; path, rules,
        gains : of the vehicle, a rover where the path is of Waypoints.
    """

    world: World
    seed: int = 0
    given: str = "nothing"
    yaw: str = "known"
    config: FilterConfig = field(default_factory=FilterConfig)
    effects: EffectSet | None = None
    model: str | None = None
    again: bool = False
    peer: str | None = None
    path: Circles | Waypoints = Circles()
    rules: Rules = Rules()
    gains: Gains = Gains()

    @property
    def vehicle(self) -> str:
        """One of VEHICLES."""
        return "rover" if isinstance(self.path, Waypoints) else "quadrotor"


@dataclass(frozen=True)
class TrialResult:
    """What became of it. flight : Flight, all that arrived, its truth at every sample of the
    inertial sensor; states (n, 17) and contact (n,), number of feet on the ground, beside that;
    odometry : Odometry, all that came out; missions : [Mission], one for each take-off, or
    [rover.Drive]; crash : what ended it, text, or "".
    """

    task: Task
    flight: Flight
    states: np.ndarray
    contact: np.ndarray
    odometry: Odometry
    missions: list[Any]
    crash: str


class Trial:
    """A Task under way. simulator : Simulator; source : who tells where it is; missions :
    [Mission], the last one under way; crash : as of TrialResult.
    """

    def __init__(
        self, task: Task, source: EstimateSource | None = None, lasts: float | None = None
    ) -> None:
        """source : something like OurFilter, default: what the Task says; lasts : s, default: as
        long as it can take.
        """
        world, seed, rules = task.world, task.seed, task.rules
        longest = (
            rules.rest + rules.patience + task.path.duration + rules.longest_descent + REST_AFTER
        )
        duration = lasts or longest * (2 if task.again else 1) + (
            PAUSE + CARRY_TIME if task.again else 0.0
        )
        self.task = task
        self.simulator = self._simulator(duration)
        self._rng = random(seed, "task")
        rng = random(seed, "told")
        place, off = (
            self.simulator.state[POSITION] + GIVEN_STD * rng.standard_normal(3),
            GIVEN_STD * rng.standard_normal(),
        )
        yaw = self.simulator.yaw + off
        self.source: EstimateSource | PeerFilter = source or _filter_of(task, place, yaw)
        if task.given == "place" and not isinstance(self.source, PeerFilter):
            self.source.set_pose(
                GIVEN_AT, place, GIVEN_STD, yaw if task.yaw == "known" else math.nan
            )
        self.controller = self._controller()
        self.transport = Transport(world.latency, world.jitter, random(seed, "transport"))
        self.missions: list[Any] = []
        self.crash = ""
        self._arrived: list[SensorReadings] = []

    def _simulator(self, duration: float) -> Simulator:
        """The vehicle, for so many s."""
        assert isinstance(self.task.path, Circles)
        return Simulator(self.task.world, self.task.seed, duration, self.task.path.radius)

    def _controller(self) -> Any:
        """What moves it."""
        return Controller(self.task.gains, self.simulator.nominal)

    def fly(self) -> None:
        """One mission from where it stands, until it has rested for a while after it, or has come
        to an end.
        """
        self.begin()
        while not self.over:
            self.turn()

    def begin(self, path: Plan | None = None, rules: Rules | None = None) -> None:
        """Begin a mission from where it stands; path, rules : default: those of the Task."""
        self.missions.append(self._mission(path or self.task.path, rules or self.task.rules))
        self._moment = _moment(self.task.world.silence, self.task.path, self.task.rules, self._rng)

    def _mission(self, path: Any, rules: Rules) -> Any:
        """A mission from where it stands now."""
        state = self.simulator.state
        return Mission(path, state[:2].copy(), state[2], rules, self.simulator.now)

    @property
    def over(self) -> bool:
        """True when the mission under way has come to an end, or nothing more can come."""
        mission = self.missions[-1]
        rested = (
            mission.state == DONE
            and mission.ended is not None
            and self.simulator.now > mission.ended + REST_AFTER
        )
        return bool(rested or mission.state == REFUSED or self.crash or self.simulator.over)

    def turn(self) -> None:
        """One turn of the controller, as the mission under way decides; rotors off without one."""
        wanted = self._decide(self.missions[-1]) if self.missions else None
        if wanted is None:
            self.controller.stop()
        else:
            pose = self.source.pose
            assert pose is not None  # as the mission has begun by it
            since, p, v, q = pose
            self.controller.fly(
                p, v, self._predicted_attitude(q, since), wanted, self.missions[-1].yaw, DT
            )
        self._turn()

    def _decide(self, mission: Mission) -> np.ndarray | None:
        """What a Mission wants now."""
        simulator, k = self.simulator, self.simulator.done
        self._schedule_faults(mission)
        force = float(
            np.mean(simulator.samples[max(k - int(SUPPORT_TIME * IMU_RATE), 0) : k + 1, 5])
        )
        return mission.decide(
            simulator.now, self.source.pose, self.source.deviation, self.controller.support(force)
        )

    def _schedule_faults(self, mission: Any) -> None:
        """Have the silence and the change of its world come when they are due in a mission."""
        started = mission.begin + mission.rules.rest if mission.started is None else mission.started
        self.simulator.radio.schedule_faults(
            started + self._moment, started + 0.5 * self.task.path.duration
        )

    def rest(self, seconds: float) -> None:
        """Stand, or be carried, with rotors off."""
        self.controller.stop()
        end = self.simulator.now + seconds
        while self.simulator.now < end and not (self.simulator.over or self.crash):
            self._turn()

    def _turn(self) -> None:
        measured = self.transport.arrived(
            self.simulator.advance(self.controller), self.simulator.now
        )
        self._arrived.append(measured)
        self.source.take(measured)
        self.crash = self._crash()

    def _crash(self) -> str:
        """What ends it, in words, or ""."""
        return _crash(self.simulator, self.task.world)

    def _predicted_attitude(self, attitude: np.ndarray, since: float) -> np.ndarray:
        """An attitude (4,) of `since`, s, turned by the rates that were felt until now."""
        times, samples, k, attitude = (
            self.simulator.times,
            self.simulator.samples,
            self.simulator.done,
            attitude.copy(),
        )
        for j in range(max(int(np.searchsorted(times[: k + 1], since, side="right")), 1), k + 1):
            rotate_attitude(attitude, samples[j, :3], times[j] - max(times[j - 1], since))
        return attitude

    @property
    def result(self) -> TrialResult:
        """TrialResult."""
        simulator, world = self.simulator, self.task.world
        end = simulator.done + 1
        states = simulator.states[:end]
        parts = [
            concatenated([getattr(one, name) for one in self._arrived]) for name in ("imu", "tdoa")
        ]
        aids: dict[str, Any] = {
            name: concatenated([one.aids[name] for one in self._arrived]) for name in world.aids
        }
        truth = Truth(simulator.times[:end], states[:, POSITION], states[:, ATTITUDE])
        meta = {"source": "fly", "format": "simulation", "protocol": world.protocol}
        flight = Flight(
            f"flown-{self.task.seed}", world.anchors, parts[1], parts[0], truth, meta=meta, **aids
        )
        return TrialResult(
            self.task,
            flight,
            states,
            simulator.contact[:end],
            self.source.odometry,
            self.missions,
            self.crash,
        )


def fly(task: Task) -> TrialResult:
    """TrialResult, of a Task."""
    trial = Trial(task)
    trial.fly()
    if task.again and not trial.crash and trial.missions[0].state == DONE:
        trial.rest(PAUSE)
        angle = random(task.seed, "carried").uniform(-np.pi, np.pi)
        trial.simulator.carry(CARRIED * np.array([np.cos(angle), np.sin(angle)]), CARRY_TIME)
        trial.rest(CARRY_TIME)
        trial.fly()
    return trial.result


def _filter_of(task: Task, place: np.ndarray, yaw: float) -> OwnFilter | PeerFilter:
    """Who tells where it is, of a Task; place (3,) m and yaw, rad: what is given at the start, if
    it is.
    """
    anchors = task.world.anchors
    if task.peer is not None:
        return PeerFilter(task.peer, anchors, yaw, place if task.given == "place" else None)
    known: dict[str, Any] = (
        {"initial_yaw": yaw, "initial_yaw_std": GIVEN_STD} if task.yaw == "known" else {}
    )
    return OwnFilter(anchors, replace(task.config, **known), task.effects, load_network(task.model))


def _moment(
    silence: tuple[str, float] | None,
    path: Circles | Waypoints,
    rules: Rules,
    rng: np.random.Generator,
) -> float:
    """s since the rotors started, at which a silence begins; inf without one."""
    anywhere = rng.uniform(-0.5 * rules.rest, path.duration)
    if silence is None:
        return math.inf
    return {
        "rest": -0.5 * rules.rest,
        "lift-off": 0.5,
        "circle": path.middle,
        "landing": path.duration - 2.0,
        "anywhere": anywhere,
    }[silence[0]]


def _crash(simulator: Simulator, world: World) -> str:
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
