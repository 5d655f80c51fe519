# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The result of a diagnosis; `output` and `report` write it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.monitoring.finding import Finding as NumbersFinding

from .attribution import Attribution
from .channels import ChannelResiduals
from .channels.base import Figures
from .comparison import ValidationCase
from .findings import EffectFinding, Refused
from .frames import TruthTransform
from .next_flight import NextFlight
from .references import Reference
from .regression.confounding import Unobservable


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The effects found in some flights, and their validation.

    Attributes
    ----------
    flights : (Flight, ...), prepared by the reference
    reference : Reference
    findings : [EffectFinding]
    effects : EffectSet, the base and the added effects
    refused : [Refused]
    unobservable : [Unobservable]
    before, after : results of `comparison.compare`, without and with the added effects
    judged_on : sentence, the validation data
    health : figures of the channels and the filter
    attribution : Attribution
    remaining : [{channel: ChannelResidual}] under `effects`, one per flight
    numbers : {name of a flight: [Finding of checking]}, errors of a driver, survey or clock
    changes : sentences, changes since the last calibration
    applying : ((command line, its purpose), ...), commands that apply the effects
    judge_truth : {name of a flight: sentences}, clock or frame errors of its ground truth
    truth_transform : TruthTransform of the ground truth to the survey; None if it is not moved
    cases : (ValidationCase, ...) that `after` is of
    share : of the fitted values that is applied, because few flights support less
    tdoa_std : m, noise for the filter beside these effects, None if it was not measured
    base : EffectSet of the model before
    next_flight : NextFlight that settles what is left open, None if none was asked for
    written : as `after`, with this noise too: what the written files give; None if not judged
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
    truth_transform: TruthTransform | None = None
    cases: tuple[ValidationCase, ...] = ()
    share: float = 1.0
    tdoa_std: float | None = None
    written: dict[str, Any] | None = None
    base: EffectSet = EffectSet()
    next_flight: NextFlight | None = None
