"""What gyroscope and accelerometer share: residuals of means over cells, axis by axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import ImuSamples, SmoothTerm
from uwb_tdoa_bias.effects.covariates import OF_IMU, ImuFeatures, sensor_covariate

from .base import Channel, ChannelResidual, Rows
from .extra import extra_at, extra_names
from .figures import APART, figures
from .knots import knots_of
from .views import views_of_axes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects import Effect
    from uwb_tdoa_bias.foundation.flight import Imu

    from .base import Comparison, Figures
    from .views import CovariateView

CELL = 0.25  # s over which both sides of a residual are averaged
OF_POSE = (
    "x",
    "y",
    "height",
    "speed",
    "climb_rate",
    "acceleration",
)  # covariates that TDOAs have too


@dataclass(frozen=True)
class ImuResidual(ChannelResidual):
    """samples : ImuSamples, cells; residual (n, 3), body axes; unit of the channel."""

    samples: ImuSamples
    residual: np.ndarray
    unit: str

    def rows(self) -> Rows:
        samples, n = self.samples, len(self.samples)
        t, place = np.tile(samples.t - samples.start, 3), np.tile(samples.p, (3, 1))
        axis = np.repeat(np.arange(3), n)
        return Rows(self.residual.T.ravel(), axis, axis, t, np.ones(3 * n), place)

    def columns(self, effect: Effect, keys: Sequence[str]) -> np.ndarray:
        values = effect.regressors(self.samples, list(keys))
        return values.transpose(1, 0, 2).reshape(-1, len(keys))

    def covariate(self, name: str) -> np.ndarray | None:
        return sensor_covariate(name, self.samples)

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        name = self.samples.channel
        return {
            f"{name}.{axis} [{self.unit}]": (self.samples.t, self.residual[:, k])
            for k, axis in enumerate("xyz")
        }


class Inertial(Channel[ImuResidual]):
    """A channel of an inertial sensor."""

    axes: ClassVar[str] = "xyz"

    def smooth_terms(self, residuals: Sequence[ImuResidual]) -> list[SmoothTerm]:
        out = []
        for name in self._covariates(residuals):
            if knots := knots_of(name, residuals):
                out += [
                    SmoothTerm(channel=f"{self.name}.{axis}", covariate=name, knots=knots)
                    for axis in self.axes
                ]
        return out

    def views(self, residuals: Sequence[ImuResidual]) -> list[CovariateView]:
        channels, names = [f"{self.name}.{axis}" for axis in self.axes], self._covariates(residuals)
        axis = np.concatenate([np.repeat(np.arange(3), len(part.samples)) for part in residuals])
        values = {}
        for name in names:
            known = (part.covariate(name) for part in residuals)
            values[name] = np.concatenate([np.tile(one, 3) for one in known if one is not None])
        return views_of_axes(channels, values, axis)

    @staticmethod
    def _covariates(residuals: Sequence[ImuResidual]) -> tuple[str, ...]:
        return (*OF_IMU, *OF_POSE, *extra_names([part.samples for part in residuals]))

    def health(self, residuals: Sequence[ImuResidual]) -> Figures:
        t = np.concatenate(
            [part.samples.t + APART * number for number, part in enumerate(residuals)]
        )
        r = np.concatenate([part.residual for part in residuals])
        return {
            "axes": [
                {"axis": f"{self.name}.{axis}", **figures(t, r[:, k])}
                for k, axis in enumerate(self.axes)
            ]
        }

    def _samples(
        self,
        comparison: Comparison,
        t: np.ndarray,
        reading: np.ndarray,
        features: np.ndarray,
        change: np.ndarray | None = None,
    ) -> ImuSamples:
        """ImuSamples of this channel at the middles t (n,) of cells."""
        track = comparison.track
        q = track.attitudes(t)
        up = np.full((len(t), 3), [0.0, 0.0, 1.0])
        known = np.isfinite(q).all(axis=1)
        if known.any():
            up[known] = Rotation.from_quat(q[known]).inv().apply([0.0, 0.0, 1.0])
        place, motion = track.positions(t), track.motion(t)
        extra = extra_at(comparison.flight, t)
        return ImuSamples(
            self.name, t, place, comparison.start, reading, change, up, features, motion, extra
        )


def features_of(imu: Imu) -> np.ndarray:
    """Covariates OF_IMU along the stream: (n, len(OF_IMU))."""
    return ImuFeatures()(imu.t, imu.gyro, imu.accel)


def vibration_at(imu: Imu | None, t: np.ndarray) -> np.ndarray | None:
    """(n,) m/s^2 at stamps t (n,) s; None without an IMU."""
    return (
        None if imu is None else np.interp(t, imu.t, features_of(imu)[:, OF_IMU.index("vibration")])
    )


def cells_in_the_air(comparison: Comparison, imu: Imu, shift: float) -> np.ndarray:
    """Edges of the cells, s, of what counts and is covered by Imu and reference, `shift` s more at
    both ends.
    """
    poses, (first, last) = comparison.poses, comparison.span
    low = max(first, imu.t[0], poses.t[0]) + CELL + shift
    high = min(last, imu.t[-1], poses.t[-1]) - CELL - shift
    return np.arange(low, high, CELL)


def means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means of (n, k) values over the intervals between edges: the integral of the linear
    interpolation.
    """
    dt = np.diff(t)[:, None]
    total = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]) * dt, axis=0)]
    )
    at = np.stack([np.interp(edges, t, column) for column in total.T], axis=1)
    return np.diff(at, axis=0) / np.diff(edges)[:, None]
