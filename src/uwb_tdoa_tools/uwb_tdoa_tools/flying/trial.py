# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly one task in lockstep by an estimate of the filter, without ROS.

The same task gives the same flight on any computer.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.model import Model, load_network
from uwb_tdoa_bias.effects import EffectSet, StreamCorrector
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.yaw_check import YAW_KNOWN
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.results import Odometry, concatenated, poses_of, rotation_std

from .mission import DONE, LOST, REFUSED, Circles, Mission, Pose, Rules, TimedPath, Waypoints
from .simulator import DT, SUPPORT_TIME, Controller, Simulator, Streams, Transport, integrate
from .vehicle import ATTITUDE, GRAVITY, IMU_RATE, POSITION, World, random

_NO_VECTORS = np.empty((0, 3))
NO_ODOMETRY = Odometry(
    np.empty(0),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 4)),
    _NO_VECTORS,
    _NO_VECTORS,
    np.empty((0, 9, 9)),
    np.empty((0, 3, 3)),
)


class EstimateSource:
    """Provide the estimate that a vehicle flies by."""

    def __init__(self) -> None:
        # (t s, p (3,), v (3,), q (4,), covariance of p (3, 3)) of each estimate
        self._rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Set the position and the yaw at a time.

        Parameters
        ----------
        t : float
            s.
        p : numpy.ndarray
            (3,), m.
        std : float
            Standard deviation of position, m, and yaw, rad.
        yaw : float
            rad, NaN if unknown.
        """
        raise NotImplementedError

    def take(self, streams: Streams) -> None:
        """Process the samples that have arrived."""
        raise NotImplementedError

    @property
    def why(self) -> str:
        """Return the reason for which the estimate cannot be used, or ""."""
        return ""

    @property
    def yaw_known(self) -> bool:
        """Return whether the yaw of the estimate can be used."""
        return True

    @property
    def pose(self) -> Pose | None:
        """Return (t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        return self._rows[-1][:4] if self._rows else None

    @property
    def deviation(self) -> float:
        """Return its largest standard deviation of a coordinate, m, or inf without an estimate."""
        return math.sqrt(self._rows[-1][4].diagonal().max()) if self._rows else math.inf

    @property
    def odometry(self) -> Odometry:
        """Return all estimates, without rates. Only the position has a covariance."""
        if not self._rows:
            return NO_ODOMETRY
        t, p, v, q, of_position = map(np.array, zip(*self._rows))
        covariance = np.zeros((len(t), 9, 9))
        covariance[:, :3, :3] = of_position
        zero = np.zeros(p.shape)
        return Odometry(t, p, v, q, zero, zero, covariance, np.zeros((len(t), 3, 3)))


class OwnFilter(EstimateSource):
    """Run `Corrector` and `Estimator` as bias_node and ekf_node do.

    Attributes
    ----------
    estimator : Estimator
    newest : Odometry or None
        The last output.
    """

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig,
        effects: EffectSet | None = None,
        network: Model | None = None,
    ) -> None:
        """Set up the filter and its corrections.

        Parameters
        ----------
        anchors : Anchors
        config : FilterConfig
        effects : EffectSet, optional
        network : Model, optional
            Corrections of the measurements.
        """
        super().__init__()
        effects = effects or EffectSet()
        self._anchors = anchors
        self._streams = StreamCorrector(effects.effects)
        self._corrector = Corrector(anchors, effects, network)
        self.estimator = Estimator(anchors, config, effects=effects)
        self._parts = [NO_ODOMETRY]
        self.newest: Odometry | None = None

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        self.estimator.set_pose(t, p, std**2 * np.eye(3), yaw, std)

    def take(self, streams: Streams) -> None:
        for name, part in streams.items():
            if len(part.t):
                self._add(name, self._streams.correct(name, part))
        odometry, _ = self.estimator.advance()
        if not len(odometry):
            return
        self._parts.append(odometry)
        self.newest = odometry
        self._rows = [  # the newest alone: _parts hold all
            (
                odometry.t[-1],
                odometry.p[-1],
                odometry.v[-1],
                odometry.q[-1],
                odometry.covariance[-1, :3, :3],
            )
        ]
        if not self._corrector.idle:
            self._corrector.add_pose(*poses_of(odometry))

    @property
    def yaw_known(self) -> bool:
        return self.newest is not None and bool(
            rotation_std(self.newest.q[-1:], self.newest.covariance[-1:])[0, 2] <= YAW_KNOWN
        )

    def _add(self, name: str, part: Any) -> None:
        """Give a part of one stream to the filter, and correct the bias of TDOAs."""
        if name == "imu":
            self.estimator.add_imu(part.t, part.gyro, part.accel)
        elif name == "tdoa":
            known = self._corrector.correct(
                part.t, self._anchors.index(part.a), self._anchors.index(part.b), part.d
            )
            self.estimator.add_tdoa(
                part.t,
                part.a,
                part.b,
                known.corrected,
                known.std**2 + part.variance,
                known.slope,
                known.state,
            )
        else:
            self.estimator.add(name, part)

    @property
    def odometry(self) -> Odometry:
        """Return all estimates."""
        return concatenated(self._parts)


