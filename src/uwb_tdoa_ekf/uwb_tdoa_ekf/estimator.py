# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the filter on live streams; the odometry depends on stamps, not on the order of arrival."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import Record
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import Stream
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK
from uwb_tdoa_bias.effects import EffectSet

from .anchor_table import MOST_ROWS, AnchorTable
from .core import height, sensors
from .core.config import FilterConfig
from .core.engine import INCONSISTENT, RECOVERY_NAMED
from .core.initialization import LOST_TIME
from .core.memory import (
    INVALID,
    N_YAWS,
    ODOMETRY,
    POSE,
    TDOA,
    imu_rows,
    sensor_rows,
    structured,
    usable_tdoas,
)
from .core.startup import APART
from .monitoring.finding import Finding, Steady, clock_ahead, implausible, restarted
from .offline import Pipeline, PipelineOutput, odometry_of
from .reorder_buffer import IMU_STREAM, STREAMS, TDOA_STREAM, ReorderBuffer, Restart
from .results import VERDICTS, Odometry, Residuals, concatenated

# s, largest lead of a pose that the user sets over the newest measurement
LARGEST_POSE_AHEAD = 10.0
RESTART_NAMED = 10.0  # s of stamps for which /diagnostics reports a restart
LEAST_POSE_STD = 1e-3  # m, and rad; the covariance of the filter must stay positive definite
MOST_POSES = 100  # poses that may wait for their stamp
NOTHING = (
    Odometry.from_rows(np.empty(0, ODOMETRY)),
    Residuals.refused(np.empty(0), np.empty(0), np.empty(0), INVALID),
)


