"""Distances to anchors, corrected in the filter's own process: the same live and off line, and at
poses of the past alone.
"""

from dataclasses import replace

from flights import fly
from live import assert_same, feed
import numpy as np
import pytest

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.flight import Tdoas
from uwb_tdoa_bias.foundation.sensors import Ranges
from uwb_tdoa_ekf.core.aids import STREAMS
from uwb_tdoa_ekf.core.memory import AID, IMU_SAMPLE, ODOMETRY, TDOA, Measurements
from uwb_tdoa_ekf.estimator import Estimator
from uwb_tdoa_ekf.installed import Installed
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.radio_corrections import SLICE, RadioCorrections

NO_TDOAS = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
RATE, STD = 100.0, 0.1  # Hz, m
DELAY, MOVED = (
    EFFECTS["anchor_delay"]({"1": 0.3}),
    EFFECTS["anchor_position"]({"2.x": 0.6, "2.z": -0.4}),
)
BOX = Anchors.from_positions([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5]], ids=[1, 2, 3, 4])


@pytest.fixture(scope="module")
def ranged():
    """A Flight of ranges alone, each anchor in its turn."""
    flight = fly(seed=1)
    truth, rng = flight.truth, np.random.default_rng(3)
    t = np.arange(truth.t[0], truth.t[-1], 1.0 / RATE)
    p = np.stack([np.interp(t, truth.t, column) for column in truth.p.T], axis=1)
    row = np.arange(len(t)) % len(flight.anchors)
    anchors = Anchors.from_positions(flight.anchors.positions, ids=np.arange(8))
    d = np.linalg.norm(p - anchors.positions[row], axis=1) + STD * rng.standard_normal(len(t))
    return replace(
        flight,
        anchors=anchors,
        tdoa=NO_TDOAS,
        range=Ranges(t, anchors.ids[row], d, np.zeros(len(t))),
    )


def error(flight, odometry):
    truth = np.stack(
        [np.interp(odometry.t, flight.truth.t, column) for column in flight.truth.p.T], axis=1
    )
    late = odometry.t > odometry.t[0] + 2.0
    return float(np.sqrt(np.mean(np.sum((odometry.p - truth)[late] ** 2, axis=1))))


@pytest.mark.parametrize(
    "effects",
    [(DELAY,), (MOVED,), (DELAY, MOVED)],
    ids=lambda effects: "+".join(one.name for one in effects),
)
def test_what_is_known_of_ranges_is_taken_out_live_as_off_line(ranged, effects):
    wrong = ranged
    for effect in effects:
        wrong = effect.inject(wrong)
    known = EffectSet(effects)
    run = run_offline(wrong, None, Corrector(wrong.anchors, known))
    clean, without = (
        error(ranged, run_offline(ranged).odometry),
        error(ranged, run_offline(wrong).odometry),
    )
    assert without > 1.5 * clean and error(ranged, run.odometry) < 1.1 * clean
    odometry, _ = feed(Estimator(wrong.anchors, effects=known), wrong)
    assert_same(odometry, run.odometry)


def measured(t, anchor, value):
    """Measurements of ranges alone."""
    rows = np.zeros(len(t), AID)
    rows["t"], rows["kind"], rows["anchor"], rows["value"][:, 0] = (
        t,
        STREAMS.index("range"),
        anchor,
        value,
    )
    return Measurements(np.empty(0, IMU_SAMPLE), np.empty(0, TDOA), rows)


def odometry_at(t, p):
    """(n,) of ODOMETRY of a tag at p (n, 3) m, whose attitude nobody knows."""
    rows = np.zeros(len(t), ODOMETRY)
    rows["t"], rows["x"] = t, np.nan
    rows["x"][:, :3] = p
    return rows