REST_AFTER = 3.0  # s, recording after the rotors have stopped
# s at rest between two flights, then distance, m, and duration, s, of carrying
PAUSE, CARRIED, CARRY_TIME = 60.0, 2.0, 6.0
OUTSIDE = 0.5  # m beyond the walls, end of a flight
TIPPED = math.radians(75.0)  # tilt on the ground from which it cannot recover
# s after switching on, and standard deviation, m and rad, of the given place and yaw
GIVEN_AT, GIVEN_STD = 0.3, 0.1


# the check of the estimate by the vehicle's own IMU: s, age of the estimate that it starts from;
# s at rest that determine the offsets of the IMU; s on the path during which the floor disturbs the
# estimate; s after the vehicle was lost until an estimate can be a start
MEMORY, AT_REST, LIFT_OFF, SETTLED = 2.0, 1.0, 4.0, 1.0
# difference that contradicts, for each second of the age: position in stated deviations, m/s, rad.
# 60 flights without a fault reach 2.1, 0.31 and 0.03.
# During lift-off, ROUGH times that means an IMU that is too rough: shaking rotors reach 5.
FARTHER, FASTER, TURNED, ROUGH = 2.5, 0.4, 0.13, 2.0


def _difference(one: Pose, other: Pose, deviation: float, age: float) -> float:
    """Return the difference of two poses in units of what `age`, s, of inertial samples explains.

    deviation : float
        Stated standard deviation of a coordinate, m.
    """
    far, fast = (float(np.linalg.norm(one[k] - other[k])) for k in (1, 2))
    turn = 2.0 * math.acos(min(1.0, abs(float(one[3] @ other[3]))))
    return max(far / (FARTHER * deviation), fast / FASTER, turn / TURNED) / max(age, MEMORY)


@dataclass(frozen=True)
class Task:
    """Describe one flight.

    Parameters
    ----------
    world : World
    seed : int
        Seed of all random numbers.
    given : str
        "place" or "nothing": information at the start.
    yaw : str
        "known", to 0.1 rad, or "unknown".
    config : FilterConfig
    effects : EffectSet, optional
    model : str, optional
        Path of a bias network. Both correct the measurements.
    again : bool
        Fly twice. The vehicle is carried by hand in between.
    path : Circles or Waypoints
        Waypoints make the vehicle a rover.
    rules : Rules
    """

    world: World
    seed: int = 0
    given: str = "nothing"
    yaw: str = "known"
    config: FilterConfig = field(default_factory=FilterConfig)
    effects: EffectSet | None = None
    model: str | None = None
    again: bool = False
    path: Circles | Waypoints = Circles()
    rules: Rules = Rules()

    @property
    def vehicle(self) -> str:
        """Return "quadrotor" or "rover"."""
        return "rover" if isinstance(self.path, Waypoints) else "quadrotor"


@dataclass(frozen=True)
class TrialResult:
    """Hold the outcome of a flight.

    Parameters
    ----------
    task : Task
    flight : Flight
        All samples that arrived, with the true pose at every inertial sample.
    states : numpy.ndarray
        True states (n, 17) at the stamps of the truth.
    contact : numpy.ndarray
        Number of feet on the ground (n,).
    odometry : Odometry
        All estimates.
    missions : list of Mission or Drive
        One per start.
    crash : str
        Reason for which the flight ended early, or "".
    """

    task: Task
    flight: Flight
    states: np.ndarray
    contact: np.ndarray
    odometry: Odometry
    missions: list[Any]
    crash: str


