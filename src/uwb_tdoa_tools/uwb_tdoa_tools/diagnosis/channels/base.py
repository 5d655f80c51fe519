# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channel, a kind of measurement, and its residual in a flight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.effects import (
    Effect,
    EffectSet,
    ImuSamples,
    Samples,
    SensorSamples,
    SmoothTerm,
    Track,
)
from uwb_tdoa_bias.effects.samples import OF_IMU, ImuFeatures

from ..references import Reference, ReferenceView
from ..regression.algebra import Matrix
from .views import CovariateView

FEWEST_ATTITUDES = 10  # fewest poses with an attitude, for a reference with known attitude
# of the health of channels: {"pairs", "anchors", "axes", ...: rows}
Figures = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Comparison:
    """A flight and its reference.

    flight : Flight with streams corrected by `effects`; view : ReferenceView
    span : (first, last) s, the part that counts
    """

    flight: Flight
    reference: Reference
    effects: EffectSet
    view: ReferenceView
    span: tuple[float, float]

    @classmethod
    def of(
        cls,
        flight: Flight,
        reference: Reference,
        effects: EffectSet,
        span: tuple[float, float] | None = None,
    ) -> Comparison:
        """Return the Comparison of a prepared Flight with a Reference.

        span : of another Comparison of the flight, None to compute it
        """
        view = reference.view(flight, effects)
        corrected = effects.correct_streams(replace(flight, truth=None))
        return cls(corrected, reference, effects, view, span or reference.span(flight, view.poses))

    @property
    def poses(self) -> Truth:
        """Return the known or estimated poses."""
        return self.view.poses

    @property
    def attitude_known(self) -> bool:
        """Return whether the reference has attitudes of more than a few poses."""
        return bool(
            self.reference.attitude_known
            and np.isfinite(self.poses.q).all(axis=1).sum() > FEWEST_ATTITUDES
        )

    @cached_property
    def track(self) -> Track:
        """Return the interpolated poses."""
        return Track(self.poses)

    @cached_property
    def imu_features(self) -> np.ndarray:
        """Return the covariates OF_IMU along the inertial stream, (n, len(OF_IMU))."""
        imu = self.flight.imu
        assert imu is not None  # as the callers know
        return ImuFeatures()(imu.t, imu.gyro, imu.accel)

    def vibration_at(self, t: np.ndarray) -> np.ndarray | None:
        """Return the vibration, (n,) m/s^2, at stamps t (n,), s; None without an IMU."""
        imu = self.flight.imu
        if imu is None:
            return None
        return np.interp(t, imu.t, self.imu_features[:, OF_IMU.index("vibration")])

    @property
    def start(self) -> float:
        """Return the stamp, s, of the origin of drifts."""
        return self.flight.start


@dataclass(frozen=True)
class Rows:
    """The m rows of a linear fit.

    y : (m,) residual; axis : (m,) int, 0 to 2, of the sensor
    series : (m,) int, number of the time series of a row; t : (m,) s since the start
    count : (m,) averaged samples; place : (m, 3) m, world
    """

    y: np.ndarray
    axis: np.ndarray
    series: np.ndarray
    t: np.ndarray
    count: np.ndarray
    place: np.ndarray


