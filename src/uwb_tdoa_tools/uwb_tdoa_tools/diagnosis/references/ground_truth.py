"""Motion capture: every pose is known."""

from uwb_tdoa_bias.effects.stamp_error import shifted
from uwb_tdoa_bias.foundation.errors import InputError

from ...scoring.alignment import NONE
from ...scoring.settling import settled
from .base import Reference, View


class GroundTruth(Reference):
    """The ground truth that the recording holds."""

    words = "the recorded ground truth"
    knows_floor = True

    def __init__(self, config=None, constraints=(), align=NONE):
        """config : FilterConfig and constraints, which no known pose needs; align : as of `settled`."""
        self._align = align

    def prepare(self, flight):
        if flight.truth is None or len(flight.truth) < 2:
            raise InputError(f"{flight.name}: holds no ground truth to compare with; give --no-truth.")
        return flight

    def settled(self, flight, base, config=None):
        return settled(flight, base, config, self._align)

    def view(self, flight, effects):
        return View(shifted(flight, "truth", -effects.stamp_offset("truth")).truth)
