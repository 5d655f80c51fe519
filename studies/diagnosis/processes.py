# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A second generator of effects that no catalogue holds: random processes, random trees of one or
two covariates, many periods and duty cycles in time.

It draws functions, not shapes, so the search cannot try the same functions. It shares only the
covariates with the search.
"""

from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import true_samples

from . import grammar

RECURRING = ("periods", "duty")
KINDS = ("process", "tree", *RECURRING)
STREAMS = ("tdoa", "tdoa", "tdoa", "tdoa", "gyro", "accel")
# m, rad/s, m/s^2: root mean square of an effect in the flight, drawn evenly in the logarithm
SIZES = {"tdoa": (0.1, 0.4), "gyro": (0.02, 0.15), "accel": (0.2, 1.0)}
SUBSETS = ("anchor", "anchor", "anchor", "pair", "all")
ON_TDOA = ("time", "x", "y", "height", "speed", "climb_rate", "acceleration", "turning_rate")
ON_ANCHOR = (*ON_TDOA, "range", "bearing", "elevation")
ON_IMU = ("time", "x", "y", "height", "speed", "climb_rate", "vibration", "turning_rate")
LENGTHS = (0.08, 0.6)  # shares of the range of a covariate, length scale of a process
FEATURES = 60  # a process is a sum of so many cosines
DEPTH = 3  # largest, of a tree
PERIODS = (2.0, 9.0)  # of a wave or a duty cycle in a flight
LOW, HIGH = 0.02, 0.98  # quantiles of the covariate between which a function unfolds


@dataclass(frozen=True, eq=False)
class Hidden:
    """An effect: function(u (n, k)), of k covariates scaled to 0 ... 1, times `size`.

    stream, subset, who : as in grammar.Undeclared
    covariates : names
    ranges : ((low, high), ...) of the covariates
    shape : one of KINDS
    """

    stream: str
    subset: str
    who: tuple
    covariates: tuple
    ranges: tuple
    shape: str
    size: float
    function: object

    @property
    def covariate(self):
        """The first covariate."""
        return self.covariates[0]

    @property
    def limits(self):
        """Its range."""
        return self.ranges[0]

    @property
    def name(self):
        """In a few words."""
        part = "xyz"[self.who[0]] if self.subset == "axis" else "-".join(map(str, self.who))
        over = " and ".join(self.covariates)
        return f"{self.stream} {self.subset} {part}: {self.size:.2g} {self.shape} over {over}"

    def course(self, *several):
        """What it adds at values (n,) of each covariate: (n,). What recurs does not end."""
        scaled = [(v - low) / (high - low) for v, (low, high) in zip(several, self.ranges)]
        u = np.stack(scaled, axis=1)
        return self.size * self.function(u if self.shape in RECURRING else np.clip(u, 0.0, 1.0))

    def inject(self, flight, rng=None):
        """The Flight with it."""
        if self.stream != "tdoa":
            imu = flight.imu
            values = [grammar.of_imu(flight, name) for name in self.covariates]
            change = np.zeros((len(imu), 3))
            change[:, self.who[0]] = np.nan_to_num(self.course(*values))
            changed = getattr(imu, self.stream) + change
            return replace(flight, imu=replace(imu, **{self.stream: changed}))
        samples, rows = true_samples(flight)
        d = flight.tdoa.d.copy()
        d[rows] += np.nan_to_num(self.bias(samples))
        return replace(flight, tdoa=replace(flight.tdoa, d=d))

    def bias(self, samples):
        """What it adds to the TDOAs of Samples, (n,) m."""
        ids, n = samples.anchors.ids, len(samples)
        values = [_values(samples, name) for name in self.covariates]
        late = self.course(*(np.broadcast_to(v, (2, n)).ravel() for v in values)).reshape(2, n)
        if self.subset == "all":
            return late[1]
        a, b = ids[samples.a], ids[samples.b]
        if self.subset == "anchor":
            return late[1] * (b == self.who[0]) - late[0] * (a == self.who[0])
        first, second = self.who
        forth, back = (a == first) & (b == second), (a == second) & (b == first)
        return late[1] * (1.0 * forth - back)


def _values(samples, name):
    """Values of a covariate of Samples, (n,), or (2, n) of both arrivals."""
    if name in grammar.ON_ARRIVAL:
        return grammar.of_arrival(samples, name).reshape(2, -1)
    return grammar.of_tdoa(samples, name)


def draw(seed, flight):
    """The Hidden of a seed, on anchors and at values of covariates that a Flight has."""
    rng = np.random.default_rng([seed, 20262])
    kind = KINDS[rng.integers(len(KINDS))]
    stream = STREAMS[rng.integers(len(STREAMS))] if flight.imu is not None else "tdoa"
    attitude = np.isfinite(flight.truth.q).all(axis=1).any()
    if stream == "tdoa":
        pairs = np.column_stack([flight.tdoa.a, flight.tdoa.b])
        heard, count = np.unique(pairs, axis=0, return_counts=True)
        heard = heard[count > 0.2 * len(flight.tdoa) / len(heard)]
        subset = SUBSETS[rng.integers(len(SUBSETS))]
        pair = tuple(heard[rng.integers(len(heard))].tolist())
        who = {"anchor": pair[:1], "all": ()}.get(subset, pair)
        choices = ON_ANCHOR if subset == "anchor" else ON_TDOA
    else:
        subset, who, choices = "axis", (int(rng.integers(3)),), ON_IMU
    choices = [name for name in choices if attitude or name != "turning_rate"]
    # nodes correct inertial samples over one covariate
    number = 1 + int(kind == "tree" and stream == "tdoa" and rng.uniform() < 0.5)
    covariates = tuple(rng.choice(choices, number, replace=False).tolist())
    if kind in RECURRING:
        covariates = ("time",)
    function = {"process": _process, "tree": _tree, "periods": _wave, "duty": _duty}[kind](
        rng, number
    )
    size = float(np.exp(rng.uniform(*np.log(SIZES[stream]))))
    ranges = tuple(
        tuple(np.nanquantile(_flown(flight, stream, name), [LOW, HIGH]).tolist())
        for name in covariates
    )
    return Hidden(stream, subset, who, covariates, ranges, kind, size, _even(function, number))


def _flown(flight, stream, name):
    """Values of a covariate in the air: (n,)."""
    up = flight.truth.t[flight.truth.p[:, 2] > 0.3]
    if stream != "tdoa":
        inside = (flight.imu.t >= up[0]) & (flight.imu.t <= up[-1])
        return grammar.of_imu(flight, name)[inside]
    samples, _ = true_samples(flight)
    inside = (samples.t >= up[0]) & (samples.t <= up[-1])
    return np.broadcast_to(_values(samples, name), (2, len(samples)))[:, inside].ravel()


def _even(function, number):
    """The function over [0, 1]^number, shifted and scaled to mean 0 and power 1."""
    grid = np.linspace(0.0, 1.0, 200 if number == 1 else 40)
    at = np.stack([one.ravel() for one in np.meshgrid(*[grid] * number)], axis=1)
    values = function(at)
    mean, std = values.mean(), max(values.std(), 1e-9)
    return lambda u: (function(u) - mean) / std


def _process(rng, number):
    """A Gaussian process of squared-exponential covariance, by random cosines."""
    length = np.exp(rng.uniform(*np.log(LENGTHS)))
    rates = rng.standard_normal((FEATURES, number)) / length
    phases = rng.uniform(0.0, 2.0 * np.pi, FEATURES)
    return lambda u: np.cos(u @ rates.T + phases).sum(axis=1)


def _tree(rng, number):
    """A random tree: constants on boxes. Its first split is always there."""

    def grow(level, box):
        if level == DEPTH or (level and rng.uniform() < 0.3):
            value = rng.standard_normal()
            return lambda u: np.full(len(u), value)
        k = level % number
        low, high = box[k]
        at = low + (high - low) * rng.uniform(0.3, 0.7)
        below, above = (grow(level + 1, {**box, k: side}) for side in ((low, at), (at, high)))
        return lambda u: np.where(u[:, k] < at, below(u), above(u))

    return grow(0, dict.fromkeys(range(number), (0.0, 1.0)))


def _wave(rng, number):
    periods, phase = rng.uniform(*PERIODS), rng.uniform(0.0, 2.0 * np.pi)
    return lambda u: np.sin(2.0 * np.pi * periods * u[:, 0] + phase)


def _duty(rng, number):
    periods, share, phase = rng.uniform(*PERIODS), rng.uniform(0.2, 0.8), rng.uniform()
    return lambda u: 1.0 * ((periods * u[:, 0] + phase) % 1.0 < share)
