# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibration of anchors from a stream, piece by piece."""

from copy import copy
from dataclasses import replace
import json

from known_effects import sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.calibrating import between, in_pieces
from uwb_tdoa_tools.commands import calibrate
from uwb_tdoa_tools.diagnosis.self_calibration import Tape
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.surveying import stream
from uwb_tdoa_tools.surveying.stream import PIECE, StreamCalibration, in_place

pytestmark = pytest.mark.slow
TAPE = 0.1  # m
SEEDS = 300, 304, 308  # simulated flights by TDOA2 in the same hall


@pytest.fixture(scope="module")
def flights():
    """Flights of two pieces, with anchors as a tape has them."""
    clean = [sparse_flight(seed, 2.0 * PIECE) for seed in SEEDS]
    given = clean[0].anchors
    off = np.random.default_rng(7).normal(0.0, TAPE, given.positions.shape)
    return [replace(flight, anchors=given.at(given.positions + off)) for flight in clean]


def rmse(flight, effects):
    anchors, others = in_place(flight.anchors, effects)
    score, _ = evaluate(replace(flight, anchors=anchors), effects=others)
    return score.rmse_3d


def taken_all(calibration, flights):
    return [calibration.take(piece) for flight in flights for piece in in_pieces(flight)]


def judged(calibration, piece):
    """Take the last piece of a test. Nothing is found from it, as no piece would judge that."""
    calibration._find = lambda *_: ""
    return calibration.take(piece)


@pytest.fixture(scope="module")
def calibrated(flights):
    """The StreamCalibration of the first two flights, and its steps."""
    calibration = StreamCalibration(flights[0].anchors, Tape(TAPE))
    return calibration, taken_all(calibration, flights[:2])


@pytest.fixture
def begun(after_first_piece):
    """Return a StreamCalibration that has taken the first piece."""
    return copy(after_first_piece)


@pytest.fixture(scope="module")
def after_first_piece(flights):
    calibration = StreamCalibration(flights[0].anchors, Tape(TAPE))
    calibration.take(next(in_pieces(flights[0])))
    return calibration


def test_pieces_are_the_flight_without_truth(flights):
    pieces = list(in_pieces(flights[0]))
    assert all(piece.truth is None for piece in pieces)
    assert len({piece.name for piece in pieces}) == len(pieces)
    assert all(piece.duration <= PIECE for piece in pieces)
    np.testing.assert_array_equal(
        np.concatenate([piece.tdoa.d for piece in pieces]), flights[0].tdoa.d
    )


def test_a_piece_is_used_once_the_next_one_agrees(calibrated, flights):
    calibration, steps = calibrated
    assert not steps[0].taken and np.isnan(steps[0].after)
    assert steps[1].taken and steps[1].after < 0.5 * steps[1].before
    assert calibration.number == sum(step.taken for step in steps)
    other = flights[2]
    assert rmse(other, calibration.effects) < 0.5 * rmse(other, EffectSet())


def test_the_result_depends_on_the_pieces_alone(calibrated, flights):
    again = StreamCalibration(flights[0].anchors, Tape(TAPE))
    steps = taken_all(again, [replace(flights[0], truth=None, extra={})])
    assert steps == calibrated[1][: len(steps)] or str(steps) == str(calibrated[1][: len(steps)])


def test_it_goes_on_from_what_it_knew(calibrated, flights, tmp_path):
    calibration, _ = calibrated
    calibration.effects.to_yaml(tmp_path / "effects.yaml")
    known = EffectSet.from_yaml(tmp_path / "effects.yaml")
    later = StreamCalibration(flights[0].anchors, Tape(TAPE), known)
    first, second = in_pieces(flights[2])
    judged = later.take(first)
    assert judged.before < 0.02 and not judged.taken  # it is calibrated from the start
    assert later.take(second).after < 0.02
    assert rmse(flights[2], later.effects) < 1.1 * rmse(flights[2], known)


def late(piece, anchor, by):
    """The piece with an anchor that is late by some metres."""
    tdoa = piece.tdoa
    sign = (tdoa.b == anchor).astype(float) - (tdoa.a == anchor)
    return replace(piece, tdoa=replace(tdoa, d=tdoa.d + by * sign))


def test_a_late_anchor_is_found_and_the_others_stay(calibrated, flights):
    calibration, _ = calibrated
    changed = StreamCalibration(flights[0].anchors, Tape(TAPE), calibration.effects)
    first, second = (late(piece, 3, 0.3) for piece in in_pieces(flights[2]))
    steps = [changed.take(first), judged(changed, second)]
    assert any("anchor 3" in step.text for step in steps if step.taken)
    before, after = (
        {key: one.values[key] for one in some.effects for key in one.values}
        for some in (calibration, changed)
    )
    assert abs(after["3"] - before["3"] - 0.3) < 0.05
    others = [key for key in before if not key.startswith("3")]
    assert max(abs(after[key] - before[key]) for key in others) < 0.06


