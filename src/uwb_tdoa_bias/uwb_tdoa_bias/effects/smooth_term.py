"""An effect without a name: a smooth function of something, found in residuals."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar
import warnings

import numpy as np

from ..foundation.compiled import compiled
from ..foundation.errors import InputError
from ..foundation.sensors import BY_POSE, COMPARED
from .base import Effect, known_anchors, once_per_anchors
from .covariates import (
    CATEGORIES,
    EXTRA,
    OF_AIDS,
    OF_ARRIVAL,
    OF_IMU,
    OF_MOTION,
    OF_STATE,
    OF_TDOA,
    STATES,
    sensor_covariate,
)
from .domain import FADE, bounded, share
from .samples import RADIO, tile
from .sensor_function import SensorFunction
from .shapes import SHAPES, functions
from .smooth_words import sentences
from .wording import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike

    from ..foundation.anchors import Anchors
    from .samples import AidSamples, ImuSamples, Samples

DEGREE = 2
GONE = 4 * FADE  # share of the width of a domain beyond which nothing is left of a function
IMU_CHANNELS = tuple(f"{sensor}.{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
AID_CHANNELS = tuple(name + axis for name in BY_POSE for axis in COMPARED[name].axes)
FORMS = ("common", "arrival", "anchor", "pair", "direction")
OF_LINKS = ("pair", "direction")  # forms with a function for a pair of anchors
TYPICAL = {"tdoa": 0.1, "gyro": 0.1, "accel": 0.5}  # m, rad/s, m/s^2
ALONE = 0.3  # m, of what few have
OLD_NAMES = {
    "force": "accel",
    **{f"force_{axis}": f"accel_{axis}" for axis in "xyz"},
}  # of covariates, until 0.3


@dataclass
class SmoothTerm(Effect):
    """A function of one covariate, held constant beyond its knots; `values` are its coefficients
    c0, c1, ...

    channel : one of RADIO, "gyro.x" ... "accel.z", or of AID_CHANNELS
    covariate : of RADIO a name of covariates.OF_TDOA or OF_ARRIVAL, of "range" none that needs the
        TDOAs before, for other
        channels of OF_AIDS, for the inertial ones of OF_IMU too; or, but for AID_CHANNELS,
        "extra.STREAM.COLUMN". Where a recording does not hold it, it adds nothing
    form : of RADIO only: "common", the same f(covariate) on every d_ab; "arrival", f of each
        anchor's own
        covariate, as d_ab = f_b - f_a; "anchor", the same with a function for each anchor,
        coefficients "3.c0", ...; of "tdoa" alone "pair": f on d_ab and -f on d_ba, coefficients
        "0-1.c0", ...; "direction": f on d_ab alone
    knots : where the pieces meet, ends included, rising; for a covariate of names: the names, one
        coefficient each
    shape : "spline", quadratic, or one of `shapes.SHAPES`
    """

    channel: str = "tdoa"
    covariate: str = "time"
    form: str = "common"
    knots: tuple[float, ...] = field(default_factory=tuple)
    shape: str = "spline"

    name: ClassVar[str] = "smooth_term"
    price: ClassVar[float] = 6.0  # of having no name: of equals, a declared effect is preferred
    settings: ClassVar[tuple] = ("channel", "covariate", "form", "knots", "shape")
    unit: ClassVar[str] = "m, rad/s or m/s^2"
    bound: ClassVar[float] = 100.0
    negligible: ClassVar[float] = 0.0
    typical: ClassVar[float] = 0.1
    physics: ClassVar[str] = "unknown: what is left when the declared effects are taken out"
    reference: ClassVar[str] = "found in residuals by diagnose"
    fitted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.covariate in OLD_NAMES:
            warnings.warn(
                (
                    f"effects: smooth_term: covariate {self.covariate} is now "
                    f"{OLD_NAMES[self.covariate]}"
                ),
                FutureWarning,
                stacklevel=2,
            )
            self.covariate = OLD_NAMES[self.covariate]
        try:
            self.knots = tuple(float(knot) for knot in self.knots)
        except (TypeError, ValueError):
            self.knots = ()
        if len(self.knots) < 2 or not (np.diff(self.knots) > 0.0).all():
            raise InputError(
                f"effects: smooth_term: knots: {self.knots!r} are not two or more rising numbers."
            )
        known: dict[str, tuple[str, ...]] = {"tdoa": (*OF_TDOA, *OF_ARRIVAL)}
        known |= {
            channel: (*(name for name in OF_TDOA if name not in OF_MOTION), *OF_ARRIVAL)
            for channel in RADIO
            if channel != "tdoa"
        }
        known |= dict.fromkeys(IMU_CHANNELS, tuple(dict.fromkeys((*OF_IMU, *OF_AIDS))))
        known |= dict.fromkeys(AID_CHANNELS, OF_AIDS)
        extra = self.covariate.startswith(EXTRA) and self.channel not in AID_CHANNELS
        if (
            self.form not in FORMS
            or self.channel not in known
            or not (extra or self.covariate in known[self.channel])
        ):
            remedy = f"channels are {listed(known)}"
            if self.channel in known:
                remedy = (
                    f"forms are {listed(FORMS)}, covariates of this channel "
                    f"{listed(known[self.channel])}"
                )
            raise InputError(
                f"effects: smooth_term: no {self.form!r} function of {self.covariate!r} acts "
                f"on {self.channel!r}; {remedy}."
            )
        if self.shape != "spline" and SHAPES.get(self.shape, (0,))[0] != len(self.knots):
            shapes = ", ".join(f"{shape} ({count})" for shape, (count, _) in SHAPES.items())
            raise InputError(
                f"effects: smooth_term: shape: {self.shape!r} with {len(self.knots)} knots is "
                "not spline or one of "
                f"{shapes}."
            )
        if self.form in OF_LINKS and self.channel in RADIO and RADIO[self.channel].ends < 2:
            raise InputError(
                f"effects: smooth_term: form: {self.form} acts on two anchors, {self.channel} "
                "is of one; write form: anchor."
            )
        if self.form in OF_LINKS and self.covariate in OF_ARRIVAL:
            raise InputError(
                f"effects: smooth_term: form: {self.form} acts on both anchors, "
                f"{self.covariate} is of one; write form: anchor."
            )
        super().__post_init__()

    @classmethod
    def plausible(cls, values: dict[str, float]) -> bool:
        return True

    @classmethod
    def check_key(cls, key: str) -> None:
        if not key.rpartition(".")[2].removeprefix("c").isdigit():
            raise InputError(
                f"effects: smooth_term: parameter {key!r} is not a coefficient such as c0 or 3.c0."
            )

    # In other effects the following are of the class; here they follow from the settings of each
    # term.
    def typical_of(self, key: str) -> float:  # type: ignore[override]  # of a term
        if self.shape != "spline" or self.form in OF_LINKS:
            return (
                ALONE
                if self.channel in RADIO
                else TYPICAL.get(self.channel.partition(".")[0], self.typical)
            )
        return (
            0.5 * self.typical if "." in key else self.typical
        )  # a function for each anchor: many, hence small

    @property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]  # of a term
        """Where it acts."""
        return (self.channel.partition(".")[0],)

    def label_of(self, keys: Iterable[str]) -> str:
        parts = list(dict.fromkeys(key.rpartition(".")[0] for key in keys))
        of = f" of {self.form} {parts[0]}" if len(parts) == 1 and parts[0] else ""
        return f"{self.channel}{of} over {self.covariate}"

    @property
    def covariates(self) -> tuple[str, ...]:  # type: ignore[override]  # of a term
        return (self.covariate,) if bounded(self.covariate) else ()

    @property
    def uses_attitude(self) -> bool:  # type: ignore[override]  # of a term
        return self.covariate.endswith("_in_tag") or self.covariate == "tilt"

    @property
    def states(self) -> tuple[int, ...]:
        return STATES.get(self.covariate, ()) if self.channel == "tdoa" else ()

    @property
    def needs_motion(self) -> bool:  # type: ignore[override]  # of a term
        return self.channel == "tdoa" and self.covariate in OF_MOTION

    @property
    def usable(self) -> bool:  # type: ignore[override]  # of a term
        """Whether the nodes, and the filter off line, have the covariate at hand."""
        if self.channel in RADIO:
            return self.covariate in (*OF_TDOA, *OF_ARRIVAL) and self.covariate != "vibration"
        return self.channel in IMU_CHANNELS and self.covariate in (*OF_IMU, *OF_STATE)

    def keys(self, anchors: Anchors | None = None) -> tuple[str, ...]:
        """All coefficients: of every anchor for the form "anchor"."""
        return (
            self.keys_of(known_anchors(anchors)) if self.form == "anchor" else self.keys_of(("",))
        )

    def keys_of(self, parts: Iterable[str]) -> tuple[str, ...]:
        """All coefficients of some anchors "3" or pairs "0-1": tuple."""
        return tuple(f"{part}.c{k}".lstrip(".") for part in parts for k in range(self.count))

    def basis(self, values: ArrayLike) -> np.ndarray:
        """The functions that the coefficients c0, c1, ... multiply, at covariate values (n,): (n,
        k), NaN stays NaN.
        """
        values = np.asarray(values, dtype=float)
        if self.shape != "spline":
            return functions(self.shape, self.knots, values)
        if self.covariate in CATEGORIES:
            return (values[:, None] == self._at).astype(float)
        out = np.zeros((len(values), self.count))
        _basis(self._at, values, out)
        return out

    def curve(self, values: np.ndarray, prefix: str = "") -> np.ndarray:
        """The function at covariate values (n,): (n,). prefix : "3." for that of anchor 3 of the
        form "anchor".
        """
        weights = np.array([[self.values.get(f"{prefix}c{k}", 0.0) for k in range(self.count)]])
        return self._functions(values, weights, np.zeros(len(values), dtype=np.int64))

    def spread(self, values: np.ndarray, prefix: str = "") -> np.ndarray:
        """Standard deviation of what `curve` gives beside a level, (n,), as if its coefficients
        were independent.
        """
        std = np.array([self.std.get(f"{prefix}c{k}", 0.0) for k in range(self.count)])
        std[0] *= self.shape == "spline"  # else the level
        return np.sqrt(self.basis(values) ** 2 @ std**2)

    @cached_property
    def _at(self) -> np.ndarray:
        return np.array(self.knots, dtype=float)

    @property
    def count(self) -> int:
        """Coefficients of each function."""
        if self.shape != "spline":
            return SHAPES[self.shape][1]
        return len(self.knots) if self.covariate in CATEGORIES else len(self.knots) + DEGREE - 1

    def _functions(self, values: np.ndarray, weights: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Functions with weights (m, k) at values (n,), each that of its row (n,): (n,)."""
        if self.shape != "spline" or self.covariate in CATEGORIES:
            return np.einsum("nk,nk->n", self.basis(values), weights[rows])
        out = np.empty(len(values))
        _curves(self._at, np.asarray(values, dtype=float), weights, rows, out)
        return out

    @once_per_anchors
    def _weights(self, anchors: Anchors) -> np.ndarray:
        """Coefficients of every anchor's function, (m, k); zero for an anchor without one."""
        prefixes = [f"{i}." if self.form == "anchor" else "" for i in known_anchors(anchors)]
        return np.array(
            [
                [self.values.get(f"{prefix}c{k}", 0.0) for k in range(self.count)]
                for prefix in prefixes
            ]
        )

    def _covariate(self, samples: Samples) -> tuple[Any, np.ndarray | None]:
        """(values per TDOA or None, values per arrival or None)"""
        if self.covariate in OF_ARRIVAL:
            return None, OF_ARRIVAL[self.covariate](samples, samples.rows)
        if self.covariate in OF_TDOA:
            values = OF_TDOA[self.covariate](samples)
        else:
            values = (samples.extra or {}).get(self.covariate.removeprefix(EXTRA))
        return values, None if values is None else tile(samples, values)

    def bias(self, samples: Samples) -> np.ndarray:
        n = len(samples)
        values, both = self._covariate(samples)
        if self.channel != samples.channel or both is None:
            return np.zeros(n)
        if self.form == "common":
            return self.curve(values)
        if self.form in OF_LINKS:
            links = dict.fromkeys(key.rpartition(".")[0] for key in self.values)
            return sum(
                (self._of_link(samples, link) * self.curve(values, f"{link}.") for link in links),
                np.zeros(n),
            )
        return samples.difference(
            self._functions(both, self._weights(samples.anchors), samples.rows)
        )

    def _of_link(self, samples: Samples, link: str) -> np.ndarray:
        """By how much the function of the pair "0-1" counts in each d_ab: (n,) 1, -1 or 0."""
        ids, (first, second) = samples.anchors.ids, map(int, link.split("-"))
        a, b = ids[samples.a], ids[samples.b]
        forth = 1.0 * ((a == first) & (b == second))
        return forth - ((a == second) & (b == first)) if self.form == "pair" else forth

    def sensor_bias(self, channel: str, features: np.ndarray) -> np.ndarray | None:
        if channel not in self.channels or self.covariate not in OF_IMU:
            return None
        out, values = np.zeros((len(features), 3)), features[:, OF_IMU.index(self.covariate)]
        out[:, self._axis] = self._faded_curve(values)
        return out

    def _faded_curve(self, values: np.ndarray) -> np.ndarray:
        """`curve`, faded where it was not seen."""
        limits = self.domain.get(self.covariate)
        return self.curve(values) if limits is None else self.curve(values) * share(values, limits)

    def sensor_functions(self) -> tuple[SensorFunction, ...]:
        if self.channel not in IMU_CHANNELS or self.covariate not in OF_STATE:
            return ()
        low, high = self.domain.get(self.covariate, (self.knots[0], self.knots[-1]))
        beyond = GONE * (high - low) if self.domain else 0.0
        periodic = self.shape == "wave" and not self.domain
        return (
            SensorFunction.of(
                self._faded_curve,
                self.channel,
                self.covariate,
                low - beyond,
                high + beyond,
                periodic,
            ),
        )

    @property
    def _axis(self) -> int:
        """Place of its axis in what the sensor reads."""
        return "xyz".index(self.channel.partition(".")[2] or "x")

    def uncorrected(self, samples: ImuSamples | AidSamples) -> np.ndarray | float:
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
        values, both = self._covariate(samples)
        if self.channel != samples.channel or both is None:
            return out
        if self.form == "common":
            return self.basis(values)[:, [int(key[1:]) for key in keys]]
        if self.form in OF_LINKS:
            basis = self.basis(values)
            parts = [
                (basis[:, int(c[1:])], link) for link, _, c in (key.rpartition(".") for key in keys)
            ]
            return np.stack([part * self._of_link(samples, link) for part, link in parts], axis=1)
        basis, ids = self.basis(both), samples.anchors.ids[samples.rows]
        for column, key in enumerate(keys):
            anchor, _, c = key.rpartition(".")
            out[:, column] = samples.difference(
                basis[:, int(c[1:])] * (1.0 if not anchor else ids == int(anchor))
            )
        return out

    def groups(  # type: ignore[override]  # of a term
        self, anchors: Anchors | None, pairs: np.ndarray | None
    ) -> list[tuple[str, ...]]:
        keys = self.keys(anchors)
        each = dict.fromkeys(key.rpartition(".")[0] for key in keys)
        alone = [tuple(key for key in keys if key.rpartition(".")[0] == name) for name in each]
        return [keys, *alone] if self.form == "anchor" else [keys]

    def advice(self) -> tuple[str, ...]:
        return sentences(self)


