# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effect, the base of all systematic effects, and the kinds of effects that families share."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, wraps
import math
import re
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..common.anchors import Anchors
from ..common.errors import InputError, number_of
from ..common.flight import Flight
from ..common.sensors import STREAM_OF, measured_on
from .samples import (
    OF_ARRIVAL,
    RADIO,
    Samples,
    checked_domain,
    covariate_of,
    fade_weight,
    shown_in,
    true_samples,
)

__all__ = ["ArrivalEffect", "Effect", "Row", "Samples"]

SIGNIFICANT = 2.0  # standard deviations; the data do not determine a smaller value
FADED_BELOW = (
    0.5  # weight of an effect, or share of the knowledge of a network, below which it is faded
)
ROUNDED = 0.1  # share by which a printed standard deviation may be rounded
LARGEST = 3  # values in one sentence
TABLE_STEPS = 256  # intervals in the table of a SensorFunction
UNLIMITED = 1e6  # bound of stamps and places, s and m
ANCHOR = "[0-9]{1,5}"  # regular expression of the id of an anchor in a parameter
# (regular expression of a parameter, what a parameter is, in words)
OF_ANCHOR = ANCHOR, "an anchor id; write for example '3: 0.05'"
OF_PAIR = f"{ANCHOR}-{ANCHOR}", "a pair of anchors; write for example '0-1'"
STREAM_WORDS = {"imu": "inertial samples", "truth": "ground truth"}  # others by their names

Made = TypeVar("Made")


def rounded(value: float, std: float | None = None) -> str:
    """Return a number to the first digit of its standard deviation.

    If rounding changes the standard deviation by more than ROUNDED, two digits are kept. Without a
    standard deviation the number has three digits.
    """
    if not std:
        return f"{value:.3g}"
    decimals = -math.floor(math.log10(std))
    two_digits = abs(round(std, decimals) - std) > ROUNDED * std
    return f"{value:.{max(0, decimals + two_digits)}f}"


def measured(value: float, std: float | None = None, unit: str = "") -> str:
    """Return a value with its standard deviation and unit, as "0.31 ± 0.01 m"."""
    number = f"{rounded(value, std)} ± {rounded(std, std)}" if std else rounded(value)
    return f"{number} {unit}".strip()


def listed(words: Iterable[str], last: str = "and") -> str:
    """Join words, as "a, b and c"."""
    words = list(words)
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def counted(words: Iterable[str], noun: str) -> str:
    """Join words after their noun, as "anchor 3" or "anchors 3 and 5"."""
    words = list(words)
    return f"{noun}{'s' if len(words) > 1 else ''} {listed(words)}"


