"""Steps of the ground below the tag."""

from uwb_tdoa_bias.effects.floor_step import FloorStep

from .intervals import IntervalDetector


class FloorStepDetector(IntervalDetector):
    """Steps, one after the other."""

    effect = FloorStep
