"""A velocity that is lost for a while."""

from uwb_tdoa_bias.effects.velocity_slip import VelocitySlip

from .intervals import IntervalDetector


class VelocitySlipDetector(IntervalDetector):
    """Losses, one after the other."""

    effect = VelocitySlip
