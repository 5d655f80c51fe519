# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The frame of the ground truth, fitted jointly with the lever arm and delays."""

from dataclasses import replace
import json

from known_effects import sparse_flight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.diagnose import main
from uwb_tdoa_tools.diagnosis import frames
from uwb_tdoa_tools.scoring.evaluation import align_truth, transform_truth

TURN = Rotation.from_euler("ZYX", [30.0, -2.0, 3.0], degrees=True).as_matrix()
SHIFT = np.array([0.8, -0.5, 0.2])
DELAYS = {"0": 0.2, "3": -0.15, "5": 0.1, "6": -0.2}
ARM = {"x": 0.06, "y": -0.05}


def in_own_frame(flight):
    """The Flight with delays and a lever arm, and its ground truth in another frame."""
    flight = EFFECTS["anchor_delay"](DELAYS).inject(EFFECTS["tag_lever_arm"](ARM).inject(flight))
    back = TURN.T
    return replace(flight, truth=transform_truth(flight.truth, back, -back @ SHIFT))


@pytest.fixture(scope="module")
def recorded():
    return [in_own_frame(sparse_flight(seed, 40.0)) for seed in (100, 101)]


def angle(turn, other=TURN):
    return np.rad2deg(Rotation.from_matrix(turn @ other.T).magnitude())


def start(degrees, shift):
    """A transform that is off, as one to a biased path."""
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ TURN, SHIFT + shift


@pytest.mark.quick
def test_the_frame_the_lever_arm_and_delays_are_found_together(recorded):
    found = frames.fitted(recorded, *start(4.0, 0.2), EffectSet())
    assert angle(found.turn) < 0.5
    p = recorded[0].truth.p
    off = (p @ found.turn.T + found.shift - p @ TURN.T - SHIFT).mean(axis=0)
    assert (np.abs(off) < 3.0 * np.array([found.std[axis] for axis in "xyz"])).all()
    assert all(abs(found.values[f"lever.{axis}"] - ARM[axis]) < 0.01 for axis in "xy")
    delays = np.array([found.values[f"delay.{k}"] - DELAYS.get(str(k), 0.0) for k in range(8)])
    assert np.std(delays) < 0.05


@pytest.mark.quick
def test_known_effects_are_no_delays(recorded):
    known = EffectSet((EFFECTS["anchor_delay"](DELAYS),))
    found = frames.fitted(recorded, *start(0.0, 0.0), known)
    assert np.std([found.values[f"delay.{k}"] for k in range(8)]) < 0.05


@pytest.mark.quick
def test_what_flights_do_not_determine_is_said(recorded):
    """A flight that turns about the vertical alone: the height of the arm is that of the frame."""
    level = [
        replace(one, truth=replace(one.truth, q=np.tile([0.0, 0.0, 0.0, 1.0], (len(one.truth), 1))))
        for one in recorded
    ]
    found = frames.fitted(level, *start(0.0, 0.0), EffectSet())
    assert {"z", "lever.x", "lever.y", "lever.z"} <= set(found.undetermined)
    assert "lever.z" in found.in_words()
    found = frames.fitted(recorded, *start(0.0, 0.0), EffectSet())
    assert "z" in found.undetermined and not {"lever.x", "lever.y"} & set(found.undetermined)
    bare = [
        replace(one, truth=replace(one.truth, q=np.full_like(one.truth.q, np.nan)))
        for one in recorded
    ]
    found = frames.fitted(bare, *start(0.0, 0.0), EffectSet())
    assert "lever.x" not in found.values and "lever.x" in found.undetermined
    assert angle(found.turn) < 1.0


@pytest.mark.quick
def test_only_flights_of_the_same_frame_are_moved_by_it(recorded):
    """Alignments that are biased apart are one frame. A path that was not moved stays, and one in
    a third frame keeps its alignment.
    """
    first, second = recorded
    aligned = [
        replace(one, truth=transform_truth(one.truth, *start(*biased)))
        for one, biased in ((first, (4.0, 0.2)), (second, (-4.0, -0.2)))
    ]
    third = replace(first, truth=transform_truth(first.truth, TURN, np.array([3.0, 0.0, 0.0])))
    elsewhere = replace(third, truth=transform_truth(third.truth, TURN.T, SHIFT))
    (moved, other, apart, still), found = frames.moved_together(
        [first, second, third, second], [*aligned, elsewhere, second], 3, EffectSet()
    )
    assert apart is elsewhere and still is second
    assert found.flights == (first.name, second.name)
    for one, of in ((moved, first), (other, second)):
        np.testing.assert_allclose(one.truth.p, of.truth.p @ found.turn.T + found.shift)
    assert angle(found.turn) < 0.5
    unmoved, nothing = frames.moved_together(recorded, recorded, 2, EffectSet())
    assert nothing is None and unmoved == recorded


@pytest.mark.quick
def test_the_lines_apply_the_file(recorded, tmp_path, monkeypatch):
    found = frames.fitted(recorded[:1], *start(0.0, 0.0), EffectSet())
    monkeypatch.chdir(tmp_path)
    ((name, text),) = found.files().items()
    (tmp_path / name).write_text(text)
    known = {"np": np, "p_truth": recorded[0].truth.p}
    exec("\n".join(frames.TO_APPLY), known)
    expected = transform_truth(recorded[0].truth, found.turn, found.shift)
    np.testing.assert_allclose(known["p_survey"], expected.p, atol=1e-6)


@pytest.mark.slow
def test_diagnose_writes_the_transform(recorded, tmp_path, capsys):
    """It is better than an alignment with the biased estimate, and the report has it."""
    flight = recorded[0]
    write_bag(flight, tmp_path / "arm")
    assert main([str(tmp_path / "arm"), "--out", str(tmp_path / "out")]) == 0
    said = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["truth_transform"]
    turn = np.array(said["matrix"])[:3, :3]
    np.testing.assert_allclose(
        np.loadtxt(tmp_path / "out" / frames.FILE), said["matrix"], atol=1e-8
    )
    quaternion = Rotation.from_quat(said["quaternion"]).as_matrix()
    np.testing.assert_allclose(quaternion, turn, atol=1e-9)
    (aligned, _) = align_truth(flight)
    first = Rotation.from_quat(aligned.truth.q[:1]) * Rotation.from_quat(flight.truth.q[:1]).inv()
    assert angle(turn) < min(0.8, angle(first.as_matrix()[0]))
    shown = capsys.readouterr().out
    assert "np.loadtxt" in " ".join(shown.split()) and frames.FILE in shown
