"""Motion capture: every pose is known."""

from uwb_tdoa_bias.effects.stamp_error import shifted
from uwb_tdoa_bias.foundation.errors import InputError

from .base import Reference, View


class GroundTruth(Reference):
    """The ground truth that the recording holds."""

    words = "the recorded ground truth"
    knows_floor = True

    def __init__(self, config=None, constraints=()):
        """config : FilterConfig and constraints, which no known pose needs."""

    def prepare(self, flight):
        if flight.truth is None or len(flight.truth) < 2:
            raise InputError(f"{flight.name}: holds no ground truth to compare with; give --no-truth.")
        return flight

    def view(self, flight, effects):
        return View(shifted(flight, "truth", -effects.stamp_offset("truth")).truth)
