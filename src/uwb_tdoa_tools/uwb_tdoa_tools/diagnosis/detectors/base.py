# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detector, the search for an effect that linear regression does not find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from uwb_tdoa_bias.effects import Effect

from ..channels import ChannelResiduals
from ..regression.fit import Fit
from ..regression.table import RegressionTable
from ..regression.terms import Candidate


@dataclass(frozen=True, eq=False)
class Detection:
    """An effect that a detector found.

    effect : Effect with values and std; channel : name of the channel on which it shows
    evidence : {figure: number}
    """

    effect: Effect
    channel: str
    evidence: dict[str, float]


class Detector:
    """The search for one effect with `fitted` False; DETECTORS lists all detectors.

    If an effect is linear in some parameters once all other parameters are given, `search` proposes
    candidates for the selection. Otherwise `detect` looks at the residual of the whole model.
    """

    effect: ClassVar[type[Effect]]
    on_floor: ClassVar[bool] = False  # True: uses measurements near the floor, not in the air
    searched_first: ClassVar[bool] = False  # True: the effect dominates its channel as noise

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        """Return Candidates for the residual of `model`, the Fit of the chosen ones to a table."""
        return []

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        """Return the Detection in residuals of the whole model, one dict per flight, or None."""
        return None

    def keys_chosen(self, chosen: Sequence[Candidate]) -> list[str]:
        """Return the parameters of its effect among chosen Candidates."""
        return [
            key
            for candidate in chosen
            if candidate.name == self.effect.name
            for key in candidate.terms[0].keys
        ]
