# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""fly-faults: the vehicle of `fly` takes off, flies and lands by the estimate, with a fault in its
streams.

It obeys `status`: it sinks while `status` is not "running". It sinks while the odometry is older
than `autopilot_node` sends, too. The study runs in lockstep, without
ROS. A fault lasts from 12 to 15 s after switching on, in the first circle.
"""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.monitoring.finding import most_severe_first
from uwb_tdoa_ekf.monitoring.status import FAULT, RUNNING, Use, status_of
from uwb_tdoa_ekf.monitoring.stream_rules import StreamWatch
from uwb_tdoa_ekf.results import concatenated, rotation_std, rows_of
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.autopilot.estimate import OLDEST
from uwb_tdoa_tools.flying.simulator import Streams
from uwb_tdoa_tools.flying.trial import OwnFilter, Task, Trial
from uwb_tdoa_tools.flying.vehicle import world_of
from uwb_tdoa_tools.flying.verdict import verdict_of

from .. import table

BEGIN, END = 12.0, 15.0  # s
LOOK, REPORT = 0.2, 1.0  # s between two looks at the status, and two at the streams, as in ekf_node
LAG = 0.25  # s
SENSOR_NAMES = "height", "velocity"

# of the part of a stream that came in one turn: Imu, Tdoas or another
Change = Callable[[Any], Any]


@dataclass(frozen=True)
class FlownFault:
    """stream : name; change : of its measurements; once : only the first message; lasts : s."""

    stream: str
    change: Change
    once: bool = False
    lasts: float = END - BEGIN

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that it needs in addition to TDOAs and the IMU."""
        return (self.stream,) if self.stream in SENSOR_NAMES else ()


def _put(**columns: Callable[[Any], np.ndarray]) -> Change:
    """New columns of a part."""
    return lambda part: replace(part, **{name: make(part) for name, make in columns.items()})


def _late(part: Any, anchors: dict[int, float]) -> np.ndarray:
    delays = np.array(
        [anchors.get(int(b), 0.0) - anchors.get(int(a), 0.0) for a, b in zip(part.a, part.b)]
    )
    return part.d + delays.reshape(part.d.shape)


def _swapped(ids: np.ndarray) -> np.ndarray:
    return np.where(ids == 2, 5, np.where(ids == 5, 2, ids))


def _none(part: Any) -> Any:
    return rows_of(part, slice(0, 0))


def _twice(part: Any) -> Any:
    return concatenated([part, part])


def _outliers(part: Any) -> np.ndarray:
    hit = (np.arange(len(part.t)) + np.floor(1e3 * part.t)).astype(int) % 2 == 0
    return part.d + np.where(hit, 3.0 * np.sin(1e4 * part.t), 0.0)


def _ahead(seconds: float) -> Change:
    return _put(t=lambda part: part.t + seconds)


FAULTS = {
    "nothing": FlownFault("tdoa", lambda part: part),
    "tdoa: one stamp 5 s ahead": FlownFault("tdoa", _ahead(5.0), once=True),
    "tdoa: one stamp 5 s behind": FlownFault("tdoa", _ahead(-5.0), once=True),
    "tdoa: stamps 0.3 s behind": FlownFault("tdoa", _ahead(-0.3)),
    "tdoa: silent": FlownFault("tdoa", _none),
    "tdoa: silent, 1 s": FlownFault("tdoa", _none, lasts=1.0),
    "tdoa: NaN": FlownFault("tdoa", _put(d=lambda part: np.full(len(part.t), np.nan))),
    "tdoa: twice": FlownFault("tdoa", _twice),
    "tdoa: sign": FlownFault("tdoa", _put(d=lambda part: -part.d)),
    "tdoa: in cm": FlownFault("tdoa", _put(d=lambda part: 100.0 * part.d)),
    "tdoa: half are outliers": FlownFault("tdoa", _put(d=_outliers)),
    "tdoa: an anchor 1 m late": FlownFault("tdoa", _put(d=lambda part: _late(part, {2: 1.0}))),
    "tdoa: two anchors 1.5 m late, one of them low": FlownFault(
        "tdoa", _put(d=lambda part: _late(part, {2: 1.5, 3: 1.5}))
    ),
    "tdoa: two low anchors 1.5 m late": FlownFault(
        "tdoa", _put(d=lambda part: _late(part, {2: 1.5, 5: 1.5}))
    ),
    "tdoa: two ids exchanged": FlownFault(
        "tdoa",
        _put(a=lambda part: _swapped(part.a), b=lambda part: _swapped(part.b)),
        lasts=math.inf,
    ),
    "tdoa: ids unknown": FlownFault("tdoa", _put(a=lambda part: part.a + 100)),
    "imu: one stamp 5 s ahead": FlownFault("imu", _ahead(5.0), once=True),
    "imu: one stamp 5 s behind": FlownFault("imu", _ahead(-5.0), once=True),
    "imu: silent": FlownFault("imu", _none),
    "imu: NaN": FlownFault("imu", _put(gyro=lambda part: np.full(part.gyro.shape, np.nan))),
    "imu: in g": FlownFault("imu", _put(accel=lambda part: part.accel / 9.80665)),
    "imu: gyroscope 0.5 rad/s off": FlownFault(
        "imu", _put(gyro=lambda part: part.gyro + [0.0, 0.0, 0.5])
    ),
    "height: 60 s ahead": FlownFault("height", _ahead(60.0)),
    "height: 1 m too large": FlownFault("height", _put(range=lambda part: part.range + 1.0)),
    "velocity: 60 s ahead": FlownFault("velocity", _ahead(60.0)),
    "velocity: sign": FlownFault("velocity", _put(v=lambda part: -part.v)),
}


