"""What the effects on stamps share: a stream is stamped some seconds after the instant it was taken
at.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from .aid_error import need_stream
from .base import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.flight import Flight
    from .samples import AidSamples, Samples


class StampEffect(Effect):
    """An effect on the stamps of one stream.

    Subclasses say which, by its name in a Flight, and what to do about it.
    """

    unit = "s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "offset"
    stream: ClassVar[str]
    remedy: ClassVar[str]  # a sentence, {} for by how much the stamps are late or early

    def stamp_offset(self, stream: str) -> float:
        return self.values.get("offset", 0.0) if stream == self.stream else 0.0

    def regressors(self, samples: Samples | AidSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(-samples.change[..., None], len(keys), axis=-1)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        need_stream(self, flight, self.stream)
        return shifted(flight, self.stream, self.stamp_offset(self.stream))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("offset", "late", "early", "ms", 1e3)
        return (self.remedy.format(off),) if off else ()


def shifted(flight: Flight, stream: str, seconds: float) -> Flight:
    """The Flight with `seconds` added to the stamps of a stream, which may be missing."""
    part = getattr(flight, stream)
    return (
        flight
        if part is None or not seconds
        else replace(flight, **{stream: replace(part, t=part.t + seconds)})
    )
