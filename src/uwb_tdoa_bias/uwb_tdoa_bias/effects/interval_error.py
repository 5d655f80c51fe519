"""What the effects share that a stream has for a while, several times in a flight."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..foundation.errors import InputError
from .aid_error import need_stream
from .base import Effect, require_truth
from .samples import Track, aid_samples
from .wording import measured

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight
    from .samples import AidSamples

LIMITS = ("start", "end")  # s after the first TDOA


class IntervalEffect(Effect):
    """An effect on one stream, its only channel, of the size "N.<part>" from "N.start" to "N.end"
    seconds after the first TDOA; N counts from 1; a limit that is not given does not limit it.
    """

    part: ClassVar[str]
    portable = False
    fitted = False
    usable = False  # of another flight it tells nothing; the filter's own judgement is the remedy

    def per_unit(self, samples: AidSamples) -> np.ndarray:
        """What a unit of its size adds to the readings of AidSamples: (n, k)."""
        raise NotImplementedError

    @classmethod
    def check_key(cls, key: str) -> None:
        number, _, part = key.partition(".")
        if not number.isdigit() or part not in (cls.part, *LIMITS):
            raise InputError(
                f"effects: {cls.name}: parameter {key!r} is not a number and {cls.part}, "
                f"start or end, as 1.{cls.part}."
            )

    @classmethod
    def bound_of(cls, key: str) -> float:
        return 1e6 if key.endswith(LIMITS) else cls.bound

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [()]

    @property
    def identity(self) -> tuple[Hashable, ...]:
        return (
            self.name,
            *sorted((key, value) for key, value in self.values.items() if key.endswith(LIMITS)),
        )

    @property
    def sizes(self) -> dict[str, float]:
        """{parameter: value} without limits."""
        return {key: value for key, value in self.values.items() if not key.endswith(LIMITS)}

    def regressors(self, samples: AidSamples, keys: Sequence[str]) -> np.ndarray:
        get, since, unit = self.values.get, samples.t - samples.start, self.per_unit(samples)
        out = np.zeros((*unit.shape, len(keys)))
        for column, key in enumerate(keys):
            number = key.partition(".")[0]
            inside = (since >= get(f"{number}.start", -np.inf)) & (
                since <= get(f"{number}.end", np.inf)
            )
            out[inside, :, column] = unit[inside]
        return out

    def uncorrected(self, samples: AidSamples) -> np.ndarray:
        return self.regressors(samples, list(self.sizes)) @ np.array(list(self.sizes.values()))

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        (stream,) = self.channels
        part = need_stream(self, flight, stream)
        truth = require_truth(self, flight)
        samples = aid_samples(stream, part.t, Track(truth), float(flight.tdoa.t[0]))
        extra = self.uncorrected(samples)
        if not np.isfinite(extra).all():
            raise InputError(
                f"{flight.name}: has no attitude in its ground truth, which {self.name} needs."
            )
        return flight.replaced(**{stream: part.sensed(part.values + extra)})

    def significant_sizes(self, unit: str, factor: float = 1.0) -> list[tuple[float, str, str]]:
        """[(signed size, its words, when, in words)] of those sizes that are significant, the most
        certain first.
        """
        out = []
        for key, value in self.significant().items():
            if key in self.sizes:
                number, std = key.partition(".")[0], self.std.get(key, 0.0)
                start, end = (self.values.get(f"{number}.{limit}") for limit in LIMITS)
                when = (
                    ""
                    if start is None or end is None
                    else f" from {start:.0f} to {end:.0f} s after the first TDOA"
                )
                out.append((value, measured(abs(value) * factor, std * factor, unit), when))
        return out
