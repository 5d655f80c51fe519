"""What a systematic effect is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import wraps
import math
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from ..foundation.errors import InputError
from .affine import IDENTITY
from .domain import checked
from .samples import RADIO, Samples, true_samples
from .wording import LARGEST, listed, measured

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Sequence

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight, Truth
    from .affine import Affine
    from .marks import Region, Shift
    from .sensor_function import SensorFunction

__all__ = ["ArrivalEffect", "Effect", "Samples"]

SIGNIFICANT = 2.0  # standard deviations; a smaller value is not determined by the data

Made = TypeVar("Made")


def once_per_anchors(method: Callable[[Any, Anchors], Made]) -> Callable[[Any, Anchors], Made]:
    """A method(self, anchors) that is computed once as long as it is asked for the same Anchors
    object.
    """
    name = f"_{method.__name__}_of"

    @wraps(method)
    def remembered(self: Any, anchors: Anchors) -> Made:
        known = self.__dict__.get(name)
        if known is None or known[0] is not anchors:
            known = self.__dict__[name] = anchors, method(self, anchors)
        return known[1]

    return remembered


@dataclass
class Effect:
    """A named systematic error with scalar parameters. One effect, one file: subclass and list it
    in EFFECTS.

    values : {parameter name: value in `unit`}; std : the same keys, standard errors, empty if
        unknown;
    source : where the values came from, free text; domain : {covariate: (low, high)}, where it was
        seen, see `domain.py`.
    An effect says what it does to measurements, and by that how it is undone, the same way in a
    node, off line and in a recording: `bias` and `noise_std` of TDOAs, `stamp_offset` of streams,
    `sensor_model` of inertial samples, heights and velocities, `sensor_bias` of inertial samples,
    `sensor_functions` of what these do by the state of the filter. For `diagnose` it gives
    `regressors` on the channels where it shows.
    """

    values: dict[str, float] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)
    source: str = ""
    domain: dict[str, tuple[float, float]] = field(default_factory=dict, kw_only=True)

    name: ClassVar[str]
    unit: ClassVar[str]
    bound: ClassVar[float]  # a larger magnitude is refused as a mistake, in `unit`
    negligible: ClassVar[float]  # a smaller magnitude is not worth a term in the model, in `unit`
    typical: ClassVar[
        float
    ]  # a plausible size, standard deviation of what fits expect before they see data, in `unit`
    example: ClassVar[str]  # the parameter that a value without a name is for; see `from_text`
    physics: ClassVar[str]  # one sentence for the catalogue
    confounded_with: ClassVar[tuple[str, ...]] = ()
    reference: ClassVar[str]
    channels: ClassVar[tuple[str, ...]] = ("tdoa",)  # where it shows: names of channels of diagnose
    fitted: ClassVar[bool] = True  # False: found by a detector of its own, not by linear regression
    portable: ClassVar[bool] = (
        True  # goes with the tag, the vehicle and the anchors' modules to another installation
    )
    # what it is a function of, and must not be taken beyond: its domain is of these
    covariates: ClassVar[tuple[str, ...]] = ()
    settings: ClassVar[
        tuple[str, ...]
    ] = ()  # further entries in effects.yaml, constructor arguments
    price: ClassVar[float] = (
        0.0  # what it must gain beyond others, twice a log-likelihood, to be chosen by diagnose
    )
    distinguished_by: ClassVar[
        dict[str, str]
    ] = {}  # {other effect: which flight tells this one from it}
    usable: ClassVar[bool] = True  # False: nodes cannot, or need not, take it out
    unused: ClassVar[str] = (
        "nodes cannot, or need not, take it out"  # why not, where it is not usable
    )
    # share of the parameters of a group that must not be negligible: of fewer a smaller group says
    # as much
    sizable_share: ClassVar[float] = 0.5
    # channels, one of which must be there too: else what it is compared with may be as wrong
    witnesses: ClassVar[tuple[str, ...]] = ()
    weighed: ClassVar[bool] = (
        False  # may be there or not: the filter weighs that, and no Corrector takes it out
    )
    needs_reference: ClassVar[bool] = False  # not observable in the filter's innovations alone
    needs_motion: ClassVar[bool] = False  # looks at more than the pose of the tag
    uses_attitude: ClassVar[bool] = False  # its part of a TDOA changes with the attitude of the tag

    def __post_init__(self) -> None:
        for group in ("values", "std"):
            read = {}
            for key, value in (getattr(self, group) or {}).items():
                key = str(key)
                self.check_key(key)
                try:
                    read[key] = float(value)
                except (TypeError, ValueError):
                    read[key] = np.nan
                bound = self.bound_of(key)
                if not np.isfinite(read[key]) or abs(read[key]) > bound:
                    raise InputError(
                        f"effects: {self.name}: {group}: {key} is {value!r}; expected a "
                        f"number of {self.unit} "
                        f"between -{bound:g} and {bound:g}."
                    )
            setattr(self, group, read)
        self.domain = checked(self.name, self.domain)

    @classmethod
    def check_key(cls, key: str) -> None:
        """Raise InputError if `key` is no parameter of this effect."""
        if key not in cls.groups(None, None)[0]:
            known = ", ".join(cls.groups(None, None)[0])
            raise InputError(f"effects: {cls.name}: parameter {key!r} is not one of {known}.")

    @classmethod
    def bound_of(cls, key: str) -> float:
        """Largest magnitude of the parameter `key`, in its unit."""
        return cls.bound

    @classmethod
    def typical_of(cls, key: str) -> float:
        """Plausible size of the parameter `key`, in its unit."""
        return cls.typical

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        """Sets of parameters that make sense together, as tuples of names, the full set first; here
        the one of `example`.

        anchors : Anchors; pairs : (m, 2) ids of the pairs that were heard. Both may be None where
            they do not matter.
        """
        return [(cls.example,)]

    @property
    def label(self) -> str:
        """What reports call it."""
        return self.label_of(self.values)

    def label_of(self, keys: Iterable[str]) -> str:
        """What reports call it if it has the parameters `keys` alone."""
        return self.name

    @property
    def identity(self) -> tuple[Hashable, ...]:
        """Hashable: equal for effects whose parameters of one name are the same quantity, which can
        hence be merged.
        """
        return (self.name, *(getattr(self, name) for name in self.settings))

    @classmethod
    def plausible(cls, values: dict[str, float]) -> bool:
        """Whether {parameter: value} could be: within bounds."""
        return all(abs(value) <= cls.bound_of(key) for key, value in values.items())

    def bias(self, samples: Samples) -> np.ndarray:
        """Contribution to what `samples.channel` measures, (n,) metres: of Samples to d_ab, of
        RangeSamples to the distance; NaN where it is not known (unknown pose).
        """
        return np.zeros(len(samples))

    @property
    def states(self) -> tuple[int, ...]:
        """Which of position (0, 1, 2) and velocity (3, 4, 5) its part of a TDOA may change steeply
        with, so that the filter should follow it: tuple.
        """
        return ()

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        """Derivative of what `samples.channel` measures by the parameters `keys`: of Samples (n,
        len(keys)), metres per `unit`; of ImuSamples (n, 3, len(keys)), body axes; of AidSamples (n,
        k, len(keys)). Asked for the channels in `channels` only.
        """
        return np.zeros((len(samples), len(keys)))

    def noise_std(self, samples: Samples) -> np.ndarray:
        """Standard deviation that it adds to d_ab, (n,) metres."""
        return np.zeros(len(samples))

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        """The Flight that would have been recorded with this effect on top. Raises InputError where
        that needs a ground truth, or an attitude, that the flight does not have. rng : numpy
        Generator, for random effects.
        """
        need_truth(self, flight)
        for channel in [
            channel
            for channel in self.channels
            if channel in RADIO and getattr(flight, channel) is not None
        ]:
            stream, (samples, rows) = getattr(flight, channel), true_samples(flight, RADIO[channel])
            bias = self.bias(samples)
            if not np.isfinite(bias).all():
                raise InputError(
                    f"{flight.name}: has no attitude in its ground truth, which {self.name} needs."
                )
            d = stream.d.copy()
            d[rows] += bias
            flight = flight.replaced(**{channel: replace(stream, d=d)})
        return flight

    def advice(self) -> tuple[str, ...]:
        """What a person can do about it in the hall: imperative sentences, the most important
        first; () if nothing but taking it out of the measurements helps. They name `significant`
        values alone.
        """
        largest = list(self.significant().items())[:LARGEST]
        if not largest:
            return ()
        values = listed(f"{key} = {measured(value, self.std.get(key))}" for key, value in largest)
        return (
            f"Look for the cause of {self.name}: {self.physics} (found: {values}, in {self.unit}).",
        )

    def significant(self) -> dict[str, float]:
        """{parameter: value} of those values that the data determine, the largest first in standard
        deviations; values without a standard deviation, or with none but 0, were set, not
        estimated, and come last.
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

    def size(self, key: str, unit: str | None = None, factor: float = 1.0) -> str:
        """Magnitude of a parameter with its standard deviation, times `factor`, in `unit`."""
        unit = self.unit if unit is None else unit
        return measured(abs(self.values[key]) * factor, self.std.get(key, 0.0) * abs(factor), unit)

    def directed(
        self, key: str, above: str, below: str, unit: str | None = None, factor: float = 1.0
    ) -> str:
        """The `size` of a significant parameter, and which way it is off: "12.0 ± 0.3 ms late"; ""
        if the data do not determine it.
        """
        if key not in self.significant():
            return ""
        return f"{self.size(key, unit, factor)} {above if self.values[key] > 0.0 else below}"

    def on_floor(self, anchors: Anchors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is given to the filter of an effect that is `weighed`, as of
        `FloorMultipath.on_floor`.
        """
        raise NotImplementedError

    def marks(self, anchors: Anchors) -> tuple[Shift | Region, ...]:
        """Shifts and Regions (`marks.py`) that show it on a map of some Anchors: tuple."""
        return ()

    def stamp_offset(self, stream: str) -> float:
        """Seconds by which the stamps of a stream of a Flight are late, by its name."""
        return 0.0

    def sensor_model(self, channel: str) -> Affine:
        """Affine from the true to the measured values of "gyro" (rad/s), "accel" (m/s^2) or
        "velocity" (m/s), body axes, of "yaw_rate" (rad/s), or of "height" (m).
        """
        return IDENTITY

    def sensor_bias(self, channel: str, features: np.ndarray) -> np.ndarray | None:
        """What it adds to "gyro" or "accel" besides, (n, 3), given their features (n, len(OF_IMU));
        None for nothing.
        """
        return None

    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        """What it adds to inertial samples that changes with the state of the filter: tuple of
        SensorFunction.
        """
        return ()

    def uncorrected(self, samples: Any) -> np.ndarray | float:
        """What taking it out of a stream leaves of it in ImuSamples, (n, 3), or AidSamples, (n, k),
        because nodes know less than those.
        """
        return 0.0


class ArrivalEffect(Effect):
    """An effect that makes the signals of single anchors arrive late: bias of d_ab = delay_b -
    delay_a, of a range to b delay_b.
    """

    channels = tuple(RADIO)

    def delays(self, samples: Samples, rows: np.ndarray) -> np.ndarray:
        """By how much the anchors in `rows` (k * n,), the samples repeated k times, seem too far:
        (k * n,) m; here linear in all values.
        """
        return self.delay_regressors(samples, rows, list(self.values)) @ np.array(
            list(self.values.values())
        )

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        """Its derivative with respect to `keys`, (k * n, len(keys))."""
        raise NotImplementedError

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.difference(self.delays(samples, samples.rows))

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return samples.difference(self.delay_regressors(samples, samples.rows, keys))


class AnchorEffect(Effect):
    """An effect with one parameter for each anchor, named by its id, that makes its arrivals late
    in proportion.
    """

    channels = tuple(RADIO)

    @classmethod
    def check_key(cls, key: str) -> None:
        check_anchor(cls.name, key, key)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        ids = known_anchors(anchors)
        return [ids, *((key,) for key in ids)]

    def delay_per_unit(self, samples: Samples) -> np.ndarray | float:
        """By how many metres an anchor is late for each unit of its parameter, (n,) or a scalar."""
        return 1.0

    def bias(self, samples: Samples) -> np.ndarray:
        values = self._of_each(samples.anchors)
        return samples.difference(values[samples.rows]) * self.delay_per_unit(samples)

    @once_per_anchors
    def _of_each(self, anchors: Anchors) -> np.ndarray:
        return np.array([self.values.get(str(i), 0.0) for i in anchors.ids.tolist()])

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        ids, wanted = samples.anchors.ids, np.array([int(key) for key in keys])
        sign = samples.difference((ids[samples.rows][:, None] == wanted).astype(float))
        return sign * np.reshape(self.delay_per_unit(samples), (-1, 1))


def need_truth(effect: Effect, flight: Flight) -> Truth:
    """The ground truth of a flight; raises InputError if it has none to compute `effect` at."""
    if flight.truth is None or len(flight.truth) == 0:
        raise InputError(f"{flight.name}: holds no ground truth, which {effect.name} needs.")
    return flight.truth


def check_anchor(name: str, text: str, key: str) -> None:
    """Raise InputError if `text`, of the parameter `key` of effect `name`, is not an anchor id."""
    if not (text.isdigit() and int(text) <= 65535):
        raise InputError(
            f"effects: {name}: parameter {key!r} is not an anchor id; write for example '3: 0.05'."
        )


def known_anchors(anchors: Anchors | None) -> tuple[str, ...]:
    """Ids as text; () without anchors."""
    return () if anchors is None else tuple(str(i) for i in anchors.ids.tolist())
