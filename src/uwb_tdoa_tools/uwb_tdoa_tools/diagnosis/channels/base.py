"""What a channel is, and what it makes of a flight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from uwb_tdoa_bias.effects import EffectSet, Track
from uwb_tdoa_bias.foundation.flight import Flight

from ..references import Reference, ReferenceView

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects import AidSamples, Effect, ImuSamples, Samples, SmoothTerm
    from uwb_tdoa_bias.foundation.flight import Truth

    from ..regression.algebra import Matrix
    from .views import CovariateView

FEWEST_ATTITUDES = 10
Figures = dict[
    str, list[dict[str, Any]]
]  # of the health of channels: {"pairs", "anchors", "axes", ...: rows}


@dataclass(frozen=True)
class Comparison:
    """A flight beside its reference.

    flight : Flight, its streams corrected by `effects`; view : ReferenceView; span : (first, last)
        s of what counts.
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
        """Comparison of a prepared Flight with a Reference. span : as another Comparison of it has
        found.
        """
        view = reference.view(flight, effects)
        corrected = effects.correct_streams(replace(flight, truth=None))
        return cls(corrected, reference, effects, view, span or reference.span(flight, view.poses))

    @property
    def poses(self) -> Truth:
        """Truth: where the flight was, or is believed to have been."""
        return self.view.poses

    @property
    def attitude_known(self) -> bool:
        """Whether the reference knows attitudes, and of more than a few poses."""
        return bool(
            self.reference.attitude_known
            and np.isfinite(self.poses.q).all(axis=1).sum() > FEWEST_ATTITUDES
        )

    @cached_property
    def track(self) -> Track:
        """The poses, to be asked at any stamp."""
        return Track(self.poses)

    @property
    def start(self) -> float:
        """Stamp, s, from which slow changes count."""
        return self.flight.start


@dataclass(frozen=True)
class Rows:
    """m rows of a linear fit: y (m,); axis (m,) int, 0 to 2, of the sensor; series (m,) int, what
    is one series in time; t (m,) s since the start; count (m,) samples averaged; place (m, 3) m,
    world.
    """

    y: np.ndarray
    axis: np.ndarray
    series: np.ndarray
    t: np.ndarray
    count: np.ndarray
    place: np.ndarray


class ChannelResidual:
    """The residual of a channel in one flight: measured minus what the model says at the poses of
    the reference.

    Subclasses hold `samples`, what effects take (Samples, ImuSamples), and `residual`, one per
    sample.
    """

    samples: Samples | ImuSamples | AidSamples
    residual: np.ndarray

    def of_floor(self) -> ChannelResidual | None:
        """The ChannelResidual of what is near the floor, which is not among its rows; None if there
        is no telling of it.
        """
        return None

    def rows(self) -> Rows:
        """Rows for a fit."""
        raise NotImplementedError

    def columns(self, effect: Effect, keys: Sequence[str]) -> Matrix:
        """Regressors of an Effect for the parameters `keys`, averaged as the rows are: (m,
        len(keys)), sparse where few are not zero.
        """
        raise NotImplementedError

    def covariate(self, name: str) -> np.ndarray | None:
        """Values (n,) of a covariate, of OF_TDOA, OF_ARRIVAL or OF_IMU, or "extra.STREAM.COLUMN",
        at what is looked at; None where it is not known.
        """
        raise NotImplementedError

    def place_in_room(self, series: int) -> str:
        """What a series number of Rows is of in the room, such as a pair of anchors; "" if it is of
        the vehicle.
        """
        return ""

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """{label with unit: (t (k,) s, residual (k,))}, to be plotted and judged."""
        raise NotImplementedError


ChannelResiduals = dict[str, ChannelResidual]  # of one flight, by the name of the channel
Own = TypeVar("Own", bound=ChannelResidual)


class Channel(Generic[Own]):
    """A kind of measurement. One channel, one file: subclass it and list it in CHANNELS."""

    name: str
    unit: str
    negligible: float  # root mean square, in `unit`, of a contribution that is not worth a term
    needs: str  # what a recording must hold for it, in words
    stream: str = ""  # attribute of a Flight that it is of; "" for its name
    maps: ClassVar[
        tuple[str, ...]
    ] = ()  # covariates whose functions, each too weak alone, are tried together

    def residual(self, comparison: Comparison) -> Own | None:
        """ChannelResidual of a Comparison; None if the flight or its reference does not show this
        channel.
        """
        raise NotImplementedError

    def smooth_terms(self, residuals: Sequence[Own]) -> list[SmoothTerm]:
        """SmoothTerms without values: whatever the ChannelResiduals of some flights may depend on."""
        return []

    def views(self, residuals: Sequence[Own]) -> list[CovariateView]:
        """[CovariateView] of the rows of the ChannelResiduals of some flights: what a part of them
        may depend on.
        """
        return []

    def health(self, residuals: Sequence[Own]) -> Figures:
        """{"pairs", "anchors", "axes" or "cross_correlation": [dict of figures]} of the
        ChannelResiduals of some flights.
        """
        return {}
