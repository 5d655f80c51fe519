# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors that are added, removed and moved while a filter runs."""

from dataclasses import replace

from driving import cut as part
from flights import corners, fly, kept, position_at
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_ekf.core.memory import INVALID, USED
from uwb_tdoa_ekf.estimator import Estimator

BOX = corners()
CHANGE = 4.0  # s
GONE, MOVED, ADDED = BOX.ids[0], BOX.ids[1], 99
PLACE, NEW = BOX.positions[1] + [1.5, 0.0, -0.5], [3.5, 4.0, 3.0]


def after(before=BOX):
    """Return the Anchors after the change: one removed, one moved, one added."""
    positions = before.positions.copy()
    positions[1] = PLACE
    return Anchors.from_positions(np.vstack([positions[1:], NEW]), np.append(before.ids[1:], ADDED))


def flight_through(seed=3, seconds=8.0, everything=False):
    """Return a Flight with the anchors of each time.

    With `everything`, the removed anchor continues to send.
    """
    flight, rng = fly(seed, seconds), np.random.default_rng(seed)
    t = flight.tdoa.t
    parts = []
    for anchors, rows in ((BOX, t < CHANGE), (after(), t >= CHANGE)):
        if everything:
            anchors = (
                Anchors.from_positions(
                    np.vstack([anchors.positions, BOX.positions[:1]]),
                    np.append(anchors.ids[:], GONE),
                )
                if rows[-1]
                else anchors
            )
        a = rng.integers(0, len(anchors), rows.sum())
        b = (a + rng.integers(1, len(anchors), rows.sum())) % len(anchors)
        d = tdoa(
            position_at(flight, t[rows]), anchors.positions[a], anchors.positions[b]
        ) + 0.05 * rng.standard_normal(rows.sum())
        parts.append((t[rows], anchors.ids[a], anchors.ids[b], d))
    return replace(flight, anchors=BOX, tdoa=Tdoas(*map(np.concatenate, zip(*parts))))


def cut(flight, low, high):
    return replace(flight, tdoa=part(flight.tdoa, low, high), imu=part(flight.imu, low, high))


def fed(estimator, flight):
    estimator.add_imu(flight.imu.t, flight.imu.gyro, flight.imu.accel)
    estimator.add_tdoa(flight.tdoa.t, flight.tdoa.a, flight.tdoa.b, flight.tdoa.d)
    return estimator.finish()


def flown(told=True, everything=False):
    """Return (Estimator, Flight, results before the change, results after it)."""
    flight, estimator = flight_through(everything=everything), Estimator(BOX)
    before = fed(estimator, cut(flight, -np.inf, CHANGE))
    if told:
        assert estimator.stay(after())
        estimator.change_anchors(after())
    return estimator, flight, before, fed(estimator, cut(flight, CHANGE, np.inf))


def test_the_filter_goes_on_with_those_that_are_there():
    estimator, flight, _, (odometry, residuals) = flown()
    assert estimator.counts["restarts"] == 0 and estimator.recoveries == 0
    off = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    assert odometry.t[0] < CHANGE + 0.05 and off.max() < 0.3
    assert (residuals.verdict != INVALID).all()
    for anchor in (MOVED, ADDED):
        mine = (residuals.verdict == USED) & ((residuals.a == anchor) | (residuals.b == anchor))
        assert mine.sum() > 50 and np.median(np.abs(residuals.innovation[mine])) < 0.1


def test_untold_the_anchor_that_was_moved_contradicts():
    *_, (_, residuals) = flown(told=False)
    mine = np.isfinite(residuals.innovation) & ((residuals.a == MOVED) | (residuals.b == MOVED))
    assert np.median(np.abs(residuals.innovation[mine])) > 0.2
    assert ((residuals.a == ADDED) <= (residuals.verdict == INVALID)).all()


def test_one_that_is_gone_is_used_no_more():
    *_, (_, residuals) = flown(everything=True)
    gone = (residuals.a == GONE) | (residuals.b == GONE)
    assert (
        gone.sum() > 50
        and (residuals.verdict[gone] == INVALID).all()
        and (residuals.verdict[~gone] != INVALID).all()
    )


def test_a_reset_afterwards_and_an_anchor_that_comes_back():
    estimator, flight, _, _ = flown()
    estimator.reset()
    assert len(estimator._anchor_table) == len(after())
    estimator.change_anchors(BOX)
    odometry, residuals = fed(estimator, cut(flight, -np.inf, CHANGE))
    off = np.linalg.norm(odometry.p - position_at(flight, odometry.t), axis=1)
    assert off[-1] < 0.3 and (residuals.verdict != INVALID).all()


def test_other_anchors_in_another_frame_or_all_elsewhere_are_no_change():
    estimator = Estimator(BOX)
    assert estimator.stay(BOX) and estimator.stay(after())
    assert not estimator.stay(BOX.at(BOX.positions + 0.5))
    assert not estimator.stay(replace(BOX, frame="hall"))


def test_who_moves_anchors_again_and_again_fills_no_memory(monkeypatch):
    monkeypatch.setattr("uwb_tdoa_ekf.estimator.MOST_ROWS", len(BOX) + 3)
    estimator, moved = Estimator(BOX), 0
    for k in range(10):
        other = BOX.at(
            BOX.positions + [[0.1 * (k + 1), 0.0, 0.0]] * (np.arange(len(BOX)) == 0)[:, None]
        )
        if estimator.stay(other):
            estimator.change_anchors(other)
            moved += 1
    assert moved == 3 and len(estimator._anchor_table) == len(BOX) + 3


def test_nothing_is_said_of_an_anchor_that_was_taken_away():
    """The monitor reports a silent anchor, unless the anchor was removed."""
    flight = fly(5, 16.0, tdoa_rate=400.0)
    quiet = (flight.tdoa.t > 6.0) & ((flight.tdoa.a == GONE) | (flight.tdoa.b == GONE))
    flight = replace(flight, tdoa=kept(flight.tdoa, ~quiet))
    for taken in (False, True):
        estimator = Estimator(BOX)
        fed(estimator, cut(flight, -np.inf, 6.0))
        if taken:
            estimator.change_anchors(BOX.only(range(1, len(BOX))))
        fed(estimator, cut(flight, 6.0, np.inf))
        assert any(f"anchor {GONE} is not heard" in alarm for alarm in estimator.alarms) == (
            not taken
        )