class Trial:
    """Run a Task turn by turn.

    Attributes
    ----------
    simulator : Simulator
    source : EstimateSource
    missions : list of Mission or Drive
        The last one is active.
    crash : str
        Reason for which the flight ended early, or "".
    """

    def __init__(
        self, task: Task, source: EstimateSource | None = None, duration: float | None = None
    ) -> None:
        """Set up vehicle, estimate and controller.

        Parameters
        ----------
        task : Task
        source : EstimateSource, optional
            The default is the filter of the task.
        duration : float, optional
            s. The default is the longest duration of the task.
        """
        world, seed = task.world, task.seed
        self.task = task
        self.simulator = self._simulator(duration or self._longest())
        self._rng = random(seed, "task")
        rng = random(seed, "told")
        place = self.simulator.state[POSITION] + GIVEN_STD * rng.standard_normal(3)
        yaw = self.simulator.yaw + GIVEN_STD * rng.standard_normal()
        self.source = source or _filter_of(task, yaw)
        if task.given == "place":
            self.source.set_pose(
                GIVEN_AT, place, GIVEN_STD, yaw if task.yaw == "known" else math.nan
            )
        self.controller = self._controller()
        self.transport = Transport(world.latency, world.jitter, random(seed, "transport"))
        self.missions: list[Any] = []
        self.crash = ""
        self._arrived: list[Streams] = []
        # poses of the last MEMORY s that could be flown by, each with its deviation, m
        self._past: deque[tuple[Pose, float]] = deque(maxlen=int(MEMORY / DT))
        self._stop()

    def _longest(self) -> float:
        """Return the longest duration of the task, s."""
        rules, path = self.task.rules, self.task.path.duration
        once = rules.rest + rules.patience + path + rules.longest_descent + REST_AFTER
        return 2.0 * once + (PAUSE + CARRY_TIME) if self.task.again else once

    def _simulator(self, duration: float) -> Simulator:
        """Return the simulated vehicle for `duration`, s."""
        path = self.task.path
        assert not isinstance(path, Waypoints)  # a rover has a simulator of its own
        return Simulator(self.task.world, self.task.seed, duration, path.radius)

    def _controller(self) -> Any:
        """Return the controller."""
        return Controller(self.simulator.nominal)

    def fly(self) -> None:
        """Run one mission until the vehicle has rested after it or has crashed."""
        self.begin()
        while not self.over:
            self.turn()

    def begin(self, path: TimedPath | None = None, rules: Rules | None = None) -> None:
        """Begin a mission at the present place. The defaults are path and rules of the task."""
        self.missions.append(self._mission(path, rules or self.task.rules))
        self._silence_begins = _silence_start(
            self.task.world.silence, self.task.path, self.task.rules, self._rng
        )

    def _mission(self, path: TimedPath | None, rules: Rules) -> Any:
        """Return a mission from the present place, along the path of the task without another."""
        place, ground = self.simulator.state[:2].copy(), self.simulator.state[2]
        planned: Any = path or self.task.path.starting_at(place, ground)
        return Mission(planned, ground, rules, self.simulator.now)

    @property
    def over(self) -> bool:
        """Return whether the active mission has ended."""
        mission = self.missions[-1]
        ended = mission.ended if mission.state == DONE else None
        rested = ended is not None and self.simulator.now > ended + REST_AFTER
        return bool(rested or mission.state == REFUSED or self.crash or self.simulator.over)

    def turn(self) -> None:
        """Execute one turn of the controller."""
        if self.missions:
            self._schedule_faults(self.missions[-1])
            self._control(self.missions[-1])
        else:
            self._stop()
        self._turn()

    def _control(self, mission: Any) -> None:
        """Set the outputs of the controller as a mission wants."""
        now, source = self.simulator.now, self.source
        support = self.controller.support(float(np.mean(self._samples(SUPPORT_TIME)[:, 5])))
        pose = None if source.pose is None else self._propagated(source.pose)
        own = self._own_pose(mission, pose)
        refused = self._contradicted or (mission.state == LOST and own and not source.yaw_known)
        deviation = math.inf if refused else source.deviation
        wanted = mission.decide(now, pose, deviation, support)
        if wanted is None:
            self._stop()
            return
        assert source.pose is not None and pose is not None  # a mission starts with a pose
        if mission.state == LOST:
            pose, self._last_lost = own or pose, now
        elif source.yaw_known and now > self._last_lost + SETTLED:
            self._past.append((source.pose, source.deviation))
            while self._past[0][0][0] < now - 2.0 * MEMORY:  # from before the vehicle was lost
                self._past.popleft()
        self.controller.fly(*pose[1:], wanted, mission.yaw, DT)

    def _stop(self) -> None:
        """Turn the rotors off, forget the flight, and determine the offsets of the IMU at rest."""
        self.controller.stop()
        self._past.clear()
        self._own_usable, self._contradicted, self._last_lost = True, False, -math.inf
        resting = np.median(self._samples(AT_REST), axis=0)
        self._offsets = resting - [0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY]

    def _samples(self, seconds: float) -> np.ndarray:
        """Return the inertial samples (n, 6) of the last seconds."""
        first = max(self.simulator.done - int(seconds * IMU_RATE), 0)
        return self.simulator.samples[first : self.simulator.done + 1]

    def _own_pose(self, mission: Mission, pose: Pose | None) -> Pose | None:
        """Return an estimate of before, propagated by the IMU, and compare the newest `pose` with it.

        After lift-off a contradiction means that the estimate is wrong. It must have been right until the
        middle of the time between: otherwise it was wrong before, and is right again. During lift-off a
        contradiction means that the IMU is not precise enough, for example because the rotors shake it.
        """
        if pose is None or not self._past or not self._own_usable:
            return None
        before, deviation = self._past[0]
        own, middle = (self._propagated(self._past[k][0]) for k in (0, len(self._past) // 2))
        age = self.simulator.now - before[0]
        late, early = (_difference(one, own, deviation, age) for one in (pose, middle))
        if mission.path_time < LIFT_OFF:
            self._own_usable = late < ROUGH
        else:
            self._contradicted |= late > 1.0 and early < 0.5
        return own

    def _schedule_faults(self, mission: Any) -> None:
        """Set the times of the gap and of the anchor change for a mission."""
        started = mission.begin + mission.rules.rest if mission.started is None else mission.started
        self.simulator.radio.schedule_faults(
            started + self._silence_begins, started + 0.5 * self.task.path.duration
        )

    def rest(self, seconds: float) -> None:
        """Wait with the rotors off."""
        end = self.simulator.now + seconds
        while self.simulator.now < end and not (self.simulator.over or self.crash):
            self._stop()
            self._turn()

    def _turn(self) -> None:
        measured = self.simulator.advance(self.controller)
        arrived = self.transport.arrived(measured, self.simulator.now)
        self._arrived.append(arrived)
        self.source.take(arrived)
        self.crash = self._crash()

    def _crash(self) -> str:
        """Return the reason of a crash, or ""."""
        simulator, size = self.simulator, self.task.world.size
        x, y, z = simulator.state[POSITION]
        qx, qy = simulator.state[ATTITUDE][:2]
        tilt = math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (qx**2 + qy**2))))
        if tilt > TIPPED and simulator.contact[simulator.done]:
            return "tipped over"
        if abs(x) > 0.5 * size[0] + OUTSIDE or abs(y) > 0.5 * size[1] + OUTSIDE:
            return "flew into a wall"
        return "flew into the ceiling" if z > size[2] + OUTSIDE else ""

    def _propagated(self, pose: Pose) -> Pose:
        """Return a Pose propagated to the present by the inertial samples. It keeps its stamp."""
        since, (p, v, q), of = pose[0], (part.copy() for part in pose[1:]), self.simulator
        first = max(int(np.searchsorted(of.times, since, side="right")), 1)
        rows = slice(first, of.done + 1)
        integrate(since, p, v, q, of.times[rows], of.samples[rows] - self._offsets)
        return since, p, v, q

    @property
    def result(self) -> TrialResult:
        """Return the outcome so far."""
        simulator, world = self.simulator, self.task.world
        end = simulator.done + 1
        states = simulator.states[:end]
        streams = {
            name: concatenated([one[name] for one in self._arrived])
            for name in ("tdoa", "imu", *world.sensors)
        }
        truth = Truth(simulator.times[:end], states[:, POSITION], states[:, ATTITUDE])
        meta = {"source": "fly", "format": "simulation", "protocol": world.protocol}
        flight = Flight(
            f"flown-{self.task.seed}",
            world.anchors,
            truth=truth,
            meta=meta,
            **streams,
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
    """Fly a Task and return the TrialResult."""
    trial = Trial(task)
    trial.fly()
    if task.again and not trial.crash and trial.missions[0].state == DONE:
        trial.rest(PAUSE)
        angle = random(task.seed, "carried").uniform(-np.pi, np.pi)
        trial.simulator.carry(CARRIED * np.array([np.cos(angle), np.sin(angle)]), CARRY_TIME)
        trial.rest(CARRY_TIME)
        trial.fly()
    return trial.result


def _filter_of(task: Task, yaw: float) -> EstimateSource:
    """Return the filter of a Task. It gets `yaw`, rad, if the task says that it is known."""
    config = task.config
    if task.yaw == "known":
        config = replace(config, initial_yaw=yaw, initial_yaw_std=GIVEN_STD)
    model = load_network(task.model)
    if model is not None:
        model.require(task.world.anchors)
    return OwnFilter(task.world.anchors, config, task.effects, model)


def _silence_start(
    silence: tuple[str, float] | None,
    path: Circles | Waypoints,
    rules: Rules,
    rng: np.random.Generator,
) -> float:
    """Return the begin of the gap, s after the start of the rotors, or inf without a gap."""
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
