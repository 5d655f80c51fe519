"""The filter for live streams: messages in any order in, odometry that depends on their stamps alone out."""

from dataclasses import dataclass, fields
import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.sensors import LOCATING, Stream
from uwb_tdoa_bias.foundation.stamps import LARGEST_STEP_AHEAD, LARGEST_STEP_BACK, StampGate

from .aid_rows import aid_rows
from .core import aids
from .core.config import FilterConfig
from .core.engine import LOST_TIME, feed, tell_pose
from .core.height import LONGEST_GAP
from .core.memory import AID, IMU_SAMPLE, ODOMETRY, POSE, RESIDUAL, TDOA, YAWS, Measurements, joined, new_memory, structured
from .core.startup import APART
from .core.validity import usable_all, usable_imu, usable_slopes
from .core.verdicts import COMPENSATED, INVALID, LATE, REJECTED, REPEATED, STARTUP, USED
from .monitoring.implausible import implausible
from .monitoring.monitor import Monitor
from .order import Order
from .waiting import Waiting

VERDICTS = {
    USED: "used", REJECTED: "rejected", LATE: "late", INVALID: "invalid", STARTUP: "startup", COMPENSATED: "compensated",
    REPEATED: "repeated",
}  # fmt: skip
STREAMS = "imu", "tdoa", *aids.STREAMS
KINDS = IMU_SAMPLE, TDOA, *[AID] * len(aids.STREAMS)
IMU_STREAM, TDOA_STREAM, FIRST_AID = range(3)  # places in STREAMS
LEADING = IMU_STREAM, TDOA_STREAM, *map(STREAMS.index, LOCATING)  # by whose stamps time goes on
RATE_SAMPLES = 10  # inertial samples from whose stamps their rate is known
MOST_POSES = 100  # that were told and wait for their time
MOST_WAITING = 2000  # messages of a stream: 2 s at 1 kHz; those of one stamp for ever, or a nanosecond apart, would never be passed
SILENT = 1.0  # s of stamps after which a sensor is not waited for any more, until it is back
OF_AIDS = 0.5  # share of `lag` for which they are waited for: bias_node's `hold` must outlast that by far


@dataclass(frozen=True)
class Residuals:
    """What became of each TDOA. t (n,) s; a, b (n,) anchor ids; innovation (n,) m and variance (n,) m^2, NaN unless
    used, rejected or compensated by the filter; weight (n,) 0 to 1; verdict (n,) a key of VERDICTS."""

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    innovation: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    verdict: np.ndarray


@dataclass(frozen=True)
class Odometry:
    """Estimates. t (n,) s; p (n, 3) m; v (n, 3) m/s, world; q (n, 4) x y z w, body to world; accel_bias (n, 3) m/s^2
    and gyro_bias (n, 3) rad/s, body; covariance (n, 9, 9) of [p, v, attitude], the attitude's in the body frame, rad;
    persistent (n, 3, 3) m^2, what of the position's covariance errors that do not average out make."""

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    accel_bias: np.ndarray
    gyro_bias: np.ndarray
    covariance: np.ndarray
    persistent: np.ndarray

    @classmethod
    def from_rows(cls, rows):
        """From (n,) of memory.ODOMETRY."""
        x = rows["x"]
        return cls(rows["t"], x[:, :3], x[:, 3:6], x[:, 6:10], x[:, 10:13], x[:, 13:], rows["covariance"], rows["persistent"])

    def __len__(self):
        return len(self.t)