@dataclass(frozen=True)
class Affine:
    """A sensor model x -> matrix x + offset, for (n, k) rows of true values."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return measured values (n, k) for true ones (n, k)."""
        return x @ self.matrix.T + self.offset

    def after(self, first: Affine) -> Affine:
        """Return the map that applies `first`, then this one."""
        return Affine(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self) -> Affine:
        """Return the map that undoes this one."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.offset)


IDENTITY = Affine(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class SensorFunction:
    """A table of an inertial error over the state of the filter, for compiled code.

    sensor : "gyro" or "accel"; axis : 0 to 2, body; covariate : a name of OF_STATE
    low, high : first and last value of the covariate
    values : (TABLE_STEPS + 1,) rad/s or m/s^2, evenly spaced between low and high
    periodic : whether the table repeats beyond low and high; otherwise its ends are held
    """

    sensor: str
    axis: int
    covariate: str
    low: float
    high: float
    values: np.ndarray
    periodic: bool = False

    @classmethod
    def of(
        cls,
        function: Callable[[np.ndarray], np.ndarray],
        channel: str,
        covariate: str,
        ends: tuple[float, float],
        periodic: bool = False,
    ) -> SensorFunction:
        """Return the table of a function, (n,) to (n,), between two ends of the covariate.

        channel : "gyro.x" ... "accel.z"
        """
        sensor, _, axis = channel.partition(".")
        values = function(np.linspace(*ends, TABLE_STEPS + 1))
        return cls(sensor, "xyz".index(axis), covariate, *ends, values, periodic)


@dataclass(frozen=True, eq=False)
class Shift:
    """A shift of an anchor on a map: id, `by` (3,) m, world, and std (3,) m, NaN if unknown."""

    anchor: int
    by: np.ndarray
    std: np.ndarray


@dataclass(frozen=True, eq=False)
class Region:
    """A sphere of tag positions in which an anchor is disturbed: centre (3,) m, world, radius m."""

    anchor: int
    centre: np.ndarray
    radius: float


def cached_by_anchors(method: Callable[[Any, Anchors], Made]) -> Callable[[Any, Anchors], Made]:
    """Cache the result of a method(self, anchors) for the latest Anchors object."""
    name = f"_{method.__name__}_of"

    @wraps(method)
    def cached(self: Any, anchors: Anchors) -> Made:
        known = self.__dict__.get(name)
        if known is None or known[0] is not anchors:
            known = self.__dict__[name] = anchors, method(self, anchors)
        return known[1]

    return cached


@dataclass(frozen=True)
class Row:
    """A row of the table of effects: its parameters, sizes, source and wording.

    Attributes
    ----------
    name : its key in an effects file
    unit : of the parameters; `bound`, `negligible` and `prior_std` are in this unit
    bound : largest magnitude that is accepted
    negligible : smallest magnitude that deserves a term in a model
    prior_std : standard deviation that a fit assumes before it sees data
    example : parameter that `inject --value NUMBER` sets
    physics : the cause, one phrase
    reference : source of the equation or of the sizes
    confounded_with : effects that explain nearly the same residuals
    distinguished_by : {such an effect: flight that distinguishes the two}
    remedy : sentence of a report; {found} and {where} stand for the significant values
    phrase : words of one significant value, of {size}, {value}, {way} and {key}
    ways : {way} of a positive and of a negative value
    shown : (unit, factor from `unit`) in which reports show values; None for `unit`
    """

    name: str
    unit: str
    bound: float
    negligible: float
    prior_std: float
    example: str
    physics: str
    reference: str
    confounded_with: tuple[str, ...] = ()
    distinguished_by: dict[str, str] = field(default_factory=dict)
    remedy: str = ""
    phrase: str = "{size} {way}"
    ways: tuple[str, str] = ("", "")
    shown: tuple[str, float] | None = None


@dataclass
class Effect:
    """A named systematic error with scalar parameters.

    A subclass declares its `row` and states its equation once: `bias` of TDOAs and ranges,
    `model` of a sensor, or `stamp_offset` of a stream. Nodes, off-line runs and `inject` use that
    equation. `regressors` are its derivatives by the parameters, for `diagnose`.

    Attributes
    ----------
    values : {parameter: value in `unit`}
    std : {parameter: standard error in `unit`}, empty if unknown
    source : where the values come from, free text
    domain : {covariate: (low, high)}, where the effect was observed
    """

    values: dict[str, float] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)
    source: str = ""
    domain: dict[str, tuple[float, float]] = field(default_factory=dict, kw_only=True)

    row: ClassVar[Row]
    name: ClassVar[str]  # of the row, as the unit
    unit: ClassVar[str]

    # Parameters of a fixed set; None: the example alone. An effect with `key_form` has no fixed set.
    parameters: ClassVar[tuple[str, ...] | None] = None
    key_form: ClassVar[tuple[str, str] | None] = None
    # Last parts of parameters that state when or where it acts, not how large it is
    conditions: ClassVar[tuple[str, ...]] = ()
    # {last part of a parameter: its unit} of parameters that are not in the first unit of `unit`
    other_units: ClassVar[dict[str, str]] = {}
    # What it means for people that no single value is significant, a clause; "" for nothing
    if_undetermined: ClassVar[str] = ""
    channels: ClassVar[tuple[str, ...]] = ("tdoa",)  # channels of `diagnose` on which it shows
    fitted: ClassVar[bool] = True  # False: a detector finds it, not linear regression
    portable: ClassVar[bool] = True  # True: stays valid in another installation of anchors
    covariates: ClassVar[tuple[str, ...]] = ()  # quantities that its domain limits
    settings: ClassVar[tuple[str, ...]] = ()  # further constructor arguments in effects.yaml
    penalty: ClassVar[float] = 0.0  # twice a log-likelihood that a selection must gain in addition
    usable: ClassVar[bool] = True  # False: nodes do not correct it, for the following reason
    why_unusable: ClassVar[str] = "nodes cannot, or need not, take it out"
    # Share of the parameters of a group that must not be negligible; else a smaller group suffices
    sizable_share: ClassVar[float] = 0.5
    # Channels, at least one of which must show: else the reference may have the error.
    corroborating_channels: ClassVar[tuple[str, ...]] = ()
    # True: no Corrector removes it; the filter decides whether it acts, as floor reflections
    is_hypothesis: ClassVar[bool] = False
    needs_reference: ClassVar[bool] = False  # True: innovations alone do not show it
    needs_motion: ClassVar[bool] = False  # True: depends on more than the pose of the tag
    uses_pose: ClassVar[bool] = True  # False: its bias is a constant of each pair of anchors
    uses_attitude: ClassVar[bool] = False  # True: its bias depends on the attitude of the tag
    uses_orientations: ClassVar[bool] = False  # True: on the orientations of anchors, too
    periodic: ClassVar[bool] = False  # True: it recurs in time, and goes on beyond its domain

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "row" in vars(cls):
            cls.name, cls.unit = cls.row.name, cls.row.unit

    def __post_init__(self) -> None:
        for group in ("values", "std"):
            read = {}
            for key, value in (getattr(self, group) or {}).items():
                key = str(key)
                self.check_key(key)
                read[key] = number_of(value)
                bound = self.bound_of(key)
                if not np.isfinite(read[key]) or abs(read[key]) > bound:
                    raise InputError(
                        f"effects: {self.name}: {group}: {key} is {value!r}; expected a "
                        f"number of {self.unit} between -{bound:g} and {bound:g}."
                    )
            setattr(self, group, read)
        self.domain = checked_domain(self.name, self.domain)

    # Parameters

    @classmethod
    def check_key(cls, key: str) -> None:
        """Raise InputError if `key` is no parameter of this effect."""
        if cls.key_form is None:
            known = cls.groups(None, None)[0]
            pattern, words = "|".join(known), f"one of {', '.join(known)}"
        else:
            pattern, words = cls.key_form
        if not re.fullmatch(pattern, key):
            raise InputError(f"effects: {cls.name}: parameter {key!r} is not {words}.")

    @classmethod
    def bound_of(cls, key: str) -> float:
        """Return the largest magnitude of the parameter `key`, in its unit."""
        return cls.row.bound

    @classmethod
    def prior_std_of(cls, key: str) -> float:
        """Return the prior standard deviation of the parameter `key`, in its unit."""
        return cls.row.prior_std

    @classmethod
    def unit_of(cls, key: str) -> str:
        """Return the unit of the parameter `key`."""
        return cls.other_units.get(key.rpartition(".")[2], cls.unit.partition(",")[0])

    @classmethod
    def is_condition(cls, key: str) -> bool:
        """Return whether the parameter `key` states when or where the effect acts.

        The others state how large it is.
        """
        return key.rpartition(".")[2] in cls.conditions

    @classmethod
    def within_bounds(cls, values: dict[str, float]) -> bool:
        """Return whether {parameter: value} is possible."""
        return all(abs(value) <= cls.bound_of(key) for key, value in values.items())

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        """Return sets of parameters that `diagnose` tries together, the full set first.

        anchors : Anchors; pairs : (m, 2) ids of the pairs that were heard. Both may be None.
        """
        return with_each((cls.row.example,) if cls.parameters is None else cls.parameters)

    @property
    def label(self) -> str:
        """Return the name that reports print."""
        return self.label_of(self.values)

    def label_of(self, keys: Iterable[str]) -> str:
        """Return the name that reports print for the parameters `keys` alone."""
        return self.name

    @property
    def merge_key(self) -> tuple[Hashable, ...]:
        """Return a key that is equal for effects whose parameters may be merged by name."""
        return (self.name, *(getattr(self, name) for name in self.settings))

    # Equation

    def bias(self, samples: Samples) -> np.ndarray:
        """Return the error of `samples.channel`, (n,) m; NaN where the pose is unknown."""
        return np.zeros(len(samples))

    def noise_std(self, samples: Samples) -> np.ndarray:
        """Return the standard deviation that it adds to d_ab, (n,) m."""
        return np.zeros(len(samples))

    def stamp_offset(self, stream: str) -> float:
        """Return by how many seconds the stamps of a stream of a Flight are late."""
        return 0.0

    def sensor_model(self, channel: str) -> Affine:
        """Return the Affine from true to measured values of a channel.

        channel : "gyro" (rad/s, body), "accel" (m/s^2, body), "velocity" (m/s, body), "yaw_rate"
            (rad/s, body) or "height" (m)
        """
        return IDENTITY

    def sensor_bias(self, channel: str, features: np.ndarray) -> np.ndarray | None:
        """Return what it adds to "gyro" or "accel", (n, 3), or None.

        features : (n, len(OF_IMU)), as of ImuFeatures
        """
        return None

    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        """Return inertial errors that depend on the state of the filter."""
        return ()

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        """Return derivatives of the measurement by the parameters `keys`.

        Of Samples (n, len(keys)), m per `unit`; of ImuSamples (n, 3, len(keys)), body; of
        SensorSamples (n, k, len(keys)).
        """
        return np.zeros((len(samples), len(keys)))

    def uncorrected(self, samples: Any) -> np.ndarray | float:
        """Return the part that nodes cannot correct: of ImuSamples (n, 3), of SensorSamples (n, k)."""
        return 0.0

    @property
    def jacobian_states(self) -> tuple[int, ...]:
        """Return the states by which the filter must differentiate the bias of a TDOA.

        0 to 2 are the position, 3 to 5 the velocity.
        """
        return ()

    def near_ground_delays(self, anchors: Anchors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return delays of anchors near the ground, as FloorMultipath does."""
        raise NotImplementedError

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        """Return the Flight that would have been recorded with this effect in addition.

        rng : numpy Generator, for random effects. Raises InputError if the flight lacks a stream,
        the ground truth or an attitude that the effect needs.
        """
        require(self, flight, "truth")
        for channel in self.channels:
            stream = getattr(flight, channel) if channel in RADIO else None
            if stream is None:
                continue
            samples, rows = true_samples(flight, RADIO[channel])
            d = stream.d.copy()
            d[rows] += finite(self, flight, self.bias(samples))
            flight = flight.replaced(**{channel: replace(stream, d=d)})
        return flight

    # Domain

    def domain_weight(self, samples: Samples) -> np.ndarray:
        """Return the weight of the effect, (n,): 1 within its domain, less beyond."""
        limits = tuple(self.domain.items())
        return samples.kept(("domain", limits), partial(_domain_weight, samples, limits))

    def corrected_bias(self, samples: Samples) -> np.ndarray:
        """Return the bias that is corrected, (n,) m: it fades beyond the domain.

        It is NaN where unknown.
        """
        bias = self._held_bias(samples)
        return self.domain_weight(samples) * bias if self.domain else bias

    def uncorrected_std(self, samples: Samples) -> np.ndarray | float:
        """Return the standard deviation of what is not corrected beyond the domain, (n,) m."""
        rest = 1.0 - self.domain_weight(samples)
        return rest * np.abs(np.nan_to_num(self._held_bias(samples))) if rest.any() else 0.0

    def _held_bias(self, samples: Samples) -> np.ndarray:
        """Return the bias, (n,) m. A time is held at the end of its domain.

        No growth beyond it was observed. What recurs goes on.
        """
        if "time" in self.domain and not self.periodic:
            last = samples.start + self.domain["time"][1]
            samples = replace(samples, t=np.minimum(samples.t, last))
        return self.bias(samples)

    @property
    def domain_words(self) -> str:
        """Return its label and its domain as a phrase."""
        limits = []
        for name, (low, high) in self.domain.items():
            unit, factor = shown_in(name)
            limits.append(f"{name} {factor * low:.3g} to {factor * high:.3g} {unit}")
        return f"{self.label} ({', '.join(limits)})"

    # Reports

    def significant(self) -> dict[str, float]:
        """Return {parameter: value} of the values that the data determine.

        The most significant value comes first. Values without a standard deviation come last.
        """
        std = self.std
        known = {
            key: value
            for key, value in self.values.items()
            if not abs(value) < SIGNIFICANT * std.get(key, 0.0)
        }
        return dict(
            sorted(known.items(), key=lambda item: -abs(item[1]) / (std.get(item[0]) or math.inf))
        )

    def largest_size(self) -> str | None:
        """Return the parameter of the largest size, of the significant ones if there are any.

        Sizes of different units are compared in prior standard deviations. None without a size.
        """
        sizes = {key: value for key, value in self.values.items() if not self.is_condition(key)}
        among = self.significant_sizes() or sizes
        return max(among, key=lambda key: abs(sizes[key]) / self.prior_std_of(key), default=None)

    def significant_sizes(self) -> dict[str, float]:
        """Return those of `significant` that state how large the effect is."""
        return {
            key: value for key, value in self.significant().items() if not self.is_condition(key)
        }

    def advice(self) -> tuple[str, ...]:
        """Return imperative sentences for people, the most important first.

        They name significant values alone. Without any, or without a remedy, there is none.
        """
        significant = self.significant()
        if not significant:
            return ()
        if self.row.remedy:
            return (self.row.remedy.format(found=self.found(), where=self.where()),)
        largest = list(significant.items())[:LARGEST]
        values = listed(f"{key} = {measured(value, self.std.get(key))}" for key, value in largest)
        return (
            f"Look for the cause of {self.name}: {self.row.physics} (found: {values}, in {self.unit}).",
        )

    def found(self) -> str:
        """Return all significant values in words, those of a fixed set in its order."""
        order = {key: place for place, key in enumerate(self.groups(None, None)[0])}
        keys = sorted(self.significant(), key=lambda key: order.get(key, 0))
        return listed(
            self.row.phrase.format(
                size=self.size(key), value=self.signed(key), way=self.way(key), key=key
            )
            for key in keys
        )

    def where(self) -> str:
        """Return the anchors or pairs of the significant values in words; "" if it has none."""
        return ""

    def way(self, key: str) -> str:
        """Return the word of `ways` for the sign of a value."""
        return self.row.ways[0] if self.values[key] > 0.0 else self.row.ways[1]

    def shown_in(self, key: str) -> tuple[str, float]:
        """Return (unit, factor) in which reports show a value."""
        return self.row.shown or (self.unit, 1.0)

    def size(self, key: str) -> str:
        """Return the magnitude of a value with its standard deviation, as reports show it."""
        unit, factor = self.shown_in(key)
        return measured(abs(self.values[key]) * factor, self.std.get(key, 0.0) * abs(factor), unit)

    def signed(self, key: str) -> str:
        """Return a value with its standard deviation, as reports show it."""
        unit, factor = self.shown_in(key)
        return measured(self.values[key] * factor, self.std.get(key, 0.0) * abs(factor), unit)

    def marks(self, anchors: Anchors) -> tuple[Shift | Region, ...]:
        """Return Shifts and Regions that show the effect on a map of some Anchors."""
        return ()


