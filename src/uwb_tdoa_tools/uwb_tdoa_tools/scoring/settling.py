"""Ground truth put right, before errors are judged by it or learned from it.

Whatever a ground truth has wrong, clock or frame, is its own: it is moved, which changes what
estimates are compared with, and nothing of that goes into effects, which nodes take.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import RADIO, EffectSet, true_samples

from ..checking.pair_rules import repairs
from ..estimate import FlightEstimator
from ..readers.inputs import report_remarks
from .alignment import FRAME, NONE, TIME, alignment_of, apart, need_truth, on_another_clock, paths

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from .alignment import Alignment

# times the distance that another frame leaves, which wrong ids and signs may leave to explain as
# much
AS_WELL = 1.5


def settled(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> tuple[Flight, tuple[str, ...]]:
    """(Flight, sentences): its ground truth on the clock and in the frame of its TDOAs, where it
    was plainly not, and what was found.

    flight : Flight with ground truth; effects : EffectSet that is in the model, or None; config :
        FilterConfig; align : of ALIGN: with
    "none" a ground truth on another clock is refused. Raises InputError.
    """
    need_truth(flight, align == NONE)
    assert flight.truth is not None
    effects = effects or EffectSet()
    found = _alignment(flight, effects, config)
    said = [
        f"{words}: it is moved to judge by, and nothing of that goes to the nodes"
        for words in (found.of_clock(), found.of_frame())
        if words
    ]
    return replace(
        flight, truth=found.least().applied(flight.truth, FRAME if found.other_frame else TIME)
    ), tuple(said)


def with_settled_truth(
    flight: Flight,
    effects: EffectSet | None = None,
    config: FilterConfig | None = None,
    align: str = NONE,
) -> Flight:
    """The Flight of `settled`; what was found is printed on stderr.

    Can be handed to other processes.
    """
    flight, said = settled(flight, effects, config, align)
    report_remarks(flight.name, (f"{sentence}." for sentence in said))
    return flight


def on_one_clock(flight: Flight, align: str = NONE) -> Flight:
    """The Flight with its ground truth, if it has one, on the clock of the TDOAs. align : of ALIGN:
    with "none" one on another clock is refused. Raises InputError.
    """
    if flight.truth is None or len(flight.truth) < 2 or not on_another_clock(flight):
        return flight
    need_truth(flight, align == NONE)
    found = alignment_of(flight, FlightEstimator()(flight).odometry)
    report_remarks(flight.name, [f"{found.of_clock()}: they are moved."])
    return replace(flight, truth=found.applied(flight.truth, TIME))


def _alignment(flight: Flight, effects: EffectSet, config: FilterConfig | None) -> Alignment:
    """Alignment of a Flight, or, where wrong ids and signs explain another frame as well, the one
    without these.
    """
    straight, odometry = (
        effects.correct_streams(flight),
        FlightEstimator(config, effects)(flight).odometry,
    )
    assert straight.truth is not None
    found = alignment_of(straight, odometry)
    if found.other_frame and _ranges_fit(straight, effects, found):
        found = replace(found, axes=np.eye(3), turn=np.eye(3), shift=np.zeros(3))
    repair = (
        EffectSet(repairs(replace(straight, truth=found.applied(straight.truth, TIME))))
        if found.other_frame
        else EffectSet()
    )
    if not len(repair):
        return found
    of_labels = FlightEstimator(config, effects)(repair.correct_streams(flight)).odometry
    error = apart(*paths(found.applied(straight.truth, TIME), of_labels))
    left = apart(*paths(found.applied(straight.truth, FRAME), odometry))
    return (
        alignment_of(repair.correct_streams(straight), of_labels)
        if error < AS_WELL * left
        else found
    )


def _ranges_fit(flight: Flight, effects: EffectSet, found: Alignment) -> bool:
    """Whether distances to anchors speak for the frame of the ground truth as it is, against that
    of an Alignment: delays of anchors, which make the estimate bend, are constants of these. False
    without distances.
    """
    assert flight.truth is not None
    for channel in (
        name for name, kind in RADIO.items() if kind.ends == 1 and getattr(flight, name) is not None
    ):
        stream = getattr(flight, channel)
        away = []
        for how in (TIME, FRAME):
            samples, rows = true_samples(
                replace(flight, truth=found.least().applied(flight.truth, how)), RADIO[channel]
            )
            left = stream.d[rows] - samples.true() - effects.bias(samples)
            apart = [
                np.abs(left[samples.b == anchor] - np.median(left[samples.b == anchor]))
                for anchor in np.unique(samples.b)
            ]
            away.append(np.median(np.concatenate(apart)) if apart else np.nan)
        return bool(away[0] <= away[1])
    return False