class Estimator:
    """Put measurements in order, run the filter on them, and count the result of each message.

    The Estimator combines a ReorderBuffer, the Pipeline that `run_offline` also uses, and poses
    that the user sets.
    """

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig | None = None,
        reorder: float = 0.003,
        lag: float = 0.25,
        effects: EffectSet = EffectSet(),
    ) -> None:
        """Create an estimator without measurements.

        Streams that are added must already be corrected for all other effects (ImuCorrector,
        StreamCorrector, bias_node).

        Parameters
        ----------
        anchors : Anchors
            Anchors in the world frame.
        config : FilterConfig or None
            Parameters of the filter; defaults if None.
        reorder, lag : float
            In s; see ReorderBuffer.
        effects : EffectSet
            Known effects that the Pipeline corrects.
        """
        self._anchor_table, self._effects = AnchorTable(anchors), effects
        self.config = config or FilterConfig()
        of_sensors = [
            f"{stream}_{verdict}" for stream in sensors.STREAMS for verdict in VERDICTS.values()
        ]
        names = [*VERDICTS.values(), "imu_used", "imu_late", "imu_invalid", "restarts", *of_sensors]
        self.counts = dict.fromkeys(names, 0)
        self._refused: list[Residuals] = []
        self._buffer = ReorderBuffer(
            reorder, lag, self.config.use_imu, self._refuse, self._start_anew
        )
        self._restart: Restart | None = None  # the last restart
        self._steady = Steady()
        self._clear()

    def _clear(self) -> None:
        self._pipeline = Pipeline(self._anchor_table, self.config, self._effects)
        # each (1,) of POSE: poses that are set but whose stamp is not reached
        self._poses: list[np.ndarray] = []
        self._begun = False  # True after the first measurement
        # Message about a pose that was set before the first measurement and has another time.
        self.refused_pose: str | None = None

    @property
    def anchors(self) -> Anchors:
        """Return the present anchors."""
        return self._anchor_table.anchors

    @property
    def _ekf(self) -> Record:
        return self._pipeline.state.record

    @property
    def running(self) -> bool:
        """Return whether the initialization has found a position."""
        return bool(self._ekf["running"])

    @property
    def lost(self) -> str | None:
        """Return a sentence on why the filter has lost the tag, or None.

        It is None before the first initialization and while the filter runs. The result depends on
        stamps only.
        """
        ekf = self._ekf
        if ekf["running"] or ekf["t"] == -math.inf:
            return None
        return (
            f"the tag is lost: for more than {LOST_TIME:g} s no TDOA came, and nothing else "
            "tells where it is by now; there is no odometry "
            "until TDOAs tell that anew"
        )

    @property
    def side_unknown(self) -> str | None:
        """Return a sentence on an unresolved mirror ambiguity of the anchors, or None.

        The ambiguity exists if all anchors that are heard lie in a plane and the position across it
        is uncertain. It is ignored where the height is known.
        """
        ekf = self._ekf
        if not ekf.running:
            return None
        known = self.config.known_height_std > 0.0 or ekf.t - ekf.height.used < height.MEMORY
        places = {
            h // N_YAWS for h in np.flatnonzero(ekf.hypotheses["log_weight"] > -np.inf).tolist()
        }
        flat, variances = ekf["flat"], np.diagonal(ekf.hypotheses["P"][ekf.best])
        for axis, (sides, where) in enumerate(
            (("-x or +x", "x"), ("-y or +y", "y"), ("below or above", "height"))
        ):
            if (
                flat[axis]
                and (len(places) > 1 or variances[axis] > APART**2)
                and not (axis == 2 and known)
            ):
                return (
                    f"the anchors that are heard have one {where}, so that TDOAs do not tell on "
                    f"which side of them the tag is: set tag_side to {sides}"
                )
        return None

    @property
    def unsure(self) -> str | None:
        """Return a sentence on why the tag may be at another position, or None.

        The result depends on stamps only.
        """
        ekf = self._ekf
        if not ekf.running:
            return None
        if self.rival:
            return (
                "TDOAs agree on another place than the wheels have gone to: the position is "
                "unsure, and follows the wheels; look for anchors that "
                "are late or blocked"
            )
        if ekf.consistency < INCONSISTENT:
            return (
                "TDOAs contradict the filter: the position may be wrong by metres; look for what "
                "has changed in TDOAs or IMU"
            )
        if ekf.t - ekf.recovered < RECOVERY_NAMED:
            return (
                "the filter was wrong, and has moved to where TDOAs agree: do not rely on it yet; "
                "look for what has changed in TDOAs or IMU"
            )
        if ekf.t < ekf.height.ignored_until:
            held = self.config.fixed_height_std > 0.0 and not self.config.planar
            names = ("fixed_height", "fixed_height_std"), ("the range finder", "height_std")
            of, std = names[0] if held else names[1]
            return f"TDOAs contradict {of}, and it is not used: check it, {std}"
        if ekf.velocity.contradicted:
            return "TDOAs contradict the wheels, and they are not used: check if they slip or stick"
        return None

    @property
    def rival(self) -> bool:
        """Return whether TDOAs agree on another place than the one to which wheels have led."""
        return bool(self._ekf.t < self._ekf.rival_until)

    @property
    def workspace(self) -> np.ndarray:
        """Return the size of the box in which the tag is expected, (3,) m, world frame."""
        low, high = self._ekf["workspace"]
        return np.asarray(high - low)

    @property
    def newest(self) -> float:
        """Return the stamp that the streams have reached, in s; -inf before the first measurement.

        Only TDOAs, ranges and inertial samples count.
        """
        return self._buffer.newest

    @property
    def next_odometry(self) -> float:
        """Return the stamp, in s, up to which no odometry will come."""
        return float(self._ekf["next_odometry"])

    @property
    def recoveries(self) -> int:
        """Return how often the filter detected divergence and initialized again."""
        return int(self._ekf.recoveries)

    @property
    def alarms(self) -> list[str]:
        """Return sentences on changes since the start of the flight."""
        return self._pipeline.alarms

    @property
    def sign_turns(self) -> int:
        """Return how often the signs of all TDOAs have flipped since the filter started."""
        monitor = self._pipeline.monitor
        return 0 if monitor is None else monitor.turns

    @property
    def findings(self) -> list[Finding]:
        """Return the Findings of the filter, of the clocks of its streams, and of the Monitor."""
        monitor = self._pipeline.monitor
        exchanged = None if monitor is None else monitor.exchanged
        return [*filter(None, [self.without_imu, exchanged, self.restarted]), *self.clocks]

    @property
    def yaw_doubts(self) -> int:
        """Return how often the filter found its yaw wrong and restarted the yaw hypotheses."""
        return int(self._ekf.yaw_test["count"])

    @property
    def without_imu(self) -> Finding | None:
        """Return the Finding that makes the filter ignore the IMU, or None while it is used."""
        ekf = self._ekf
        return next(
            iter(self._steady([implausible(ekf.imu_fault_detector)] if ekf.imu_faulty else [])),
            None,
        )

    @property
    def restarted(self) -> Finding | None:
        """Return the Finding on the last restart, for RESTART_NAMED s of stamps; else None."""
        cause = self._restart
        return (
            restarted(cause)
            if cause is not None and self.newest < cause.at + RESTART_NAMED
            else None
        )

    @property
    def clocks(self) -> list[Finding]:
        """Return Findings on streams whose clocks are wrong now."""
        of_streams = zip(STREAMS, self._buffer.leads)
        return [
            clock_ahead(name, lead, self.counts["invalid" if name == "tdoa" else f"{name}_invalid"])
            for name, lead in of_streams
            if lead
        ]

    @property
    def waiting(self) -> tuple[int, ...]:
        """Return the number of messages neither used nor refused yet, for each of STREAMS."""
        return self._buffer.waiting

    def add_imu(self, t: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Add inertial samples in the order of their arrival.

        A single sample may be given without its first dimension.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        gyro : (n, 3) array
            Angular velocity in the body frame, in rad/s.
        accel : (n, 3) array
            Specific force in the body frame, in m/s^2.
        """
        self._add(
            IMU_STREAM, *imu_rows(np.atleast_1d(t), np.atleast_2d(gyro), np.atleast_2d(accel))
        )

    def add_tdoa(
        self,
        t: ArrayLike,
        a: ArrayLike,
        b: ArrayLike,
        d: ArrayLike,
        variance: ArrayLike = 0.0,
        slope: ArrayLike = 0.0,
        state: ArrayLike = 0.0,
    ) -> None:
        """Add corrected TDOAs in the order of their arrival.

        A single TDOA may be given as numbers.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) int array
            Anchor ids.
        d : (n,) array
            Distance difference, in m.
        variance : (n,) array
            Variance in addition to tdoa_std^2, in m^2.
        slope, state : (n, 6) array
            Jacobian of the bias and its linearization point, as in Correction.
        """
        t, a, b, d = map(np.atleast_1d, (t, a, b, d))
        rows = structured(
            TDOA,
            t,
            self._anchor_table.index(a),
            self._anchor_table.index(b),
            d,
            variance,
            slope,
            state,
        )
        usable = usable_tdoas(rows, self._anchor_table.positions)
        if not usable.all():
            self._refused.append(Residuals.refused(t[~usable], a[~usable], b[~usable], INVALID))
        self._buffer.add(TDOA_STREAM, rows, usable)

    def add(self, name: str, stream: Stream) -> None:
        """Add a Stream of a sensor in SENSORS, its rows in the order of their arrival."""
        if getattr(self.config, f"use_{name}"):
            self._add(STREAMS.index(name), *sensor_rows(name, stream, self._anchor_table))

    def _add(self, stream: int, rows: np.ndarray, usable: np.ndarray) -> None:
        self.counts[f"{STREAMS[stream]}_invalid"] += len(usable) - int(usable.sum())
        self._buffer.add(stream, rows, usable)

    def set_pose(
        self,
        t: float,
        p: ArrayLike,
        covariance: ArrayLike,
        yaw: float = math.nan,
        yaw_std: float = math.nan,
    ) -> None:
        """Set a pose that the user knows.

        The pose takes effect at its stamp. If the filter is already past that stamp, the pose takes
        effect at the next measurement. A pose that is set before any measurement is compared with
        the first stamp. It is dropped if the two differ too much (`refused_pose`).

        Parameters
        ----------
        t : float
            Stamp, in s.
        p : (3,) array
            Position in the world frame, in m; NaN for an unknown coordinate.
        covariance : (3, 3) array
            Covariance of the position, in m^2; smaller deviations than LEAST_POSE_STD count as that.
        yaw, yaw_std : float
            Yaw and its standard deviation, in rad, at least LEAST_POSE_STD; NaN if unknown.

        Raises
        ------
        InputError
            If the stamp is too far from the streams, or too many poses wait.
        """
        self.refused_pose = None
        newest = self.newest
        if (
            newest > -math.inf
            and not newest - LARGEST_STEP_BACK <= t <= newest + LARGEST_POSE_AHEAD
        ):
            raise InputError(
                f"pose: its stamp is {t - newest:+.3f} s from that of the newest measurement; "
                "give one from "
                f"-{LARGEST_STEP_BACK:g} to {LARGEST_POSE_AHEAD:g} s."
            )
        if len(self._poses) >= MOST_POSES:
            raise InputError(f"pose: {MOST_POSES} wait for their time already; give fewer.")
        known = np.isfinite(p)
        given = np.where(np.outer(known, known), covariance, np.eye(3))
        missing = max(0.0, LEAST_POSE_STD**2 - float(np.linalg.eigvalsh(given)[0]))
        covariance, yaw_std = given + missing * np.eye(3), max(yaw_std, LEAST_POSE_STD)
        self._poses.append(
            np.array([(max(t, self._buffer.used_until), p, covariance, yaw, yaw_std)], POSE)
        )
        self._poses.sort(key=lambda pose: pose["t"][0])

    def distrust(self) -> None:
        """Open position, velocity, attitude and biases, because a fault has spoiled them."""
        self._ekf.distrusted = True

    def expect_imu(self, expected: bool) -> None:
        """Set whether the filter waits for inertial samples before the first one has come."""
        self._buffer.imu_expected = expected

    def configure(self, config: FilterConfig) -> None:
        """Replace the FilterConfig; parameters that are fixed must be equal (see FilterConfig)."""
        self.config = config
        self._pipeline.configure(config)

    def stay(self, anchors: Anchors) -> bool:
        """Return whether the filter can keep its state with other Anchors.

        This needs at least one common anchor, the same frame, and enough rows in the AnchorTable.
        """
        stay = self._anchor_table.stay(anchors)
        return (
            anchors.frame == self.anchors.frame
            and bool(stay.any())
            and len(self._anchor_table) + int(np.sum(~stay)) <= MOST_ROWS
        )

    def change_anchors(self, anchors: Anchors) -> None:
        """Replace the anchors and keep the state of the filter.

        New anchors are used from now on, and anchors that are gone are not. A moved anchor counts
        as a new one. Everything that is stored about the other anchors is kept. TDOAs that wait are
        used if both anchors were present when they arrived.
        """
        self._pipeline.change_anchors(self._anchor_table.change(anchors))

    def recalibrated(self) -> None:
        """Begin the search for changes again, because another calibration corrects the TDOAs now.

        The calibration contains the changes that were found before.
        """
        if self._pipeline.monitor is not None:
            self._pipeline.monitor.restart()

    def reset(self) -> tuple[Odometry, Residuals]:
        """Process all measurements that wait, then clear the filter; return (Odometry, Residuals).

        The next measurement starts a new initialization.
        """
        out = self.finish()
        self._buffer.clear()
        self._anchor_table = AnchorTable(self.anchors)  # no TDOA waits that refers to an old row
        self.counts["restarts"] += 1
        self._clear()
        return out

    def advance(self) -> tuple[Odometry, Residuals]:
        """Process every measurement that no earlier one can precede; return (Odometry, Residuals).

        Both may be empty.
        """
        return self._use(self._buffer.watermark)

    def finish(self) -> tuple[Odometry, Residuals]:
        """Process all measurements that wait; return (Odometry, Residuals)."""
        self._buffer.finish()
        return self._use(math.inf)

    def _refuse(self, stream: int, rows: np.ndarray, verdict: int) -> None:
        """Count rows that the filter will not use."""
        if stream == TDOA_STREAM:
            a, b = (self._anchor_table.ids[rows[side]] for side in "ab")
            self._refused.append(Residuals.refused(rows["t"], a, b, verdict))
        else:
            self.counts[f"{STREAMS[stream]}_{VERDICTS[verdict]}"] += len(rows)

    def _start_anew(self, cause: Restart) -> None:
        """Restart the filter at the time to which the streams have jumped back."""
        self.counts["restarts"] += 1
        self._restart = cause
        self._clear()

    def _use(self, until: float) -> tuple[Odometry, Residuals]:
        """Process measurements and poses that the user set, up to the stamp `until`, in s."""
        self._check_early_poses()
        parts: list[PipelineOutput] = []
        while self._poses and self._poses[0]["t"][0] <= until and self._has_begun():
            pose = self._poses.pop(0)
            pose["t"] = max(pose["t"][0], self._buffer.used_until)
            parts += self._pipeline.run(self._buffer, pose["t"][0])
            self._pipeline.set_pose(pose)
            self._buffer.used_until = pose["t"][0]
        parts += self._pipeline.run(self._buffer, until)
        return self._account(parts) if parts or self._refused else NOTHING

    def _account(self, parts: list[PipelineOutput]) -> tuple[Odometry, Residuals]:
        """Count the measurements that were used or refused and return (Odometry, Residuals)."""
        for part in parts:
            self.counts["imu_used"] += len(part.measured.imu)
            for kind, verdict in zip(
                part.measured.sensors["kind"].tolist(), part.sensors["verdict"].tolist()
            ):
                self.counts[f"{sensors.STREAMS[kind]}_{VERDICTS[verdict]}"] += 1
        residuals = concatenated([self._pipeline.residuals(parts), *self._refused])
        self._refused = []
        for verdict in residuals.verdict.tolist():
            self.counts[VERDICTS[verdict]] += 1
        return odometry_of(parts), residuals

    def _check_early_poses(self) -> None:
        """Drop poses that were set before the first measurement and are too far from its stamp."""
        if self._begun or not self._has_begun():
            return
        self._begun = True
        first = self._buffer.began
        early, self._poses = self._poses, []
        for pose in early:
            ahead = float(pose["t"][0]) - first
            if -LOST_TIME <= ahead <= LARGEST_POSE_AHEAD:
                self._poses.append(pose)
            else:
                self.refused_pose = (
                    f"the pose that was told is not used: its stamp is {ahead:+.3f} s from "
                    "that of the first measurement; give one from "
                    f"-{LOST_TIME:g} to {LARGEST_POSE_AHEAD:g} s, on the clock of the measurements"
                )

    def _has_begun(self) -> bool:
        return self._buffer.began < math.inf