class ArrivalEffect(Effect):
    """An effect that delays the signals of single anchors.

    The bias of d_ab is delay_b - delay_a, that of a range to b is delay_b.
    """

    channels = tuple(RADIO)

    @property
    def delay_keys(self) -> tuple[str, ...]:
        """Return the parameters in which the delays are linear; by default all."""
        return tuple(self.values)

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        """Return the derivatives of delays, m, by the parameters `keys`, (k * n, len(keys)).

        rows : (k * n,) rows of the delayed anchors, with the samples repeated k times
        """
        raise NotImplementedError

    def bias(self, samples: Samples) -> np.ndarray:
        keys = self.delay_keys
        by_values = samples.kept((self.merge_key, keys), partial(self.regressors, samples, keys))
        return by_values @ np.array([self.values[key] for key in keys])

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return samples.difference(self.delay_regressors(samples, samples.rows, keys))


class GeometryEffect(Effect):
    """An effect that moves antennas: bias = predicted(where they are) - predicted(survey)."""

    channels = tuple(RADIO)

    def antennas(self, samples: Samples) -> dict[str, np.ndarray]:
        """Return the arguments of `samples.predicted`: p (n, 3) m, or positions (N, 3) m."""
        return {"positions": self.positions(samples.anchors)}

    def positions(self, anchors: Anchors) -> np.ndarray:
        """Return where the anchors are, (N, 3) m, of an effect that moves them."""
        raise NotImplementedError

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.predicted(**self.antennas(samples)) - samples.predicted()


