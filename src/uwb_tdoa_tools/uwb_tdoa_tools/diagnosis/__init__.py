"""From residuals to missing effects.

from uwb_tdoa_tools.diagnosis import diagnose
diagnosis = diagnose(flights, holdout)   # diagnosis.findings, diagnosis.effects, diagnosis.before, diagnosis.after, ...

Four ideas, each with a folder and a small interface: a *reference* is what a flight is compared
with; a *channel* is one kind of measurement, with its residual; an *effect* (uwb_tdoa_bias.effects)
is what may be wrong with channels; a *detector* searches for an effect that no regression finds.
The rest knows none of them by name.
"""

from .diagnose import diagnose
from .result import Diagnosis

__all__ = ["Diagnosis", "diagnose"]
