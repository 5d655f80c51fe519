"""No reference: the filter's own estimate is all there is."""

from dataclasses import replace

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.offline import run_offline

from .base import Reference

TRUTHS = "_truth"  # how streams are called in which a simulation tells what was true


class Nothing(Reference):
    """Residuals are taken at the estimate; what an error of its position would explain is projected out of them."""

    positions_known = (False, False, False)
    attitude_known = False
    judges = False
    words = "nothing but the flights themselves"

    def __init__(self, config=None):
        """config : FilterConfig."""
        self._config = config

    def prepare(self, flight):
        extra = {name: stream for name, stream in flight.extra.items() if not name.endswith(TRUTHS)}
        return replace(flight, truth=None, extra=extra)

    def poses(self, flight, effects):
        estimate = run_offline(flight, self._config, Corrector(flight.anchors, effects)).odometry
        return Truth(estimate.t, estimate.p, estimate.q)
