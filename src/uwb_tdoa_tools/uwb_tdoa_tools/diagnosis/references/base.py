"""What a reference is."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Truth

from ...scoring.metrics import airborne

MARGIN = 0.5  # s left out at both ends of the airborne part
SHORTEST = 5.0  # s in the air that can be diagnosed


@dataclass(frozen=True)
class View:
    """Where a flight was, as far as a reference tells. poses : Truth, known or estimated; innovations : Innovations of the
    run that estimated them, None where they are known."""

    poses: Truth
    innovations: object = None


class Reference:
    """What flights are compared with. One kind, one file: subclass it and give it an option of `diagnose`.

    Nothing that a reference does without is read: `prepare` takes it out of a recording before anything else sees it.
    """

    positions_known: ClassVar[tuple] = (True, True, True)  # x, y, z, world
    attitude_known: ClassVar[bool] = True
    knows_floor: ClassVar[bool] = False  # positions before lift-off and after landing, where an estimate may be metres off
    judges: ClassVar[bool] = True  # errors of the filter's positions can be told with it
    words: ClassVar[str]  # what a report says the figures rest on

    def prepare(self, flight):
        """The Flight without what must not be used. Raises InputError where it lacks what the reference is."""
        return flight

    def settled(self, flight, base, config=None):
        """(Flight, sentences): a prepared one, in which what this compares with was put right where it is plainly wrong itself. base :
        EffectSet that is in the model; config : FilterConfig."""
        return flight, ()

    def view(self, flight, effects):
        """View of a prepared Flight under the EffectSet `effects`."""
        raise NotImplementedError

    def shift_std(self, name):
        """(3,) m: standard deviation of what all positions of the prepared flight of a name may be off by together, each axis."""
        return np.zeros(3)

    def span(self, flight, poses):
        """(first, last) stamp, s, of what is diagnosed: in the air, without its ends. Raises InputError if that is short."""
        first, last = airborne(poses)
        first, last = first + MARGIN, last - MARGIN
        if last - first < SHORTEST:
            raise InputError(
                f"{flight.name}: only {last - first:.1f} s of it are in the air; {SHORTEST:g} s are needed."
            )
        return first, last
