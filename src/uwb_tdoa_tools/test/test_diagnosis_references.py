from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.truth_time_offset import TruthTimeOffset
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.references import GroundTruth, Nothing
from uwb_tdoa_tools.studies.diagnosis.bank import clean_flight, effect_of

NONSENSE = np.array([100.0, -50.0, 7.0])


@pytest.fixture(scope="module")
def flight():
    return effect_of("anchor_delay", True, 4).inject(clean_flight(100, 30.0))


def with_wrong_truth(flight):
    truth = flight.truth
    return replace(flight, truth=replace(truth, p=truth.p[::-1] + NONSENSE, q=np.roll(truth.q, 1, axis=1)))


def test_what_is_told_to_do_without_the_truth_has_none_to_read(flight):
    prepared = Nothing().prepare(replace(flight, extra={"pose_truth": {"t": np.zeros(3)}, "battery": {"t": np.zeros(3)}}))
    assert prepared.truth is None and list(prepared.extra) == ["battery"]


@pytest.mark.slow
def test_without_truth_a_wrong_one_changes_nothing(flight):
    other = effect_of("anchor_delay", True, 4).inject(clean_flight(101, 30.0))
    cases = [
        diagnose([flight], [other], reference=Nothing()),
        diagnose([with_wrong_truth(flight)], [with_wrong_truth(other)], reference=Nothing()),
        diagnose([replace(flight, truth=None)], [replace(other, truth=None)], reference=Nothing()),
    ]
    contents = [case.as_json() for case in cases]
    assert contents[0] == contents[1] == contents[2]
    assert contents[0]["after"]["pooled"]["rmse_3d"] is None


def test_the_truth_that_is_missing_is_asked_for(flight):
    with pytest.raises(InputError, match="holds no ground truth.*--no-truth"):
        diagnose([replace(flight, truth=None)])


def test_residuals_are_taken_where_the_corrected_stamps_of_the_truth_say(flight):
    late = TruthTimeOffset({"offset": 0.1})
    poses = GroundTruth().view(late.inject(flight), EffectSet((late,))).poses
    np.testing.assert_allclose(poses.t, flight.truth.t)
