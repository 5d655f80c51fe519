"""A velocity that is lost for a while."""

from uwb_tdoa_bias.effects import EFFECTS

from .intervals import IntervalDetector


class VelocitySlipDetector(IntervalDetector):
    """Losses, one after the other."""

    effect = EFFECTS["velocity_slip"]
