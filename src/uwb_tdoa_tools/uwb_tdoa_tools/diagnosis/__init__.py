"""From residuals to missing effects.

from uwb_tdoa_tools.diagnosis import diagnose
result = diagnose(flights, holdout)      # result.findings, result.effects, result.before, result.after, ...
"""

from .diagnose import Diagnosis, diagnose

__all__ = ["Diagnosis", "diagnose"]