@compiled
def _pieces(knots: np.ndarray, value: float) -> tuple[int, float, float, float]:
    """(number of the first of three quadratic B-splines that are not zero at a value, held at the
    ends of the knots, and their values): de Boor's recursion with clamped ends.
    """
    last = len(knots) - 1
    if not value > knots[0]:
        value = knots[0] if value == value else value  # NaN stays NaN
    elif value > knots[last]:
        value = knots[last]
    piece = 0
    while piece < last - 1 and value >= knots[piece + 1]:
        piece += 1
    left, right = knots[piece], knots[piece + 1]
    before = knots[piece - 1] if piece > 0 else knots[0]
    after = knots[piece + 2] if piece + 2 <= last else knots[last]
    up, down = (value - left) / (right - left), (right - value) / (right - left)
    rise, fall = (value - before) / (right - before), (after - value) / (after - left)
    first = (1.0 - rise) * down
    third = (1.0 - fall) * up
    return piece, first, 1.0 - first - third, third


@compiled
def _basis(knots: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(values)):
        piece, first, second, third = _pieces(knots, values[i])
        out[i, piece], out[i, piece + 1], out[i, piece + 2] = first, second, third


@compiled
def _curves(
    knots: np.ndarray, values: np.ndarray, weights: np.ndarray, rows: np.ndarray, out: np.ndarray
) -> None:
    for i in range(len(values)):
        piece, first, second, third = _pieces(knots, values[i])
        w = weights[rows[i]]
        out[i] = first * w[piece] + second * w[piece + 1] + third * w[piece + 2]
