# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

from known_effects import effect_of, late_flight, marks_of, sparse_flight
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_bias.effects.stamps import TruthTimeOffset
from uwb_tdoa_tools.diagnosis import diagnose, output
from uwb_tdoa_tools.diagnosis.references import (
    REFERENCES,
    GroundTruth,
    Heights,
    Marks,
    Nothing,
)
from uwb_tdoa_tools.scoring.evaluation import evaluate

NONSENSE = np.array([100.0, -50.0, 7.0])


@pytest.fixture(scope="module")
def flight():
    return effect_of("anchor_delay", True, 4).inject(sparse_flight(100, 30.0))


@pytest.fixture(scope="module")
def aided():
    return sparse_flight(100, 30.0, aided=True)


def with_wrong_truth(flight):
    truth = flight.truth
    return replace(
        flight, truth=replace(truth, p=truth.p[::-1] + NONSENSE, q=np.roll(truth.q, 1, axis=1))
    )


def test_what_is_told_to_do_without_the_truth_has_none_to_read(flight):
    prepared = Nothing().prepare(
        replace(flight, extra={"pose_truth": {"t": np.zeros(3)}, "battery": {"t": np.zeros(3)}})
    )
    assert prepared.truth is None and list(prepared.extra) == ["battery"]


@pytest.mark.slow
def test_without_truth_a_wrong_one_changes_nothing(diagnosed_without_truth):
    """The flight of the shared diagnosis has a ground truth."""
    wrong = diagnose([with_wrong_truth(late_flight())], reference=Nothing())
    told, expected = map(output.as_json, (wrong, diagnosed_without_truth))
    assert told == expected and told["after"]["pooled"]["rmse_3d"] is None


@pytest.mark.parametrize("reference", [Nothing, Heights])
def test_what_a_reference_does_without_is_taken_out_first(aided, reference):
    prepared = [
        reference().prepare(each)
        for each in (aided, with_wrong_truth(aided), replace(aided, truth=None))
    ]
    if reference is Nothing:
        assert [each.truth for each in prepared] == [None] * 3
    else:
        for each in prepared:
            np.testing.assert_array_equal(each.truth.p, prepared[0].truth.p)
            assert each.height is None


@pytest.mark.parametrize("name", sorted(set(REFERENCES) - {"truth"}))
def test_only_a_recorded_ground_truth_is_moved_to_another_clock_or_frame(flight, name):
    assert REFERENCES[name]().settled(flight, EffectSet()) == (flight, ())


def test_a_path_by_heights_is_at_the_right_height(aided):
    path = (
        Heights()
        .prepare(
            EFFECTS["anchor_delay"]({"0": 0.5, "5": -0.3}).inject(aided, np.random.default_rng(0))
        )
        .truth
    )
    z = np.interp(path.t, aided.truth.t, aided.truth.p[:, 2])
    flown = z > 0.5
    assert np.sqrt(np.mean((path.p[flown, 2] - z[flown]) ** 2)) < 0.03


def test_a_flight_without_a_range_finder_cannot_be_compared_with_heights(flight):
    with pytest.raises(InputError, match="holds no height.*--no-truth"):
        diagnose([flight], reference=Heights())


@pytest.mark.slow
def test_marks_tell_which_anchor_is_late_without_the_truth():
    flight = effect_of("anchor_delay", True, 4).inject(sparse_flight(100, 40.0))
    marks = marks_of(flight, 6, np.random.default_rng(0))
    found = diagnose([with_wrong_truth(flight)], reference=Marks(None, marks))
    assert output.as_json(found)["rests_on"].startswith("places measured")
    assert {"anchor_position", "anchor_delay"} == {effect.name for effect in found.effects.effects}
    assert found.effects.covariance.matrix.shape == (32, 32)
    after, before = (
        evaluate(flight, effects=effects)[0].row()["rmse_3d"]
        for effects in (found.effects, EffectSet())
    )
    assert after < 0.5 * before


def test_the_truth_that_is_missing_is_asked_for(flight):
    with pytest.raises(InputError, match="holds no ground truth.*--no-truth"):
        diagnose([replace(flight, truth=None)])


def test_residuals_are_taken_where_the_corrected_stamps_of_the_truth_say(flight):
    late = TruthTimeOffset({"offset": 0.1})
    poses = GroundTruth().view(late.inject(flight), EffectSet((late,))).poses
    np.testing.assert_allclose(poses.t, flight.truth.t)
