"""From a tape measure and flights to anchors."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError

from ..diagnosis import self_survey
from ..diagnosis.diagnose import same_anchors
from ..diagnosis.prior import Prior
from ..parallel import in_one_thread
from .placing import PLACED_STD, place
from .result import Result

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from ..diagnosis.constraints import Constraint
    from .tape import Tape

LEAST = 30.0  # s in the air; fewer do not tell how alike errors are
NOTHING_KNOWN = 1e3  # m, standard deviation of a coordinate of which nothing is known


@in_one_thread
def survey(
    flights: Sequence[Flight], tape: Tape, base: EffectSet = EffectSet(), config: FilterConfig | None = None,
    constraints: Sequence[Constraint] = (), progress: Callable[[], object] = lambda: None,
) -> Result:  # fmt: skip
    """Result of Flights with the anchors that a Tape speaks of.

    base : EffectSet that is in the model already; its covariance, of the last calibration, counts where there is one, not the
    Tape; config : FilterConfig; constraints : what else is known (`diagnosis/constraints`). Ground truth is not used. Raises
    InputError for flights of different anchors or that are too short, and for a Tape that does not fit.
    """
    same_anchors(flights)
    given = flights[0].anchors
    std, rows = tape.position_std(given), tape.unknown_rows(given)
    start, start_std = given, std.copy()
    if rows:
        start = place(flights, rows, config)
        start_std[rows], std[rows] = PLACED_STD, NOTHING_KNOWN
        if base.covariance is not None:
            base = replace(base, covariance=base.covariance.without(tape.unknown))
    moved = [replace(flight, anchors=start) for flight in flights]
    found = self_survey.survey(moved, start_std, base, config, constraints, progress)
    if found.seconds < LEAST:
        raise InputError(f"the flights are {found.seconds:g} s in the air together; {LEAST:g} s are needed: fly for longer.")
    prior = Prior.of(given, std, base.covariance)
    std = np.sqrt(np.diag(prior.covariance))[: std.size].reshape(-1, 3)
    return Result(given, std, found, tuple(flight.name for flight in flights), base)