class FaultyFilter:
    """An EstimateSource: OwnFilter, whose streams have a fault, and that obeys what `status` would
    say.
    """

    def __init__(self, ours: OwnFilter, fault: FlownFault) -> None:
        """ours : OwnFilter; fault : FlownFault."""
        self._ours, self._of, self._begun, self._fault = ours, fault, False, False
        self._use, self._watch, self._findings = (
            Use(LAG),
            StreamWatch(ours.estimator.anchors, LAG),
            [],
        )
        self._received = dict.fromkeys(("imu", "tdoa", *SENSORS), 0)
        self._now = self._looked = self._reported = self._last = 0.0
        self._restarts, self.why, self.said = 0, "", ""

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """As of OwnFilter."""
        self._ours.set_pose(t, p, std, yaw)

    def take(self, measured: Streams) -> None:
        """Take what arrived, and look at it as ekf_node does."""
        if len(measured["imu"].t):
            self._now = float(measured["imu"].t[-1])
        streams = {name: self._changed(name, part) for name, part in measured.items()}
        for name, part in streams.items():
            self._received[name] += len(part.t)
        imu, tdoa = streams["imu"], streams["tdoa"]
        self._watch.add_imu(imu.t, np.full(len(imu.t), self._now), imu.gyro, imu.accel)
        self._watch.add_tdoa(tdoa.t, np.full(len(tdoa.t), self._now), tdoa.a, tdoa.b, tdoa.d)
        before = self._ours.newest
        self._ours.take(streams)
        if self._ours.newest is not before:
            self._last = self._now
        if self._now >= self._looked + LOOK:
            self._look()

    def _changed(self, name: str, part: Any) -> Any:
        fault = self._of
        if name != fault.stream or not len(part.t) or not BEGIN <= self._now < BEGIN + fault.lasts:
            return part
        if not fault.once:
            return fault.change(part)
        if self._begun:
            return part
        self._begun = True
        return concatenated(
            [fault.change(rows_of(part, slice(0, 1))), rows_of(part, slice(1, None))]
        )

    def _look(self) -> None:
        estimator, newest, self._looked = self._ours.estimator, self._ours.newest, self._now
        self._use.update(self._now, self._received, estimator.counts, estimator.running)
        if self._now >= self._reported + REPORT:
            self._reported = self._now
            if self._restarts != estimator.counts["restarts"]:
                self._restarts = estimator.counts["restarts"]
                self._watch.restart()
            found = self._watch.findings(estimator.sign_turns)
            self._findings = most_severe_first([*found, *estimator.findings])
        yaw_std = (
            math.nan
            if newest is None
            else rotation_std(newest.q[-1:], newest.covariance[-1:])[0, 2]
        )
        status = status_of(estimator, yaw_std, self._now - self._last, self._use, self._findings)
        if self._fault and status.status != FAULT:
            estimator.distrust()  # as ekf_node does at the end of a fault
        self._fault = status.status == FAULT
        self.why = "" if status.status == RUNNING else status.why
        self.said = self.said or (self.why if self._now > BEGIN else "")

    @property
    def pose(self) -> Any:
        """As of OwnFilter."""
        return self._ours.pose

    @property
    def yaw_known(self) -> bool:
        """As of OwnFilter."""
        return self._ours.yaw_known

    @property
    def deviation(self) -> float:
        """m, inf where `status` is not "running", and where the odometry is old by its stamp."""
        old = self.pose is not None and self._now - self.pose[0] > OLDEST
        return math.inf if self.why or old else self._ours.deviation

    @property
    def odometry(self) -> Any:
        """As of OwnFilter."""
        return self._ours.odometry


def flown(task: tuple[str, int]) -> dict[str, Any]:
    """The result of one flight: (name of a fault, seed)."""
    name, seed = task
    fault = FAULTS[name]
    trial = Trial(Task(world_of("hall", sensors=fault.sensors), seed))
    assert isinstance(trial.source, OwnFilter)
    trial.source = source = FaultyFilter(trial.source, fault)
    trial.fly()
    verdict = verdict_of(trial.result)
    return {key: verdict[key] for key in ("landed", "safe", "why", "reported_lost", "tracking")} | {
        "fault": name,
        "seed": seed,
        "said": source.said,
    }


def add_options(add: Callable) -> None:
    """add : add_argument of a parser."""
    table.add_options(add, draws=10, first=5001)
    table.add_only(add)


def run(args: Namespace) -> None:
    """Fly, and print the table."""
    columns = "fault", "what `status` said first", "flights", "landed", "safe"
    cli.show(table.head(*columns, texts=2))
    for name, rows in table.trials(flown, table.chosen(args, FAULTS), args):
        cli.show(line(name, rows))


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """The row of a fault: the first status message, the flights that landed at their place, and
    those that came down safely.
    """
    said = next((row["said"] for row in rows if row["said"]), "nothing")
    counts = (sum(row[key] for row in rows) for key in ("landed", "safe"))
    return table.line([name, said[:90], len(rows), *counts])
