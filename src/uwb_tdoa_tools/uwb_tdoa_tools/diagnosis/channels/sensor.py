# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Channels of auxiliary sensors and their parts: residuals of their medians over cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.sensors import COMPARED, STREAM_OF, measured_on
from uwb_tdoa_bias.effects import SensorSamples, SmoothTerm, sensor_samples
from uwb_tdoa_bias.effects.covariates import OF_SENSORS, sensor_covariate

from .base import Channel, ChannelResidual, Rows
from .figures import APART, figures
from .inertial import CELL
from .views import knots_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.sensors import Stream
    from uwb_tdoa_bias.effects import Effect

    from .base import Comparison, Figures

FEWEST_CELLS = 8  # fewest cells of a residual


@dataclass(frozen=True)
class SensorResidual(ChannelResidual):
    """Residual (n, k) of SensorSamples of cells, NaN where an axis was not measured.

    labels : of its k axes; unit : of the channel
    floating : whether a constant has no meaning: rows and columns are without their mean
    """

    samples: SensorSamples
    residual: np.ndarray
    labels: tuple[str, ...]
    unit: str
    floating: bool

    @property
    def _known(self) -> np.ndarray:
        return np.isfinite(self.residual.T.ravel())

    def rows(self) -> Rows:
        samples, (n, k), known = self.samples, self.residual.shape, self._known
        y, t = self.residual.T.ravel()[known], np.tile(samples.t - samples.start, k)[known]
        place = np.tile(samples.p, (k, 1))[known]
        axis = np.repeat(np.arange(k), n)[known]
        return Rows(self._free(y), axis, axis, t, np.ones(len(y)), place)

    def columns(self, effect: Effect, keys: Sequence[str]) -> np.ndarray:
        values = effect.regressors(self.samples, list(keys))
        return self._free(values.transpose(1, 0, 2).reshape(-1, len(keys))[self._known])

    def covariate(self, name: str) -> np.ndarray | None:
        return sensor_covariate(name, self.samples)

    def series(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        columns = {
            f"{label} [{self.unit}]": self.residual[:, k] for k, label in enumerate(self.labels)
        }
        out = {}
        for label, column in columns.items():
            measured = np.isfinite(column)  # optical flow measures no vertical velocity
            if measured.any():
                out[label] = self.samples.t[measured], column[measured]
        return out

    def _free(self, values: np.ndarray) -> np.ndarray:
        return values - values.mean(axis=0) if self.floating else values


class Sensor(Channel[SensorResidual]):
    """Channel of an auxiliary sensor, or of a part, with the fields of its Compared."""

    axes: tuple[str, ...]
    positions: tuple[int, ...]
    of_attitude: bool
    floating: bool

    def __init__(self, name: str) -> None:
        self.name, self.stream = name, STREAM_OF[name]
        vars(self).update(vars(COMPARED[name]))

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the names of its axes."""
        return tuple(self.name + axis for axis in self.axes)

    def residual(self, comparison: Comparison) -> SensorResidual | None:
        part, reference = measured_on(comparison.flight, self.name), comparison.reference
        known = all(reference.positions_known[k] for k in self.positions)
        if part is None or not known or (self.of_attitude and not comparison.attitude_known):
            return None
        poses, (first, last) = comparison.poses, comparison.span
        inside = (part.t >= max(first, poses.t[0])) & (part.t <= min(last, poses.t[-1]))
        t, values = part.t[inside], self._values(part)[inside]
        cell = np.unique((t / CELL).astype(int), return_inverse=True)[1]
        if not len(t) or cell.max() < FEWEST_CELLS:
            return None
        error = values - sensor_samples(self.name, t, comparison.track, comparison.start).reading
        edges = np.flatnonzero(np.diff(cell)) + 1
        middles = np.array([some.mean() for some in np.split(t, edges)])
        error = np.stack([_median(some) for some in np.split(error, edges)])
        samples = sensor_samples(
            self.name,
            middles,
            comparison.track,
            comparison.start,
            comparison.vibration_at(middles),
        )
        error = error - comparison.effects.uncorrected(samples)
        return SensorResidual(samples, error, self.labels, self.unit, self.floating)

    def smooth_terms(self, residuals: Sequence[SensorResidual]) -> list[SmoothTerm]:
        out = []
        for name in OF_SENSORS:
            if knots := knots_of(name, [part.covariate(name) for part in residuals]):
                out += [
                    SmoothTerm(channel=label, covariate=name, knots=knots) for label in self.labels
                ]
        return out

    def health(self, residuals: Sequence[SensorResidual]) -> Figures:
        out = []
        t = np.concatenate(
            [part.samples.t + APART * number for number, part in enumerate(residuals)]
        )
        for k, label in enumerate(self.labels):
            r = np.concatenate([part.residual[:, k] for part in residuals])
            known = np.isfinite(r)
            if known.any():
                out.append({"axis": label, **figures(t[known], r[known])})
        return {"axes": out}

    def _values(self, part: Stream) -> np.ndarray:
        """Return the values of a stream, (n, k), NaN where not measured."""
        values, std = part.values, getattr(part, "std", 0.0)
        return np.where(np.isfinite(values) & np.isfinite(std), values, np.nan)


def _median(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values).any(axis=0)
    return np.where(known, np.nanmedian(np.where(known, values, 0.0), axis=0), np.nan)
