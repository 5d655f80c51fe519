"""No reference: the filter's own estimate is all there is."""

from dataclasses import replace

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.foundation.flight import Truth
from uwb_tdoa_ekf.sensitivity import record_innovations

from .base import Reference, View

TRUTHS = "_truth"  # how streams are called in which a simulation tells what was true


def without_truth(flight):
    """The Flight without anything of where it really was."""
    extra = {name: stream for name, stream in flight.extra.items() if not name.endswith(TRUTHS)}
    return replace(flight, truth=None, extra=extra)


class Nothing(Reference):
    """Residuals are the innovations of the filter; what the path follows of an effect is taken out of its regressors, with all
    that the filter knows of the path."""

    positions_known = (False, False, False)
    attitude_known = False
    judges = False
    words = "nothing but the flights themselves"

    def __init__(self, config=None, constraints=()):
        """config : FilterConfig; constraints : what is known beside (`diagnosis/constraints`)."""
        self._config, self.constraints = config, tuple(constraints)

    def prepare(self, flight):
        return without_truth(flight)

    def view(self, flight, effects):
        innovations = record_innovations(flight, self._config, Corrector(flight.anchors, effects))
        estimate = innovations.run.odometry
        return View(Truth(estimate.t, estimate.p, estimate.q), innovations)
