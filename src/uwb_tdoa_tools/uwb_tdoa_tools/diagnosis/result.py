"""What a diagnosis says; `output` and `report` write it for machines and for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .findings import EffectFinding, Refused

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.monitoring.finding import Finding as NumbersFinding

    from .attribution import Attribution
    from .channels import ChannelResiduals
    from .channels.base import Figures
    from .references import Reference
    from .regression.confounding import Unobservable


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found in some flights, and what it is worth.

    flights : (Flight, ...), as the reference leaves them; reference : Reference; findings :
        [EffectFinding]; effects :
    EffectSet, the base and what is added; refused : [Refused]; unobservable : [Unobservable];
    before, after : dicts of `comparison.compare`; judged_on : sentence; health : dict; attribution
    : Attribution; remaining : [{channel: ChannelResidual}] under `effects`; numbers : {name of a
    flight: [Finding of checking]}, what is wrong with its numbers; changes : sentences, what is not
    as in the last calibration;
    applying : ((command line, what it does), ...), how the effects are put to use;
    judge_truth : {name of a flight: sentences}, what was wrong with the clock or the frame of its
        ground truth.
    """

    flights: tuple[Flight, ...]
    reference: Reference
    findings: list[EffectFinding]
    effects: EffectSet
    refused: list[Refused]
    unobservable: list[Unobservable]
    before: dict[str, Any]
    after: dict[str, Any]
    judged_on: str
    health: Figures
    attribution: Attribution
    remaining: list[ChannelResiduals]
    numbers: dict[str, list[NumbersFinding]]
    changes: tuple[str, ...] = ()
    applying: tuple[tuple[str, str], ...] = ()
    judge_truth: dict[str, tuple[str, ...]] = field(default_factory=dict)
