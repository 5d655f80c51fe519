# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pieces of a stream of messages, and calibrations that are kept."""

from dataclasses import replace
import os

from flights import fly
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import AnchorDelay, Covariance, EffectSet
from uwb_tdoa_bias.effects.anchor import AnchorPosition
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_tools.bags.bag import read_bag, write_bag
from uwb_tdoa_tools.bags.files import open_bag
from uwb_tdoa_tools.calibrating import cut, in_pieces
from uwb_tdoa_tools.surveying import pieces
from uwb_tdoa_tools.surveying.pieces import (
    ENCAPSULATION,
    LATE,
    STAMP,
    TDOAS,
    PieceCutter,
    keep,
    last_kept,
)
from uwb_tdoa_tools.surveying.stream import PIECE

EPOCH = 1_700_000_000  # s
STREAMS = TDOAS, "imu/data"
ANCHORS = Anchors.from_positions(
    np.array([[0.0, 0, 0], [8, 0, 2], [8, 8, 0], [0, 8, 2], [4, 0, 3]])
)


def stamp(t):
    """Return a stamp, s, as it is read from a message; t : s since EPOCH."""
    return (EPOCH * 10**9 + round(1e9 * t)) / 1e9


def message(t):
    """Return the bytes of a message with a stamp, s since EPOCH."""
    nanoseconds = round(1e9 * t)
    header = STAMP.pack(EPOCH + nanoseconds // 10**9, nanoseconds % 10**9)
    return bytes(ENCAPSULATION) + header + bytes(8)


def cut_all(cutter, arrivals):
    """Give [(topic, s)] to a PieceCutter, and return its pieces."""
    out = []
    for place, (topic, t) in enumerate(arrivals):
        cutter.add(topic, place, message(t))
        out += cutter.pieces()
    return out


@settings(max_examples=30)
@given(
    st.integers(0, 2**31),
    st.floats(0.0, 0.9 * LATE),
    st.lists(st.tuples(st.floats(20.0, 150.0), st.floats(1.0, 120.0)), max_size=2),
)
def test_each_message_is_in_the_piece_of_its_stamp(seed, delay, silences):
    random = np.random.default_rng(seed)
    steps = random.uniform(0.05, 0.15, 2000)
    t = np.cumsum(steps)
    for at, silence in silences:
        t = np.where(t > at, t + silence, t)
    arrivals = [(TDOAS, one) for one in t] + [("imu/data", one) for one in t + 0.01]
    arrivals.sort(key=lambda one: one[1] + random.uniform(0.0, delay))
    out = cut_all(PieceCutter(), arrivals)
    stamps = {name: [stamp(one) for topic, one in arrivals if topic == name] for name in STREAMS}
    first = stamp(t[0])
    assert [piece.number for piece in out] == list(range(len(out)))
    for piece in out:
        end = piece.first + PIECE
        assert ((piece.first - first) / PIECE).is_integer()
        for name, all_of in stamps.items():
            held = [one.t for one in piece.messages if one.topic == name]
            assert [one for one in held if piece.first <= one < end] == [
                one for one in all_of if piece.first <= one < end
            ]
    complete = {
        (one - first) // PIECE for one in stamps[TDOAS] if one < stamp(t[-1]) - PIECE - LATE
    }
    assert complete <= {(piece.first - first) / PIECE for piece in out}


def test_a_clock_that_goes_back_starts_a_new_piece():
    cutter = PieceCutter()
    t = np.arange(0.0, 60.0, 0.1)
    before = cut_all(cutter, [(TDOAS, one) for one in t + 1000.0])
    after = cut_all(cutter, [(TDOAS, one) for one in t])
    assert len(before) == len(after) == 1
    assert before[0].number < after[0].number
    assert after[0].first - EPOCH == pytest.approx(0.0, abs=0.2)
    assert max(one.t for one in after[0].messages) < EPOCH + 100.0


def test_a_wrong_stamp_is_no_end_of_a_piece():
    t = np.arange(0.0, 100.0, 0.1).tolist()
    arrivals = [(TDOAS, one) for one in t]
    arrivals.insert(100, (TDOAS, 5000.0))
    arrivals.insert(200, (TDOAS, -1000.0))
    out = cut_all(PieceCutter(), arrivals)
    assert [piece.first - EPOCH for piece in out] == pytest.approx([0.0, PIECE])


def test_a_message_without_a_stamp_is_left_out():
    cutter = PieceCutter()
    cutter.add(TDOAS, 0, b"\0" * 5)
    assert (cutter.left_out, len(cutter)) == (1, 0)


def test_an_imu_beside_a_silent_radio_takes_no_memory_and_stops_nothing(monkeypatch):
    monkeypatch.setattr(pieces, "MOST_BYTES", 100_000)
    cutter, most = PieceCutter(), 0
    for k in range(20_000):
        cutter.add("imu/data", k, message(0.01 * k))
        most = max(most, len(cutter))
    assert most < 6000 and cutter.left_out > 14_000
    out = cut_all(cutter, [(TDOAS, one) for one in np.arange(200.0, 300.0, 0.1)])
    assert len(out) == 2


def test_pieces_of_a_bag_are_the_pieces_of_its_flight(tmp_path):
    flight = fly(seed=5, duration=2.5 * PIECE, imu_rate=50.0, tdoa_rate=50.0)
    write_bag(flight, tmp_path / "bag")
    whole = read_bag(tmp_path / "bag", truth=False)
    cutter, found = PieceCutter(), []
    with open_bag(tmp_path / "bag") as reader:
        for connection, arrived, content in reader.messages(reader.connections):
            topic = connection.topic.lstrip("/")
            if topic in pieces.TOPICS:
                cutter.add(topic, arrived, bytes(content))
                found += cutter.pieces()
    assert len(found) == 2
    for number, (piece, expected) in enumerate(zip(found, in_pieces(whole))):
        piece.write(tmp_path / str(number))
        read = read_bag(tmp_path / str(number), anchors=flight.anchors, truth=False)
        part = cut(read, piece.number, piece.first)
        for name in ("tdoa", "imu"):
            one, other = getattr(part, name), getattr(expected, name)
            for field in vars(other):
                np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


def calibration(scale=1.0):
    """Return an EffectSet with positions, delays and their covariance."""
    ids = ANCHORS.ids.tolist()
    shifts = {f"{i}.{axis}": scale * 0.01 * (i + 1) for i in ids for axis in "xyz"}
    delays = {str(i): -scale * 0.02 * i for i in ids}
    keys = [("anchor_position", key) for key in shifts] + [("anchor_delay", key) for key in delays]
    effects = (
        TagLeverArm(values={"x": 0.1}),
        AnchorPosition(values=shifts),
        AnchorDelay(values=delays),
    )
    return EffectSet(effects, Covariance(tuple(keys), 1e-4 * np.eye(len(keys))))


def values(effects):
    return {
        (one.name, key): pytest.approx(value, abs=1e-9)
        for one in effects
        for key, value in one.values.items()
    }


def test_the_last_calibration_is_kept(tmp_path):
    base = EffectSet((TagLeverArm(values={"x": 0.2}), AnchorDelay(values={"0": 1.0})))
    assert last_kept(tmp_path / "kept", ANCHORS, base) == (0, base, 0.0)
    for number in range(1, 6):
        keep(tmp_path / "kept", number, ANCHORS, calibration(number))
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["3", "4", "5"]
    number, effects, age = last_kept(tmp_path / "kept", ANCHORS, base)
    expected = replace(calibration(5), effects=(base.effects[0], *calibration(5).effects[1:]))
    assert number == 5 and 0.0 <= age < 600.0 and values(effects) == values(expected)
    np.testing.assert_allclose(effects.covariance.matrix, expected.covariance.matrix)


def test_a_survey_that_is_made_anew_keeps_the_places(tmp_path):
    keep(tmp_path, 1, ANCHORS, calibration())
    moved = ANCHORS.at(ANCHORS.positions + [0.0, 0.5, 0.0])
    _, effects, _ = last_kept(tmp_path, moved, EffectSet())
    (before, after) = (
        next(one for one in of if isinstance(one, AnchorPosition)).values["2.y"]
        for of in (calibration(), effects)
    )
    assert after == pytest.approx(before - 0.5)


def test_half_written_calibrations_do_not_count(tmp_path):
    keep(tmp_path, 1, ANCHORS, calibration())
    os.makedirs(tmp_path / ".partial")
    (tmp_path / ".partial" / "anchors.yaml").write_text("anchors:")
    assert last_kept(tmp_path, ANCHORS, EffectSet())[0] == 1
    keep(tmp_path, 2, ANCHORS, calibration(2.0))
    assert last_kept(tmp_path, ANCHORS, EffectSet())[0] == 2


def test_calibrations_of_other_anchors_are_refused(tmp_path):
    keep(tmp_path, 1, ANCHORS, calibration())
    other = Anchors.from_positions(ANCHORS.positions[:4])
    with pytest.raises(InputError, match="is of anchors 0, 1, 2, 3, 4 .* of 0, 1, 2, 3 .* delete"):
        last_kept(tmp_path, other, EffectSet())
