"""What a reference is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Truth

from ...scoring.metrics import scored_phase
from ...scoring.phases import TITLES

if TYPE_CHECKING:
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.sensitivity import Innovations

    from ..constraints import Constraint

MARGIN = 0.5  # s left out at both ends
SHORTEST = 5.0  # s that can be diagnosed


@dataclass(frozen=True)
class ReferenceView:
    """Where a flight was, as far as a reference tells. poses : Truth, known or estimated;
    innovations : Innovations of the run that estimated them, None where they are known.
    """

    poses: Truth
    innovations: Innovations | None = None


class Reference:
    """What flights are compared with. One kind, one file: subclass it and give it an option of
    `diagnose`.

    Nothing that a reference does without is read: `prepare` takes it out of a recording before
    anything else sees it.
    """

    positions_known: ClassVar[tuple] = (True, True, True)  # x, y, z, world
    attitude_known: ClassVar[bool] = True
    knows_floor: ClassVar[bool] = (
        False  # positions before lift-off and after landing, where an estimate may be metres off
    )
    tells_errors: ClassVar[bool] = True  # errors of the filter's positions are known with it
    constraints: tuple[Constraint, ...] = ()  # what is known beside (`diagnosis/constraints`)
    words: str  # what a report says the figures rest on

    def prepare(self, flight: Flight) -> Flight:
        """The Flight without what must not be used.

        Raises InputError where it lacks what the reference is.
        """
        return flight

    def settled(
        self, flight: Flight, base: EffectSet, config: FilterConfig | None = None
    ) -> tuple[Flight, tuple[str, ...]]:
        """(Flight, sentences): a prepared one, in which what this compares with was put right where
        it is plainly wrong itself. base : EffectSet that is in the model; config : FilterConfig.
        """
        return flight, ()

    def view(self, flight: Flight, effects: EffectSet) -> ReferenceView:
        """ReferenceView of a prepared Flight under the EffectSet `effects`."""
        raise NotImplementedError

    def shift_std(self, name: str) -> np.ndarray:
        """(3,) m: standard deviation of what all positions of the prepared flight of a name may be
        off by together, each axis.
        """
        return np.zeros(3)

    def span(self, flight: Flight, poses: Truth) -> tuple[float, float]:
        """(first, last) stamp, s, of what is diagnosed: in the air, or in motion on the floor,
        without its ends. Raises InputError if that is short.
        """
        part, first, last = scored_phase(poses)
        first, last = first + MARGIN, last - MARGIN
        if last - first < SHORTEST:
            raise InputError(
                f"{flight.name}: only {last - first:.1f} s of it are {TITLES[part]}; "
                f"{SHORTEST:g} s are needed."
            )
        return first, last
