# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""SmoothTerm, an effect without a name: a function of one covariate that residuals show.

First the term, then its shapes, then its words.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..common.anchors import Anchors
from ..common.arrays import floats, interpolate, numbers_of, piecewise
from ..common.errors import InputError
from ..common.sensors import BY_POSE, COMPARED
from .base import (
    Effect,
    Row,
    SensorFunction,
    cached_by_anchors,
    id_texts,
    listed,
    measured,
    rounded,
)
from .pair import of_pair
from .samples import (
    CATEGORIES,
    EXTRA,
    FADE,
    OF_ACCEL,
    OF_ARRIVAL,
    OF_IMU,
    OF_MOTION,
    OF_SENSORS,
    OF_STATE,
    OF_TDOA,
    ONLY_TDOA,
    RADIO,
    STATES,
    ImuSamples,
    Samples,
    SensorSamples,
    covariate_of,
    fade_weight,
    has_domain,
    sensor_covariate,
    shown_in,
    tile,
)

DEGREE = 2  # of splines
GONE = 4 * FADE  # widths of a domain beyond which nothing of a function is left
IMU_CHANNELS = tuple(f"{sensor}.{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
SENSOR_CHANNELS = tuple(name + axis for name in BY_POSE for axis in COMPARED[name].axes)
FORMS = ("common", "arrival", "anchor", "pair", "direction")
OF_LINKS = ("pair", "direction")  # forms with one function per pair of anchors
OF_ARRIVALS = ("arrival", "anchor")  # forms with a function of each arrival
# Prior standard deviations of functions with few coefficients: m, rad/s and m/s^2
RADIO_PRIOR_STD, PRIOR_STD = 0.3, {"gyro": 0.1, "accel": 0.5}
LEAST_WIDTH = 1.0  # of the covariate, below which a slope per unit would extrapolate
# widest intervals that determine a place, m and rad
NARROW = {"range": 1.0, "bearing": 0.5, "elevation": 0.5}
MOST_PARTS = 3  # anchors or pairs whose functions are described
# {shape: (knots, coefficients)}. Knots are the ends, and points between them where a part begins or
# ends. The knots of a wave are one period apart. Those of a pulse are its start, its end, and the
# start of the next one. Between its ends, switching has any number of knots (None).
SHAPES = {
    "line": (2, 2),
    "beyond": (3, 2),
    "below": (3, 2),
    "step": (3, 2),
    "interval": (4, 2),
    "switching": (None, 2),
    "pulse": (3, 2),
    "wave": (2, 3),
    "parabola": (2, 3),
}
# {shape: where it acts}, of the name of a covariate and its knots in words; of a time
WHERE = {
    "step": "where {name} is above {1}",
    "interval": "where {name} is between {1} and {2}",
}
WHEN = {"step": "after {1}", "interval": "from {1} to {2}"}
# {covariates of two intervals: the place of the tag}
PLACES = {
    frozenset(("range", "bearing")): "{x:+.1f} m in x and {y:+.1f} m in y from the anchor, at most",
    frozenset(("range", "elevation")): "{z:+.1f} m in z and {level:.1f} m level from the anchor",
    frozenset(("bearing", "elevation")): (
        "in the direction ({x:+.2f}, {y:+.2f}, {z:+.2f}) from the anchor"
    ),
}
# Shapes of a factor: those with one function besides the level.
FACTORS = ("line", "beyond", "below", "step", "interval")


@dataclass
class SmoothTerm(Effect):
    """A function of one covariate, held constant beyond its knots, with coefficients c0, c1, ...

    channel : of RADIO, "gyro.x" ... "accel.z", or of SENSOR_CHANNELS
    covariate : name that the channel has, see `known_covariates`, or "extra.STREAM.COLUMN" on RADIO
        and inertial channels. Without its column in a recording the term is zero.
    form : of RADIO. "common": f(covariate) on every d_ab. "arrival": f_b - f_a, with the covariate
        of each arrival. "anchor": the same with one function per anchor, coefficients "3.c0".
        "pair", TDOAs only: f on d_ab and -f on d_ba, coefficients "0-1.c0". "direction": f on d_ab
        only.
    knots : where pieces meet, rising, ends included; of a covariate of names the names
    shape : "spline", quadratic, or a name of SHAPES
    factor : a second covariate, or "". A shape of FACTORS over it, with its own knots, multiplies
        the function without its level c0.
    """

    channel: str = "tdoa"
    covariate: str = "time"
    form: str = "common"
    knots: tuple[float, ...] = field(default_factory=tuple)
    shape: str = "spline"
    factor: str = ""
    factor_shape: str = ""
    factor_knots: tuple[float, ...] = field(default_factory=tuple)

    row = Row(
        name="smooth_term",
        unit="m, rad/s or m/s^2",
        bound=100.0,
        negligible=0.0,
        prior_std=0.1,
        example="c0",
        physics="unknown: what is left when the declared effects are taken out",
        reference="found in residuals by diagnose",
    )
    penalty: ClassVar[float] = 6.0  # a declared effect wins if it explains as much
    settings: ClassVar[tuple] = (
        "channel",
        "covariate",
        "form",
        "knots",
        "shape",
        "factor",
        "factor_shape",
        "factor_knots",
    )
    fitted: ClassVar[bool] = False
    key_form: ClassVar[tuple[str, str]] = r"(.+\.)?c[0-9]+", "a coefficient such as c0 or 3.c0"

    def __post_init__(self) -> None:
        covariates = known_covariates()
        _check("channel", self.channel, covariates)
        radio = RADIO.get(self.channel)
        forms = [form for form in FORMS if form not in OF_LINKS or (radio and radio.ends > 1)]
        _check("form", self.form, forms)
        known = [
            name
            for name in covariates[self.channel]
            if self.form in OF_ARRIVALS or name not in OF_ARRIVAL
        ]
        extra = self.covariate.startswith(EXTRA) and self.channel not in SENSOR_CHANNELS
        if not extra:
            _check("covariate", self.covariate, known)
        if self.shape != "spline":
            _check("shape", self.shape, ["spline", *SHAPES])
        self.knots = _rising("knots", self.knots, self.shape)
        if self.factor:
            has_factor = radio is not None and self.shape != "spline"
            others = [name for name in known if has_domain(name) and name != self.covariate]
            _check("factor", self.factor, others if has_factor else [])
            _check("factor_shape", self.factor_shape, FACTORS)
            self.factor_knots = _rising("factor_knots", self.factor_knots, self.factor_shape)
        super().__post_init__()

    @classmethod
    def within_bounds(cls, values: dict[str, float]) -> bool:
        return True

    # The following depend on the settings of a term; other effects have them as a class.
    def prior_std_of(self, key: str) -> float:  # type: ignore[override]  # of a term
        if self.shape == "spline" and self.form not in OF_LINKS:
            # One function per anchor: many, hence small.
            return 0.5 * self.row.prior_std if "." in key else self.row.prior_std
        if self.channel in RADIO:
            return RADIO_PRIOR_STD
        return PRIOR_STD.get(self.channel.partition(".")[0], self.row.prior_std)

    @property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]  # of a term
        """Return the channel without its axis."""
        return (self.channel.partition(".")[0],)

    def label_of(self, keys: Iterable[str]) -> str:
        parts = list(dict.fromkeys(key.rpartition(".")[0] for key in keys))
        of = f" of {self.form} {parts[0]}" if len(parts) == 1 and parts[0] else ""
        return f"{self.channel}{of} over {' and '.join(self.arguments)}"

    @property
    def arguments(self) -> tuple[str, ...]:
        """Return its covariate, and that of its factor."""
        return (self.covariate, self.factor) if self.factor else (self.covariate,)

    @property
    def covariates(self) -> tuple[str, ...]:  # type: ignore[override]  # of a term
        """Return its arguments, and the height where it is a function of the place."""
        own = tuple(filter(has_domain, self.arguments))
        of_place = self.channel in RADIO and set(own) & set(OF_PLACE)
        return (*own, "height") if of_place and "height" not in own else own

    @property
    def uses_attitude(self) -> bool:  # type: ignore[override]  # of a term
        return any(name.endswith("_in_tag") or name in ("tilt", "yaw") for name in self.arguments)

    @property
    def uses_orientations(self) -> bool:  # type: ignore[override]  # of a term
        return any(name.endswith("_in_anchor") for name in self.arguments)

    @property
    def periodic(self) -> bool:  # type: ignore[override]  # of a term
        return self.covariate == "time" and self.shape in ("wave", "pulse")

    @property
    def jacobian_states(self) -> tuple[int, ...]:
        if self.channel != "tdoa":
            return ()
        return tuple(sorted({state for name in self.arguments for state in STATES.get(name, ())}))

    @property
    def needs_motion(self) -> bool:  # type: ignore[override]  # of a term
        return self.channel == "tdoa" and any(name in OF_MOTION for name in self.arguments)

    @property
    def usable(self) -> bool:  # type: ignore[override]  # of a term
        """Return whether nodes can compute the covariate."""
        if self.channel in RADIO:
            computed = {*OF_TDOA, *OF_ARRIVAL} - {"vibration"}
            return computed.issuperset(self.arguments)
        return self.channel in IMU_CHANNELS and self.covariate in (*OF_IMU, *OF_STATE)

    def keys(self, anchors: Anchors | None = None) -> tuple[str, ...]:
        """Return all coefficients; for the form "anchor" of every anchor."""
        return self.keys_of(id_texts(anchors) if self.form == "anchor" else ("",))

    def keys_of(self, parts: Iterable[str]) -> tuple[str, ...]:
        """Return all coefficients of some anchors, "3", or pairs, "0-1"."""
        return tuple(f"{part}.c{k}".lstrip(".") for part in parts for k in range(self.count))

    def basis(self, values: ArrayLike, factor: np.ndarray | None = None) -> np.ndarray:
        """Return the basis functions of c0, c1, ... at values (n,) of the covariate, (n, k).

        They are NaN for NaN.

        factor : (n,) values of the factor; without it, the factor is 1
        """
        at: np.ndarray = floats(values)
        if self._is_spline:
            return self._splines(np.minimum(np.maximum(at, self.knots[0]), self.knots[-1]))
        if self.covariate in CATEGORIES and self.shape == "spline":
            return 1.0 * (at[:, None] == np.array(self.knots))
        basis = shape_basis(self.shape, self.knots, at)
        if factor is None:
            return basis
        by = shape_basis(self.factor_shape, self.factor_knots, factor)[:, 1]
        return np.stack([basis[:, 0], *(basis[:, k] * by for k in range(1, self.count))], axis=1)

    @cached_property
    def _splines(self) -> Any:
        """Return the quadratic B-splines between the knots, a scipy BSpline."""
        ends = [[end] * DEGREE for end in (self.knots[0], self.knots[-1])]
        clamped = np.concatenate([ends[0], self.knots, ends[1]])
        return interpolate.BSpline(clamped, np.eye(self.count), DEGREE)

    def curve(
        self, values: np.ndarray, prefix: str = "", factor: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the function at covariate values (n,), (n,).

        prefix : "3." for anchor 3 of the form "anchor", "0-1." for a pair
        factor : (n,) values of the factor, 1 if None
        """
        return self._functions(values, np.array(self._coefficients(prefix)), factor)

    def spread(self, values: np.ndarray, prefix: str = "") -> np.ndarray:
        """Return the standard deviation of `curve` without its level, (n,).

        The coefficients count as independent.
        """
        std = np.array([self.std.get(f"{prefix}c{k}", 0.0) for k in range(self.count)])
        std[0] *= self.shape == "spline"  # c0 of another shape is the level
        return np.sqrt(self.basis(values) ** 2 @ std**2)

    @property
    def _is_spline(self) -> bool:
        return self.shape == "spline" and self.covariate not in CATEGORIES

    @property
    def count(self) -> int:
        """Return the number of coefficients of each function."""
        if self.shape != "spline":
            return SHAPES[self.shape][1]
        return len(self.knots) if self.covariate in CATEGORIES else len(self.knots) + DEGREE - 1

    def _functions(
        self, values: np.ndarray, weights: np.ndarray, factor: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the values (n,) of functions with coefficients (n, k), or (k,) for all."""
        if not self._is_spline:
            return np.einsum("...k,...k->...", self.basis(values, factor), weights)

        def curves(at: np.ndarray) -> np.ndarray:
            basis = self.basis(at).reshape(-1, len(values), self.count)
            return np.einsum("...k,...k->...", basis, weights).ravel()

        return piecewise(curves, floats(values), np.array(self.knots), DEGREE)

    def _weights(self, samples: Samples) -> np.ndarray:
        """Return the coefficients of each measurement or arrival, (n, k), or (k,) for all."""
        if self.form == "anchor":
            return self._of_anchors(samples.anchors)[samples.rows]
        if self.form not in OF_LINKS:
            return np.array(self._coefficients(""))
        weights = np.zeros((len(samples), self.count))
        for link in self.parts:
            weights += np.outer(self._share(samples, link), self._coefficients(f"{link}."))
        return weights

    @cached_by_anchors
    def _of_anchors(self, anchors: Anchors) -> np.ndarray:
        """Return the coefficients of the function of every anchor, (N, k), 0 if it has none."""
        return np.array([self._coefficients(f"{i}.") for i in id_texts(anchors)])

    def _share(self, samples: Samples, part: str) -> np.ndarray | float:
        """Return by what the function of an anchor "3", or of a pair "0-1", is multiplied.

        It is 1, -1 or 0 in each arrival of an anchor, or each measurement of a pair. Without a part
        it is 1.
        """
        if not part:
            return 1.0
        if self.form == "anchor":
            return 1.0 * (samples.anchors.ids[samples.rows] == int(part))
        forth, back = of_pair(samples, part)
        return 1.0 * forth - back if self.form == "pair" else 1.0 * forth

    @property
    def parts(self) -> list[str]:
        """Return the anchors "3" or pairs "0-1" with a function of their own; "" for all."""
        return list(dict.fromkeys(key.rpartition(".")[0] for key in self.values))

    def _coefficients(self, prefix: str) -> list[float]:
        return [self.values.get(f"{prefix}c{k}", 0.0) for k in range(self.count)]

    def _values_of(self, covariate: str, samples: Samples) -> np.ndarray | None:
        """Return values per arrival, or per measurement if both arrivals have one function."""
        if covariate in (*OF_TDOA, *OF_ARRIVAL):
            values = covariate_of(samples, covariate)
        else:
            values = (samples.extra or {}).get(covariate.removeprefix(EXTRA))
        if values is None or covariate in OF_ARRIVAL or self.form in ("common", *OF_LINKS):
            return values
        return tile(samples, values)

    def _arguments(self, samples: Samples) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return values of the covariate, and of the factor or None, as of `_values_of`.

        The first is None if samples lack a covariate.
        """
        values = self._values_of(self.covariate, samples)
        factor = self._values_of(self.factor, samples) if self.factor else None
        return None if self.factor and factor is None else values, factor

    def bias(self, samples: Samples) -> np.ndarray:
        values, factor = self._arguments(samples)
        if self.channel != samples.channel or values is None:
            return np.zeros(len(samples))
        if self.form != "anchor" or not isinstance(values, np.ndarray):
            each = self._functions(values, self._weights(samples), factor)
            return self._of_measurements(samples, each)
        table, rows = self._of_anchors(samples.anchors), samples.rows
        # arrivals of anchors with a function
        mine = np.flatnonzero(np.count_nonzero(table, axis=1)[rows])
        each = 0.0 * values  # NaN where unknown
        some = None if factor is None else factor[mine]
        each[mine] = self._functions(values[mine], table[rows[mine]], some)
        return samples.difference(each)

    def _of_measurements(self, samples: Samples, each: np.ndarray) -> np.ndarray:
        """Return values of measurements, of values of their arrivals if a function is of these."""
        return samples.difference(each) if self.form in OF_ARRIVALS else each

    def sensor_bias(self, channel: str, features: np.ndarray) -> np.ndarray | None:
        if channel not in self.channels or self.covariate not in OF_IMU:
            return None
        out, values = np.zeros((len(features), 3)), features[:, OF_IMU.index(self.covariate)]
        out[:, self._axis] = self._faded_curve(values)
        return out

    def _faded_curve(self, values: np.ndarray) -> np.ndarray:
        """Return `curve`, faded beyond its domain."""
        limits, curve = self.domain.get(self.covariate), self.curve(values)
        return curve if limits is None else curve * fade_weight(values, limits)

    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        if self.channel not in IMU_CHANNELS or self.covariate not in OF_STATE:
            return ()
        low, high = self.domain.get(self.covariate, (self.knots[0], self.knots[-1]))
        beyond = GONE * (high - low) if self.domain else 0.0
        endless = self.shape == "wave" and not self.domain
        ends = low - beyond, high + beyond
        return (SensorFunction.of(self._faded_curve, self.channel, self.covariate, ends, endless),)

    @property
    def _axis(self) -> int:
        """Return the column of its axis in a reading."""
        return "xyz".index(self.channel.partition(".")[2] or "x")

    def uncorrected(self, samples: ImuSamples | SensorSamples) -> np.ndarray | float:
        if self.channel in IMU_CHANNELS and self.covariate in OF_IMU:
            return 0.0
        keys = self.keys()
        return self.regressors(samples, keys) @ np.array(
            [self.values.get(key, 0.0) for key in keys]
        )

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        if samples.channel not in RADIO:
            out = np.zeros((*samples.reading.shape, len(keys)))
            values = sensor_covariate(self.covariate, samples)
            if values is not None:
                out[:, self._axis] = self.basis(values)[:, [int(key[1:]) for key in keys]]
            return out
        out = np.zeros((len(samples), len(keys)))
        values, factor = self._arguments(samples)
        if self.channel != samples.channel or values is None:
            return out
        basis = self.basis(values, factor)
        split = [key.rpartition(".") for key in keys]
        for part in dict.fromkeys(part for part, _, _ in split):
            columns = [column for column, names in enumerate(split) if names[0] == part]
            coefficients = [int(split[column][2][1:]) for column in columns]
            each = basis[:, coefficients] * np.reshape(self._share(samples, part), (-1, 1))
            out[:, columns] = self._of_measurements(samples, each)
        return out

    def groups(  # type: ignore[override]  # of a term
        self, anchors: Anchors | None, pairs: np.ndarray | None
    ) -> list[tuple[str, ...]]:
        if self.form != "anchor":
            return [self.keys()]
        return [self.keys(anchors), *(self.keys_of((i,)) for i in id_texts(anchors))]

    def advice(self) -> tuple[str, ...]:
        if not 0 < len(self.parts) <= MOST_PARTS:
            return ()
        cause, trial = causes(self)
        functions = listed(described(self, part) for part in self.parts)
        return f"Look for why {functions}.", f"Likely causes: {cause}. To tell: {trial}."


def _check(setting: str, value: str, known: Collection[str]) -> None:
    """Raise InputError if the value of a setting is not known."""
    if value not in known:
        expected = f"not one of {listed(known, 'or')}" if known else "not possible here"
        raise InputError(f"effects: smooth_term: {setting}: {value!r} is {expected}.")


def _rising(setting: str, knots: Any, shape: str) -> tuple[float, ...]:
    """Return the knots of a shape as a tuple; raise InputError if they are none."""
    found = numbers_of(knots)
    out = tuple(found.tolist()) if found.ndim == 1 else ()
    count = SHAPES[shape][0] if shape in SHAPES else None
    if len(out) != (count or max(len(out), 2)) or not (np.diff(out) > 0.0).all():
        expected = count or "two or more"
        raise InputError(
            f"effects: smooth_term: {setting}: {knots!r} are not {expected} rising numbers, "
            f"as the shape {shape} needs."
        )
    return out


def known_covariates() -> dict[str, tuple[str, ...]]:
    """Return {channel: covariates of a SmoothTerm on it}, without further columns of logs."""
    of_ranges = tuple(name for name in (*OF_TDOA, *OF_ARRIVAL) if name not in ONLY_TDOA)
    return {
        **dict.fromkeys(RADIO, of_ranges),
        "tdoa": (*OF_TDOA, *OF_ARRIVAL),
        **dict.fromkeys(IMU_CHANNELS, tuple(dict.fromkeys((*OF_IMU, *OF_SENSORS)))),
        **dict.fromkeys(SENSOR_CHANNELS, OF_SENSORS),
    }


def shape_basis(shape: str, knots: Sequence[float] | np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the basis functions of a shape at covariate values (n,), (n, k); NaN of NaN.

    Knots may be arrays (m,), of m shapes, with values (n, 1). The result is (n, m, k) then.

    The first is 1, the level. The second is, for
    line, parabola : a rise from -1/2 to 1/2 between the knots; a parabola has its square too
    beyond, below : a rise from 0 at the middle knot to 1 at the last, or at the first
    step, interval, switching : 1 beyond the first inner knot, up to the second, and so on
    pulse : 1 from the first knot to the second, and again from the third
    wave : the sine of the period between the knots, and the cosine
    """
    v = floats(values)
    if shape == "wave":
        phase = 2.0 * np.pi * (v - knots[0]) / (knots[1] - knots[0])
        return np.stack([np.ones_like(phase), np.sin(phase), np.cos(phase)], axis=-1)
    low, high = knots[0], knots[-1]
    held = np.clip(v, low, high)
    if shape in ("line", "parabola"):
        second = (held - low) / (high - low) - 0.5
        if shape == "parabola":
            return np.stack([np.ones_like(second), second, second**2], axis=-1)
    elif shape == "beyond":
        second = np.maximum(held - knots[1], 0.0) / (high - knots[1])
    elif shape == "below":
        second = np.maximum(knots[1] - held, 0.0) / (knots[1] - low)
    elif shape == "pulse":
        since = np.remainder(v - knots[0], knots[2] - knots[0])
        second = np.where(np.isnan(v), np.nan, 1.0 * (since < knots[1] - knots[0]))
    else:
        beyond = [1.0 * (v >= knot) for knot in knots[1:-1]]
        second = np.where(np.isnan(v), np.nan, sum(beyond[::2]) - sum(beyond[1::2]))
    return np.stack([np.ones_like(second), second], axis=-1)


AXES = {"gyro": "the gyroscope reads {} about {}", "accel": "the accelerometer reads {} along {}"}
SENSOR_UNITS = {"gyro": "rad/s", "accel": "m/s^2"}
OF_PLACE = (
    "x",
    "y",
    "height",
    "range",
    "bearing",
    "elevation",
    "bearing_in_anchor",
    "elevation_in_anchor",
)
OF_DIRECTION = ("bearing_in_tag", "elevation_in_tag", "tilt", "yaw")
INERTIAL = ("inertial",)  # in place of the form of functions on gyroscope and accelerometer
# (forms, covariates, causes, trial that distinguishes them); the first row that fits is used.
_CAUSES = (
    (
        INERTIAL,
        ("time",),
        "warming up (BMI088 data sheet)",
        "leave the vehicle switched on and at rest for as long",
    ),
    (
        INERTIAL,
        ("vibration",),
        "vibration that it rectifies",
        "mount it softer and fly again",
    ),
    (
        INERTIAL,
        ("turning_rate", "rate_x", "rate_y", "rate_z"),
        "its scale, its axes, or a place off the centre of turns",
        "turn the vehicle by hand about one axis at a time",
    ),
    (
        INERTIAL,
        OF_ACCEL,
        "its scale, its axes, or acceleration that it takes for turning (BMI088 data sheet)",
        "lay the vehicle on each side",
    ),
    (
        INERTIAL,
        None,
        "air flow, magnetism or load that go with the motion",
        "carry the vehicle by hand along the same path",
    ),
    (
        ("pair", "direction"),
        None,
        (
            "the time of flight that these anchors measured between them (Bitcraze documentation "
            "of TDoA2), or something between them"
        ),
        (
            "let them measure it again, then exchange one of the two modules: what stays is in "
            "the room"
        ),
    ),
    (
        ("anchor",),
        ("time",),
        (
            "something that came or went near it, its clock or its temperature (DW1000 user "
            "manual: 2.15 mm per degree)"
        ),
        "leave the tag at one place for as long: what still changes is in the anchor or near it",
    ),
    (
        ("anchor",),
        OF_PLACE,
        (
            "an obstacle or a reflector on that side of it, its antenna's pattern (errors of 10 to 15 "
            "cm, says Qorvo), or its place in the survey"
        ),
        (
            "exchange its module with that of another anchor and fly there again: what stays is "
            "in the room or in the survey"
        ),
    ),
    (
        ("anchor", "arrival"),
        OF_DIRECTION,
        (
            "the pattern of the tag's antenna, or a part of the vehicle in the way (Qorvo "
            "support: 10 - 15 cm)"
        ),
        "turn the vehicle by hand on the spot",
    ),
    (
        ("anchor", "arrival"),
        ("range_difference",),
        "a clock that runs at another rate than it says, or a TDOA that is scaled or clipped",
        "compare the TDOAs of two known places with the tape",
    ),
    (
        ("arrival",),
        OF_PLACE,
        (
            "the detection of weak and strong signals (Decawave APS011), the antennas' pattern or "
            "the frame of the survey"
        ),
        "fly to and fro along one line to an anchor",
    ),
    (
        ("common",),
        ("time",),
        "the tag's clock, supply or temperature",
        "leave the tag at one place for as long",
    ),
    (
        None,
        ("speed", "climb_rate", "range_rate", "acceleration", "turning_rate", "vibration", "tilt"),
        "stamps that are late, the attitude of the antenna or its supply under load",
        "fly one straight line slowly and fast, level and tilted",
    ),
    (
        None,
        ("interval", "previous_anchor"),
        "the order in which packets come and how the tag handles them",
        "change the order of the anchors",
    ),
    (
        None,
        None,
        "nothing that is known to do this everywhere in the room",
        "fly where this changes and all else does not",
    ),
)


def described(term: SmoothTerm, part: str = "") -> str:
    """Return the function of an anchor "3", of a pair "0-1" or of all, "", as a clause."""
    prefix = f"{part}." if part else ""
    name, unit = _named(term.covariate), shown_in(term.covariate)[0]
    knots = _in_words(term.covariate, term.knots)
    seen = f"{_factor_clause(term)} (seen: {name} from {knots[0]} to {knots[-1]}){_place(term)}"
    size = term.values.get(f"{prefix}c1", 0.0)
    std = term.std.get(f"{prefix}c1")
    if term.shape in ("step", "interval"):
        words = (WHEN if name == "time" else WHERE)[term.shape]
        return _off(term, part, size, std, f" {words.format(*knots, name=name)}{seen}")
    if term.shape == "switching":
        late = np.diff(term.knots[1:])[::2]
        share = f"{100.0 * late.sum() / (term.knots[-1] - term.knots[0]):.0f} % of the {name}"
        pieces = f"{len(late)} pieces of {' to '.join(_in_words('time', [late.min(), late.max()]))}"
        return _off(term, part, size, std, f" for {share}, in {pieces}")
    if term.shape == "pulse":
        on, period = _in_words(term.covariate, np.subtract(term.knots[1:], term.knots[0]))
        where = f" for {on} in each {period} of {name}, first at {knots[0]}{_factor_clause(term)}"
        return _off(term, part, size, std, where)
    if term.shape in ("line", "beyond", "below"):
        first, last = {"line": (0, 1), "beyond": (1, 2), "below": (1, 0)}[term.shape]
        width = term.knots[last] - term.knots[first]
        if unit == "degrees" or abs(width) < LEAST_WIDTH:
            reach = {"line": "", "beyond": " or less", "below": " or more"}[term.shape]
            where = f" where {name} is {knots[last]} than where it is {knots[first]}{reach}"
            return _off(term, part, size, std, f"{where}{seen}")
        side = {"line": "", "beyond": f", above {knots[1]}", "below": f", below {knots[1]}"}
        how = f" for each {unit or 'unit'} more of {name}{side[term.shape]}{seen}"
        return _off(term, part, size / width, None if std is None else std / abs(width), how)
    at = np.linspace(term.knots[0], term.knots[-1], 60)
    course = term.curve(at, prefix)
    top, bottom = int(np.argmax(course)), int(np.argmin(course))
    swing = course[top] - course[bottom]
    if term.shape == "wave":
        (length,) = _in_words(term.covariate, [term.knots[1] - term.knots[0]])
        where = f" at the crests of a wave over {name}, every {length}, compared with its troughs"
        return _off(term, part, swing, None, f"{where}{_factor_clause(term)}")
    high, low = _in_words(term.covariate, at[[top, bottom]])
    return _off(term, part, swing, None, f" where {name} is {high} than where it is {low}{seen}")


def in_brief(term: SmoothTerm, part: str = "") -> str:
    """Return the size of the function of a part, and on what it depends, as a clause."""
    prefix = f"{part}." if part else ""
    size, std = term.values.get(f"{prefix}c1", 0.0), term.std.get(f"{prefix}c1")
    if term.shape not in SHAPES or SHAPES[term.shape][1] > 2:  # c1 is not its size
        size = float(np.ptp(term.curve(np.linspace(term.knots[0], term.knots[-1], 60), prefix)))
        std = None
    return _off(
        term, part, size, std, f" at most, depending on {listed(map(_named, term.arguments))}"
    )


def _in_words(covariate: str, values: Iterable[float]) -> list[str]:
    """Return values of a covariate with its unit, for people: whole degrees, whole centimetres."""
    unit, factor = shown_in(covariate)
    decimals = {"degrees": 0, "m": 2, "s": 2, "m/s": 2}.get(unit)
    if decimals is None:
        return [f"{rounded(factor * value)} {unit}".strip() for value in values]
    return [f"{round(factor * value, decimals) + 0.0:g} {unit}" for value in values]


def _place(term: SmoothTerm) -> str:
    """Return the place, seen from the anchor, to which intervals of range and angle limit the tag.

    It is a part of a clause; "" if they determine none.
    """
    knots = {term.covariate: term.knots, term.factor: term.factor_knots}
    words = PLACES.get(frozenset(knots))
    if words is None or term.shape != "interval" or term.factor_shape != "interval":
        return ""
    if any(high - low > NARROW[name] for name, (_, low, high, _) in knots.items()):
        return ""
    middle = {name: 0.5 * (low + high) for name, (_, low, high, _) in knots.items()}
    # Bearing and elevation are of the anchor, seen from the tag. Level, if there is no elevation.
    away, up = middle.get("range", 1.0), -math.sin(middle.get("elevation", 0.0))
    level = math.cos(middle.get("elevation", 0.0))
    x, y = (-level * turn(middle.get("bearing", 0.0)) for turn in (math.cos, math.sin))
    where = words.format(x=away * x, y=away * y, z=away * up, level=away * level)
    return f": there the tag is {where}"


def _factor_clause(term: SmoothTerm) -> str:
    """Return a clause on where the factor lets the function act; "" without a factor."""
    if not term.factor:
        return ""
    name, knots = _named(term.factor), _in_words(term.factor, term.factor_knots)
    return {
        "line": f", with opposite signs at a {name} of {knots[0]} and of {knots[-1]}",
        "beyond": f", growing from none at a {name} of {knots[1]} to this at {knots[-1]}",
        "below": f", growing from none at a {name} of {knots[1]} to this at {knots[0]}",
        "step": f", while {name} is above {knots[1]}",
        "interval": f", while {name} is between {knots[1]} and {knots[-2]}",
    }[term.factor_shape]


def causes(term: SmoothTerm) -> tuple[str, str]:
    """Return (possible causes, trial that distinguishes them)."""
    if term.covariate.startswith(EXTRA):
        return (
            "what warms, loads or supplies it",
            f"keep the vehicle at rest and change {_named(term.covariate)} alone",
        )
    form = term.form if term.channel not in IMU_CHANNELS else "inertial"
    return next(
        (cause, trial)
        for forms, covariates, cause, trial in _CAUSES
        if (forms is None or form in forms) and (covariates is None or term.covariate in covariates)
    )


def _named(covariate: str) -> str:
    return covariate.removeprefix(EXTRA).replace("_", " ").replace(".", " ")


def _off(term: SmoothTerm, part: str, value: float, std: float | None, how: str) -> str:
    sensor, _, axis = term.channel.partition(".")
    if sensor in SENSOR_UNITS:
        amount = (
            f"{measured(abs(value), std, SENSOR_UNITS[sensor])} too "
            f"{'much' if value > 0.0 else 'little'}"
        )
        return AXES[sensor].format(amount, axis) + how
    amount = measured(abs(value), std, COMPARED[sensor].unit if sensor in COMPARED else "m")
    if term.form in ("anchor", "arrival"):
        who = f"anchor {part}" if part else "each anchor"
        return f"{who} seems {amount} {'farther' if value > 0.0 else 'nearer'}{how}"
    if part:
        subject = f"the TDOA of {part}"
    else:
        subject = "every TDOA" if sensor == "tdoa" else f"each value of {term.channel}"
    return f"{subject} is {amount} {'larger' if value > 0.0 else 'smaller'}{how}"