class Estimator:
    """Time-ordered buffer, filter and accounts.

    Messages wait until every stream has passed them and are used in stamp order. A stream that is silent is waited for
    for `lag` seconds of stamps, one of the SENSORS for half of that, and only if it was there a second ago;
    `reorder` more for late siblings, unless they have come in order so far (Order). What is older than what was used is late.
    A stream that falls back in time starts the filter anew; a single stamp far from its neighbours only counts as late, or as
    invalid if it lies ahead.
    """

    def __init__(self, anchors, config=None, reorder=0.003, lag=0.25, functions=(), floor=None):
        """anchors : Anchors; config : FilterConfig; reorder, lag : s; functions : SensorFunctions that are known; floor : what is known
        of the anchors at a tag on the floor, see `EffectSet.on_floor`."""
        self.anchors, self._known = anchors, (functions, floor)
        self.config = config or FilterConfig()
        self.reorder, self.lag = reorder, lag
        self._tuning = self.config.tuning()
        of_aids = [f"{stream}_{verdict}" for stream in aids.STREAMS for verdict in VERDICTS.values()]
        names = [*VERDICTS.values(), "imu_used", "imu_late", "imu_invalid", "restarts", *of_aids]
        self.counts = dict.fromkeys(names, 0)
        self._refused = []
        self._sensed = NONE[IMU_STREAM]  # the inertial samples of the last feed, and RATE_SAMPLES before them
        self._clear()

    def _clear(self):
        self._memory, self._monitor = new_memory(self.anchors.positions, *self._known), Monitor(self.anchors)
        self._waiting = [Waiting(kind) for kind in KINDS]
        self._gates, self._orders = [StampGate() for _ in STREAMS], [Order() for _ in STREAMS]
        self._fed_until = -math.inf  # s, stamp of the last measurement that the filter has been fed with
        self._poses, self._begun = [], False  # (1,) of POSE, told and not reached yet; whether there was a measurement
        self.refused_pose = None  # sentence on a pose that was told before the first measurement, and is of another time

    @property
    def running(self):
        """True once a start position was found."""
        return bool(self._memory.record.running)

    @property
    def lost(self):
        """Why there is no odometry any more, a sentence, until the tag is found anew; None while it is not lost, and before it was
        found. Depends on stamps alone."""
        ekf = self._memory.record
        if ekf.running or ekf.t == -math.inf:
            return None
        return (
            f"the tag is lost: for more than {LOST_TIME:g} s no TDOA came, and nothing else tells where it is by now; there is no odometry "
            "until TDOAs tell that anew"
        )

    @property
    def side_unknown(self):
        """Why nobody knows on which side of its anchors the tag is, a sentence; None where that is known, or does not matter. Anchors that
        are heard lie in a plane, and the place is uncertain across it."""
        ekf = self._memory.record
        if not ekf.running:
            return None
        known = self.config.fixed_height_std > 0.0 or ekf.t - ekf.height.used < LONGEST_GAP
        places = {h // YAWS for h in np.flatnonzero(ekf.hypotheses["log_weight"] > -np.inf).tolist()}
        flat, variances = self._memory.ekf["flat"][0], np.diagonal(ekf.hypotheses["P"][ekf.best])
        for axis, (sides, where) in enumerate((("-x or +x", "x"), ("-y or +y", "y"), ("below or above", "height"))):
            if flat[axis] and (len(places) > 1 or variances[axis] > APART**2) and not (axis == 2 and known):
                return (
                    f"the anchors that are heard have one {where}, so that TDOAs do not tell on which side of them the tag is: set tag_side to {sides}"
                )
        return None

    @property
    def newest(self):
        """Stamp of the newest measurement, s; -inf before the first."""
        return max(gate.newest for gate in self._gates)

    @property
    def next_odometry(self):
        """Stamp, s, up to which no odometry will come."""
        return float(self._memory.ekf["next_odometry"][0])

    @property
    def recoveries(self):
        """How often the filter found that it had lost the tag, and found it again."""
        return int(self._memory.record.recoveries)

    @property
    def alarms(self):
        """Sentences on what has changed since the flight began."""
        return self._monitor.alarms

    @property
    def without_imu(self):
        """Finding by which the filter goes without inertial samples, because they cannot be right; None while it uses them."""
        ekf = self._memory.record
        return implausible(ekf.plausibility) if ekf.distrusted else None

    @property
    def waiting(self):
        """Messages received and neither used nor refused yet, for each of STREAMS."""
        return tuple(len(stream) + len(gate) for stream, gate in zip(self._waiting, self._gates))

    def add_imu(self, t, gyro, accel):
        """Take inertial samples in the order of their arrival: t (n,) s; gyro (n, 3) rad/s; accel (n, 3) m/s^2, specific
        force; body frame. Or one: a number, (3,), (3,)."""
        rows = structured(IMU_SAMPLE, np.atleast_1d(t), np.atleast_2d(gyro), np.atleast_2d(accel))
        self._add(IMU_STREAM, rows, usable_imu(rows["t"], rows["gyro"], rows["accel"]))

    def add_tdoa(self, t, a, b, d, variance=0.0, slope=0.0, state=0.0):
        """Take corrected TDOAs in the order of their arrival: t (n,) s; a, b (n,) anchor ids; d (n,) m; variance (n,) m^2, of
        what is known beyond tdoa_std; slope, state (n, 6), as of a Correction. Or one: numbers."""
        t, a, b, d = map(np.atleast_1d, (t, a, b, d))
        rows = structured(TDOA, t, self.anchors.index(a), self.anchors.index(b), d, variance, slope, state)
        usable = usable_all(rows["a"], rows["b"], rows["d"], rows["variance"], self.anchors.positions) & np.isfinite(t)
        usable &= usable_slopes(rows["slope"], rows["state"])
        refused = zip(*(column[~usable].tolist() for column in (t, a, b))) if not usable.all() else ()
        self._refused += [(*one, INVALID) for one in refused]
        self._add(TDOA_STREAM, rows, usable)

    def add(self, name: str, stream: Stream) -> None:
        """Take a Stream of one of the SENSORS, its rows in the order of their arrival."""
        if getattr(self.config, f"use_{name}"):
            self._add(STREAMS.index(name), *aid_rows(name, stream, self.anchors))

    def tell_pose(self, t, p, covariance, yaw=math.nan, yaw_std=math.nan):
        """Take a pose that somebody tells: t s; p (3,) m, NaN where it is not known; covariance (3, 3) m^2; yaw and yaw_std rad,
        or NaN. It holds from its stamp on; if the filter has passed that, from the next measurement on.

        Raises InputError for a stamp that is not of the time of the streams, and when too many wait. One that is told before there is any measurement is
        judged by the first, and dropped if it is not of its time: `refused_pose`.
        """
        self.refused_pose = None
        newest = self.newest
        if newest > -math.inf and not newest - LARGEST_STEP_BACK <= t <= newest + LARGEST_STEP_AHEAD:
            raise InputError(
                f"pose: its stamp is {t - newest:+.3f} s from that of the newest measurement; give one from "
                f"-{LARGEST_STEP_BACK:g} to {LARGEST_STEP_AHEAD:g} s."
            )
        if len(self._poses) >= MOST_POSES:
            raise InputError(f"pose: {MOST_POSES} wait for their time already; give fewer.")
        self._poses.append(np.array([(max(t, self._fed_until), p, covariance, yaw, yaw_std)], POSE))
        self._poses.sort(key=lambda pose: pose["t"][0])

    def retune(self, config):
        """Go on with another FilterConfig, which differs in nothing that is fixed (see FilterConfig)."""
        self.config, self._tuning = config, config.tuning()
        if not config.compensate_changes:
            self._memory.anchors["delay"] = self._memory.anchors["delay_variance"] = 0.0

    def reset(self):
        """Use everything that still waits, and forget it: what comes next starts the filter anew. Returns
        (Odometry, Residuals)."""
        out = self.finish()
        self.counts["restarts"] += 1
        self._clear()
        return out

    def advance(self):
        """Use every message that nothing earlier can precede any more, and of more than MOST_WAITING the first. Returns (Odometry, Residuals), possibly empty."""
        stamps = [gate.newest for gate in self._gates]
        newest = max(stamps[stream] for stream in LEADING)
        passed = []  # by each stream that is waited for
        for stream, (t, order) in enumerate(zip(stamps, self._orders)):
            if stream < FIRST_AID:
                if stream == TDOA_STREAM or self.config.use_imu:
                    passed.append(order.passed(t, self.reorder))
            elif newest - SILENT < t < newest:
                passed.append(max(order.passed(t, self.reorder), newest - OF_AIDS * self.lag))
        too_many = (waiting.rows["t"][-MOST_WAITING] for waiting in self._waiting if len(waiting) > MOST_WAITING)
        return self._feed(max(min(passed), newest - self.lag, *too_many))

    def finish(self):
        """Use everything that still waits. Returns (Odometry, Residuals)."""
        for stream, gate in enumerate(self._gates):
            self._refuse_outliers(stream, gate.finish())
        return self._feed(math.inf)

    def rates_at(self, t):
        """(angular velocity as measured, (n, 3) rad/s, its variance per axis, (n,) rad^2/s^2) at stamps t (n,) of the Odometry
        returned last; NaN where no sample is near. White noise of density gyro_noise has, in samples that are dt apart, the
        variance gyro_noise^2 / dt; dt is the mean of the last RATE_SAMPLES."""
        rates, variances = np.empty((len(t), 3)), np.empty(len(t))
        _look_up(np.ascontiguousarray(t), self._sensed, self.config.imu_timeout, self.config.gyro_noise, rates, variances)
        return rates, variances

    def _add(self, stream, rows, usable):
        """Take rows of a stream, of which some may not be usable: those count as invalid (TDOAs are refused already)."""
        gate = self._gates[stream]
        if len(rows) and not gate and usable.all():
            newest = self._waiting[stream].append(rows, gate.newest, self._fed_until)
            if newest == newest:
                gate.newest = newest
                self._orders[stream].begin(rows["t"][0])
                return
        for k, (t, good) in enumerate(zip(rows["t"].tolist(), usable.tolist())):
            if good:
                self._take(stream, t, rows[k : k + 1])
                continue
            if stream != TDOA_STREAM:
                self.counts[f"{STREAMS[stream]}_invalid"] += 1
            self._gates[stream].note(t)  # or whoever waits for our pose of this time waits for the next one

    def _take(self, stream, t, row):
        """Keep a row of a stream, and one that was held because of its stamp, if their stamps are accepted."""
        newest = self._gates[stream].newest
        accepted, outliers, jumped_back = self._gates[stream].take(t, row)
        if jumped_back:
            self._start_anew(stream)
            newest = -math.inf
        self._refuse_outliers(stream, outliers)
        for t, row in accepted:
            if self._orders[stream].is_late(t, newest):
                self._refuse(stream, row, LATE)
            else:
                self._keep(stream, row)
            newest = max(newest, t)

    def _keep(self, stream, rows):
        """Have rows wait in the order of their stamps, but those that come after what was used."""
        late = rows["t"] < self._fed_until
        if late.any():
            self._refuse(stream, rows[late], LATE)
            rows = rows[~late]
        if len(rows):
            self._waiting[stream].merge(rows)

    def _refuse_outliers(self, stream, outliers):
        """Account for items whose stamps are far from those of their neighbours."""
        for t, row in outliers:
            self._refuse(stream, row, INVALID if t > self._gates[stream].newest else LATE)

    def _refuse(self, stream, rows, verdict):
        if stream != TDOA_STREAM:
            self.counts[f"{STREAMS[stream]}_{VERDICTS[verdict]}"] += len(rows)
        else:
            ids = (self.anchors.ids[rows[side]].tolist() for side in "ab")
            self._refused += [(*one, verdict) for one in zip(rows["t"].tolist(), *ids)]

    def _start_anew(self, stream):
        """Forget everything but the time that the stream has fallen back to."""
        for k, waiting in enumerate(self._waiting):
            self._refuse(k, waiting.rows, LATE)
        self.counts["restarts"] += 1
        held = [(k, *outlier) for k, gate in enumerate(self._gates) if k != stream for outlier in gate.finish()]
        gate = self._gates[stream]
        self._clear()
        self._gates[stream] = gate
        for other, t, row in held:  # was not plausible in the time that is over
            self._take(other, t, row)

    def _feed(self, until):
        """Use what is stamped up to `until`, s, and between it what poses were told."""
        self._judge_early_poses()
        parts, self._sensed = [], self._sensed[-RATE_SAMPLES:]
        while self._poses and self._poses[0]["t"][0] <= until and self._has_begun():
            pose = self._poses.pop(0)
            pose["t"] = max(pose["t"][0], self._fed_until)
            parts += self._feed_and_judge(pose["t"][0])
            tell_pose(self._memory, self._tuning, pose)
            self._fed_until = pose["t"][0]
        parts += self._feed_and_judge(until)
        return parts[0] if len(parts) == 1 else tuple(_joined(column) for column in zip(*parts))

    def _feed_and_judge(self, until):
        """Use measurements; if delays are taken out, from the stamps on at which the monitor finds them."""
        parts, monitor = [], self._monitor
        while self.config.compensate_changes and monitor.end <= until and any(self._waiting):
            end = monitor.end
            parts.append(self._feed_measurements(np.nextafter(end, -math.inf)))
            monitor.judge(end)
            self._memory.anchors["delay"], self._memory.anchors["delay_variance"] = monitor.delays
        parts.append(self._feed_measurements(until))
        monitor.judge(self._fed_until)
        return parts

    def _judge_early_poses(self):
        """Drop what was told before the first measurement and is of another time than that."""
        if self._begun or not self._has_begun():
            return
        self._begun = True
        first = min(waiting.rows["t"][0] for waiting in self._waiting if len(waiting))
        early, self._poses = self._poses, []
        for pose in early:
            ahead = float(pose["t"][0]) - first
            if -LOST_TIME <= ahead <= LARGEST_STEP_AHEAD:
                self._poses.append(pose)
            else:
                self.refused_pose = (
                    f"the pose that was told is not used: its stamp is {ahead:+.3f} s from that of the first measurement; give one from "
                    f"-{LOST_TIME:g} to {LARGEST_STEP_AHEAD:g} s, on the clock of the measurements"
                )

    def _has_begun(self):
        return any(map(len, self._waiting)) or self._fed_until > -math.inf

    def _feed_measurements(self, until):
        imu, tdoa, *felt = (waiting.take(until) if len(waiting) else NONE[k] for k, waiting in enumerate(self._waiting))
        felt = np.concatenate(felt) if any(map(len, felt)) else NO_AIDS
        if not (len(imu) or len(tdoa) or len(felt) or self._refused):
            return NOTHING
        felt = felt[np.lexsort((felt["kind"], felt["t"]))] if len(felt) > 1 else felt
        odometry, outcome, of_aids = feed(
            self._memory, self._tuning, Measurements(imu if self.config.use_imu else imu[:0], tdoa, felt)
        )
        for kind, verdict in zip(felt["kind"].tolist(), of_aids["verdict"].tolist()):
            self.counts[f"{aids.STREAMS[kind]}_{VERDICTS[verdict]}"] += 1
        for part in (imu, tdoa, felt):
            if len(part):
                self._fed_until = max(self._fed_until, part["t"][-1])
        if len(imu):
            self._sensed = joined(IMU_SAMPLE, [self._sensed, imu])
        self.counts["imu_used"] += len(imu)
        out = Odometry.from_rows(odometry), self._residuals(tdoa, outcome)
        self._monitor.add(*out)
        return out

    def _residuals(self, tdoa, outcome):
        """Residuals of (k,) of TDOA that were fed, with their (k,) of RESIDUAL, and of those that were refused."""
        a, b = self.anchors.ids[tdoa["a"]], self.anchors.ids[tdoa["b"]]
        columns = [tdoa["t"], a, b, *(outcome[name] for name in RESIDUAL.names)]
        if self._refused:
            t, a, b, verdict = zip(*self._refused)
            unknown, none = np.full((2, len(t)), math.nan), np.zeros(len(t))
            others = (t, a, b, *unknown, none, np.array(verdict, np.uint8))
            columns = [np.concatenate(both) for both in zip(columns, others)]
            self._refused = []
        for verdict in columns[-1].tolist():
            self.counts[VERDICTS[verdict]] += 1
        return Residuals(*columns)


@compiled
def _look_up(t, sensed, timeout, noise, rates, variances):
    """Rates of the last of `sensed`, (m,) of IMU_SAMPLE, up to each of t (n,) s, and their variances; NaN where it is older than
    timeout, s."""
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


NONE = [np.empty(0, kind) for kind in KINDS]
NO_AIDS = NONE[FIRST_AID]
NOTHING = Odometry.from_rows(np.empty(0, ODOMETRY)), Residuals(*(np.empty(0) for _ in range(7)))


def invalid(t, a, b):
    """Residuals of TDOAs that no Estimator took: t (n,) s; a, b (n,) ids."""
    unknown, none = np.full((2, len(t)), math.nan), np.zeros(len(t))
    return Residuals(t, a, b, *unknown, none, np.full(len(t), INVALID, np.uint8))


def _joined(parts):
    """One Odometry, or Residuals, of several."""
    parts = [part for part in parts if len(part.t)] or parts[:1]
    kind = type(parts[0])
    return kind(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(kind)))
