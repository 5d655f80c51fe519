"""The filter for live streams: messages in any order in, odometry that depends on their stamps
alone out.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.stamps import LARGEST_STEP_BACK
from uwb_tdoa_bias.effects import EffectSet

from .anchor_table import MOST_ROWS, AnchorTable
from .core import aids
from .core.config import FilterConfig
from .core.engine import LOST_TIME
from .core.height import LONGEST_GAP
from .core.measurements import aid_rows, imu_rows, usable_tdoas
from .core.memory import (
    AID,
    IMU_SAMPLE,
    INVALID,
    N_YAWS,
    ODOMETRY,
    POSE,
    TDOA,
    USED,
    joined,
    structured,
)
from .core.startup import APART
from .core.velocity import HELD, LONGEST_STD, YAW_RATE
from .monitoring.filter_findings import clock_ahead, implausible, restarted
from .monitoring.finding import Steady
from .pipeline import Pipeline, odometry_of
from .reorder_buffer import IMU_STREAM, STREAMS, TDOA_STREAM, ReorderBuffer
from .results import VERDICTS, Odometry, Residuals, concatenated

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.sensors import Stream

    from .monitoring.finding import Finding
    from .pipeline import PipelineOutput
    from .reorder_buffer import Restart

RATE_SAMPLES = 10  # inertial samples from whose stamps their rate is known
LARGEST_POSE_AHEAD = 10.0  # s of a pose that is set, from the newest measurement
RESTART_NAMED = 10.0  # s of stamps for which a restart is named
MOST_POSES = 100  # that were set and wait for their time
NOTHING = (
    Odometry.from_rows(np.empty(0, ODOMETRY)),
    Residuals.refused(np.empty(0), np.empty(0), np.empty(0), INVALID),
)


class Estimator:
    """Time-ordered buffer, filter and accounts.

    A ReorderBuffer, the Pipeline that `run_offline` has too, poses that are set from outside, and
    accounts of every message.
    """

    def __init__(
        self,
        anchors: Anchors,
        config: FilterConfig | None = None,
        reorder: float = 0.003,
        lag: float = 0.25,
        effects: EffectSet = EffectSet(),
    ) -> None:
        """anchors : Anchors; config : FilterConfig; reorder, lag : s, see ReorderBuffer; effects :
        EffectSet that is known, as of a Pipeline; streams that are added are free of the rest
        (ImuCorrector, AidCorrector, bias_node).
        """
        self._anchor_table, self._effects = AnchorTable(anchors), effects
        self.config = config or FilterConfig()
        of_aids = [
            f"{stream}_{verdict}" for stream in aids.STREAMS for verdict in VERDICTS.values()
        ]
        names = [*VERDICTS.values(), "imu_used", "imu_late", "imu_invalid", "restarts", *of_aids]
        self.counts = dict.fromkeys(names, 0)
        self._refused: list[Residuals] = []
        # the inertial samples that were used last, and RATE_SAMPLES before them
        self._sensed = np.empty(0, IMU_SAMPLE)
        self._wheels = np.empty(0, AID)  # yaw rates of wheels that were used last
        self._buffer = ReorderBuffer(
            reorder, lag, self.config.use_imu, self._refuse, self._start_anew
        )
        self._restart: Restart | None = None  # the last one
        self._steady = Steady()
        self._clear()

    def _clear(self) -> None:
        self._pipeline = Pipeline(self._anchor_table, self.config, self._effects)
        self._poses: list[np.ndarray] = []  # (1,) of POSE, set and not reached yet
        self._begun = False  # there was a measurement
        # sentence on a pose that was set before the first measurement, and is of another time
        self.refused_pose: str | None = None

    @property
    def anchors(self) -> Anchors:
        """Anchors that are there."""
        return self._anchor_table.anchors

    @property
    def _ekf(self) -> Record:
        return self._pipeline.state.record

    @property
    def running(self) -> bool:
        """True once a start position was found."""
        return bool(self._ekf["running"])

    @property
    def lost(self) -> str | None:
        """Why there is no odometry any more, a sentence, until the tag is found anew; None while it
        is not lost, and before it was found. Depends on stamps alone.
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
        """Why nobody knows on which side of its anchors the tag is, a sentence; None where that is
        known, or does not matter. Anchors that are heard lie in a plane, and the place is uncertain
        across it.
        """
        ekf = self._ekf
        if not ekf.running:
            return None
        known = self.config.fixed_height_std > 0.0 or ekf.t - ekf.height.used < LONGEST_GAP
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
        """Why the tag may be elsewhere, a sentence; None while nothing says so.

        Depends on stamps alone.
        """
        ekf = self._ekf
        if not ekf.running or ekf.t >= ekf.rival_until:
            return None
        return (
            "TDOAs agree on another place than the wheels have gone to: the position is "
            "unsure, and follows the wheels; look for anchors that "
            "are late or blocked"
        )

    @property
    def workspace(self) -> np.ndarray:
        """Size of the box in which the tag is expected, (3,) m."""
        low, high = self._ekf["workspace"]
        return np.asarray(high - low)

    @property
    def newest(self) -> float:
        """Stamp that the time of the streams has reached, s; -inf before the first TDOA, range or
        inertial sample.
        """
        return self._buffer.newest

    @property
    def next_odometry(self) -> float:
        """Stamp, s, up to which no odometry will come."""
        return float(self._ekf["next_odometry"])

    @property
    def recoveries(self) -> int:
        """How often the filter found that it had lost the tag, and found it again."""
        return int(self._ekf.recoveries)

    @property
    def alarms(self) -> list[str]:
        """Sentences on what has changed since the flight began."""
        return self._pipeline.alarms

    @property
    def sign_turns(self) -> int:
        """How often the signs of all TDOAs have turned since the filter began."""
        monitor = self._pipeline.monitor
        return 0 if monitor is None else monitor.turns

    @property
    def findings(self) -> list[Finding]:
        """What the filter, the clocks of its streams, and who watches its residuals, have found:
        Findings.
        """
        monitor = self._pipeline.monitor
        exchanged = None if monitor is None else monitor.exchanged
        return [*filter(None, [self.without_imu, exchanged, self.restarted]), *self.clocks]

    @property
    def yaw_doubts(self) -> int:
        """How often the yaw was found to be wrong, and opened again."""
        return int(self._ekf.yaw_test["count"])

    @property
    def without_imu(self) -> Finding | None:
        """Finding by which the filter goes without inertial samples, because they cannot be right;
        None while it uses them.
        """
        ekf = self._ekf
        return next(
            iter(self._steady([implausible(ekf.imu_fault_detector)] if ekf.imu_faulty else [])),
            None,
        )

    @property
    def restarted(self) -> Finding | None:
        """Finding on why the filter started anew, for RESTART_NAMED seconds of stamps after it did."""
        cause = self._restart
        return (
            restarted(cause)
            if cause is not None and self.newest < cause.at + RESTART_NAMED
            else None
        )

    @property
    def clocks(self) -> list[Finding]:
        """Findings on streams whose clocks are wrong at present."""
        of_streams = zip(STREAMS, self._buffer.leads)
        return [
            clock_ahead(name, lead, self.counts["invalid" if name == "tdoa" else f"{name}_invalid"])
            for name, lead in of_streams
            if lead
        ]

    @property
    def waiting(self) -> tuple[int, ...]:
        """Messages received and neither used nor refused yet, for each of STREAMS."""
        return self._buffer.waiting

    def add_imu(self, t: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Take inertial samples in the order of their arrival: t (n,) s; gyro (n, 3) rad/s; accel
        (n, 3) m/s^2, specific force; body frame. Or one: a number, (3,), (3,).
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
        """Take corrected TDOAs in the order of their arrival: t (n,) s; a, b (n,) anchor ids; d
        (n,) m; variance (n,) m^2, of what is known beyond tdoa_std; slope, state (n, 6), as of a
        Correction. Or one: numbers.
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
        """Take a Stream of one of the SENSORS, its rows in the order of their arrival."""
        if getattr(self.config, f"use_{name}"):
            self._add(STREAMS.index(name), *aid_rows(name, stream, self._anchor_table))

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
        """Take a pose that is known from outside: t s; p (3,) m, NaN where it is not known;
        covariance (3, 3) m^2; yaw and yaw_std rad, or NaN. It holds from its stamp on; if the
        filter has passed that, from the next measurement on.

        Raises InputError for a stamp that is not of the time of the streams, and when too many
        wait. One that is set before there is any measurement is judged by the first, and dropped if
        it is not of its time: `refused_pose`.
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
        self._poses.append(
            np.array([(max(t, self._buffer.used_until), p, covariance, yaw, yaw_std)], POSE)
        )
        self._poses.sort(key=lambda pose: pose["t"][0])

    def configure(self, config: FilterConfig) -> None:
        """Go on with another FilterConfig, which differs in nothing that is fixed (see
        FilterConfig).
        """
        self.config = config
        self._pipeline.configure(config)

    def stay(self, anchors: Anchors) -> bool:
        """Whether it can go on among other Anchors: some of its own are there still, in the same
        frame.
        """
        stay = self._anchor_table.stay(anchors)
        return (
            anchors.frame == self.anchors.frame
            and bool(stay.any())
            and len(self._anchor_table) + int(np.sum(~stay)) <= MOST_ROWS
        )

    def change_anchors(self, anchors: Anchors) -> None:
        """Go on among other Anchors: those that are new are used from now on, those that are gone
        no more, and one that stands elsewhere as a new one. Nothing is forgotten of those that
        stay. TDOAs that wait are used, as far as their anchors were there when they came.
        """
        self._pipeline.change_anchors(self._anchor_table.change(anchors))

    def reset(self) -> tuple[Odometry, Residuals]:
        """Use everything that still waits, and forget it: what comes next starts the filter anew.
        Returns (Odometry, Residuals).
        """
        out = self.finish()
        self._buffer.clear()
        self._anchor_table = AnchorTable(self.anchors)  # no row waits any more
        self.counts["restarts"] += 1
        self._clear()
        return out

    def advance(self) -> tuple[Odometry, Residuals]:
        """Use every message that nothing earlier can precede any more.

        Returns (Odometry, Residuals), possibly empty.
        """
        return self._use(self._buffer.watermark)

    def finish(self) -> tuple[Odometry, Residuals]:
        """Use everything that still waits. Returns (Odometry, Residuals)."""
        self._buffer.finish()
        return self._use(math.inf)

    def rates_at(self, odometry: Odometry) -> tuple[np.ndarray, np.ndarray]:
        """(angular velocity in the body frame, (n, 3) rad/s, its variances, (n, 3) rad^2/s^2) at
        the stamps of the Odometry returned last; NaN where nothing near measures it. Of the
        gyroscope less its bias; of wheels, where no inertial sample is used, the rate about z.
        White noise of density gyro_noise has, in samples that are dt apart, the variance
        gyro_noise^2 / dt; dt is the mean of the last RATE_SAMPLES.
        """
        t = np.ascontiguousarray(odometry.t)
        rates, variance = np.empty((len(t), 3)), np.empty(len(t))
        sensed = self._sensed if self.config.use_imu else self._sensed[:0]
        _look_up(t, sensed, self.config.imu_timeout, self.config.gyro_noise, rates, variance)
        rates -= odometry.gyro_bias
        variances = np.repeat(variance[:, None], 3, axis=1)
        if len(self._wheels):
            last = np.searchsorted(self._wheels["t"], t, side="right") - 1
            near = t - self._wheels["t"][last] <= HELD
            rows = np.isnan(rates[:, 2]) & (last >= 0) & near
            rates[rows, 2] = self._wheels["value"][last[rows], YAW_RATE]
            variances[rows, 2] = self._wheels["std"][last[rows], YAW_RATE] ** 2
        return rates, variances

    def _refuse(self, stream: int, rows: np.ndarray, verdict: int) -> None:
        """Account for rows that will not be used."""
        if stream == TDOA_STREAM:
            a, b = (self._anchor_table.ids[rows[side]] for side in "ab")
            self._refused.append(Residuals.refused(rows["t"], a, b, verdict))
        else:
            self.counts[f"{STREAMS[stream]}_{VERDICTS[verdict]}"] += len(rows)

    def _start_anew(self, cause: Restart) -> None:
        """Go on in the time to which the streams have fallen back."""
        self.counts["restarts"] += 1
        self._restart = cause
        self._clear()

    def _use(self, until: float) -> tuple[Odometry, Residuals]:
        """Use what is stamped up to `until`, s, and between it what poses were set."""
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
        """Count what was used in parts, and what was refused; returns what is said of it."""
        for part in parts:
            self.counts["imu_used"] += len(part.measured.imu)
            for kind, verdict in zip(
                part.measured.aids["kind"].tolist(), part.aids["verdict"].tolist()
            ):
                self.counts[f"{aids.STREAMS[kind]}_{VERDICTS[verdict]}"] += 1
        self._sensed = joined(
            IMU_SAMPLE, [self._sensed[-RATE_SAMPLES:], *(part.measured.imu for part in parts)]
        )
        self._wheels = joined(AID, [self._wheels[-1:], *(_of_wheels(part) for part in parts)])
        residuals = concatenated([self._pipeline.residuals(parts), *self._refused])
        self._refused = []
        for verdict in residuals.verdict.tolist():
            self.counts[VERDICTS[verdict]] += 1
        return odometry_of(parts), residuals

    def _check_early_poses(self) -> None:
        """Drop what was set before the first measurement and is of another time than that."""
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


def _of_wheels(part: PipelineOutput) -> np.ndarray:
    """Of what was fed, (n,) of AID: velocities with a yaw rate that were used."""
    rows = part.measured.aids
    used = (rows["kind"] == aids.VELOCITY) & (part.aids["verdict"] == USED)
    out: np.ndarray = rows[used & (rows["std"][:, YAW_RATE] <= LONGEST_STD)]
    return out


@compiled
def _look_up(
    t: np.ndarray,
    sensed: np.ndarray,
    timeout: float,
    noise: float,
    rates: np.ndarray,
    variances: np.ndarray,
) -> None:
    """Rates of the last of `sensed`, (m,) of IMU_SAMPLE, up to each of t (n,) s, and their
    variances; NaN where it is older than timeout, s.
    """
    k = len(sensed) - 1
    for i in range(len(t) - 1, -1, -1):
        while k >= 0 and sensed[k].t > t[i]:
            k -= 1
        rates[i], variances[i] = np.nan, np.nan
        if k < 0 or t[i] - sensed[k].t > timeout:
            continue
        rates[i] = sensed[k].gyro
        apart = intervals = 0.0
        for j in range(max(1, k - RATE_SAMPLES + 1), k + 1):
            if 0.0 < sensed[j].t - sensed[j - 1].t <= timeout:
                apart += sensed[j].t - sensed[j - 1].t
                intervals += 1.0
        if intervals > 0.0:
            variances[i] = noise**2 * intervals / apart