class DetectedEffect(Effect):
    """An effect of one installation or flight that a detector finds, not linear regression."""

    fitted = False
    portable = False
    parameters: ClassVar[tuple[str, ...] | None] = ()


class LabelEffect(DetectedEffect):
    """An effect on the ids or on the sign of TDOAs, a mistake of a driver or a survey.

    A rule finds it; its values are whole numbers. It is corrected before all other effects.
    """

    separable: ClassVar[bool] = True  # each value is meaningful without the others
    expected: ClassVar[str]  # possible values, in words

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, value in self.values.items():
            if not self.possible(value):
                raise InputError(
                    f"effects: {self.name}: values: {key} is {value:g}; expected {self.expected}."
                )

    @staticmethod
    def possible(value: float) -> bool:
        """Return whether a value is meaningful."""
        raise NotImplementedError

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return TDOAs without the mistake: ids a, b (n,) and d (n,) m."""
        raise NotImplementedError

    def mislabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return TDOAs with the mistake: ids a, b (n,) and d (n,) m."""
        return self.relabelled(a, b, d)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        tdoa = flight.tdoa
        a, b, d = self.mislabelled(tdoa.a, tdoa.b, tdoa.d)
        return replace(flight, tdoa=replace(tdoa, a=a, b=b, d=d))


