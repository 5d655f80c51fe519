"""The way from the sensors to the estimate: it takes time, the same for all streams and more for
some messages.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uwb_tdoa_ekf.results import concatenated, rows_of

from .simulator import SensorReadings


class Transport:
    """Holds what was measured until it arrives; within a stream nothing overtakes."""

    def __init__(self, latency: float, jitter: float, rng: np.random.Generator) -> None:
        """latency : s, of everything; jitter : s, mean of what comes on top; rng : numpy Generator."""
        self._latency, self._jitter, self._rng = latency, jitter, rng
        # by stream: (what waits, when it arrives (n,) s, the last arrival)
        self._waiting: dict[str, tuple[Any, np.ndarray, float]] = {}

    def arrived(self, measured: SensorReadings, now: float) -> SensorReadings:
        """SensorReadings that have arrived by `now`, s, after more of them were sent."""
        if not self._latency and not self._jitter:
            return measured
        parts = {stream: self._due(stream, part, now) for stream, part in measured.streams.items()}
        return SensorReadings(parts.pop("imu"), parts.pop("tdoa"), parts)

    def _due(self, stream: str, part: Any, now: float) -> Any:
        held, arrival, last = self._waiting.get(stream, (None, np.empty(0), 0.0))
        delay = (
            self._latency + self._rng.exponential(self._jitter, len(part))
            if self._jitter
            else np.full(len(part), self._latency)
        )
        came = np.maximum.accumulate(np.maximum(part.t + delay, last))
        part = part if held is None else concatenated([held, part])
        arrival = np.concatenate([arrival, came])
        due = int(np.searchsorted(arrival, now, side="right"))
        self._waiting[stream] = (
            rows_of(part, slice(due, None)),
            arrival[due:],
            came[-1] if len(came) else last,
        )
        return rows_of(part, slice(0, due))
