from dataclasses import replace

import numpy as np
import pytest
from training_flights import flight, without_attitude

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet, TagLeverArm
from uwb_tdoa_tools.training.labels import (
    labels,
    split,
    thinned,
    white_noise,
)

PERFECT = {"noise_std": 0.0, "bias": False, "outlier_probability": 0.0}


@pytest.fixture(scope="module")
def one():
    return flight()


def changed(one, **columns):
    return replace(one, tdoa=replace(one.tdoa, **columns))


def test_labels_are_measured_minus_geometry_at_the_true_pose(one):
    found = labels(one)
    rows = np.searchsorted(one.tdoa.t, found.samples.t)
    at = np.stack(
        [np.interp(found.samples.t, one.truth.t, one.truth.p[:, k]) for k in range(3)], axis=1
    )
    expected = one.tdoa.d[rows] - tdoa(at, found.samples.position_a, found.samples.position_b)
    np.testing.assert_allclose(found.error, expected, atol=1e-12)
    assert np.abs(found.error).max() <= 1.0 and found.samples.p[:, 2].min() > 0.3
    assert 0.0 < found.sample_weight < 0.1


def test_labels_without_effects_that_are_known():
    effects = EffectSet((AnchorDelay({"3": 0.2}), TagLeverArm({"z": 0.1})))
    late = flight(**PERFECT)
    for effect in effects.effects:
        late = effect.inject(late)
    assert np.sqrt(np.mean(labels(late).error ** 2)) > 0.05
    with pytest.raises(InputError, match="all labels are zero"):
        labels(late, effects)


def test_without_attitude_the_vehicle_is_level(one):
    found = labels(without_attitude(one))
    assert (found.samples.q == [0.0, 0.0, 0.0, 1.0]).all()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda one: replace(one, truth=None), "holds no ground truth"),
        (
            lambda one: changed(one, a=np.where(one.tdoa.a == 2, 99, one.tdoa.a)),
            "anchor 99 is heard but not in",
        ),
        (
            lambda one: changed(one, d=np.where(one.tdoa.a == 2, np.nan, one.tdoa.d)),
            r"\d+ TDOAs are not finite",
        ),
        (lambda one: changed(one, d=one.tdoa.d + 30.0), "only 0 TDOAs are right to 1 m"),
        (lambda one: replace(one, truth=replace(one.truth, p=one.truth.p * np.nan)), "truth"),
    ],
)
def test_says_what_it_cannot_learn_from(one, spoil, message):
    with pytest.raises(InputError, match=message):
        labels(spoil(one))


def test_all_zero_labels_are_an_error():
    with pytest.raises(InputError, match="all labels are zero"):
        labels(flight(**PERFECT))


def test_split_is_by_flight_and_by_seed():
    names = [f"flight {k}" for k in range(10)]
    training, validation = split(names, 3)
    assert sorted([*training, *validation]) == names and len(validation) == 2
    assert split(names, 3) == (training, validation) and any(
        split(names, seed)[1] != validation for seed in range(9)
    )
    assert split(names, 0, ["flight 4"]) == (
        [name for name in names if name != "flight 4"],
        ["flight 4"],
    )


@pytest.mark.parametrize(
    ("names", "validation", "message"),
    [
        (["a"], None, "1 is too few"),
        (["a", "b", "a"], None, "a is there twice"),
        (["a", "b"], ["c"], "c is not one of the flights"),
        (["a", "b"], ["a", "b"], "leaves no flight to train"),
    ],
)
def test_split_says_what_is_wrong(names, validation, message):
    with pytest.raises(InputError, match=message):
        split(names, 0, validation)


def test_thinned_samples_count_for_as_much_together(one):
    (few,) = thinned([labels(one)], 0.05, np.random.default_rng(0))
    assert len(few) < 0.2 * len(labels(one)) and (np.diff(few.samples.t) >= 0.0).all()
    assert few.sample_weight * len(few) == pytest.approx(
        labels(one).sample_weight * len(labels(one))
    )


def test_white_noise_is_what_changes_from_one_tdoa_to_the_next(one):
    assert white_noise([labels(one)]) == pytest.approx(0.06, rel=0.1)