def relabelled(
    effects: Iterable[LabelEffect], a: np.ndarray, b: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return TDOAs without the mistakes of LabelEffects, in their order: ids a, b (n,) and d (n,) m."""
    for effect in effects:
        a, b, d = effect.relabelled(a, b, d)
    return a, b, d


def central_differences(
    function: Callable[[dict[str, float]], np.ndarray],
    values: dict[str, float],
    keys: Sequence[str],
    step: float,
) -> np.ndarray:
    """Return numerical derivatives of function(values) by the parameters `keys`.

    Returns the shape of function(values) with len(keys) columns appended.
    """
    columns = []
    for key in keys:
        here = values.get(key, 0.0)
        low, high = (function({**values, key: here + shift}) for shift in (-step, step))
        columns.append((high - low) / (2.0 * step))
    return np.stack(columns, axis=-1)


def undoing(effects: Iterable[Effect], channel: str) -> Affine:
    """Return the Affine that undoes the sensor models of effects in their order, or IDENTITY."""
    undo = IDENTITY
    for effect in effects:
        model = effect.sensor_model(channel)
        if model is not IDENTITY:
            undo = model.inverse() if undo is IDENTITY else model.inverse().after(undo)
    return undo


def require(effect: Effect, flight: Flight, name: str) -> Any:
    """Return the Stream of a channel of a sensor, "tdoa", "imu" or "truth"; raise InputError."""
    part = measured_on(flight, name) if name in STREAM_OF else getattr(flight, name)
    if part is None or (name == "truth" and len(part) == 0):
        words = STREAM_WORDS.get(name, name.replace("_", " "))
        raise InputError(f"{flight.name}: holds no {words}, which {effect.name} needs.")
    return part


def finite(effect: Effect, flight: Flight, error: np.ndarray) -> np.ndarray:
    """Return an error of measurements; raise InputError if an attitude is missing for it."""
    if not np.isfinite(error).all():
        raise InputError(
            f"{flight.name}: has no attitude in its ground truth, which {effect.name} needs."
        )
    return error


def _domain_weight(
    samples: Samples, domain: tuple[tuple[str, tuple[float, float]], ...]
) -> np.ndarray:
    """Return the weight (n,) of an effect with the items of a domain."""
    n = len(samples)
    weight = np.ones(n)
    for covariate, limits in domain:
        if covariate in OF_ARRIVAL:
            of_arrivals = fade_weight(covariate_of(samples, covariate), limits)
            weight *= of_arrivals.reshape(-1, n).min(axis=0)
        elif (values := covariate_of(samples, covariate)) is not None:
            weight *= fade_weight(values, limits)
    return weight


def with_each(keys: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return a set of parameters, and each of several alone."""
    return [keys, *((key,) for key in keys if len(keys) > 1)]


def is_within(effect: Effect, part: str, since: np.ndarray) -> np.ndarray:
    """Return whether times (n,) lie between "<part>.start" and "<part>.end" of an effect: (n,) bool.

    A limit that is not given does not apply. since : s after the first TDOA
    """
    start = effect.values.get(f"{part}.start", -np.inf)
    end = effect.values.get(f"{part}.end", np.inf)
    return (since >= start) & (since <= end)


def interval_words(effect: Effect, part: str) -> str:
    """Return the interval of `is_within` as the end of a clause; "" without limits."""
    start, end = (effect.values.get(f"{part}.{limit}") for limit in ("start", "end"))
    if start is None and end is None:
        return ""
    if start is None:
        return f"until {end:.0f} s after the first TDOA"
    if end is None:
        return f"from {start:.0f} s on after the first TDOA"
    return f"from {start:.0f} to {end:.0f} s after the first TDOA"


def id_texts(anchors: Anchors | None) -> tuple[str, ...]:
    """Return the ids of Anchors as text; () without anchors."""
    return () if anchors is None else tuple(str(i) for i in anchors.ids.tolist())
