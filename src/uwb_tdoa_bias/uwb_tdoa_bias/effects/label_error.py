"""What the effects share that are in ids and signs of TDOAs: mistakes of a driver, not of physics."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from ..foundation.errors import InputError
from .base import Effect

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight


class LabelEffect(Effect):
    """An effect on which anchors a TDOA names, or in which order it subtracts. Undone before
    everything else, see LabelCorrector. Its values are whole numbers, set by the rule that names
    the mistake, not fitted.
    """

    fitted = False
    portable = False
    separable = True  # each value means something without the others
    expected: ClassVar[str]  # what its values may be, in words

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, value in self.values.items():
            if not self.possible(value):
                raise InputError(
                    f"effects: {self.name}: values: {key} is {value:g}; expected {self.expected}."
                )

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [()]

    @staticmethod
    def possible(value: float) -> bool:
        """Whether a value means something."""
        raise NotImplementedError

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(a, b, d) as they should have come, of TDOAs with ids a, b (n,) and values d (n,) m."""
        raise NotImplementedError

    def mislabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(a, b, d) as they come with the mistake."""
        raise NotImplementedError

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        of = flight.tdoa
        a, b, d = self.mislabelled(of.a, of.b, of.d)
        return replace(flight, tdoa=replace(of, a=a, b=b, d=d))


class LabelCorrector:
    """Undoes the effects of a set on ids and signs, in the order in which they are listed."""

    def __init__(self, effects: Iterable[Effect]) -> None:
        """effects : others than LabelEffects are passed over."""
        self._effects = [effect for effect in effects if isinstance(effect, LabelEffect)]
        self.idle = not self._effects

    def correct(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """a, b (n,) ids; d (n,) m. Returns them corrected."""
        for effect in self._effects:
            a, b, d = effect.relabelled(a, b, d)
        return a, b, d
