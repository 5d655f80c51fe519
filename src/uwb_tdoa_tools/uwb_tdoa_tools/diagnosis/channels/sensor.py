# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels of sensors that measure along axes: auxiliary sensors, and what inertial ones share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.common.sensors import COMPARED, STREAM_OF, measured_on
from uwb_tdoa_bias.effects import Effect, ImuSamples, SensorSamples, SmoothTerm, sensor_samples
from uwb_tdoa_bias.effects.samples import OF_SENSORS, sensor_covariate

from .base import Channel, ChannelResidual, Comparison, Figures, Rows
from .figures import figures
from .views import knots_of

CELL = 0.25  # s, length of a cell; both sides of a residual are averaged over it
FEWEST_CELLS = 8  # fewest cells of a residual


@dataclass(frozen=True)
class AxesResidual(ChannelResidual):
    """Residual (n, k) of samples of cells, NaN where an axis was not measured.

    labels : of its k axes; unit : of the channel
    floating : whether a constant has no meaning: rows and columns are without their mean
    """

    samples: ImuSamples | SensorSamples
    residual: np.ndarray
    labels: tuple[str, ...]
    unit: str
    floating: bool = False

    @property
    def _known(self) -> np.ndarray:
        return np.isfinite(self.residual.T.ravel())

    def rows(self) -> Rows:
        samples, known = self.samples, self._known
        n, k = self.residual.shape
        y = self.residual.T.ravel()[known]
        axis = np.repeat(np.arange(k), n)[known]
        t = np.tile(samples.t - samples.start, k)[known]
        place = np.tile(samples.p, (k, 1))[known]
        return Rows(self._free(y), axis, axis, t, np.ones(len(y)), place)

    def columns(self, effect: Effect, keys: Sequence[str]) -> np.ndarray:
        values = effect.regressors(self.samples, list(keys))
        return self._free(values.transpose(1, 0, 2).reshape(-1, len(keys))[self._known])

    def covariate(self, name: str) -> np.ndarray | None:
        return sensor_covariate(name, self.samples)

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        out = {}
        for label, column in zip(self.labels, self.residual.T):
            measured = np.isfinite(column)  # optical flow measures no vertical velocity
            if measured.any():
                out[f"{label} [{self.unit}]"] = self.samples.t[measured], column[measured]
        return out

    def _free(self, values: np.ndarray) -> np.ndarray:
        return values - values.mean(axis=0) if self.floating else values


class AxesChannel(Channel[AxesResidual]):
    """The channel of a sensor that measures along axes, which end the names of its functions."""

    axes: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the names of its axes."""
        return tuple(self.name + axis for axis in self.axes)

    def covariates(self, residuals: Sequence[AxesResidual]) -> Sequence[str]:
        """Return the covariates on which its residual may depend."""
        raise NotImplementedError

    def smooth_terms(self, residuals: Sequence[AxesResidual]) -> list[SmoothTerm]:
        out = []
        for name in self.covariates(residuals):
            knots = knots_of(name, [part.covariate(name) for part in residuals])
            if knots is None:
                continue
            for label in self.labels:
                out.append(SmoothTerm(channel=label, covariate=name, knots=knots))
        return out

    def health(self, residuals: Sequence[AxesResidual]) -> Figures:
        columns = np.concatenate([part.residual for part in residuals]).T
        known = {label: some[np.isfinite(some)] for label, some in zip(self.labels, columns)}
        return {"axes": [{"axis": label, **figures(r)} for label, r in known.items() if len(r)]}


class Sensor(AxesChannel):
    """Channel of an auxiliary sensor, or of a part, with the fields of its Compared."""

    positions: tuple[int, ...]
    of_attitude: bool
    floating: bool

    def __init__(self, name: str) -> None:
        self.name = name
        self.stream = STREAM_OF[name]
        vars(self).update(vars(COMPARED[name]))

    def covariates(self, residuals: Sequence[AxesResidual]) -> Sequence[str]:
        return OF_SENSORS

    def residual(self, comparison: Comparison) -> AxesResidual | None:
        part, reference = measured_on(comparison.flight, self.name), comparison.reference
        known = all(reference.positions_known[k] for k in self.positions)
        if part is None or not known or (self.of_attitude and not comparison.attitude_known):
            return None
        poses, (first, last) = comparison.poses, comparison.span
        inside = (part.t >= max(first, poses.t[0])) & (part.t <= min(last, poses.t[-1]))
        measured = np.isfinite(part.values) & np.isfinite(getattr(part, "std", 0.0))
        t, values = part.t[inside], np.where(measured, part.values, np.nan)[inside]
        cell = np.unique((t / CELL).astype(int), return_inverse=True)[1]
        if not len(t) or cell.max() < FEWEST_CELLS:
            return None
        track, start = comparison.track, comparison.start
        error = values - sensor_samples(self.name, t, track, start).reading
        edges = np.flatnonzero(np.diff(cell)) + 1
        middles = np.array([some.mean() for some in np.split(t, edges)])
        error = np.stack([_median(some) for some in np.split(error, edges)])
        vibration = comparison.vibration_at(middles)
        samples = sensor_samples(self.name, middles, track, start, vibration)
        error = error - comparison.effects.uncorrected(samples)
        return AxesResidual(samples, error, self.labels, self.unit, self.floating)


def _median(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values).any(axis=0)
    return np.where(known, np.nanmedian(np.where(known, values, 0.0), axis=0), np.nan)
