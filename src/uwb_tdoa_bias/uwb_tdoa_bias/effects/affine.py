"""What a sensor makes of the truth: a matrix and an offset."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Affine:
    """x -> matrix x + offset, for (n, k) rows."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, x):
        return x @ self.matrix.T + self.offset

    def after(self, first):
        """The map that applies `first`, then this one."""
        return Affine(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self):
        """The map that undoes this one."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.offset)


IDENTITY = Affine(np.eye(3), np.zeros(3))


def regressors(effect, samples, keys):
    """Derivative of what the `sensor_model` of an Effect makes of `samples.reading` (n, k) by the parameters `keys`:
    (n, k, len(keys)); numerical."""
    step, out = 1e-6, np.empty((*samples.reading.shape, len(keys)))
    for column, key in enumerate(keys):
        here = effect.values.get(key, 0.0)
        ends = [
            type(effect)({**effect.values, key: here + s}).sensor_model(samples.channel)(samples.reading)
            for s in (-step, step)
        ]
        out[:, :, column] = (ends[1] - ends[0]) / (2.0 * step)
    return out
