"""Takes the effects out of heights, pressures and velocities, and of their stamps, at once or one by one."""

import numpy as np

from ..foundation.flight import AIDS
from .affine import IDENTITY

UNKNOWN = 1e6  # standard deviation at which and above nothing was measured


class AidCorrector:
    """Undoes the effects of a set in the order in which they are listed."""

    def __init__(self, effects):
        """effects : iterable of Effect; those that do not act on these streams are passed over."""
        self._late = {stream: sum(effect.stamp_offset(stream) for effect in effects) for stream in AIDS}
        self._undo = {stream: self._inverse(effects, stream) for stream in AIDS}
        self.idle = not any(self._late.values()) and not any(self._undo.values())

    @staticmethod
    def _inverse(effects, stream):
        undo = None
        for effect in effects:
            model = effect.sensor_model(stream)
            if model is not IDENTITY:
                undo = model.inverse() if undo is None else model.inverse().after(undo)
        return undo

    def correct(self, stream, t, values, std=None):
        """t (n,) s; values (n,) or (n, 3), std as of the stream of a Flight. Returns what is given, corrected: a list."""
        undo, t = self._undo[stream], t - self._late[stream]
        if std is None:
            return [t, values if undo is None else undo(values[:, None])[:, 0]]
        if undo is None:
            return [t, values, std]
        known = np.isfinite(std)  # what was not measured may be anything
        variance = np.where(known, std, UNKNOWN) ** 2 @ undo.matrix.T**2
        return [t, undo(np.where(known, values, 0.0)), np.where(variance < UNKNOWN, np.sqrt(variance), np.inf)]