def test_a_change_within_a_piece_is_found_from_the_pieces_after_it(calibrated, flights):
    calibration, _ = calibrated
    changed = StreamCalibration(flights[0].anchors, Tape(TAPE), calibration.effects)
    first, *others = [piece for flight in flights[1:] for piece in in_pieces(flight)]
    d, middle = late(first, 3, 0.3).tdoa.d, first.start + 0.5 * first.duration
    d = np.where(first.tdoa.t < middle, first.tdoa.d, d)
    mixed = replace(first, tdoa=replace(first.tdoa, d=d))
    before = [changed.take(piece) for piece in (mixed, late(others[0], 3, 0.3))]
    # what explains half of a piece is not used, and does not become what is usual
    assert not any(step.taken for step in before)
    assert "not back to" in before[1].text
    after = judged(changed, late(others[1], 3, 0.3))
    assert after.taken and "anchor 3" in after.text
    assert after.after < stream.SMALLEST_RATIO * before[0].before


def test_no_anchor_is_named_where_all_have_moved(calibrated, flights):
    calibration, _ = calibrated
    given = calibration.given
    changed = StreamCalibration(given, Tape(TAPE), calibration.effects)
    off = np.random.default_rng(8).normal(0.0, 0.3, given.positions.shape)
    moved = AnchorPosition(
        values={
            f"{i}.{axis}": value
            for i, row in zip(given.ids.tolist(), off.tolist())
            for axis, value in zip("xyz", row)
        }
    )
    later = moved.inject(flights[2], np.random.default_rng(0))
    first, second = in_pieces(later)
    steps = [changed.take(first), judged(changed, second)]
    assert not any(step.taken for step in steps)
    assert "more than 2 anchors have changed: survey them again" in steps[1].text


def test_what_makes_the_next_piece_worse_is_not_taken(flights, monkeypatch):
    first, second = in_pieces(flights[0])
    wrong = []

    def instead(*given, **more):
        found = real(*given, **more)
        wrong.append(found.surveyed.at(found.given.positions - 2.0 * found.shifts))
        return replace(found, surveyed=wrong[-1])

    real = stream.self_calibrate
    monkeypatch.setattr(stream, "self_calibrate", instead)
    calibration = StreamCalibration(flights[0].anchors, Tape(TAPE))
    calibration.take(first)
    step = calibration.take(second)
    assert wrong and not step.taken and "not taken: slow innovations" in step.text
    assert calibration.number == 0 and len(calibration.effects) == 0


def test_a_tape_that_is_better_than_the_pieces_tell_is_kept():
    clean = [sparse_flight(seed, 2.0 * PIECE) for seed in SEEDS[:2]]
    given = clean[0].anchors
    off = np.random.default_rng(7).normal(0.0, 0.1 * TAPE, given.positions.shape)
    calibration = StreamCalibration(given.at(given.positions + off), Tape(TAPE))
    steps = taken_all(calibration, [replace(one, anchors=calibration.given) for one in clean])
    assert not any(step.taken for step in steps)
    assert any("is expected to leave" in step.text for step in steps)


def test_a_first_calibration_that_tells_too_little_is_continued(flights, monkeypatch):
    priors = []

    def instead(given, tape, base, config):
        priors.append(base.covariance)
        return real(given, tape, base, config)

    real = stream.self_calibrate
    monkeypatch.setattr(stream, "self_calibrate", instead)
    monkeypatch.setattr(stream, "LARGEST_SHARE", 0.0)
    calibration = StreamCalibration(flights[0].anchors, Tape(TAPE))
    steps = taken_all(calibration, flights[:2])
    assert not any(step.taken for step in steps) and not len(calibration.effects)
    assert priors[0] is None
    sizes = [np.trace(one.matrix) for one in priors[1:]]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < sizes[0]
    monkeypatch.undo()
    piece = next(in_pieces(flights[2]))
    assert calibration.take(piece).taken  # it holds all pieces
    assert rmse(flights[2], calibration.effects) < 0.5 * rmse(flights[2], EffectSet())


def test_too_little_motion_does_not_lose_what_was_found(flights, begun, monkeypatch):
    monkeypatch.setattr(stream, "LARGEST_SHARE", 0.0)
    _, second = in_pieces(flights[0])
    short = between(second, second.start, second.start + 15.0)
    assert "no new solution" in begun.take(short).text
    found = begun._further
    assert len(found) and not len(begun.effects)
    begun.take(short)
    assert begun._further is found


def test_the_order_of_a_covariance_does_not_matter(calibrated, flights, monkeypatch):
    monkeypatch.setattr(stream, "LARGEST_SHARE", 0.0)
    effects, piece = calibrated[0].effects, next(in_pieces(flights[2]))
    known = effects.covariance
    turned = replace(known, keys=known.keys[::-1], matrix=known.matrix[::-1, ::-1])
    judge = StreamCalibration(flights[0].anchors, Tape(TAPE))
    one, other = (
        judge._too_little(piece, replace(effects, covariance=some), 0.02)
        for some in (known, turned)
    )
    assert one == other and "is expected to leave" in one


