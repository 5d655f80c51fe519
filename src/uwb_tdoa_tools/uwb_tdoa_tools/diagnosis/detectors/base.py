"""What a detector is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from uwb_tdoa_bias.effects import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..channels import ChannelResiduals
    from ..regression.fit import Fit
    from ..regression.table import RegressionTable
    from ..regression.terms import Candidate


@dataclass(frozen=True, eq=False)
class Detection:
    """effect : Effect with values and std; channel : where it shows; evidence : {figure: number},
    how sure that is.
    """

    effect: Effect
    channel: str
    evidence: dict[str, float]


class Detector:
    """The search for one effect with `fitted` False. One effect, one file of its name: subclass and
    list it in DETECTORS.

    An effect with a regressor at hand for some of its parameters, once the others are given, is
    searched for among the candidates of the selection (`search`). One without any is judged on what
    all others leave (`detect`).
    """

    effect: ClassVar[type[Effect]]
    on_floor: ClassVar[bool] = (
        False  # looks at what is near the floor, the others at what is in the air
    )
    disguises: ClassVar[bool] = (
        False  # what it searches for dominates its channel: unless found first, it counts as noise
    )

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        """[Candidate] for the residual of `model`, a Fit of the chosen Candidates to the
        RegressionTable.
        """
        return []

    def detect(self, residuals: Sequence[ChannelResiduals]) -> Detection | None:
        """Detection in what the whole model leaves, [{channel: ChannelResidual}], one dict a
        flight; or None.
        """
        return None
