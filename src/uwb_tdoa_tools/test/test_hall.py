# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""diagnose and survey in a hall. The tag receives only some of the anchors at a time."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_tools.checking import pair_rules, tdoa_rules
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.ordered import SHORT, OrderedRecording
from uwb_tdoa_tools.checking.pair_rules import DRIFTS, JUMPS, MANY, OF_ALL, KnownPath
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.self_calibration import SelfCalibration, Tape, self_calibrate
from uwb_tdoa_tools.diagnosis.self_calibration.equations import _sparse
from uwb_tdoa_tools.diagnosis.self_calibration.prior import Prior, Solution
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.surveying.report import as_text, misplaced_anchors

LATE, MOVED, SHIFT = 38, 50, {"x": 0.2, "y": -0.2, "z": 0.1}


def hall(nx=11, ny=7, spacing=9.0):
    """Return a grid of Anchors. One third is low."""
    rng, n = np.random.default_rng(7), nx * ny
    x, y = np.meshgrid((np.arange(nx) + 0.5) * spacing, (np.arange(ny) + 0.5) * spacing)
    z = np.where(rng.random(n) < 1.0 / 3.0, rng.uniform(0.4, 1.2, n), rng.uniform(2.5, 6.0, n))
    return Anchors.from_positions(
        np.column_stack([x.ravel(), y.ravel(), z])
        + np.append(rng.uniform(-1.0, 1.0, (n, 2)), np.zeros((n, 1)), axis=1)
    )


@pytest.fixture(scope="module")
def sound():
    return simulate(
        SimulationConfig(
            anchors=hall(),
            radio_reach=18.0,
            bias=False,
            protocol="tdoa3",
            duration=60.0,
            speed=3.0,
            imu_rate=100.0,
            truth_rate=50.0,
            seed=2,
        )
    )


@pytest.fixture(scope="module")
def faulty(sound):
    late = EFFECTS["anchor_delay"]({str(LATE): 0.3}).inject(sound, np.random.default_rng(0))
    return EFFECTS["anchor_position"](
        {f"{MOVED}.{axis}": value for axis, value in SHIFT.items()}
    ).inject(late, np.random.default_rng(0))


@pytest.mark.slow
def test_an_anchor_that_is_late_and_one_that_was_moved_are_named_and_nothing_else(faulty):
    assert len(hall()) > MANY
    of_tdoas = [
        finding.effect
        for finding in diagnose([faulty]).findings
        if "tdoa" in finding.effect.channels
    ]  # the IMU also has errors
    found = {
        (effect.name, key): value for effect in of_tdoas for key, value in effect.values.items()
    }
    assert found.pop(("anchor_delay", str(LATE))) == pytest.approx(0.3, abs=0.03)
    shift = {key: found.pop(("anchor_position", f"{MOVED}.{key}"), 0.0) for key in "xyz"}
    assert all(shift[axis] == pytest.approx(SHIFT[axis], abs=0.06) for axis in "xy")
    assert not [
        key
        for key in found
        if key[0].startswith("anchor") or key[0] in ("pair_offset", "nlos", "smooth_term")
    ]


def test_columns_of_some_anchors_are_made_of_their_tdoas_alone(sound):
    part = residuals(sound, GroundTruth(), EffectSet())["tdoa"]
    knots = (0.0, 40.0, 120.0)
    for effect, keys in (
        (EFFECTS["anchor_delay"](), ("38", "40")),
        (EFFECTS["anchor_position"](), ("38.x", "50.z")),
        (EFFECTS["anchor_clock_drift"](), ("38",)),
        (EFFECTS["pair_offset"](), ("38-39",)),
        (EFFECTS["nlos"]({"38.start": 20.0, "38.end": 150.0}), ("38.delay",)),
        (SmoothTerm(covariate="range", form="anchor", knots=(0.0, 9.0, 18.0)), ("38.c0", "40.c1")),
        (SmoothTerm(covariate="time", form="pair", knots=knots), ("38-39.c1",)),
        (SmoothTerm(covariate="time", form="direction", knots=knots), ("38-39.c1",)),
    ):
        whole = np.nan_to_num(effect.regressors(part.samples, list(keys)))
        columns = part.columns(effect, keys).toarray()
        np.testing.assert_allclose(columns, part.cells.means(whole), atol=1e-12)
        assert np.abs(columns).max() > 0.1


def test_what_a_survey_asks_of_single_anchors_is_made_of_their_tdoas_alone(sound):
    samples = residuals(sound, GroundTruth(), EffectSet())["tdoa"].samples
    ids = [str(i) for i in samples.anchors.ids]
    for effect, keys in (
        (EFFECTS["anchor_delay"](), ids),
        (EFFECTS["anchor_position"](), [f"{i}.{axis}" for i in ids[30:50] for axis in "xyz"]),
    ):
        np.testing.assert_array_equal(
            _sparse(effect, samples, keys).toarray(),
            np.nan_to_num(effect.regressors(samples, keys)),
        )