class ChannelResidual:
    """The residual of a channel in one flight: measured minus predicted at the reference.

    samples : Samples, ImuSamples or SensorSamples, the input of effects
    residual : one per sample
    """

    samples: Samples | ImuSamples | SensorSamples
    residual: np.ndarray

    def of_floor(self) -> ChannelResidual | None:
        """Return the ChannelResidual near the floor, which its rows leave out, or None."""
        return None

    def rows(self) -> Rows:
        """Return the Rows of a fit."""
        raise NotImplementedError

    def columns(self, effect: Effect, keys: Sequence[str]) -> Matrix:
        """Return regressors of the parameters `keys`, averaged as rows are, (m, len(keys)).

        They are sparse if few are not zero.
        """
        raise NotImplementedError

    def covariate(self, name: str) -> np.ndarray | None:
        """Return values (n,) of a covariate of the fitted measurements; None if unknown.

        name : of OF_TDOA, OF_ARRIVAL or OF_IMU, or "extra.STREAM.COLUMN"
        """
        raise NotImplementedError

    def place_in_room(self, series: int) -> str:
        """Return the pair or anchor of a series number of Rows; "" for the vehicle."""
        return ""

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return {label with unit: (t (k,) s, residual (k,))} for plots and figures."""
        raise NotImplementedError


ChannelResiduals = dict[str, ChannelResidual]  # of one flight, by the name of the channel


# m, smallest width of a domain of heights of a function of something else: errors of the place
# change over such a distance
HEIGHTS = 1.0


class Seen:
    """Ranges of covariates in the residuals of some flights, computed on demand."""

    def __init__(self, residuals: Sequence[ChannelResiduals]) -> None:
        """Take [{channel: ChannelResidual}], one dict per flight."""
        self._residuals = residuals
        self._ranges: dict[tuple[int, str, str], list[float]] = {}

    def limited(
        self, effects: Iterable[Effect], flights: Sequence[int] | None = None
    ) -> list[Effect]:
        """Return Effects with their domain: the range of each covariate in some flights.

        Effects without covariates, and effects with a domain, stay unchanged.

        flights : their numbers; all by default
        """
        numbers = range(len(self._residuals)) if flights is None else flights
        return [
            effect if effect.domain else replace(effect, domain=self._domain(effect, numbers))
            for effect in effects
        ]

    def _domain(self, effect: Effect, numbers: Sequence[int]) -> dict[str, tuple[float, float]]:
        out = {}
        for covariate in effect.covariates:
            ends = []
            for number in numbers:
                for channel in effect.channels:
                    ends += self._range(number, channel, covariate)
            if not ends:
                continue
            low, high = min(ends), max(ends)
            if covariate == "height" and effect.covariates[0] != covariate:
                more = max(0.5 * (HEIGHTS - (high - low)), 0.0)
                low, high = float(f"{low - more:.6g}"), float(f"{high + more:.6g}")
            out[covariate] = low, high
        return out

    def _range(self, number: int, channel: str, covariate: str) -> list[float]:
        """Return [least, largest] of a covariate in a channel of a flight; [] if unknown."""
        key = number, channel, covariate
        if key not in self._ranges:
            part = self._residuals[number].get(channel)
            values = None if part is None else part.covariate(covariate)
            known = np.empty(0) if values is None else values[np.isfinite(values)]
            ends = [known.min(), known.max()] if len(known) else []
            self._ranges[key] = [float(f"{end:.6g}") for end in ends]
        return self._ranges[key]


Own = TypeVar("Own", bound=ChannelResidual)


class Channel(Generic[Own]):
    """A kind of measurement; CHANNELS lists all channels."""

    name: str
    unit: str
    negligible: float  # RMS, in `unit`, below which a contribution gets no term
    needs: str  # streams and truth that it needs, in words
    stream: str = ""  # field of a Flight; "" for its name
    maps: ClassVar[
        tuple[str, ...]
    ] = ()  # covariates whose functions, each too weak alone, are tried together

    def residual(self, comparison: Comparison) -> Own | None:
        """Return the ChannelResidual of a Comparison; None if the flight or reference lacks it."""
        raise NotImplementedError

    def smooth_terms(self, residuals: Sequence[Own]) -> list[SmoothTerm]:
        """Return SmoothTerms without values, the functions that `diagnose` tries."""
        return []

    def views(self, residuals: Sequence[Own]) -> list[CovariateView]:
        """Return CovariateViews of the rows of some flights, for the scan."""
        return []

    def health(self, residuals: Sequence[Own]) -> Figures:
        """Return figures of health of some flights: {"pairs", "anchors" or "axes": rows}."""
        return {}
