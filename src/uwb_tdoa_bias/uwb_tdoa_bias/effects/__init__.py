# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Systematic effects, and `effects.yaml`: which of them are in the model, with which values.

The file, written by people and by the tools, read by the nodes:

    effects:
      anchor_delay:
        values: {0: 0.05, 3: -0.02}     # m
        std: {0: 0.004, 3: 0.004}       # optional
        source: "static calibration, 12 points"
      tag_lever_arm:
        values: {x: -0.012, y: 0.001, z: 0.091}
      smooth_term_1:                    # no name: a function that diagnose found
        channel: tdoa
        covariate: range
        form: arrival
        knots: [1.0, 4.0, 9.0]
        values: {c0: 0.01, c1: 0.04, c2: -0.02, c3: 0.0}
    covariance:                         # optional, from survey and diagnose: prior of a calibration
      parameters: [anchor_delay 0, anchor_delay 3]
      matrix:                           # lower triangle
      - [1.6e-5]
      - [0.4e-5, 1.6e-5]
"""

from .anchor import AnchorDelay
from .base import ArrivalEffect, Effect, LabelEffect, Row
from .effect_set import EFFECTS, Covariance, EffectSet, ImuCorrector, StreamCorrector
from .samples import (
    RADIO,
    ImuSamples,
    RangeSamples,
    Samples,
    SensorSamples,
    Track,
    samples_at,
    sensor_samples,
    true_samples,
)
from .smooth_term import SmoothTerm
from .tag import TagLeverArm

__all__ = [
    "EFFECTS",
    "RADIO",
    "SensorSamples",
    "AnchorDelay",
    "ArrivalEffect",
    "Covariance",
    "Effect",
    "EffectSet",
    "ImuCorrector",
    "ImuSamples",
    "LabelEffect",
    "RangeSamples",
    "Row",
    "Samples",
    "SmoothTerm",
    "StreamCorrector",
    "TagLeverArm",
    "Track",
    "sensor_samples",
    "samples_at",
    "true_samples",
]