def test_a_slice_is_corrected_at_the_last_pose_before_it():
    corrections = RadioCorrections(EffectSet((MOVED,)), Installed(BOX))
    moved = BOX.positions[1] + [0.6, 0.0, -0.4]
    places = [np.array([1.0, 1.0, 1.0]), np.array([3.0, 2.0, 1.0])]
    t = np.array([0.01, 0.02, SLICE + 0.01, SLICE + 0.02, 2 * SLICE + 0.01])
    found = []
    for k, part in enumerate(corrections.slices(measured(t, np.ones(5, int), np.full(5, 4.0)))):
        found.append(part.aids)
        corrections.add_odometry(odometry_at(part.aids["t"][-1:], places[min(k, 1)]))
    assert [part["t"].tolist() for part in found] == [
        t[:2].tolist(),
        t[2:4].tolist(),
        t[4:].tolist(),
    ]
    np.testing.assert_array_equal(found[0]["value"][:, 0], 4.0)  # nobody knows where it is
    for part, place in zip(found[1:], places):
        bias = np.linalg.norm(place - moved) - np.linalg.norm(place - BOX.positions[1])
        np.testing.assert_allclose(part["value"][:, 0], 4.0 - bias, atol=1e-12)


def test_ranges_of_anchors_that_are_gone_stay_as_they_are_and_others_keep_their_rows():
    installed = Installed(BOX)
    corrections = RadioCorrections(
        EffectSet((EFFECTS["anchor_delay"]({"1": 0.3, "4": 0.1}),)), installed
    )
    installed.change(BOX.only(np.array([1, 2, 3])))
    (part,) = corrections.slices(
        measured(np.array([0.01, 0.02, 0.03]), np.array([0, 1, 3]), np.full(3, 4.0))
    )
    np.testing.assert_allclose(part.aids["value"][:, 0], [4.0, 4.0, 3.9])


def test_what_does_not_act_on_ranges_leaves_everything_in_one_piece(ranged):
    assert RadioCorrections(
        EffectSet((EFFECTS["pair_offset"]({"1-2": 0.3}), EFFECTS["range_delay"]({"offset": 0.1}))),
        Installed(BOX),
    ).idle
    assert not RadioCorrections(EffectSet((DELAY,)), Installed(BOX)).idle


def test_what_is_fed_is_not_changed():
    given = measured(np.array([0.01]), np.array([0]), np.array([4.0]))
    (part,) = RadioCorrections(EffectSet((DELAY,)), Installed(BOX)).slices(given)
    assert given.aids["value"][0, 0] == 4.0 and part.aids["value"][0, 0] == pytest.approx(3.7)


def test_what_comes_at_once_and_one_by_one_is_corrected_alike():
    """Also where the border between two slices is rounded."""
    t = 1.7e9 + np.arange(400) / 100.0
    whole, single = (RadioCorrections(EffectSet((MOVED,)), Installed(BOX)) for _ in range(2))

    def corrected(corrections, parts):
        out = []
        for part in parts:
            for piece in corrections.slices(part):
                out += piece.aids["value"][:, 0].tolist()
                last = piece.aids["t"][-1:]
                corrections.add_odometry(odometry_at(last, last - t[0]))
        return out

    given = measured(t, np.ones(400, int), np.full(400, 4.0))
    one_by_one = [measured(t[k : k + 1], np.ones(1, int), np.full(1, 4.0)) for k in range(400)]
    found = corrected(whole, [given])
    assert len(found) == 400 and len(set(found)) == 80 and found == corrected(single, one_by_one)


def test_what_holds_no_distances_is_one_part_and_distances_after_it_are_corrected_as_they_would_be():
    """Inertial samples and TDOAs alone, then a distance in the slice that they ended in, and one in
    the next.
    """
    t = 1.7e9 + np.arange(12) / 100.0
    imu = np.zeros(len(t), IMU_SAMPLE)
    imu["t"] = t
    given = Measurements(imu, np.empty(0, TDOA), np.empty(0, AID))
    later = [measured(t[-1:] + after, np.ones(1, int), np.full(1, 4.0)) for after in (0.001, SLICE)]

    def corrected(parts):
        corrections, out = RadioCorrections(EffectSet((MOVED,)), Installed(BOX)), []
        for part in parts:
            pieces = 0
            for piece in corrections.slices(part):
                pieces += 1
                out += piece.aids["value"][:, 0].tolist()
                stamps = np.concatenate([piece.imu["t"], piece.aids["t"]])
                corrections.add_odometry(odometry_at(stamps, (stamps - t[0])[:, None]))
            assert pieces == 1
        return out

    one_by_one = [given._replace(imu=imu[k : k + 1]) for k in range(len(t))]
    found = corrected([given, *later])
    assert len(set(found)) == 2 and found == corrected([*one_by_one, *later])
