"""Steps of the ground below the tag."""

from uwb_tdoa_bias.effects import EFFECTS

from .intervals import IntervalDetector


class FloorStepDetector(IntervalDetector):
    """Steps, one after the other."""

    effect = EFFECTS["floor_step"]
