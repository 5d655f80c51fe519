# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the filter over a flight and score it; align its ground truth before that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.flight import Flight, Truth
from uwb_tdoa_bias.correction.model import Model
from uwb_tdoa_bias.effects import RADIO, EffectSet, Samples, true_samples
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run

from ..checking.pair_rules import repairs
from ..choices import FRAME, NONE, TIME
from ..estimate import FlightEstimator
from ..readers.inputs import report_remarks
from .alignment import (
    Alignment,
    common_paths,
    estimate_alignment,
    median_distance,
    on_another_clock,
    require_truth,
)
from .metrics import Score, radio_residuals

# largest ratio of the distances with repaired ids and signs, and with another frame
LARGEST_LABEL_RATIO = 1.5
# Largest ratio of the residuals of TDOAs with the frame moved and with it as it is, delays of
# anchors fitted to both. Ten recordings with a ground truth put 0.35 m or 5 degrees off: 0.51 to
# 0.92, and 0.94 to 1.03 where the path is too small to tell. Errors of anchors: 0.94 and more.
LARGEST_FRAME_RATIO = 0.93
FITS_OF_DELAYS = 8  # number of reweighted fits of delays


def evaluate(
    flight: Flight,
    config: FilterConfig | None = None,
    effects: EffectSet | None = None,
    network: Model | None = None,
) -> tuple[Score, Run]:
    """Run the filter over a Flight with ground truth.

    Returns
    -------
    score : Score.
    run : Run.

    Raises InputError without ground truth.
    """
    return score_of(flight, FlightEstimator(config, effects, network))


def score_of(flight: Flight, estimator: FlightEstimator) -> tuple[Score, Run]:
    """Run a FlightEstimator over a Flight with ground truth and score it.

    Returns (Score, Run). Raises InputError without ground truth, or with one on another clock.
    """
    require_truth(flight)
    run = estimator(flight)
    return Score(
        flight.name,
        run.odometry,
        corrected_truth(flight, estimator.effects),
        radio_residuals(flight, run),
        flight.tdoa.t,
    ), run


def corrected_truth(flight: Flight, effects: EffectSet | None = None) -> Truth:
    """Return the ground truth of a Flight without its errors that the EffectSet describes."""
    truth = effects.correct_streams(replace(flight, imu=None)).truth if effects else flight.truth
    assert truth is not None
    return truth


def align_truth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> tuple[Flight, tuple[str, ...]]:
    """Move the ground truth to the clock and frame of the TDOAs where it clearly differs.

    The moved truth only serves scoring and learning. Effects for the nodes do not contain the
    difference.

    Parameters
    ----------
    flight : Flight with ground truth.
    effects : known effects, or None.
    align : one of ALIGN. With "none", a ground truth on another clock is refused.

    Returns
    -------
    flight : Flight with the moved truth.
    sentences : what was found.

    Raises InputError.
    """
    require_truth(flight, align == NONE)
    assert flight.truth is not None
    effects = effects or EffectSet()
    found = _alignment(flight, effects, config)
    sentences = [
        f"{words}: it is moved to judge by, and nothing of that goes to the nodes"
        for words in (found.clock_sentence(), found.frame_sentence())
        if words
    ]
    return replace(
        flight,
        truth=found.significant().applied_to(flight.truth, FRAME if found.frame_differs else TIME),
    ), tuple(sentences)


def with_aligned_truth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> Flight:
    """Return the Flight of `align_truth` and print the findings on stderr.

    Other processes can call it (it can be pickled).
    """
    flight, sentences = align_truth(flight, effects, config, align)
    report_remarks(flight.name, (f"{sentence}." for sentence in sentences))
    return flight


def on_one_clock(flight: Flight, align: str = NONE) -> Flight:
    """Move the ground truth, if there is one, to the clock of the TDOAs.

    With align "none", a ground truth on another clock is refused. Raises InputError.
    """
    if flight.truth is None or len(flight.truth) < 2 or not on_another_clock(flight):
        return flight
    require_truth(flight, align == NONE)
    found = estimate_alignment(flight, FlightEstimator()(flight).odometry)
    report_remarks(flight.name, [f"{found.clock_sentence()}: they are moved."])
    return replace(flight, truth=found.applied_to(flight.truth, TIME))