@pytest.mark.slow
def test_a_survey_names_both_and_nothing_else(faulty):
    found = self_calibrate([faulty], Tape(0.05))
    named = {(change.effect, change.anchor): change.values for change in found.changes}
    assert set(named) == {("anchor_delay", str(LATE)), ("anchor_position", str(MOVED))}
    np.testing.assert_allclose(named["anchor_delay", str(LATE)], 0.3, atol=0.05)
    np.testing.assert_allclose(named["anchor_position", str(MOVED)], list(SHIFT.values()), atol=0.1)
    assert "beyond what the tape may be off by: anchor" in as_text(found)
    assert len(found.effects.covariance.keys) == 4 * len(hall())


def test_an_anchor_that_stands_apart_from_the_others_is_named_even_if_the_tape_allows_it():
    given, rng = hall(), np.random.default_rng(0)
    shifts = 0.005 * rng.standard_normal((len(given), 3))
    shifts[MOVED, :2] = 0.2, -0.2
    covariance = np.diag(np.full(4 * len(given), 0.01**2))
    covariance[:3, :3] = 0.1**2 * np.eye(3)  # an anchor that was never received
    found = SelfCalibration(
        given,
        Prior.of(given, np.full((len(given), 3), 0.1)),
        ("flight",),
        EffectSet(),
        given.at(given.positions + shifts),
        np.zeros(len(given)),
        Solution(0.0, np.zeros(len(covariance)), covariance, 0.003),
        100.0,
        0.05,
        0.02,
        0.2,
        (),
        None,
        0,
        {},
    )
    assert misplaced_anchors(found) == [
        MOVED
    ] and f"anchor {MOVED} is not at its given position" in as_text(found)
    still = np.delete(shifts, MOVED, axis=0)[[*range(MOVED), 0, *range(MOVED, len(given) - 1)]]
    assert not misplaced_anchors(replace(found, surveyed=given.at(given.positions + still)))


@pytest.mark.slow
def test_two_exchanged_anchors_of_a_hall_are_named(sound):
    whole = OrderedRecording.of(of_flight(sound))
    brief = whole.part(SHORT)
    assert [trial.finding.rule for trial in tdoa_rules.judged(whole)] == ["tdoa_sign"]
    ids, times = np.unique(np.concatenate([brief.tdoa.a, brief.tdoa.b]), return_counts=True)
    one, two = sorted(ids[np.argsort(-times)][[0, 5]].tolist())
    _, trial = tdoa_rules.judged(tdoa_rules.relabelled(whole, {one: two, two: one}))
    assert trial.finding.cause == f"two anchors are exchanged, {one} and {two}"


def test_a_fast_tag_does_not_speak_against_the_survey():
    hears = {"anchors": hall(), "radio_reach": 18.0, "bias": False, "protocol": "tdoa3"}
    config = SimulationConfig(**hears, duration=180.0, speed=4.0, imu_rate=100.0, seed=2)
    fit = OrderedRecording.of(of_flight(simulate(config))).survey_fit
    assert len(fit) > tdoa_rules.FEWEST and tdoa_rules.gained(fit) is None
    assert (
        fit._loss(fit._start, fit.positions) - fit.solve()[0] > tdoa_rules.GAIN
    )  # with the initial positions of the tag, it would contradict the survey


@pytest.mark.slow
def test_a_hall_is_no_plane_unless_those_that_are_heard_together_lie_in_one(sound):
    level = np.column_stack([sound.anchors.positions[:, :2], np.full(len(sound.anchors), 4.0)])
    for anchors, is_flat in ((sound.anchors, False), (Anchors.from_positions(level), True)):
        found = check(of_flight(replace(sound, imu=None, anchors=anchors))).findings
        assert ("anchors_flat" in {finding.rule for finding in found}) == is_flat


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_tdoas_that_are_late_in_a_hall_are_found_and_others_are_not(sound, late, monkeypatch):
    monkeypatch.setattr(
        pair_rules, "MOST_TDOAS", len(sound.tdoa) // 20
    )  # as in a recording of an hour
    of = pair_rules.delays_of_tdoas(
        KnownPath(replace(sound, tdoa=replace(sound.tdoa, t=sound.tdoa.t + late)))
    )
    ratio, delay = of.constant()
    assert delay == pytest.approx(late) and (ratio < OF_ALL) == (late > 0.0)
    assert of.drift()[0] > DRIFTS and of.jump()[0] > JUMPS


@pytest.mark.slow
def test_check_says_in_one_line_who_is_not_heard_in_a_hall(sound):
    found = [
        finding
        for finding in check(of_flight(sound)).findings
        if finding.rule.startswith("anchor_")
    ]
    heard = np.unique(np.concatenate([sound.tdoa.a, sound.tdoa.b]))
    assert [finding.rule for finding in found] == (
        ["anchor_missing"] if len(heard) < len(hall()) else []
    )


def test_ids_that_are_exchanged_in_a_hall_are_found(sound):
    of = sound.tdoa
    swap = {38: 49, 49: 38}
    a, b = (np.array([swap.get(int(i), int(i)) for i in ids]) for ids in (of.a, of.b))
    path = KnownPath(
        type(sound)(sound.name, sound.anchors, type(of)(of.t, a, b, of.d), truth=sound.truth)
    )
    assert pair_rules.find_exchanges(path)[0] == swap
    assert not pair_rules.find_exchanges(KnownPath(sound))[0]