def test_a_single_anchor_far_from_its_place_is_found(flights):
    given = flights[0].anchors
    off = np.zeros_like(given.positions)
    off[3] = 0.9, -0.7, 0.3
    calibration = StreamCalibration(given.at(given.positions + off), Tape(0.03))
    steps = taken_all(calibration, [replace(flights[0], anchors=calibration.given)])
    assert any(step.taken for step in steps)
    anchors, _ = in_place(calibration.given, calibration.effects)
    assert np.linalg.norm(anchors.positions[3] - given.positions[3]) < 0.5


def test_anchors_without_an_estimate_are_not_taken(flights, begun, monkeypatch):
    _, second = in_pieces(flights[0])
    real = begun._slow

    def instead(piece, effects):
        if len(effects):
            raise InputError("no estimate.")
        return real(piece, effects)

    monkeypatch.setattr(begun, "_slow", instead)
    step = begun.take(second)
    assert not step.taken and step.text == "not taken: no estimate."
    assert begun.number == 0


def test_an_unknown_anchor_is_placed_once(flights, monkeypatch):
    tapes = []

    def instead(given, tape, **more):
        tapes.append(tape)
        return real(given, tape, **more)

    real = stream.self_calibrate
    monkeypatch.setattr(stream, "self_calibrate", instead)
    given = flights[0].anchors
    positions = given.positions.copy()
    positions[5] = positions.mean(axis=0)
    calibration = StreamCalibration(given.at(positions), Tape(TAPE, unknown=(str(given.ids[5]),)))
    steps = taken_all(calibration, flights[:1])
    assert [step.taken for step in steps] == [False, True]
    assert [bool(tape.unknown) for tape in tapes] == [True, False]
    anchors, _ = in_place(calibration.given, calibration.effects)
    assert np.linalg.norm(anchors.positions[5] - given.positions[5]) < 0.5


def test_a_piece_without_an_estimate_is_not_used(flights):
    piece = next(in_pieces(flights[0]))
    tdoa = piece.tdoa
    few = replace(tdoa, **{name: column[:100] for name, column in vars(tdoa).items()})
    calibration = StreamCalibration(flights[0].anchors, Tape(TAPE))
    step = calibration.take(replace(piece, tdoa=few, imu=None))
    assert not step.taken and np.isnan(step.before) and "give no estimate" in step.text
    assert step.name in step.as_text(0.0)


def test_anchors_are_put_in_place_once(flights):
    given = flights[0].anchors
    i = str(given.ids[2])
    shift = AnchorPosition({f"{i}.x": 0.2, f"{i}.z": -0.1})
    effects = EffectSet((AnchorDelay({i: 0.1}), shift))
    anchors, rest = in_place(given, effects)
    np.testing.assert_allclose((anchors.positions - given.positions)[2], [0.2, 0.0, -0.1])
    assert np.array_equal(np.delete(anchors.positions, 2, 0), np.delete(given.positions, 2, 0))
    again, same = in_place(anchors, rest)
    assert np.array_equal(again.positions, anchors.positions)
    assert [dict(effect.values) for effect in same] == [{i: 0.1}, {f"{i}.x": 0.0, f"{i}.z": 0.0}]


def test_the_command_writes_what_is_in_use(flights, calibrated, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bag(flights[0], "flight.bag")
    words = ["flight.bag", "--stream", "--keep", "--std", str(TAPE), "--out", "out"]
    assert calibrate.main(words) == 0
    printed = capsys.readouterr().out
    assert "calibration 1 is in use" in printed and "wrote anchors.yaml, effects.yaml" in printed
    steps = json.loads((tmp_path / "out" / "calibration.json").read_text())["steps"]
    assert steps[0]["after"] is None
    assert [step["taken"] for step in steps] == [step.taken for step in calibrated[1][: len(steps)]]
    files = [str(tmp_path / "out" / name) for name in ("anchors.yaml", "effects.yaml")]
    anchors, effects = read_survey(files[0]), EffectSet.from_yaml(files[1])
    assert effects.covariance is not None
    flight = replace(flights[2], anchors=flights[2].anchors.at(anchors.positions))
    assert rmse(flight, effects) < 0.5 * rmse(flights[2], EffectSet())


def test_too_little_motion_gives_nothing(flights, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flight = flights[0]
    write_bag(between(flight, flight.start, flight.start + 12.0), "short.bag")
    words = ["short.bag", "--stream", "--keep", "--std", str(TAPE), "--out", "out"]
    assert calibrate.main(words) == 1
    assert "that the next one confirmed" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["calibration.json"]


@pytest.mark.parametrize("option", [["--quick"], ["--holdout", "other.bag"]])
def test_options_without_effect_are_refused(tmp_path, capsys, option):
    words = ["flight.bag", "--stream", "--out", str(tmp_path / "out"), *option]
    assert calibrate.main(words) == 2
    assert f"{option[0]}: --stream judges each piece" in capsys.readouterr().err
