# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw effects that are not in the catalogue from a grammar.

An effect has a stream, a subset, a covariate, a shape and a size.
Each seed gives a different effect. This module shares no code with the search, except the
definitions of the covariates.
"""

from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import true_samples
from uwb_tdoa_bias.effects.samples import OF_ARRIVAL, OF_IMU, OF_TDOA, ImuFeatures, Track

SHAPES = ("trend", "step", "ramp", "periodic", "transient", "bend")
# m, rad/s, m/s^2; drawn evenly in the logarithm
SIZES = {"tdoa": (0.15, 0.8), "gyro": (0.03, 0.3), "accel": (0.3, 2.0)}
STREAMS = ("tdoa", "tdoa", "tdoa", "tdoa", "gyro", "accel")
SUBSETS = ("anchor", "anchor", "pair", "direction", "arrivals", "all")  # of TDOAs
# of TDOAs and of inertial samples
OF_POSE = ("time", "x", "y", "height", "speed", "climb_rate", "acceleration")
OF_ATTITUDE = ("turning_rate", "tilt", "bearing_in_tag", "elevation_in_tag")
ANGLES = ("bearing", "bearing_in_tag")
NAMES = "previous_anchor"
ON_TDOA = (*OF_POSE, "turning_rate", "tilt", "interval", NAMES)
ON_ARRIVAL = ("range", "bearing", "elevation", "bearing_in_tag", "elevation_in_tag")
ON_IMU = (
    *OF_POSE,
    "vibration",
    "turning_rate",
    "rate_x",
    "rate_y",
    "rate_z",
    "accel_x",
    "accel_y",
    "accel_z",
)
LOW, HIGH = 0.05, 0.95  # quantiles of the covariate between which a shape unfolds


@dataclass(frozen=True)
class Undeclared:
    """An effect that is not in the catalogue.

    stream : "tdoa", "gyro", "accel"
    subset : "axis" or an entry of SUBSETS
    who : anchor ids or the number of the axis
    covariate : name
    shape : one of SHAPES
    size : in the unit of the stream
    limits : (low, high) of the covariate
    form : three numbers from 0 to 1, the free parameters of the shape
    """

    stream: str
    subset: str
    who: tuple
    covariate: str
    shape: str
    size: float
    limits: tuple
    form: tuple

    @property
    def covariates(self):
        """Covariates that count as right. A claim must name at least one."""
        return (self.covariate,)

    @property
    def name(self):
        """In a few words."""
        part = "xyz"[self.who[0]] if self.subset == "axis" else "-".join(map(str, self.who))
        return (
            f"{self.stream} {self.subset} {part}: {self.size:.2g} {self.shape} over "
            f"{self.covariate}"
        )

    def course(self, values):
        """What it adds at covariate values (n,): (n,)."""
        first, second, third = self.form
        if self.covariate == NAMES:
            return self.size * (values == self.limits[0])
        if self.covariate in ANGLES and self.shape == "periodic":
            return self.size * np.sin((1 + int(2 * first)) * values + 2.0 * np.pi * second)
        low, high = self.limits
        u = np.clip((values - low) / (high - low), -0.25, 1.25)
        if self.shape == "trend":
            out = u - 0.5
        elif self.shape == "step":
            out = 1.0 * (u > 0.3 + 0.4 * first)
        elif self.shape == "ramp":
            bend = 0.2 + 0.4 * first
            out = np.maximum(u - bend, 0.0) / (1.0 - bend)
        elif self.shape == "periodic":
            out = np.sin(2.0 * np.pi * ((1.0 + 1.5 * first) * u + second))
        elif self.shape == "transient":
            out = 1.0 * (np.abs(u - (0.3 + 0.4 * first)) < 0.5 * (0.15 + 0.2 * third))
        else:
            out = (2.0 * u - 1.0) ** 2
        return self.size * (out if second < 0.5 or self.shape == "periodic" else -out)

    def inject(self, flight, rng=None):
        """The Flight with it."""
        if self.stream != "tdoa":
            imu = flight.imu
            change = np.zeros((len(imu), 3))
            change[:, self.who[0]] = np.nan_to_num(self.course(of_imu(flight, self.covariate)))
            return replace(
                flight, imu=replace(imu, **{self.stream: getattr(imu, self.stream) + change})
            )
        samples, rows = true_samples(flight)
        d = flight.tdoa.d.copy()
        d[rows] += np.nan_to_num(self.bias(samples))
        return replace(flight, tdoa=replace(flight.tdoa, d=d))

    def bias(self, samples):
        """The bias of the TDOAs of Samples, (n,) m; NaN where the pose does not determine it."""
        ids = samples.anchors.ids
        a, b = ids[samples.a], ids[samples.b]
        if self.covariate in ON_ARRIVAL:
            both = of_arrival(samples, self.covariate).reshape(2, -1)
            late = self.course(both)
            of = (
                [1.0, 1.0]
                if self.subset == "arrivals"
                else [1.0 * (a == self.who[0]), 1.0 * (b == self.who[0])]
            )
            return late[1] * of[1] - late[0] * of[0]
        late = self.course(of_tdoa(samples, self.covariate))
        if self.subset == "anchor":
            return late * (1.0 * (b == self.who[0]) - (a == self.who[0]))
        if self.subset == "all":
            return late
        forth = 1.0 * ((a == self.who[0]) & (b == self.who[-1]))
        if self.subset == "pair":
            return late * (forth - ((a == self.who[1]) & (b == self.who[0])))
        return late * forth


def draw(seed, flight):
    """The Undeclared of a seed, on anchors and at values of the covariate that a Flight has; for
    its kind alone the same for every flight.
    """
    rng = np.random.default_rng([seed, 20261])
    attitude = np.isfinite(flight.truth.q).all(axis=1).any()
    stream = STREAMS[rng.integers(len(STREAMS))] if flight.imu is not None else "tdoa"
    heard, count = np.unique(
        np.column_stack([flight.tdoa.a, flight.tdoa.b]), axis=0, return_counts=True
    )
    heard = heard[count > 0.2 * len(flight.tdoa) / len(heard)]
    if stream == "tdoa":
        subset = SUBSETS[rng.integers(len(SUBSETS))]
        choices = {"arrivals": ON_ARRIVAL, "anchor": (*ON_ARRIVAL, *ON_TDOA)}.get(subset, ON_TDOA)
        pair = tuple(heard[rng.integers(len(heard))].tolist())
        who = {"anchor": pair[:1], "arrivals": (), "all": ()}.get(subset, pair)
    else:
        subset, choices, who = "axis", ON_IMU, (int(rng.integers(3)),)
    choices = [name for name in choices if attitude or name not in OF_ATTITUDE]
    covariate = choices[rng.integers(len(choices))]
    shape = SHAPES[rng.integers(len(SHAPES))]
    size = float(np.exp(rng.uniform(*np.log(SIZES[stream]))))
    form = tuple(rng.uniform(size=3).tolist())
    if covariate == NAMES:
        shape, limits = "step", (int(rng.choice(np.unique(heard[:, 1]))),) * 2
    else:
        values = _values(flight, stream, covariate)
        limits = tuple(np.quantile(values[np.isfinite(values)], [LOW, HIGH]).tolist())
    return Undeclared(stream, subset, who, covariate, shape, size, limits, form)


def _values(flight, stream, covariate):
    """Values of a covariate in the air: (n,)."""
    up = flight.truth.t[flight.truth.p[:, 2] > 0.3]
    if stream != "tdoa":
        values = of_imu(flight, covariate)
        return values[(flight.imu.t >= up[0]) & (flight.imu.t <= up[-1])]
    samples, _ = true_samples(flight)
    flown = (samples.t >= up[0]) & (samples.t <= up[-1])
    if covariate in ON_ARRIVAL:
        return of_arrival(samples, covariate).reshape(2, -1)[:, flown].ravel()
    return of_tdoa(samples, covariate)[flown]


def of_arrival(samples, name):
    return OF_ARRIVAL[name](samples, np.concatenate([samples.a, samples.b]))


def of_tdoa(samples, name):
    if name == "interval":
        return (
            np.diff(samples.t, prepend=samples.t[:1])
            if samples.interval is None
            else samples.interval
        )
    if name == NAMES and samples.previous is not None:
        return samples.previous
    if name == NAMES:
        return np.concatenate([[-1], samples.anchors.ids[samples.b[:-1]]])
    return OF_TDOA[name](samples)


def of_imu(flight, name):
    imu = flight.imu
    if name in OF_IMU:
        return ImuFeatures()(imu.t, imu.gyro, imu.accel)[:, OF_IMU.index(name)]
    track = Track(flight.truth)
    if name in ("x", "y", "height"):
        return track.positions(imu.t)[:, ("x", "y", "height").index(name)]
    motion = track.motion(imu.t)
    if name == "climb_rate":
        return motion.velocity[:, 2]
    return np.linalg.norm(motion.velocity if name == "speed" else motion.acceleration, axis=1)