def _alignment(flight: Flight, effects: EffectSet, config: FilterConfig | None) -> Alignment:
    """Return the Alignment of a Flight.

    If wrong ids and signs explain the difference of the frames as well, they are repaired first.
    """
    straight = effects.correct_streams(flight)
    odometry = FlightEstimator(config, effects)(flight).odometry
    assert straight.truth is not None
    found = estimate_alignment(straight, odometry)
    if found.frame_differs and (
        _ranges_fit(straight, effects, found) or delays_fit(straight, effects, found)
    ):
        found = replace(found, axes=np.eye(3), turn=np.eye(3), shift=np.zeros(3))
    repair = (
        EffectSet(repairs(replace(straight, truth=found.applied_to(straight.truth, TIME))))
        if found.frame_differs
        else EffectSet()
    )
    if not len(repair):
        return found
    of_labels = FlightEstimator(config, effects)(repair.correct_streams(flight)).odometry
    error = median_distance(*common_paths(found.applied_to(straight.truth, TIME), of_labels))
    left = median_distance(*common_paths(found.applied_to(straight.truth, FRAME), odometry))
    return (
        estimate_alignment(repair.correct_streams(straight), of_labels)
        if error < LARGEST_LABEL_RATIO * left
        else found
    )


def delays_fit(flight: Flight, effects: EffectSet, found: Alignment) -> bool:
    """Return whether delays of anchors explain the TDOAs as well as another frame does.

    Errors that depend on the bearing of an anchor shift the estimate, too. False without TDOAs, and
    if the axes differ.

    Parameters
    ----------
    flight : Flight with ground truth and corrected streams.
    effects : known effects.
    found : Alignment of the ground truth with the estimate.
    """
    if found.axes_differ or not len(flight.tdoa):
        return False
    left = []
    for samples, residual in _residuals(flight, effects, found, "tdoa"):
        known = np.isfinite(residual)
        ends = np.stack([samples.a, samples.b])[:, known]
        left.append(_left_by_delays(residual[known], ends) if known.any() else np.nan)
    return bool(left[1] > LARGEST_FRAME_RATIO * left[0])


def _residuals(
    flight: Flight, effects: EffectSet, found: Alignment, stream: str
) -> Iterator[tuple[Samples, np.ndarray]]:
    """Yield (Samples, residual (n,) m) of a stream of RADIO, first in the frame of the truth.

    Then with the frame moved.
    """
    assert flight.truth is not None
    for how in (TIME, FRAME):
        moved = replace(flight, truth=found.significant().applied_to(flight.truth, how))
        samples, rows = true_samples(moved, RADIO[stream])
        measured = getattr(flight, stream).d[rows]
        yield samples, measured - samples.predicted() - effects.bias(samples)


def _left_by_delays(residual: np.ndarray, ends: np.ndarray) -> float:
    """Return the median absolute residual (n,) m after a robust fit of one delay per anchor, m.

    ends : (2, n) rows of the anchors a and b of each TDOA; their delays add delay_b - delay_a
    """
    heard, place = np.unique(ends, return_inverse=True)
    (a, b), count = place.reshape(ends.shape), len(heard)
    left: np.ndarray = residual
    weight: np.ndarray = np.ones(len(residual))
    for _ in range(FITS_OF_DELAYS):
        forth = np.bincount(a * count + b, weight, count**2).reshape(count, count)
        pairs = forth + forth.T
        normal = np.diag(pairs.sum(axis=1)) - pairs  # of a graph of anchors: its Laplacian
        vector = np.bincount(b, weight * residual, count) - np.bincount(a, weight * residual, count)
        delay = np.linalg.lstsq(normal, vector, rcond=None)[0]
        left = residual - delay[b] + delay[a]
        weight = 1.0 / (1.0 + (left / (2.0 * 1.4826 * np.median(np.abs(left)) + 1e-9)) ** 2)
    return float(np.median(np.abs(left)))


def _ranges_fit(flight: Flight, effects: EffectSet, found: Alignment) -> bool:
    """Return whether ranges to anchors support the frame of the ground truth as it is.

    Delays of anchors distort the estimate, but are only constants in ranges. False without ranges.
    """
    channels = [
        name for name, kind in RADIO.items() if kind.ends == 1 and getattr(flight, name) is not None
    ]
    if not channels:
        return False
    away = []
    for samples, left in _residuals(flight, effects, found, channels[0]):
        of_anchors = [left[samples.b == anchor] for anchor in np.unique(samples.b)]
        apart = [np.abs(some - np.median(some)) for some in of_anchors]
        away.append(np.median(np.concatenate(apart)) if apart else np.nan)
    return bool(away[0] <= away[1])
